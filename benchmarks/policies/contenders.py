"""The competitors: the policies, and constant controllers among which the best is chosen with hindsight."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

from benchmarks.policies.trial import Contender
from servotwin.plant.servo import Servo
from servotwin.redesign.certified.candidates import candidates_of
from servotwin.redesign.certified.demands import Demands
from servotwin.redesign.certified.policy import CertifiedPolicy
from servotwin.redesign.certified.uncertainty import Uncertainty
from servotwin.redesign.dead_zones import HysteresisPolicy, MarginPolicy
from servotwin.redesign.design import Design
from servotwin.redesign.policy import PaperPolicy

POLICIES = ("no dead zone", "paper", "margin", "hysteresis", "certified")
_NOT_BOUND = 100.0


@cache
def contender(name: str, model: Servo, known: Uncertainty) -> Contender:
    """Make a policy by name, with the model and its stated uncertainty."""
    own = Design(model.controller)
    if name == "no dead zone":
        return Contender(None, own)
    if name == "paper":
        return Contender(PaperPolicy(model), own)
    if name == "margin":
        return Contender(MarginPolicy(model, known.step), own)
    if name == "hysteresis":
        return Contender(HysteresisPolicy(model), own)
    certified = CertifiedPolicy(model, known)
    return Contender(certified, certified.fallback().setting)


def constants(model: Servo, known: Uncertainty) -> dict[str, Design]:
    """List constant settings by name.

    They are the candidates of `certified`, without its bound on Ms, and the paper's gains with dead zones for gaps of
    10, 30 and 60 deg.
    """
    policies = candidates(model, known, without_bounds(CertifiedPolicy(model, known).demands))
    for share in (1.0 / 6.0, 0.5, 1.0):
        width = model.tolerance_for(share * known.gap[1], 1.5)
        policies[f"own gains, dead zone {width * 1e3:.3g} mm"] = Design(model.controller, width)
    return policies


def without_bounds(demands: Demands) -> Demands:
    """Demands without their bounds on Ms, for candidates that differ from the servo's own law by their scale only."""
    return replace(demands, Ms=_NOT_BOUND, Ms_worst=_NOT_BOUND, shapes=((1.0, 1.0),))


def candidates(model: Servo, known: Uncertainty, demands: Demands) -> dict[str, Design]:
    """List the candidates of `certified` by name, those with integral action among them.

    A name has the factors on the servo's own gains, and the velocity feedforward in parts of the back EMF.
    """
    every = candidates_of(model, known, demands, disturbed=True, noisy=False)
    result = {_name(model, each): each for each in every}
    assert len(result) == len(every)
    return result


def _name(model: Servo, setting: Design) -> str:
    law, own = setting.pid, model.controller
    scale, rate, slower = law.Kp / own.Kp, law.Kd / own.Kd, law.Tf / own.Tf
    gains = f"Kp, Kd x {scale:.3g}" if rate == scale else f"Kp x {scale:.3g}, Kd x {rate:.3g}, Tf x {slower:.3g}"
    stops = f", stops within {setting.tolerance * 1e6:g} um" if law.integral_only else ""
    fed = law.velocity_feedforward * model.p / model.k_B
    return f"{gains}, Ki x {law.Ki / own.Ki:g}{stops}" + (f", velocity x {fed:g}" if fed else "")
