"""The cascade of industrial drives, as a description: position loop around a velocity loop on the motor's speed."""

from dataclasses import dataclass, fields
from math import expm1, pi
from typing import Annotated, Any

from servotwin.config.contradiction import contradiction
from servotwin.config.keys import check, key, replaced, settings
from servotwin.control.controller import notch_step
from servotwin.control.law_keys import RateLimit, ReleaseTime, SampleRate, VoltageLimit
from servotwin.control.linear_law import INPUTS, LOAD, MOTOR, LinearLaw
from servotwin.errors import InvalidInput

_STATES = ("integral", "slow angle", "slow reference", "slower reference", "notch band", "notch low", "low-pass")
Row = dict[str, float]
"""A linear combination of states and inputs."""


@settings("cascade")
@dataclass(frozen=True, slots=True, repr=False)
class Cascade:
    """Position P on load or motor, velocity PI on the motor's speed, feedforwards, notch and low-pass; a linear law.

    Raises
    ------
    InvalidInput
        When a value is out of its range, or two values do not fit.
    """

    position_gain: Annotated[
        float, key("position_gain_per_s", minimum=0.0, help="Speed command per error of the position (Kv).")
    ]
    ratio: Annotated[
        float,
        key(
            "travel_m_per_rad",
            above=0.0,
            help="Travel of the load per angle of the motor; in the file of an axis the transmission's where absent.",
        ),
    ]
    velocity_gain: Annotated[
        float | None,
        key(
            "velocity_gain_v_s_per_rad",
            above=0.0,
            help="Command per error of the motor's speed; where absent the command is the speed itself, for a drive in "
            "velocity mode.",
        ),
    ] = None
    integral_time: Annotated[
        float | None,
        key(
            "integral_time_s",
            minimum=0.0,
            help="Reset time of the velocity loop; 0 or absent: no integral action.",
        ),
    ] = None
    speed_filter: Annotated[
        float,
        key("speed_filter_s", above=0.0, help="Time constant with which the motor's angle is differentiated."),
    ] = 1e-3
    on: Annotated[
        str,
        key(choices=(LOAD, MOTOR), help="Measurement of the position loop, and of the error that the dead zone sees."),
    ] = LOAD
    velocity_feedforward: Annotated[
        float, key(minimum=0.0, unit="1", help="Share of the reference's speed that is added to the speed command.")
    ] = 0.0
    acceleration_feedforward: Annotated[
        float,
        key(
            "acceleration_feedforward_v_s2_per_rad",
            minimum=0.0,
            help="Command per acceleration of the reference at the motor: for a torque, the inertia of all that turns.",
        ),
    ] = 0.0
    reference_filter: Annotated[
        float,
        key(
            "reference_filter_s",
            above=0.0,
            help="Time constant (twice) with which the reference is differentiated for the feedforwards.",
        ),
    ] = 5e-3
    notch_hz: Annotated[
        float | None, key("notch_hz", minimum=0.0, help="Centre of a notch on the command; 0 or absent: none.")
    ] = None
    notch_damping: Annotated[
        float, key("notch_damping", above=0.0, maximum=1.0, help="Damping ratio of its poles.")
    ] = 0.5
    notch_depth: Annotated[float, key("notch_depth", minimum=0.0, below=1.0, help="Its gain at the centre.")] = 0.1
    low_pass_hz: Annotated[
        float | None,
        key("low_pass_hz", above=0.0, help="Cut-off of a first-order low-pass on the command; none where absent."),
    ] = None
    enter: Annotated[
        float, key("enter_tolerances", minimum=0.0, help="Error at or below which the dead zone is entered.")
    ] = 1.0
    leave: Annotated[
        float, key("leave_tolerances", minimum=0.0, help="Error above which it is left; at least enter_tolerances.")
    ] = 1.0
    integral_only: Annotated[
        bool,
        key(
            help="Inside the dead zone only the integral stops; otherwise the position loop opens there: the speed "
            "command is zero, and the velocity loop with its integral brakes the motor."
        ),
    ] = True
    voltage_limit: VoltageLimit = None
    rate_limit: RateLimit = None
    sample_rate: SampleRate = None
    tracking_time: Annotated[
        float | None,
        key(
            "tracking_time_s",
            above=0.0,
            help="Time constant of the integral's back-calculation; integral_time_s where absent.",
        ),
    ] = None
    feedforward: Annotated[float, key("feedforward_v", help="Command added at all times.")] = 0.0
    release_time: ReleaseTime = None

    def __post_init__(self) -> None:
        check(self)
        for name in ("integral_time", "notch_hz"):
            if getattr(self, name) == 0.0:
                object.__setattr__(self, name, None)
        if self.leave < self.enter:
            raise contradiction(self, "{0}: must be at least {1}", "leave", "enter")
        if self.notch_hz is not None and self.sample_rate is not None and not self.notch_hz < 0.5 * self.sample_rate:
            allowed = f"must be below half of sample_rate = {self.sample_rate!r} Hz, or 0 for none"
            raise InvalidInput(f"cascade notch_hz = {self.notch_hz!r} Hz: {allowed}")
        if self.velocity_gain is None:
            for name, given in (
                ("integral_time", self.integral_time),
                ("acceleration_feedforward", self.acceleration_feedforward or None),
            ):
                if given is not None:
                    raise InvalidInput(f"cascade {name} = {given!r}: needs a velocity loop; give its velocity_gain")

    def __repr__(self) -> str:
        """The values that are not their defaults."""
        shown = [f"{f.name}={getattr(self, f.name)!r}" for f in fields(self) if getattr(self, f.name) != f.default]
        return f"Cascade({', '.join(shown)})"

    def replace(self, **changes: Any) -> "Cascade":
        """A copy with some values changed, checked again.

        Raises
        ------
        InvalidInput
            A name is unknown, or a value is out of its range.
        """
        return replaced(self, "cascade", changes)

    def linear(self) -> LinearLaw:
        """The linear law that this cascade is: continuous, or with discrete matrices at its sample rate.

        Sampled, every block is exact for inputs that are held over a tick, and both differentiations for ramps.
        """
        step = None if self.sample_rate is None else 1.0 / self.sample_rate
        blocks = _Blocks(step)
        command = self._command(blocks)
        braking = _Blocks(step)
        braked = self.replace(position_gain=0.0)._command(braking)
        names = tuple(name for name in _STATES if name in blocks.following)
        rows, inside = ([each.following[name] for name in names] for each in (blocks, braking))
        # A tracking time below one tick would correct too much.
        tracking = max(self.tracking_time or self.integral_time or 1.0, step or 0.0)
        back = (step or 1.0) / tracking
        return LinearLaw(
            A=tuple(tuple(row.get(each, 0.0) for each in names) for row in rows),
            B=tuple(tuple(row.get(each, 0.0) for each in INPUTS) for row in rows),
            C=tuple(command.get(each, 0.0) for each in names),
            D=tuple(command.get(each, 0.0) for each in INPUTS),
            B_inside=tuple(tuple(row.get(each, 0.0) for each in INPUTS) for row in inside),
            D_inside=tuple(braked.get(each, 0.0) for each in INPUTS),
            sample_rate=self.sample_rate,
            discrete=step is not None,
            names=names,
            on=self.on,
            ratio=self.ratio,
            enter=self.enter,
            leave=self.leave,
            holds=("integral",) if "integral" in names else (),
            integral_only=self.integral_only,
            voltage_limit=self.voltage_limit,
            rate_limit=self.rate_limit,
            windup=tuple(back if name == "integral" else 0.0 for name in names),
            feedforward=self.feedforward,
            release_time=self.release_time,
        )

    def _command(self, blocks: "_Blocks") -> Row:
        """The command as a combination of states and inputs."""
        position: Row = {"y_load": 1.0} if self.on == LOAD else {"y_motor": self.ratio}
        gain = self.position_gain / self.ratio
        velocity, acceleration = self._of_reference(blocks)
        ahead = self.velocity_feedforward / self.ratio
        command = _sum((gain, {"reference": 1.0}), (-gain, position), (ahead, velocity))
        if self.velocity_gain is not None:
            speed = blocks.differentiated("slow angle", {"y_motor": 1.0}, self.speed_filter)
            error = _sum((1.0, command), (-1.0, speed))
            inertia = self.acceleration_feedforward / self.ratio
            command = _sum((self.velocity_gain, error), (inertia, acceleration))
            if self.integral_time is not None:
                blocks.integrated("integral", _sum((self.velocity_gain / self.integral_time, error)))
                command = _sum((1.0, command), (1.0, {"integral": 1.0}))
        if self.notch_hz is not None:
            band = blocks.band_passed("notch", command, 2.0 * pi * self.notch_hz, self.notch_damping)
            taken = 2.0 * self.notch_damping * (1.0 - self.notch_depth)
            command = _sum((1.0, command), (-taken, band))
        if self.low_pass_hz is not None:
            command = blocks.lagged("low-pass", command, 1.0 / (2.0 * pi * self.low_pass_hz))
        return command

    def _of_reference(self, blocks: "_Blocks") -> tuple[Row, Row]:
        """Speed and acceleration of the reference, through two lags."""
        if self.velocity_feedforward == 0.0 and self.acceleration_feedforward == 0.0:
            return {}, {}
        first = blocks.differentiated("slow reference", {"reference": 1.0}, self.reference_filter)
        second = blocks.differentiated("slower reference", {"slow reference": 1.0}, self.reference_filter)
        rate = blocks.rate(self.reference_filter)
        return second, _sum((rate, first), (-rate, second))


