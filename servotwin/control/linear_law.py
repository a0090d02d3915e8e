"""Any linear law of reference, motor's angle and load's position, as a description: matrices, dead zone, limits."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields, replace
from math import expm1, inf, isfinite
from typing import Any

from servotwin.config.contradiction import contradiction
from servotwin.config.keys import replaced
from servotwin.control.law import release_of
from servotwin.control.linear_tick import LinearParameters, LinearState, linear_transfer
from servotwin.control.matrices import Rows, at_rest, zero_order_held
from servotwin.control.system_matrices import system_matrices
from servotwin.errors import InvalidInput

INPUTS = ("reference", "y_motor", "y_load")
MOTOR, LOAD = "motor", "load"
# Numba compiles the tick once for each number of states: a few numbers serve all laws.
_MULTIPLE = 4
# Relative: rates that differ by no more are one rate, given as a rate and as a time.
_SAME_RATE = 1e-9


@dataclass(frozen=True, repr=False)
class LinearLaw:
    """x' = A x + B (r, y_motor, y_load), command = C x + D (r, y_motor, y_load), dead zone, limits and anti-windup.

    r and y_load in m (of a rotary axis rad), y_motor in rad at the motor; the command in the actuator's unit. x' is the
    derivative, or with discrete matrices the state at the next tick.

    Parameters
    ----------
    A, B, C, D : (n, n), (n, 3), (n,), (3,)
        Numbers row by row: tuples, lists or arrays.
    sample_rate : float, optional
        Hz; the law runs in continuous time where absent. With matrices of continuous time its tick is exact for inputs
        that are held between two ticks, inside and outside the dead zone.
    discrete : bool
        True: the matrices belong to that sample rate.
    names : tuple of str
        Of the states, "x1", "x2" and so on by default. A change of the law carries states of equal names over.
    on : {"load", "motor"}
        Measurement of the error that the dead zone looks at: reference - y_load, or reference - ratio y_motor.
    ratio : float
        Travel of the load per angle of the motor, m/rad or rad/rad.
    enter, leave : float
        Error at or below which the dead zone is entered and above which it is left, in tolerances.
    holds : tuple of str
        States that the dead zone stops: inside they keep their values. The others go on.
    integral_only : bool
        True: inside, nothing else stops; otherwise the law has neither inputs nor a command there, what is not stopped
        decays, or B_inside, (n, 3), and D_inside, (3,), act in place of B and D (of a cascade its velocity loop).
    voltage_limit, rate_limit : float, optional
        Largest command (in its unit), and its largest change (unit per s; sampled laws only).
    windup : tuple of float
        Back-calculation: added to x' per unit of the command that the limits cut off; none by default.
    feedforward : float
        Always added to the command.
    release_time : float, optional
        Time constant with which the offset after a change of the law fades, s; where absent that of its axis
        (`plant.release`), 0.5 s without one.
    gain : float
        Factor on the whole law.
    integral_share : float
        Factor on what the states in `holds` take in from the inputs and from other states.

    Raises
    ------
    InvalidInput
        A matrix of another shape, a number that is not finite or out of its range, or an unknown state.
    """

    A: Rows
    B: Rows
    C: tuple[float, ...]
    D: tuple[float, ...]
    sample_rate: float | None = None
    discrete: bool = False
    names: tuple[str, ...] = ()
    on: str = LOAD
    ratio: float = 1.0
    enter: float = 1.0
    leave: float = 1.0
    holds: tuple[str, ...] = ()
    integral_only: bool = True
    voltage_limit: float | None = None
    rate_limit: float | None = None
    windup: tuple[float, ...] = ()
    feedforward: float = 0.0
    release_time: float | None = None
    gain: float = 1.0
    integral_share: float = 1.0
    B_inside: Rows = ()
    D_inside: tuple[float, ...] = ()
    settings_name = "law"

    def __post_init__(self) -> None:
        n = len(self.C)
        shapes: dict[str, tuple[int, ...]] = {"A": (n, n), "B": (n, len(INPUTS)), "C": (n,), "D": (len(INPUTS),)}
        if len(self.D_inside) or len(self.B_inside):
            shapes |= {"B_inside": shapes["B"], "D_inside": shapes["D"]}
        for name, shape in shapes.items():
            object.__setattr__(self, name, _numbers(name, getattr(self, name), shape))
        windup = self.windup if len(self.windup) else (0.0,) * n
        object.__setattr__(self, "windup", _numbers("windup", windup, (n,)))
        object.__setattr__(self, "names", tuple(self.names) or tuple(f"x{i + 1}" for i in range(n)))
        object.__setattr__(self, "holds", tuple(self.holds))
        self._check_names(n)
        self._check_numbers()

    def _check_names(self, n: int) -> None:
        if len(self.names) != n or len(set(self.names)) != n:
            raise InvalidInput(f"law names = {self.names}: must be {n} different names, one for each state")
        for name in self.holds:
            if name not in self.names:
                raise InvalidInput(f"law holds = {name!r}: the law has no such state; it has {', '.join(self.names)}")
        if self.on not in (MOTOR, LOAD):
            raise InvalidInput(f'law on = {self.on!r}: must be "load" or "motor"')

    def _check_numbers(self) -> None:
        least = {"sample_rate": "Hz", "voltage_limit": "", "rate_limit": "1/s", "release_time": "s", "gain": ""}
        for name, unit in least.items():
            value = getattr(self, name)
            if value is not None and not (isfinite(value) and value > 0.0):
                raise InvalidInput(f"law {name} = {value!r} {unit}".rstrip() + ": must be finite and positive")
        for name in ("enter", "leave"):
            if not (isfinite(value := getattr(self, name)) and value >= 0.0):
                raise InvalidInput(f"law {name} = {value!r} tolerances: must be finite and 0 or more")
        if self.leave < self.enter:
            raise contradiction(self, "{0}: must be at least {1}", "leave", "enter")
        if not (isfinite(self.ratio) and self.ratio > 0.0):
            raise InvalidInput(f"law ratio = {self.ratio!r} m/rad: must be finite and greater than 0")
        if not (isfinite(self.integral_share) and self.integral_share >= 0.0):
            raise InvalidInput(f"law integral_share = {self.integral_share!r}: must be finite and 0 or more")
        if not isfinite(self.feedforward):
            raise InvalidInput(f"law feedforward = {self.feedforward!r}: must be finite")
        if self.discrete and self.sample_rate is None:
            raise InvalidInput("law sample_rate = None: discrete matrices need their rate in Hz")
        if self.rate_limit is not None and self.sample_rate is None:
            raise InvalidInput(f"law rate_limit = {self.rate_limit!r} 1/s: needs a sampled law; set its sample_rate")

    @classmethod
    def from_system(cls, system: Any, on: str = LOAD, ratio: float = 1.0, **values: Any) -> LinearLaw:
        """A law made of a system of scipy.signal or of python-control, continuous or sampled.

        Parameters
        ----------
        system : scipy.signal.lti or dlti, control.StateSpace or control.TransferFunction
            One input: the error of the measurement that `on` names. Two: reference and that measurement. Three:
            reference, y_motor and y_load. Its one output is the command.
        on, ratio
            As of the law.
        **values
            Other values of the law, by name.

        Raises
        ------
        InvalidInput
            Another kind of object, other numbers of inputs or outputs, or a sampled system without a sample time.
        """
        A, B, C, D, step = system_matrices(system)
        columns = {1: ((1.0,), (-1.0,)), 2: ((1.0, 0.0), (0.0, 1.0))}
        if len(C) != 1 or len(D[0]) not in (1, 2, 3):
            raise InvalidInput(
                f"law system: has {len(D[0])} inputs and {len(C)} outputs; must have one output, and the inputs error, "
                "or reference and measurement, or reference, y_motor and y_load"
            )

        def mapped(row: Sequence[float]) -> tuple[float, ...]:
            if len(row) == len(INPUTS):
                return tuple(row)
            ahead, behind = (sum(a * b for a, b in zip(row, each, strict=True)) for each in columns[len(row)])
            return (ahead, ratio * behind, 0.0) if on == MOTOR else (ahead, 0.0, behind)

        B = [mapped(row) for row in B]
        rate = None if step is None else 1.0 / step
        given = values.get("sample_rate", rate)
        if rate is not None and (given is None or abs(given - rate) > _SAME_RATE * rate):
            raise InvalidInput(f"law sample_rate = {given!r} Hz: the system is sampled at {rate!r} Hz; leave it out")
        values = {"sample_rate": rate, "discrete": rate is not None, **values}
        return cls(A, B, C[0], mapped(D[0]), on=on, ratio=ratio, **values)  # type: ignore[arg-type]

    def __repr__(self) -> str:
        """States, kind, and whatever is not its default."""
        kind = "continuous" if self.sample_rate is None else f"{self.sample_rate:g} Hz"
        shown = [
            f for f in fields(self)[7:] if getattr(self, f.name) != f.default and any(_pair(getattr(self, f.name)))
        ]
        rest = "".join(f", {f.name}={getattr(self, f.name)!r}" for f in shown)
        return f"<LinearLaw, {kind}, states {', '.join(self.names) or 'none'}{rest}>"

    def replace(self, **changes: Any) -> LinearLaw:
        """A copy with some values changed, checked again.

        Raises
        ------
        InvalidInput
            A name is unknown, or a value is out of its range.
        """
        return replaced(self, "law", changes)

    @property
    def n(self) -> int:
        """Number of states."""
        return len(self.C)

    @property
    def error(self) -> tuple[float, float]:
        """Factors (motor, load) of the measurements that the dead zone compares with the reference."""
        return (self.ratio, 0.0) if self.on == MOTOR else (0.0, 1.0)

    @property
    def release(self) -> float:
        """Time constant with which the offset after a change of the law fades, s."""
        return release_of(self.release_time)

    def reads(self, name: str) -> bool:
        """True where the law depends on one of its `INPUTS`."""
        column = INPUTS.index(name)
        rows = (*self.B, self.D, *self.B_inside, self.D_inside or self.D)
        return any(row[column] != 0.0 for row in rows) or name == f"y_{self.on}"

    @property
    def static_gain(self) -> float:
        """Command at rest per error of the position, the states in `holds` left at zero."""
        resting = self.rest((1.0, 0.0, 0.0), dict.fromkeys(self.holds, 0.0))
        return self.gain * (sum(c * x for c, x in zip(self.C, resting, strict=True)) + self.D[0])

    def linear(self) -> LinearLaw:
        """The law that runs: its matrices contain its gain and its integral share.

        The states in `holds` are those of the own law times the gain, so that a change of the gain leaves what they
        add to the command; without integral action they are left out.
        """
        if self.gain == 1.0 and self.integral_share == 1.0:
            return self
        held = [name in self.holds for name in self.names]
        rows = [i for i in range(self.n) if self.integral_share or not held[i]]
        unit = [self.gain if each else 1.0 for each in held]
        taken = [unit[i] * (self.integral_share if held[i] else 1.0) for i in range(self.n)]
        return replace(
            self,
            A=tuple(tuple(self.A[i][j] * (1.0 if i == j else taken[i] / unit[j]) for j in rows) for i in rows),
            B=tuple(tuple(taken[i] * value for value in self.B[i]) for i in rows),
            C=tuple(self.gain * self.C[i] / unit[i] for i in rows),
            D=tuple(self.gain * value for value in self.D),
            B_inside=tuple(tuple(taken[i] * value for value in self.B_inside[i]) for i in rows if self.D_inside),
            D_inside=tuple(self.gain * value for value in self.D_inside),
            windup=tuple(self.windup[i] * unit[i] / self.gain for i in rows),
            names=tuple(self.names[i] for i in rows),
            holds=self.holds if self.integral_share else (),
            gain=1.0,
            integral_share=1.0,
        )

    def inside(self) -> LinearLaw:
        """The law that runs inside the dead zone."""
        if self.D_inside and not self.integral_only:
            return replace(self, B=self.B_inside, D=self.D_inside)
        n, still = self.n, (0.0,) * len(INPUTS)
        own = [tuple(float(self.discrete and i == j) for j in range(n)) for i in range(n)]
        held = [name in self.holds for name in self.names]
        A = tuple(own[i] if held[i] else self.A[i] for i in range(n))
        B = tuple(still if held[i] or not self.integral_only else self.B[i] for i in range(n))
        C, D = (self.C, self.D) if self.integral_only else ((0.0,) * n, still)
        windup = tuple(0.0 if stopped else value for stopped, value in zip(held, self.windup, strict=True))
        return replace(self, A=A, B=B, C=C, D=D, windup=windup)

    def thresholds(self, tolerance: float | None) -> tuple[float, float]:
        """Absolute (enter, leave) for a tolerance, both in m or rad; (-1, -1), which no error meets, without dead
        zone: for None and for 0."""
        if tolerance is None or tolerance == 0.0:
            return -1.0, -1.0
        if not (isfinite(tolerance) and tolerance > 0.0):
            raise InvalidInput(f"tolerance = {tolerance!r} m: must be finite and at least 0, or None for none")
        return self.enter * tolerance, self.leave * tolerance

    def held(self) -> LinearLaw:
        """The law with discrete matrices: exact for inputs that are held between two ticks.

        Raises
        ------
        InvalidInput
            The law is continuous.
        """
        if self.sample_rate is None:
            raise InvalidInput("law sample_rate = None: the tick needs a rate in Hz")
        if self.discrete:
            return self
        columns = tuple((*row, cut) for row, cut in zip(self.B, self.windup, strict=True))
        A, B = zero_order_held(self.A, columns, 1.0 / self.sample_rate)
        windup = tuple(row[-1] for row in B)
        return replace(self, A=A, B=tuple(row[:-1] for row in B), windup=windup, discrete=True)

    def _flat(self) -> tuple[list[float], list[float]]:
        """Numbers of the tick, row by row: of the next states, and of the command; spare states never move."""
        size = len(self.padded(()))
        spare = size - self.n
        advance: list[float] = []
        for row, column, cut in zip(self.A, self.B, self.windup, strict=True):
            advance += [*row, *(0.0,) * spare, *column, cut]
        advance += (0.0,) * (spare * (size + len(INPUTS) + 1))
        return advance, [*self.C, *(0.0,) * spare, *self.D]

    def parameters(self, tolerance: float | None = None) -> LinearParameters:
        """The tick's parameters, with a dead zone of `tolerance` (m or rad).

        Raises
        ------
        InvalidInput
            The law is continuous, or the tolerance negative or not finite.
        """
        if self.sample_rate is None:
            raise InvalidInput("law sample_rate = None: the tick needs a rate in Hz")
        outside, inside = self.held()._flat(), self.inside().held()._flat()
        enter, leave = self.thresholds(tolerance)
        return LinearParameters(
            advance=tuple(outside[0] + inside[0]),
            output=tuple(outside[1] + inside[1]),
            motor=self.error[0],
            load=self.error[1],
            enter=enter,
            leave=leave,
            limit=inf if self.voltage_limit is None else float(self.voltage_limit),
            rate_step=inf if self.rate_limit is None else self.rate_limit / self.sample_rate,
            feedforward=float(self.feedforward),
            release_step=-expm1(-1.0 / (self.sample_rate * self.release)),
        )

    def start(self, y_motor: float, y_load: float) -> LinearState:
        """State at rest at measurements (rad, m or rad) with no error: filters at what they filter, integrators at
        zero."""
        reference = self.error[0] * y_motor + self.error[1] * y_load
        return LinearState(self.padded(self.rest((reference, y_motor, y_load), {})), 0.0, 1.0, 0.0)

    def rest(self, inputs: Sequence[float], known: dict[str, float]) -> tuple[float, ...]:
        """States at rest under constant inputs, some of them given by name."""
        driven = [sum(a * b for a, b in zip(row, inputs, strict=True)) for row in self.B]
        A: Iterable[Sequence[float]] = self.A
        if not self.discrete:  # at rest the derivative is zero: x = x + A x + B u
            A = [[value + (i == j) for j, value in enumerate(row)] for i, row in enumerate(self.A)]
        places = {self.names.index(name): value for name, value in known.items()}
        return at_rest(tuple(tuple(row) for row in A), driven, places)

    def padded(self, states: tuple[float, ...]) -> tuple[float, ...]:
        """States with the spare ones of the tick behind them."""
        size = max(_MULTIPLE, -(-self.n // _MULTIPLE) * _MULTIPLE)
        return states + (0.0,) * (size - len(states))

    def carried(self, old: LinearLaw, state: LinearState, inputs: Sequence[float]) -> tuple[float, ...]:
        """States of this law that take over from another one: equal names go on, new ones begin at rest."""
        known = dict(zip(old.names, state.states, strict=False))
        return self.padded(self.rest(inputs, {name: known[name] for name in self.names if name in known}))

    def transfer(
        self,
        old: LinearLaw,
        state: LinearState,
        inputs: tuple[float, float, float],
        tolerances: tuple[float | None, float | None],
    ) -> LinearState:
        """State with which this law takes over from another without a bump, for tolerances (old, new) of the dead
        zone."""
        carried = self.carried(old, state, inputs)
        return linear_transfer(old.parameters(tolerances[0]), self.parameters(tolerances[1]), state, carried, inputs)


def _pair(value: Any) -> tuple[Any, ...]:
    return value if isinstance(value, tuple) else (value,)


def _numbers(name: str, given: Any, shape: tuple[int, ...]) -> Any:
    """Finite numbers in tuples, of a shape."""
    rows = given.tolist() if hasattr(given, "tolist") else given
    try:
        if len(shape) == 1:
            found: Any = tuple(float(value) for value in rows)
            fits, flat = len(found) == shape[0], found
        else:
            found = tuple(tuple(float(value) for value in row) for row in rows)
            fits = len(found) == shape[0] and all(len(row) == shape[1] for row in found)
            flat = tuple(value for row in found for value in row)
    except (TypeError, ValueError):
        fits, flat, found = False, (), None
    size = " by ".join(str(number) for number in shape)
    if not fits:
        raise InvalidInput(f"law {name} = {rows!r}: must be {size} numbers, for {shape[0]} in C and r, y_motor, y_load")
    for value in flat:
        if not isfinite(value):
            raise InvalidInput(f"law {name} = {rows!r}: all {size} numbers must be finite")
    return found
