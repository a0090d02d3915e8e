"""All policies by name. A new policy is a module in this package and one entry here."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import NamedTuple, Protocol

from servotwin.control.controller import Controller
from servotwin.control.laws import kind_of
from servotwin.control.retuning import check_zone_acts, static_gain
from servotwin.errors import InvalidInput
from servotwin.estimation.disturbance import holds_position
from servotwin.plant.plants import Plant, check_gap_in_loop, check_homogeneous
from servotwin.redesign.certified.demands import Demands
from servotwin.redesign.certified.lookup import TablePolicy
from servotwin.redesign.certified.lookup_file import load
from servotwin.redesign.certified.policy import CertifiedPolicy
from servotwin.redesign.certified.rest_in_gap import check_rests
from servotwin.redesign.certified.uncertainty import Uncertainty
from servotwin.redesign.dead_zones import HysteresisPolicy, MarginPolicy
from servotwin.redesign.policy import PaperPolicy, Policy


class PolicyOptions(Protocol):
    """Options of all policies, as a twin's settings have them; None: the policy's default."""

    @property
    def policy(self) -> str: ...
    @property
    def uncertainty(self) -> Uncertainty: ...
    @property
    def demands(self) -> Demands: ...
    @property
    def holds_for(self) -> float: ...
    @property
    def table(self) -> str | None: ...
    @property
    def k_dz(self) -> float | None: ...
    @property
    def smoothing(self) -> float | None: ...
    @property
    def k_noise(self) -> float | None: ...


def paper_k_dz(options: PolicyOptions) -> float:
    """Dead zone of the policy `paper` over the lost motion at the load (Eq 21)."""
    return 1.0 if options.k_dz is None else options.k_dz


class PolicyEntry(NamedTuple):
    """A policy's maker, and the options that belong to it alone."""

    make: Callable[[Plant, PolicyOptions], Policy]
    options: tuple[str, ...] = ()


def policy_of(servo: Plant, options: PolicyOptions) -> Policy:
    """Make the policy that the options name.

    Parameters
    ----------
    servo : Servo or Axis
        The model, with the controller that runs: its loop filter and limits count, and candidates scale its gains.
    options : PolicyOptions

    Raises
    ------
    InvalidInput
        The policy cannot design for this controller, or its table is not this model's.
    """
    return POLICIES[options.policy].make(servo, options)


def certified_policy(servo: Plant, options: PolicyOptions) -> CertifiedPolicy:
    """Make the certified policy; its largest feedforward cancels the largest stated input bias."""
    check_verifiable(servo)
    check_rests(servo, options.uncertainty, options.demands)
    low, high = options.uncertainty.input_bias
    limit = max(abs(low), abs(high))
    return CertifiedPolicy(
        servo, options.uncertainty, options.demands, feedforward_limit=limit, horizon=options.holds_for
    )


def check_verifiable(servo: Plant) -> None:
    """Refuse an axis or a controller whose settings cannot be verified.

    Raises
    ------
    InvalidInput
        An axis whose loop does not depend on the gap.
        A cascade or a linear law without a sample rate, or one that does not answer to a constant error.
    """
    check_gap_in_loop(servo)
    law = servo.controller
    if isinstance(law, Controller):
        return
    if law.sample_rate is None:
        raise InvalidInput(
            f"controller sample_rate = None: settings of a {type(law).__name__} are verified at its rate; give it in Hz"
        )
    if not math.isfinite(static_gain(law)) or static_gain(law) == 0.0:
        raise InvalidInput(
            f"controller {law!r}: has no proportional action, without which no setting is verified; "
            "integrators belong in holds"
        )


def check_tabled(servo: Plant, named: str) -> None:
    """Refuse a table for a controller whose settings no table holds; the sentence opens with what is `named`.

    Raises
    ------
    InvalidInput
        The controller is no filtered PID.
    """
    if not isinstance(servo.controller, Controller):
        raise InvalidInput(
            f"{named}: tables hold settings of a filtered PID, and this controller is a {kind_of(servo.controller)} "
            "one; leave the table out: the twin verifies each setting before it sends it"
        )


def _certified(servo: Plant, options: PolicyOptions) -> Policy:
    """Make the policy that verifies before every update or, with a table, looks settings up."""
    policy = certified_policy(servo, options)
    if options.table is None:
        return policy
    check_tabled(servo, f"table = {options.table!r}")
    try:
        return TablePolicy(policy, load(Path(options.table), policy))
    except InvalidInput as error:
        raise InvalidInput(f"table = {options.table!r}: {error}") from None


def _margin(servo: Plant, options: PolicyOptions) -> MarginPolicy:
    check_homogeneous(servo, 'policy = "margin"')
    _check_zone(servo, "margin")
    if not isinstance(servo.controller, Controller):
        raise InvalidInput(
            "policy 'margin' designs for the filtered PID only, and this controller is another: give another policy"
        )
    if servo.pidf.voltage_limit is not None:
        raise InvalidInput(
            "policy 'margin' reads its dead zone from a map that serves every gap, which no map does for a controller "
            "with a voltage limit, and this one has one: give another policy"
        )
    step, continuous = options.uncertainty.step, servo.replace(sample_rate=None, rate_limit=None)
    if options.k_noise is None:
        return MarginPolicy(continuous, step)
    return MarginPolicy(continuous, step, options.k_noise)


def _hysteresis(servo: Plant, _options: PolicyOptions) -> HysteresisPolicy:
    _check_zone(servo, "hysteresis")
    return HysteresisPolicy(servo)


def _paper(servo: Plant, options: PolicyOptions) -> PaperPolicy:
    policy = PaperPolicy(servo, paper_k_dz(options), options.smoothing or 0.0)
    if policy.k_dz > 0.0:
        _check_zone(servo, "paper")
    return policy


def _check_zone(servo: Plant, policy: str) -> None:
    """Refuse a dead zone that changes nothing, or whose command of zero moves a stepper: it goes to its angle zero."""
    check_zone_acts(servo.controller, f"policy {policy!r}: the dead zone that it sets")
    if holds_position(servo) and not servo.controller.integral_only:
        raise InvalidInput(
            f"policy {policy!r}: inside its dead zone the command is zero, and this axis's stepper would go to the "
            "angle zero; give its controller integral_only = true, with which the motor holds its angle there, or give "
            'the policy "certified"'
        )


POLICIES: Mapping[str, PolicyEntry] = {
    "certified": PolicyEntry(_certified, ("table",)),
    "margin": PolicyEntry(_margin, ("k_noise",)),
    "hysteresis": PolicyEntry(_hysteresis),
    "paper": PolicyEntry(_paper, ("k_dz", "smoothing")),
}
"""The first is the default."""
