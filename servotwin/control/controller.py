"""The controller as a description: gains, dead zone, limits; frozen and validated."""

from dataclasses import dataclass, fields, replace
from math import expm1, inf, isfinite, pi, sqrt
from numbers import Real
from typing import TypedDict, Unpack

from servotwin.control.law import LawParameters
from servotwin.errors import InvalidInput
from servotwin.runtime.notebook import html_table

_GAINS = ("Kp", "Ki", "Kd", "Tf")
_UNITS = {
    "Kp": "V/m",
    "Ki": "V/(m s)",
    "Kd": "V s/m",
    "Tf": "s",
    "enter": "tolerances",
    "leave": "tolerances",
    "loop_filter_hz": "Hz",
    "voltage_limit": "V",
    "rate_limit": "V/s",
    "sample_rate": "Hz",
    "tracking_time": "s",
    "feedforward": "V",
    "release_time": "s",
}
_OPTIONAL = ("loop_filter_hz", "voltage_limit", "rate_limit", "sample_rate", "tracking_time")


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
    release_time: float


@dataclass(frozen=True, slots=True, repr=False)
class Controller:
    """Filtered PID (Eq 14) with a dead zone on its error (Eq 20), limits and an optional loop filter.

    Parameters
    ----------
    Kp, Ki, Kd : float
        Gains, V/m, V/(m s), V s/m; any sign.
    Tf : float
        Time constant of the derivative's filter, s, positive: without it the controller would be improper.
    enter, leave : float
        The loop opens when the error is at most `enter` tolerances and closes again above `leave` tolerances;
        equal values (the paper's) mean no hysteresis.
    loop_filter_hz : float, optional
        Cut-off of a first-order low-pass on the measurement, Hz (section 4.3); None: none.
    voltage_limit, rate_limit : float, optional
        V and V/s; None: none.
    sample_rate : float, optional
        Hz; None: the law runs in continuous time.
    tracking_time : float, optional
        Time constant of the back-calculation, s; None: see `tracking`.
    feedforward : float
        V, added to the voltage at all times, inside the dead zone too: it cancels a bias of the plant's input.
    release_time : float
        s, time constant with which the voltage that a change of parameters left over (`LawState.offset`) is let go.

    Raises
    ------
    InvalidInput
        When a value is not a finite number in its range.
    """

    Kp: float
    Ki: float
    Kd: float
    Tf: float
    enter: float = 1.0
    leave: float = 1.0
    loop_filter_hz: float | None = None
    voltage_limit: float | None = None
    rate_limit: float | None = None
    sample_rate: float | None = None
    tracking_time: float | None = None
    feedforward: float = 0.0
    release_time: float = 0.5

    def __post_init__(self) -> None:
        for field in fields(self):
            _check_number(field.name, getattr(self, field.name))
        for name in ("Tf", "release_time", *_OPTIONAL):
            _check_positive(name, getattr(self, name))
        if self.enter < 0.0:
            raise InvalidInput(f"controller enter = {self.enter!r} tolerances: must be at least 0")
        if self.leave < self.enter:
            raise InvalidInput(f"controller leave = {self.leave!r} tolerances: must be at least enter = {self.enter!r}")

    def __repr__(self) -> str:
        """Gains, and whatever is not its default."""
        shown = [f for f in fields(self) if f.name in _GAINS or getattr(self, f.name) != f.default]
        return f"Controller({', '.join(f'{f.name}={getattr(self, f.name)!r}' for f in shown)})"

    def _repr_html_(self) -> str:
        """Table for notebooks."""
        rows = {f.name: getattr(self, f.name) for f in fields(self) if getattr(self, f.name) is not None}
        return html_table("Controller", {name: f"{value:g} {_UNITS[name]}" for name, value in rows.items()})

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
        allowed = [field.name for field in fields(self)]
        if unknown := sorted(set(changes) - set(allowed)):
            raise InvalidInput(f"controller has no value named {unknown[0]!r}: allowed are {', '.join(allowed)}")
        return replace(self, **changes)

    @property
    def tracking(self) -> float:
        """Time constant of the back-calculation, s; inf: the integral is never corrected.

        As given, otherwise sqrt(Td Ti) = sqrt(abs(Kd / Ki)); without derivative action Ti = abs(Kp / Ki).
        Zero means at once (pure integral action), infinite that there is no integral to correct.
        """
        if self.Ki == 0.0:
            return inf
        if self.tracking_time is not None:
            return self.tracking_time
        return sqrt(abs(self.Kd / self.Ki)) if self.Kd != 0.0 else abs(self.Kp / self.Ki)

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
        enter, leave = self.thresholds(tolerance)
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
            tracking_step=step / max(step, self.tracking),
            feedforward=float(self.feedforward),
            release_step=-expm1(-step / self.release_time),
        )


def _check_number(name: str, value: object) -> None:
    """Every value is a finite number; optional ones may be None."""
    if value is None and name in _OPTIONAL:
        return
    if isinstance(value, bool) or not isinstance(value, Real) or not isfinite(value):
        raise InvalidInput(f"controller {name} = {value!r}: must be a finite number")


def _check_positive(name: str, value: float | None) -> None:
    if value is not None and value <= 0.0:
        raise InvalidInput(f"controller {name} = {value!r}: must be greater than 0")
