"""The information model: one object with these variables, in one namespace (docs/howto/write-a-drive.md).

Sample k of every signal is at index k modulo the arrays' length. The drive writes samples first and raises `Count`
afterwards, by at most `Block` samples at a time; so a reader of `Count`, the arrays, and `Count` again knows which
samples were not overwritten. The client writes the parameters first, then `Commit`: the drive reads them when `Commit`
changes, accepts all or none, and reports that in `Committed` and `Refused`.
"""

NAMESPACE = "urn:servotwin:drive:1"
OBJECT = "Drive"

FIXED = ("Rate", "Block")
"""Double, Hz; UInt32."""

SIGNALS = ("Reference", "ThetaM", "Position", "Voltage")
"""Double[]: m, rad, m, V."""

STATE = ("Machine", "Count", *SIGNALS, "Version", "Since", "Count")
"""String, the name of the machine's present run; UInt64, samples taken in it; the arrays; Int64, version in force, and
UInt64, the first sample under it; the count again. Read in this order in one request."""

GAINS = ("Kp", "Ki", "Kd", "Tf", "Enter", "Leave", "Feedforward")
"""Double: V/m, V/(m s), V s/m, s, tolerances, tolerances, V."""

PARAMETERS = ("NewVersion", "Tolerance", "SetGains", *GAINS)
"""Int64; Double, m; Boolean, whether the gains count too; the gains."""

INTEGRAL_ONLY = "IntegralOnly"
"""Boolean, whether the dead zone stops the integral only; a drive that lacks it cannot do that."""

VELOCITY = ("VelocityFeedforward", "VelocityTime")
"""Double: V s/m, s; a drive that lacks them has no velocity feedforward."""

FRICTION = "FrictionFeedforward"
"""Double, V; a drive that lacks it has no friction feedforward."""

NOTCH = ("NotchHz", "NotchDamping", "NotchDepth")
"""Double: Hz, ratio, gain at the centre; a drive that lacks them has no notch."""

OPTIONAL = (INTEGRAL_ONLY, *VELOCITY, FRICTION, *NOTCH)
"""Gains that not every drive has."""

COMMIT = "Commit"
"""UInt32, another number each time."""

DECISION = ("Committed", "Refused")
"""UInt32, the last `Commit` that was decided; String, why not, or empty."""

EVERY = tuple(dict.fromkeys((*FIXED, *STATE, *PARAMETERS, COMMIT, *DECISION)))
