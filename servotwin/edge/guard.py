"""Guard: decides whether an update may be applied, within its limits. Pure: nothing unsafe depends on a caller.

Several updates may be in flight. Each names the version it replaces, and only one that replaces the version in force
is applied (compare-and-swap); so of two made on the same base the first to arrive wins, and the other is refused.
Every receipt, every window and every hello names the version in force. The twin has only its newest estimate as its
goal and, when a receipt says that the goal was refused for its base or version, sends it again on the base the receipt
names. The newest data therefore win in the end, and no update is ever applied on an assumption that does not hold.
A repeated update gets its first answer again, so that a lost receipt costs nothing. `servotwin.edge.supervisor` chooses
the instant at which an admissible update is applied.
"""

from dataclasses import dataclass
from math import inf
from typing import Annotated

from servotwin.config.keys import check, key, settings
from servotwin.edge.parameters import Parameters
from servotwin.errors import InvalidInput
from servotwin.messages import KNOWN_FIELDS, AnyGains, CascadeGains, Gains, LinearGains, Reason, Receipt, Update

# A law whose gain is scaled and whose integral gain is not has its own integral gain but for rounding.
_ROUNDED = 1.0 + 1e-9


@settings("limits")
@dataclass(frozen=True, slots=True)
class Limits:
    """Limits that an update must respect.

    Where a limit on the tolerance is given in mm and in m, the one in mm counts.
    """

    minimum: Annotated[float, key("minimum_m", "minimum_mm", minimum=0.0, help="Smallest tolerance.")] = 0.0
    maximum: Annotated[
        float,
        key("maximum_m", "maximum_mm", minimum=0.0, infinite=True, help="Largest tolerance."),
    ] = inf
    max_step: Annotated[
        float,
        key("max_step_m", "max_step_mm", above=0.0, infinite=True, help="Largest change of it by one update."),
    ] = inf
    lifetime_s: Annotated[
        float,
        key(
            above=0.0,
            infinite=True,
            help="Largest age of the data when the update is applied, whatever the update itself says.",
        ),
    ] = inf
    interval_s: Annotated[float, key(minimum=0.0, help="Shortest time between two applied updates.")] = 0.0
    max_rate: Annotated[
        float,
        key(
            "max_rate_m_per_s",
            "max_rate_mm_per_s",
            above=0.0,
            infinite=True,
            help="Largest change of the tolerance per second since the last update.",
        ),
    ] = inf
    gain_factor: Annotated[
        float,
        key(
            minimum=1.0,
            infinite=True,
            help="Kp, Kd and Tf stay within this factor of the servo's own, either way; `leave` from above. The "
            "velocity feedforward answers a step of the reference by at most so many times the answer of the own Kp. "
            "Of a cascade position_gain, velocity_gain and speed_filter stay within it, and the acceleration "
            "feedforward from above; of a linear law its gain.",
        ),
    ] = 4.0
    integral_factor: Annotated[
        float,
        key(
            minimum=0.0,
            infinite=True,
            help="Largest Ki, as a multiple of the servo's own: integral action is what makes a loop with a gap cycle. "
            "0: none. Of a cascade velocity_gain / integral_time, of a linear law gain integral_share.",
        ),
    ] = 1.0
    gain_step: Annotated[
        float,
        key(
            "gain_step_factor",
            minimum=1.0,
            infinite=True,
            help="Largest factor by which one update may change a gain. Ki may fall at once; a gain counts as at least "
            "the box's lower edge, so that Ki can leave zero.",
        ),
    ] = inf
    gain_rate: Annotated[
        float,
        key(
            "gain_factor_per_s",
            minimum=1.0,
            infinite=True,
            help="Largest factor by which a gain may change per second since the last update.",
        ),
    ] = inf
    feedforward: Annotated[
        float,
        key(
            "feedforward_v",
            minimum=0.0,
            infinite=True,
            help="Largest feedforward, and largest friction feedforward, either sign.",
        ),
    ] = 0.25
    notch_min_hz: Annotated[float, key(minimum=0.0, help="Least centre of a notch.")] = 0.0
    notch_max_hz: Annotated[
        float, key(minimum=0.0, infinite=True, help="Largest centre of a notch; 0: updates set none.")
    ] = 0.0
    notch_damping: Annotated[
        float,
        key(
            "notch_max_damping",
            above=0.0,
            maximum=1.0,
            help="Largest damping ratio of a notch's poles: a wide one takes phase from the loop far below its centre.",
        ),
    ] = 0.5
    patience_s: Annotated[
        float,
        key(
            minimum=0.0,
            help="Longest time that an update waits for an instant at which the change of the dead zone neither opens "
            "nor closes the loop; after that it is applied wherever the error is. 0: at once.",
        ),
    ] = 0.0

    def __post_init__(self) -> None:
        check(self)
        if not self.minimum <= self.maximum:
            raise InvalidInput(f"limits on the tolerance {self.minimum!r} m to {self.maximum!r} m: must be in order")
        if self.notch_max_hz and not self.notch_min_hz <= self.notch_max_hz:
            raise InvalidInput(
                f"limits on a notch {self.notch_min_hz!r} Hz to {self.notch_max_hz!r} Hz: must be in order"
            )

    def allows_tolerance(self, tolerance: float) -> bool:
        """True where a tolerance (m) is in bounds."""
        return self.minimum <= tolerance <= self.maximum

    def allows_tolerance_step(self, old: float, new: float, since: float) -> bool:
        """True where the tolerance (m) may change from old to new, `since` seconds after the last change."""
        return abs(new - old) <= self.max_step and (self.max_rate == inf or abs(new - old) <= self.max_rate * since)

    def allows_gains(self, gains: AnyGains, own: AnyGains) -> bool:
        """True where gains lie in the box around the servo's own, which must be those of a law of the same kind."""
        if type(gains) is not type(own):
            return False
        scaled = all(self._in_box(getattr(gains, name), getattr(own, name)) for name in gains.scaled)
        integral = self._integral_in_box(getattr(gains, gains.integral), getattr(own, own.integral))
        fed = max(abs(getattr(gains, name)) for name in gains.fed) <= self.feedforward
        ahead = self._allows_motion(gains, own) and self._allows_notch(gains, own)
        return scaled and integral and gains.leave <= _times(self.gain_factor, own.leave) and fed and ahead

    def _allows_motion(self, gains: AnyGains, own: AnyGains) -> bool:
        """True where the feedforwards of the reference's motion are in bounds."""
        if isinstance(gains, Gains) and isinstance(own, Gains):
            kick = abs(gains.velocity_feedforward) <= _times(self.gain_factor, abs(own.Kp)) * gains.velocity_time
            return kick or gains.velocity_feedforward == 0.0
        if isinstance(gains, CascadeGains) and isinstance(own, CascadeGains):
            # All of the reference's speed is fed forward by a share of one; more would overtake it.
            speed = gains.velocity_feedforward <= max(1.0, own.velocity_feedforward)
            return speed and gains.acceleration_feedforward <= _times(self.gain_factor, own.acceleration_feedforward)
        return True

    def _allows_notch(self, gains: AnyGains, own: AnyGains) -> bool:
        """True where a notch is in bounds, or the servo's own."""
        if isinstance(gains, LinearGains) or isinstance(own, LinearGains):
            return True
        if all(getattr(gains, name) == getattr(own, name) for name in ("notch_hz", "notch_damping", "notch_depth")):
            return True
        within = self.notch_min_hz <= gains.notch_hz <= self.notch_max_hz
        return gains.notch_hz == 0.0 or (within and gains.notch_damping <= self.notch_damping)

    def allows_gains_step(self, old: AnyGains, new: AnyGains, own: AnyGains, since: float) -> bool:
        """True where gains may change from old to new, `since` seconds after the last change."""
        factor = self.gain_step if self.gain_rate == inf else min(self.gain_step, _power(self.gain_rate, since))
        if factor == inf:
            return True
        return all(
            _in_step(
                getattr(old, name),
                getattr(new, name),
                abs(getattr(own, name)) / self.gain_factor,
                factor,
                falls_at_once=name == new.integral,
            )
            for name in (*new.scaled, new.integral)
        )

    def _integral_in_box(self, value: float, own: float) -> bool:
        return value * own >= 0.0 and abs(value) <= _times(self.integral_factor, abs(own)) * _ROUNDED

    def _in_box(self, value: float, own: float) -> bool:
        raised, highest = _times(self.gain_factor, abs(value)), _times(self.gain_factor * self.gain_factor, abs(own))
        return value * own >= 0.0 and abs(own) <= raised <= highest


