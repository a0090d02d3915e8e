"""A law of any kind as it runs, sample by sample: start, tick, change; the edge's one way to control."""

from dataclasses import dataclass, field
from math import isfinite
from typing import TypeAlias

from servotwin.control.controller import Controller
from servotwin.control.law import LawParameters, LawState, start, tick, transfer
from servotwin.control.laws import AnyController, law_of
from servotwin.control.linear_law import LinearLaw
from servotwin.control.linear_tick import LinearParameters, LinearState, linear_tick
from servotwin.errors import InvalidInput

RunningState: TypeAlias = LawState | LinearState


@dataclass(frozen=True)
class RunningLaw:
    """A law with a sample rate and its dead zone.

    The filtered PID reads the load's position alone; every other law reads the motor's angle too.

    Parameters
    ----------
    controller : Controller, Cascade or LinearLaw
    tolerance : float, optional
        Half-width of the dead zone, m (rotary: rad); None or 0: none.

    Raises
    ------
    InvalidInput
        The controller is continuous, or the tolerance negative or not finite.
    """

    controller: AnyController
    tolerance: float | None = None
    law: Controller | LinearLaw = field(init=False, compare=False, repr=False)
    parameters: LawParameters | LinearParameters = field(init=False, compare=False, repr=False)

    def __post_init__(self) -> None:
        law = law_of(self.controller)
        parameters = law.law(self.tolerance) if isinstance(law, Controller) else law.parameters(self.tolerance)
        object.__setattr__(self, "law", law)
        object.__setattr__(self, "parameters", parameters)

    @property
    def reads_load_only(self) -> bool:
        """True where the motor's angle does not count."""
        return isinstance(self.law, Controller)

    def start(self, theta_m: float, position: float) -> RunningState:
        """State at rest at measurements: rad, and m or rad."""
        return start(position) if isinstance(self.law, Controller) else self.law.start(theta_m, position)

    def tick(self, state: RunningState, reference: float, theta_m: float, position: float) -> RunningState:
        """State after one sample; `command_of` it is to be applied until the next one."""
        if isinstance(self.parameters, LawParameters):
            assert isinstance(state, LawState)
            return tick(self.parameters, state, reference, position)
        assert isinstance(state, LinearState)
        return linear_tick(self.parameters, state, reference, theta_m, position)

    def take_over(
        self, old: "RunningLaw", state: RunningState, reference: float, theta_m: float, position: float
    ) -> RunningState:
        """State with which this law takes over without a bump, for the sample that is due.

        Raises
        ------
        InvalidInput
            The two laws are not of the same kind.
        """
        if isinstance(self.parameters, LawParameters) and isinstance(old.parameters, LawParameters):
            assert isinstance(state, LawState)
            return transfer(old.parameters, self.parameters, state, reference, position)
        if isinstance(self.law, LinearLaw) and isinstance(old.law, LinearLaw):
            assert isinstance(state, LinearState)
            inputs = reference, theta_m, position
            return self.law.transfer(old.law, state, inputs, (old.tolerance, self.tolerance))
        kinds = f"{type(old.controller).__name__} to a {type(self.controller).__name__}"
        raise InvalidInput(f"controller: a running law cannot go from a {kinds}")


def command_of(state: RunningState) -> float:
    """Command of a state's last tick."""
    return state.voltage if isinstance(state, LawState) else state.command


def is_finite(state: RunningState) -> bool:
    """True where command and states are finite."""
    if isinstance(state, LawState):
        return isfinite(state.voltage + state.integral + state.derivative)
    return isfinite(state.command + sum(state.states))