class _Blocks:
    """Blocks of a law and what follows their states: derivatives, or with a step (s) the states of the next tick."""

    def __init__(self, step: float | None) -> None:
        self.step = step
        self.following: dict[str, Row] = {}

    def integrated(self, name: str, row: Row) -> None:
        """Add the integral of a signal."""
        self.following[name] = row if self.step is None else _sum((1.0, {name: 1.0}), (self.step, row))

    def lagged(self, name: str, row: Row, time: float) -> Row:
        """Add a low-pass of a signal; return it."""
        if self.step is None:
            self.following[name] = _sum((1.0 / time, row), (-1.0 / time, {name: 1.0}))
        else:
            share = -expm1(-self.step / time)
            self.following[name] = _sum((share, row), (1.0 - share, {name: 1.0}))
        return {name: 1.0}

    def rate(self, time: float) -> float:
        """Speed per distance that a low-pass is behind a ramp."""
        return 1.0 / time if self.step is None else -expm1(-self.step / time) / self.step

    def differentiated(self, name: str, row: Row, time: float) -> Row:
        """Add a low-pass of a signal; return its derivative, of a sampled ramp exactly its speed."""
        rate = self.rate(time)
        return _sum((rate, row), (-rate, self.lagged(name, row, time)))

    def band_passed(self, name: str, row: Row, omega: float, damping: float) -> Row:
        """Add the two states of a resonance that a signal drives; return the one in phase with it."""
        band, low = {f"{name} band": 1.0}, {f"{name} low": 1.0}
        behind = _sum((1.0, row), (-1.0, low))
        if self.step is None:
            self.following[f"{name} band"] = _sum((omega, behind), (-2.0 * damping * omega, band))
            self.following[f"{name} low"] = _sum((omega, band))
        else:
            fall, rise, turn = notch_step(omega, damping, self.step)
            self.following[f"{name} band"] = _sum((1.0 - fall, band), (turn, behind))
            self.following[f"{name} low"] = _sum((1.0, low), (turn, band), (rise, behind))
        return band


def _sum(*terms: tuple[float, Row]) -> Row:
    total: Row = {}
    for factor, row in terms:
        for name, value in row.items():
            total[name] = total.get(name, 0.0) + factor * value
    return total