def _times(factor: float, size: float) -> float:
    """Product of a factor, which may be infinite, and a size: of zero it is zero."""
    return factor * size if size else 0.0


def _in_step(old: float, new: float, smallest: float, factor: float, falls_at_once: bool) -> bool:
    rises_little = abs(new) <= factor * max(abs(old), smallest)
    return rises_little and (falls_at_once or abs(new) * factor >= abs(old))


def _power(base: float, exponent: float) -> float:
    try:
        return base**exponent
    # So long after the last update that any step is allowed.
    except OverflowError:
        return inf


@dataclass(frozen=True, slots=True)
class Instant:
    """An edge (servo, boot) and its next sample, at `rate` Hz."""

    servo: str
    boot: str
    sample: int
    rate: float

    @property
    def time(self) -> float:
        """Sample time, s."""
        return self.sample / self.rate


def is_repeat(update: Update, current: Parameters, here: Instant) -> bool:
    """True where an update is the one in force, sent again."""
    return update.version == current.version and update.window == current.window and update.servo == here.servo


def updated_parameters(update: Update, current: Parameters, sample: int) -> Parameters:
    """Make the parameters in force from `sample` on; an update without gains leaves the gains as they are."""
    gains = current.setting.gains if update.setting.gains is None else update.setting.gains
    setting = update.setting.with_gains(gains)
    return Parameters(update.version, setting, update.data_time, update.window, sample, gap=update.gap)


