"""Model of a twin: its constant parts."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

from msgspec.structs import replace

from servotwin.control.laws import AnyController
from servotwin.estimation.disturbance import disturbance
from servotwin.estimation.drive_strength import DriveStrength
from servotwin.estimation.learning.motor import MotorLearning
from servotwin.estimation.learning.wear import Wear
from servotwin.messages import Setting
from servotwin.plant.plants import Plant
from servotwin.redesign.certified.lookup import TablePolicy
from servotwin.redesign.policy import Policy
from servotwin.redesign.registry import policy_of
from servotwin.twin.estimating import Estimator, Observer, estimator_of, motor_learning_of
from servotwin.twin.lookups import Lookups, LookupState
from servotwin.twin.requests import Requests, RequestState
from servotwin.twin.responses import Responses, ResponseState
from servotwin.twin.settings import TwinSettings
from servotwin.twin.state import TwinState, Versions, decode_state
from servotwin.twin.triage import Triage, TriageState


@dataclass(frozen=True)
class TwinModel:
    """Constant parts of a twin.

    Parameters
    ----------
    estimator : callable
        (estimation.Window, Expectation) -> GapEstimate.
    policy : Policy
        Computes a setting from the evidence; where it raises InvalidInput there is none.
    settings : TwinSettings
    observer : callable, optional
        estimation.Window -> Disturbance; None: input bias and noise are not estimated.
    start : Setting, optional
        In force at the edge before the first update; None: not known.
    requests : Requests, optional
        Requests more informative windows.
    triage : Triage, optional
        Decides for which windows a glance is enough.
    lookups : Lookups, optional
        Looks settings up, and verifies them after they were sent; `policy` is not used then.
    motor : MotorLearning, optional
        Learns the motor's numbers; None: the model's are taken as they are.
    responses : Responses, optional
        Sends the learnt structure to edges that can use it.
    controller : Controller, Cascade or LinearLaw, optional
        The servo's, with which windows are compared; None: they are not.
    drive : DriveStrength, optional
        Compares windows with the stated torque and inertia; None: it is another kind of machine.
    """

    estimator: Estimator
    policy: Policy
    settings: TwinSettings
    observer: Observer | None = None
    start: Setting | None = None
    requests: Requests | None = None
    triage: Triage | None = None
    lookups: Lookups | None = None
    motor: MotorLearning | None = None
    responses: Responses | None = None
    controller: AnyController | None = None
    drive: DriveStrength | None = None

    @classmethod
    def of(
        cls,
        servo: Plant,
        settings: TwinSettings,
        start: Setting | None = None,
        estimator: Estimator | None = None,
        policy: Policy | None = None,
    ) -> TwinModel:
        """Make the model that `settings` describe for a servo with the controller that runs.

        `estimator` and `policy` replace those of the settings.

        Raises
        ------
        InvalidInput
            The policy cannot design for this controller, its table is not this model's, or triage cannot read the axis.
        """
        settings = settings.on(servo)
        chosen = policy or policy_of(servo, settings)
        return cls(
            estimator=estimator or estimator_of(servo, settings),
            policy=chosen,
            settings=settings,
            observer=partial(disturbance, servo=servo),
            motor=motor_learning_of(servo, settings),
            start=start,
            requests=Requests.of(servo, settings),
            triage=Triage.of(servo, settings.triage),
            responses=Responses.of(servo, settings),
            lookups=Lookups(chosen) if isinstance(chosen, TablePolicy) else None,
            controller=servo.controller,
            drive=_drive_of(servo, settings),
        )

    def initial_state(self, servo: str) -> TwinState:
        """Make the state of a servo's twin before its first message."""
        known = {} if self.start is None else {0: self.start}
        return self._fitted(TwinState(servo, Versions(), known, Wear(self.settings.initial_gap)))

    def restored(self, servo: str, data: bytes) -> TwinState:
        """Decode the stored state of a servo, with a slice for each optional part of this model and no other.

        Raises
        ------
        InvalidInput
            The bytes are not a state, or belong to another servo.
        """
        return self._fitted(decode_state(servo, data))

    def _fitted(self, state: TwinState) -> TwinState:
        return replace(
            state,
            requests=None if self.requests is None else state.requests or RequestState(),
            triage=None if self.triage is None else state.triage or TriageState(),
            responses=None if self.responses is None else state.responses or ResponseState(),
            lookups=None if self.lookups is None else state.lookups or LookupState(),
        )


def _drive_of(servo: Plant, settings: TwinSettings) -> DriveStrength | None:
    """Comparison with the torque for which settings are verified, stated or not."""
    torque = 1.0 - (1.0 - settings.uncertainty.k_T) * (1.0 - settings.demands.beyond.k_T)
    return DriveStrength.of(servo, torque, settings.uncertainty.m)
