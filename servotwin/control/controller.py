"""The controller as a description: gains, dead zone, limits; frozen and validated."""

from dataclasses import dataclass, fields
from math import exp, expm1, inf, isfinite, pi, sin, sqrt
from typing import Annotated, TypedDict, Unpack

from servotwin.config.contradiction import contradiction
from servotwin.config.keys import check, items_of, key, replaced, settings
from servotwin.control.law import LawParameters, release_of
from servotwin.control.law_keys import RateLimit, ReleaseTime, SampleRate, VoltageLimit
from servotwin.errors import InvalidInput
from servotwin.runtime.notebook import html_table

# Angle per tick above which a notch has settled within the tick to all digits, unless it is very narrow.
_BEYOND_RATE = 1e6
_GAINS = ("Kp", "Ki", "Kd", "Tf")
_SLOW = 0.25  # of the reset time: below, the usual tracking time is too short


class ControllerChanges(TypedDict, total=False):
    """The keywords of `Controller.replace`: the fields of `Controller`, each of them optional."""

    Kp: float
    Ki: float
    Kd: float
    Tf: float
    enter: float
    leave: float
    loop_filter_hz: float | None
    voltage_limit: float | None
    rate_limit: float | None
    sample_rate: float | None
    tracking_time: float | None
    feedforward: float
    release_time: float | None
    integral_only: bool
    velocity_feedforward: float
    velocity_time: float
    friction_feedforward: float
    notch_hz: float
    notch_damping: float
    notch_depth: float