def judge(update: Update, current: Parameters, limits: Limits, here: Instant, own: AnyGains | None = None) -> Reason:
    """Return the reason for which an update is refused, or `Reason.APPLIED`.

    Parameters
    ----------
    update : Update
    current : Parameters
        In force.
    limits : Limits
    here : Instant
    own : gains, optional
        The servo's own gains; None: the edge changes no gains.
    """
    samples = here.sample - current.sample
    since = samples / here.rate
    old, new = current.setting.tolerance, update.setting.tolerance
    # The first failed check is the reason: servo, boot and versions before limits, which only a current update must
    # meet.
    checks = (
        (update.servo == here.servo, Reason.WRONG_SERVO),
        (update.window[0] == here.boot, Reason.OTHER_BOOT),
        # The number of a fallback may be that of an update that was on its way: only base and data tell them apart.
        (not (current.chosen_by_edge and _is_older(update, current)), Reason.FELL_BACK),
        (update.version > current.version, Reason.OLD_VERSION),
        (KNOWN_FIELDS.issuperset(update.needs), Reason.NOT_KNOWN),
        (update.data_time > current.data_time, Reason.OLD_DATA),
        (update.data_time <= here.time, Reason.FUTURE_DATA),
        # Before the base: an update that is too late fails for that, whatever else was applied meanwhile, and the twin
        # would send one with another base again.
        (here.time < update.not_after and here.time - update.data_time <= limits.lifetime_s, Reason.EXPIRED),
        (update.base_version == current.version, Reason.BASE_MISMATCH),
        (limits.allows_tolerance(new), Reason.OUT_OF_BOUNDS),
        (limits.allows_tolerance_step(old, new, since), Reason.STEP_TOO_LARGE),
        # Without a window the parameters are those of the start or a fallback, from which no interval counts.
        (current.window is None or samples >= limits.interval_s * here.rate, Reason.TOO_SOON),
        (here.sample >= current.not_before, Reason.AFTER_FALLBACK),
    )
    reason = next((reason for passed, reason in checks if not passed), Reason.APPLIED)
    if reason is not Reason.APPLIED or update.setting.gains is None:
        return reason
    return Reason.NO_GAINS if own is None else _judge_gains(update.setting.gains, current, limits, own, since)


def _is_older(update: Update, current: Parameters) -> bool:
    """True for an update that replaces, or whose data come from, what was before the parameters in force."""
    return update.base_version < current.version or update.data_time <= current.data_time


def _judge_gains(gains: AnyGains, current: Parameters, limits: Limits, own: AnyGains, since: float) -> Reason:
    if not limits.allows_gains(gains, own):
        return Reason.GAINS_OUT_OF_BOUNDS
    if not limits.allows_gains_step(current.setting.gains or own, gains, own, since):
        return Reason.GAINS_STEP_TOO_LARGE
    return Reason.APPLIED


def receipt(update: Update, reason: Reason, sample: int, current: Parameters, here: Instant) -> Receipt:
    """Make the receipt of a decision; `current` is in force after it."""
    is_applied = reason is Reason.APPLIED
    return Receipt(here.servo, update.version, is_applied, sample, reason, current.version, here.boot)
