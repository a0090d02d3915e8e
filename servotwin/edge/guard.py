"""Guard: decides whether an update may be applied, within its limits. Pure: nothing unsafe depends on a caller.

Several updates may be in flight. Each names the version it replaces, and only one that replaces the version in force
is applied (compare-and-swap); so of two made on the same base the first to arrive wins, and the other is refused.
Every receipt, every window and every hello names the version in force. The twin has only its newest estimate as its
goal and, when a receipt says that the goal was refused for its base or version, sends it again on the base the receipt
names. The newest data therefore win in the end, and no update is ever applied on an assumption that does not hold.
A repeated update gets its first answer again, so that a lost receipt costs nothing. `servotwin.edge.supervisor` chooses
the instant at which an admissible update is applied.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from math import inf, nextafter
from typing import Annotated, NamedTuple, TypeAlias

from servotwin.config.contradiction import contradiction
from servotwin.config.keys import Key, check, key, settings
from servotwin.edge.parameters import Parameters
from servotwin.messages import KNOWN_FIELDS, AnyGains, CascadeGains, Gains, LinearGains, Reason, Receipt, Update

# Gains that are scaled, and written to a file in other units, are those of the box's corners but for rounding.
_ROUNDING = 1e-9
Range: TypeAlias = tuple[float, float]


class Bounded(NamedTuple):
    """A number of a law, by name, and the least and greatest value that an update may give it."""

    name: str
    value: float
    least: float
    greatest: float

    @property
    def is_allowed(self) -> bool:
        """True where the value is in bounds, but for rounding."""
        below, above = self.least - _ROUNDING * abs(self.least), self.greatest + _ROUNDING * abs(self.greatest)
        return below <= self.value <= above


def _range_key(name: str, of: str) -> Key:
    """Key of the range of a gain."""
    words = f"Lowest and highest {of}, on the own one's side of zero; where absent within gain_factor of the own one."
    return key(name, infinite=True, ordered=True, help=words)


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
            help="Gains and filter times without a range of their own stay within this factor of the servo's own, "
            "either way; `leave` without a bound of its own, and a cascade's acceleration feedforward, from above. A "
            "filtered PID's velocity feedforward answers a step of the reference by at most so many times the answer "
            "of the own Kp.",
        ),
    ] = 4.0
    Kp: Annotated[Range | None, _range_key("kp_v_per_m", "Kp")] = None
    Kd: Annotated[Range | None, _range_key("kd_v_s_per_m", "Kd")] = None
    Tf: Annotated[Range | None, _range_key("filter_time_s", "Tf")] = None
    position_gain: Annotated[Range | None, _range_key("position_gain_per_s", "position_gain of a cascade")] = None
    velocity_gain: Annotated[Range | None, _range_key("velocity_gain_v_s_per_rad", "velocity_gain of a cascade")] = None
    speed_filter: Annotated[Range | None, _range_key("speed_filter_s", "speed_filter of a cascade")] = None
    gain: Annotated[Range | None, _range_key("gain", "gain of a linear law")] = None
    leave: Annotated[
        float | None,
        key(
            "leave_tolerances",
            minimum=0.0,
            infinite=True,
            help="Largest `leave`; where absent gain_factor times the own one.",
        ),
    ] = None
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
            raise contradiction(self, "{0}: must be at most {1}", "minimum", "maximum")
        if self.notch_max_hz and not self.notch_min_hz <= self.notch_max_hz:
            raise contradiction(self, "{0}: must be at most {1}", "notch_min_hz", "notch_max_hz")

    @property
    def ranges(self) -> dict[str, Range]:
        """The ranges of gains that are given, by the gain's name."""
        names = (name for kind in (Gains, CascadeGains, LinearGains) for name in kind.scaled)
        return {name: getattr(self, name) for name in names if getattr(self, name) is not None}

    def range_of(self, name: str, own: AnyGains) -> Range:
        """Lowest and highest allowed value of a gain, for the servo's own gains; it keeps the sign of the own one."""
        value, given = getattr(own, name), getattr(self, name)
        if given is not None:
            lowest, highest = given
            return (max(lowest, 0.0) if value > 0.0 else lowest, min(highest, 0.0) if value < 0.0 else highest)
        # A gain that the servo has does not vanish, whatever the factor.
        least = max(abs(value) / self.gain_factor, nextafter(0.0, 1.0)) if value else 0.0
        return _with_sign(value, least, _times(self.gain_factor, abs(value)))

    def allows_tolerance(self, tolerance: float) -> bool:
        """True where a tolerance (m) is in bounds."""
        return self.minimum <= tolerance <= self.maximum

    def allows_tolerance_step(self, old: float, new: float, since: float) -> bool:
        """True where the tolerance (m) may change from old to new, `since` seconds after the last change."""
        return abs(new - old) <= self.max_step and (self.max_rate == inf or abs(new - old) <= self.max_rate * since)

    def allows_gains(self, gains: AnyGains, own: AnyGains) -> bool:
        """True where gains are those of a law of the same kind as the servo's own, and in bounds."""
        return type(gains) is type(own) and self.out_of_bounds(gains, own) is None

    def out_of_bounds(self, gains: AnyGains, own: AnyGains) -> Bounded | None:
        """The first number that is out of bounds, of gains of the same kind as the servo's own; None: there is none."""
        return next((each for each in self._bounded(gains, own) if not each.is_allowed), None)

    def _bounded(self, gains: AnyGains, own: AnyGains) -> Iterator[Bounded]:
        """The bounded numbers of gains."""
        for name in gains.scaled:
            yield Bounded(name, getattr(gains, name), *self.range_of(name, own))
        integral = getattr(own, own.integral)
        whole = _with_sign(integral, 0.0, _times(self.integral_factor, abs(integral)))
        yield Bounded(gains.integral, getattr(gains, gains.integral), *whole)
        most = _times(self.gain_factor, own.leave) if self.leave is None else self.leave
        yield Bounded("leave", gains.leave, 0.0, most)
        for name in gains.fed:
            yield Bounded(name, getattr(gains, name), -self.feedforward, self.feedforward)
        yield from self._bounded_motion(gains, own)
        yield from self._bounded_notch(gains, own)

    def _bounded_motion(self, gains: AnyGains, own: AnyGains) -> Iterator[Bounded]:
        """The feedforwards of the reference's motion."""
        if isinstance(gains, Gains) and isinstance(own, Gains):
            kick = _times(self.gain_factor, abs(own.Kp)) * gains.velocity_time
            yield Bounded("velocity_feedforward", gains.velocity_feedforward, -kick, kick)
        elif isinstance(gains, CascadeGains) and isinstance(own, CascadeGains):
            # All of the reference's speed is fed forward by a share of one; more would overtake it.
            speed = max(1.0, own.velocity_feedforward)
            yield Bounded("velocity_feedforward", gains.velocity_feedforward, 0.0, speed)
            most = _times(self.gain_factor, own.acceleration_feedforward)
            yield Bounded("acceleration_feedforward", gains.acceleration_feedforward, 0.0, most)

    def _bounded_notch(self, gains: AnyGains, own: AnyGains) -> Iterator[Bounded]:
        """A notch other than the servo's own."""
        if isinstance(gains, LinearGains) or isinstance(own, LinearGains) or gains.notch_hz == 0.0:
            return
        if any(getattr(gains, name) != getattr(own, name) for name in ("notch_hz", "notch_damping", "notch_depth")):
            yield Bounded("notch_hz", gains.notch_hz, self.notch_min_hz, self.notch_max_hz)
            yield Bounded("notch_damping", gains.notch_damping, 0.0, self.notch_damping)

    def allows_gains_step(self, old: AnyGains, new: AnyGains, own: AnyGains, since: float) -> bool:
        """True where gains may change from old to new, `since` seconds after the last change."""
        factor = self.gain_step if self.gain_rate == inf else min(self.gain_step, _power(self.gain_rate, since))
        if factor == inf:
            return True
        smallest = {name: min(map(abs, self.range_of(name, own))) for name in new.scaled}
        smallest[new.integral] = abs(getattr(own, new.integral)) / self.gain_factor
        return all(
            _in_step(getattr(old, name), getattr(new, name), least, factor, falls_at_once=name == new.integral)
            for name, least in smallest.items()
        )


def _with_sign(of: float, least: float, greatest: float) -> Range:
    """Lowest and highest value of numbers of some sizes, with the sign of a number."""
    return (-greatest, 0.0 - least) if of < 0.0 else (least, greatest)


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


def receipt(
    update: Update, reason: Reason, sample: int, current: Parameters, here: Instant, detail: str = ""
) -> Receipt:
    """Make the receipt of a decision; `current` is in force after it."""
    is_applied = reason is Reason.APPLIED
    return Receipt(here.servo, update.version, is_applied, sample, reason, current.version, here.boot, detail)
