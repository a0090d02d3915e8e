"""The policy that a twin's settings name, for the controller that runs."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

from servotwin.errors import InvalidInput
from servotwin.plant.servo import Servo
from servotwin.redesign.certified.lookup import TablePolicy
from servotwin.redesign.certified.lookup_file import load
from servotwin.redesign.certified.policy import CertifiedPolicy
from servotwin.redesign.dead_zones import HysteresisPolicy, MarginPolicy
from servotwin.redesign.policy import PaperPolicy, Policy
from servotwin.twin.settings import TwinSettings


def policy_of(servo: Servo, settings: TwinSettings) -> Policy:
    """The policy that `settings` name.

    Parameters
    ----------
    servo : Servo
        The model, with the controller that runs: its loop filter and limits count, and candidates scale its gains.
    settings : TwinSettings

    Raises
    ------
    InvalidInput
        The policy cannot design for this controller, or its table is not this model's.
    """
    return _MAKERS[settings.policy](servo, settings)


def certified(servo: Servo, settings: TwinSettings) -> CertifiedPolicy:
    """The certified policy; it feeds no more forward than cancels the largest input bias that is stated."""
    low, high = settings.uncertainty.input_bias
    return CertifiedPolicy(servo, settings.uncertainty, settings.demands, feedforward_limit=max(abs(low), abs(high)))


def _certified(servo: Servo, settings: TwinSettings) -> Policy:
    """Proving, or looking up."""
    policy = certified(servo, settings)
    return policy if settings.table is None else TablePolicy(policy, load(Path(settings.table), policy))


def _margin(servo: Servo, settings: TwinSettings) -> MarginPolicy:
    if servo.controller.voltage_limit is not None:
        raise InvalidInput(
            "policy 'margin' reads its dead zone from a map that serves every gap, which no map does for a controller "
            "with a voltage limit, and this one has one: give another policy"
        )
    step, continuous = settings.uncertainty.step, servo.replace(sample_rate=None, rate_limit=None)
    return (
        MarginPolicy(continuous, step) if settings.k_noise is None else MarginPolicy(continuous, step, settings.k_noise)
    )


def _hysteresis(servo: Servo, _settings: TwinSettings) -> HysteresisPolicy:
    return HysteresisPolicy(servo)


def _paper(servo: Servo, settings: TwinSettings) -> PaperPolicy:
    return PaperPolicy(servo, 1.0 if settings.k_dz is None else settings.k_dz, settings.smoothing or 0.0)


_MAKERS: Mapping[str, Callable[[Servo, TwinSettings], Policy]] = {
    "certified": _certified,
    "margin": _margin,
    "hysteresis": _hysteresis,
    "paper": _paper,
}