@settings("controller")
@dataclass(frozen=True, slots=True, repr=False)
class Controller:
    """Filtered PID (Eq 14) with a dead zone on its error (Eq 20), limits and an optional loop filter.

    Raises
    ------
    InvalidInput
        When a value is not a finite number in its range.
    """

    Kp: Annotated[float, key("kp_v_per_m", help="Proportional gain, any sign.")]
    Ki: Annotated[float, key("ki_v_per_m_s", help="Integral gain, any sign.")]
    Kd: Annotated[float, key("kd_v_s_per_m", help="Derivative gain, any sign.")]
    Tf: Annotated[
        float,
        key("filter_time_s", above=0.0, help="Time constant of the derivative's filter, which makes the law proper."),
    ]
    enter: Annotated[float, key("enter_tolerances", minimum=0.0, help="Error at or below which the loop opens.")] = 1.0
    leave: Annotated[
        float,
        key(
            "leave_tolerances",
            minimum=0.0,
            help="The loop closes again above that error; at least enter_tolerances, equal values (the paper's) mean "
            "no hysteresis.",
        ),
    ] = 1.0
    loop_filter_hz: Annotated[
        float | None,
        key(above=0.0, help="Cut-off of a first-order low-pass on the measurement (section 4.3); none where absent."),
    ] = None
    voltage_limit: VoltageLimit = None
    rate_limit: RateLimit = None
    sample_rate: SampleRate = None
    tracking_time: Annotated[
        float | None,
        key(
            "tracking_time_s",
            above=0.0,
            help="Time constant of the integral's back-calculation; where absent sqrt(abs(Kd / Ki)), and abs(Kp / Ki) "
            "where that is more than four times as long.",
        ),
    ] = None
    feedforward: Annotated[
        float,
        key(
            "feedforward_v",
            help="Voltage added at all times, inside the dead zone too; it cancels a bias of the plant's input.",
        ),
    ] = 0.0
    release_time: ReleaseTime = None
    integral_only: Annotated[
        bool,
        key(
            help="Inside the dead zone only the integral stops; proportional and derivative action go on. Otherwise "
            "the loop opens there (the paper's).",
        ),
    ] = False
    velocity_feedforward: Annotated[
        float,
        key(
            "velocity_feedforward_v_s_per_m",
            help="Voltage per speed of the reference, through a low-pass filter; a step of the reference gives a "
            "pulse. The loop's margins do not depend on it.",
        ),
    ] = 0.0
    velocity_time: Annotated[
        float, key("velocity_time_s", above=0.0, help="Time constant of the velocity feedforward's low-pass filter.")
    ] = 0.1
    friction_feedforward: Annotated[
        float,
        key(
            "friction_feedforward_v",
            help="Voltage added with the sign of the reference's last change; it cancels Coulomb friction on the way. "
            "The loop's margins do not depend on it.",
        ),
    ] = 0.0
    notch_hz: Annotated[
        float,
        key(
            minimum=0.0,
            help="Centre of a notch on the voltage of proportional, integral and derivative action; 0: none.",
        ),
    ] = 0.0
    notch_damping: Annotated[
        float,
        key(
            "notch_damping",
            above=0.0,
            maximum=1.0,
            help="Damping ratio of the notch's poles: half of its relative width.",
        ),
    ] = 0.5
    notch_depth: Annotated[
        float, key("notch_depth", minimum=0.0, below=1.0, help="Gain of the notch at its centre; 1 elsewhere.")
    ] = 0.1

    def __post_init__(self) -> None:
        check(self)
        if self.leave < self.enter:
            raise contradiction(self, "{0}: must be at least {1}", "leave", "enter")

    def __repr__(self) -> str:
        """Gains, and whatever is not its default."""
        shown = [f for f in fields(self) if f.name in _GAINS or getattr(self, f.name) != f.default]
        return f"Controller({', '.join(f'{f.name}={getattr(self, f.name)!r}' for f in shown)})"

    def _repr_html_(self) -> str:
        """Table for notebooks."""
        given = [item for item in items_of(type(self)) if getattr(self, item.name) is not None]
        return html_table("Controller", {one.name: f"{getattr(self, one.name):g} {one.unit}" for one in given})

    def replace(self, **changes: Unpack[ControllerChanges]) -> "Controller":
        """A copy with some values changed, validated again.

        Parameters
        ----------
        **changes
            Any fields of the controller, by name: ``controller.replace(Ki=500.0, sample_rate=5000.0)``.

        Raises
        ------
        InvalidInput
            A name is unknown, or a value is out of its range.
        """
        return replaced(self, "controller", changes)

    @property
    def tracking(self) -> float:
        """Time constant of the back-calculation, s; inf: the integral is never corrected.

        As given, otherwise the usual sqrt(Td Ti) = sqrt(abs(Kd / Ki)); where that is below a quarter of the reset time
        Ti = abs(Kp / Ki), and without derivative action, Ti: a slow integral that is corrected faster runs down while
        the proportional part saturates. Zero means at once (pure integral action), infinite that there is no integral
        to correct.
        """
        if self.Ki == 0.0:
            return inf
        if self.tracking_time is not None:
            return self.tracking_time
        usual, reset = sqrt(abs(self.Kd / self.Ki)), abs(self.Kp / self.Ki)
        return usual if usual >= _SLOW * reset else reset

    @property
    def release(self) -> float:
        """Time constant with which the offset after a change of the law fades, s."""
        return release_of(self.release_time)

    @property
    def notch_gain(self) -> float:
        """Share of its band-pass that the notch takes away; 0: there is no notch."""
        return 2.0 * self.notch_damping * (1.0 - self.notch_depth) if self.notch_hz else 0.0

    def thresholds(self, tolerance: float | None) -> tuple[float, float]:
        """Absolute (enter, leave) in m for a tolerance in m; (-1, -1), which no error meets, without dead zone.

        A tolerance of zero is no dead zone: Eq 20 would otherwise cut the voltage whenever a quantised error is zero.
        """
        if tolerance is None or tolerance == 0.0:
            return -1.0, -1.0
        if not (isfinite(tolerance) and tolerance > 0.0):
            raise InvalidInput(f"tolerance = {tolerance!r} m: must be finite and at least 0, or None for none")
        return self.enter * tolerance, self.leave * tolerance

    def law(self, tolerance: float | None = None) -> LawParameters:
        """The law discretised at `sample_rate` by zero-order hold, with a dead zone of `tolerance` (m).

        Raises
        ------
        InvalidInput
            When the controller is continuous (no `sample_rate`) or the tolerance negative or not finite.
        """
        if self.sample_rate is None:
            raise InvalidInput("controller sample_rate = None: the sampled law needs a rate in Hz")
        step = 1.0 / self.sample_rate
        # expm1: with a fast tick 1 - exp(-step / Tf) would lose the digits that decide the filter's pole.
        enter, leave = self.thresholds(tolerance)
        notch = notch_step(2.0 * pi * self.notch_hz, self.notch_damping, step)
        return LawParameters(
            Kp=float(self.Kp),
            integral_step=self.Ki / self.sample_rate,
            derivative_gain=self.Kd / self.Tf,
            filter_step=-expm1(-step / self.Tf),
            enter=enter,
            leave=leave,
            voltage_limit=inf if self.voltage_limit is None else float(self.voltage_limit),
            rate_step=inf if self.rate_limit is None else self.rate_limit / self.sample_rate,
            loop_step=1.0 if self.loop_filter_hz is None else -expm1(-2.0 * pi * self.loop_filter_hz * step),
            # At most 1: a tracking time below one tick would overcorrect the integral.
            tracking_step=step / max(step, self.tracking),
            feedforward=float(self.feedforward),
            release_step=-expm1(-step / self.release),
            acting_inside=1.0 if self.integral_only else 0.0,
            velocity_gain=self.velocity_feedforward / self.velocity_time,
            velocity_step=-expm1(-step / self.velocity_time),
            friction=float(self.friction_feedforward),
            notch_gain=self.notch_gain,
            notch_fall=notch[0],
            notch_rise=notch[1],
            notch_turn=notch[2],
        )


def notch_step(omega: float, damping: float, step: float) -> tuple[float, float, float]:
    """Exact zero-order-hold step of band-pass a and low-pass b: a' = omega (v - b) - 2 damping omega a, b' = omega a.

    Returns 1 - F_aa, 1 - F_bb and F_ba = -F_ab of its transition matrix F.
    """
    if omega * step > _BEYOND_RATE:
        return 1.0, 1.0, 0.0
    decay, spread = damping * omega * step, omega * step * sqrt(1.0 - damping * damping)
    # exp(M) = exp(-decay) (cos I + sin / spread (M + decay I)); 1 - cos without cancellation.
    fade, ratio = exp(-decay), sin(spread) / spread if spread else 1.0
    common = -expm1(-decay) + 2.0 * fade * sin(0.5 * spread) ** 2
    return common + fade * ratio * decay, common - fade * ratio * decay, fade * ratio * omega * step
