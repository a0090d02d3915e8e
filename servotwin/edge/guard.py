"""Decides whether an update is applied: a pure function, so that nothing unsafe depends on who calls it.

Several updates may be in flight. Each names the version it replaces, and only one that replaces the version in force
is applied (compare-and-swap); so of two made on the same base the first to arrive wins, and the other is refused.
Every receipt, every window and every hello names the version in force. The twin keeps only its newest estimate as its
goal and, when a receipt says that the goal was refused for its base or version, sends it again on the base the receipt
names. The newest data therefore win in the end, and no update is ever applied on an assumption that does not hold.
A repeated update gets its first answer again, so that a lost receipt costs nothing.
"""

from dataclasses import dataclass
from math import inf

from servotwin.errors import InvalidInput
from servotwin.messages import Reason, Receipt, Update


@dataclass(frozen=True, slots=True)
class Limits:
    """What an update must respect.

    Parameters
    ----------
    minimum, maximum : float
        Tolerance, m.
    max_step : float
        Largest change of the tolerance by one update, m.
    lifetime_s : float
        The data may be this old when the update is applied, whatever the update itself says.
    interval_s : float
        Shortest time between two applied updates.
    """

    minimum: float = 0.0
    maximum: float = inf
    max_step: float = inf
    lifetime_s: float = inf
    interval_s: float = 0.0

    def __post_init__(self) -> None:
        if not 0.0 <= self.minimum <= self.maximum or self.minimum == inf:
            raise InvalidInput(
                f"limits on the tolerance {self.minimum!r} m to {self.maximum!r} m: must be 0 or more and in order"
            )
        for name in ("max_step", "lifetime_s"):
            if not getattr(self, name) > 0.0:
                raise InvalidInput(f"limits {name} = {getattr(self, name)!r}: must be greater than 0")
        if not 0.0 <= self.interval_s < inf:
            raise InvalidInput(f"limits interval_s = {self.interval_s!r} s: must be at least 0")


@dataclass(frozen=True, slots=True)
class Parameters:
    """What the controller runs on.

    Parameters
    ----------
    version : int
        0: as configured, no update yet.
    tolerance : float
        Dead-zone half-width, m; 0: no dead zone.
    data_time : float
        Sample time of the data they stand on, s; -inf: none of this boot.
    window : (str, int), optional
        (boot, sequence) of the window they stand on.
    sample : int
        First sample under them.
    """

    version: int = 0
    tolerance: float = 0.0
    data_time: float = -inf
    window: tuple[str, int] | None = None
    sample: int = 0

    def __post_init__(self) -> None:
        if not 0.0 <= self.tolerance < inf:
            raise InvalidInput(f"tolerance in force = {self.tolerance!r} m: must be finite and at least 0")
        if self.version < 0:
            raise InvalidInput(f"version in force = {self.version!r}: must be at least 0")


@dataclass(frozen=True, slots=True)
class Instant:
    """Which edge, and its next sample."""

    servo: str
    boot: str
    sample: int
    rate: float

    @property
    def time(self) -> float:
        """Sample time, s."""
        return self.sample / self.rate


def decide(update: Update, current: Parameters, limits: Limits, here: Instant) -> tuple[Parameters, Receipt]:
    """Apply an update at the next sample, or refuse it.

    Returns
    -------
    parameters : Parameters
        In force from the next sample on.
    receipt : Receipt
        A repetition of the update in force gets the receipt it got first.
    """
    repeated = update.version == current.version and update.window == current.window and update.servo == here.servo
    if repeated:
        return current, _receipt(update, Reason.APPLIED, current.sample, current, here)
    reason = judge(update, current, limits, here)
    if reason is Reason.APPLIED:
        current = Parameters(update.version, update.tolerance, update.data_time, update.window, here.sample)
    return current, _receipt(update, reason, here.sample, current, here)


def judge(update: Update, current: Parameters, limits: Limits, here: Instant) -> Reason:
    """Why an update is refused, or `Reason.APPLIED`."""
    since = here.sample - current.sample
    checks = (
        (update.servo == here.servo, Reason.WRONG_SERVO),
        (update.window[0] == here.boot, Reason.OTHER_BOOT),
        (update.version > current.version, Reason.OLD_VERSION),
        (update.data_time > current.data_time, Reason.OLD_DATA),
        (update.base_version == current.version, Reason.BASE_MISMATCH),
        (update.data_time <= here.time, Reason.FUTURE_DATA),
        (here.time < update.not_after and here.time - update.data_time <= limits.lifetime_s, Reason.EXPIRED),
        (limits.minimum <= update.tolerance <= limits.maximum, Reason.OUT_OF_BOUNDS),
        (abs(update.tolerance - current.tolerance) <= limits.max_step, Reason.STEP_TOO_LARGE),
        (current.window is None or since >= limits.interval_s * here.rate, Reason.TOO_SOON),
    )
    return next((reason for passed, reason in checks if not passed), Reason.APPLIED)


def _receipt(update: Update, reason: Reason, sample: int, current: Parameters, here: Instant) -> Receipt:
    applied = reason is Reason.APPLIED
    return Receipt(here.servo, update.version, applied, sample, reason, current.version, here.boot)
