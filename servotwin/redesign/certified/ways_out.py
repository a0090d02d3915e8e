"""Changes after which a setting would be verified, where none is for the ranges that are stated."""

from __future__ import annotations

import math
from collections.abc import Iterator

from servotwin.analysis.tuning.cascade import tune_cascade, under_cascade
from servotwin.config.own_units import COMMANDS
from servotwin.control.controller import Controller
from servotwin.errors import InvalidInput
from servotwin.plant.axis import Axis
from servotwin.plant.display_units import command_unit
from servotwin.plant.plants import Plant
from servotwin.redesign.certified.certificate import Certificate
from servotwin.redesign.certified.certify import certify
from servotwin.redesign.certified.demands import Demands
from servotwin.redesign.certified.trial import Trial
from servotwin.redesign.certified.uncertainty import Uncertainty

# Parts of the stated gaps, and of the own crossover for a cascade's velocity loop, that are tried; its phase margin.
_GAPS, _CROSSOVERS, _MARGIN_DEG = (0.5, 0.25), (1.0, 0.5, 0.25), 60.0


def ways_out(servo: Plant, uncertainty: Uncertainty, demands: Demands, trial: Trial) -> str:
    """Say after which change a setting is verified: a narrower range, and a cascade in place of a filtered PID.

    Each is tried by itself, and of each kind the first that is verified is named.
    """
    found, missed = list[str](), list[str]()
    for kind in (_narrower(servo, uncertainty, demands, trial), _cascades(servo, uncertainty, demands)):
        for words, verified in kind:
            (found if verified else missed).append(words)
            if verified:
                break
    return (
        f"a setting is verified {', or '.join(found)}" if found else f"none is verified {', nor '.join(missed)} either"
    )


def _narrower(servo: Plant, uncertainty: Uncertainty, demands: Demands, trial: Trial) -> Iterator[tuple[str, bool]]:
    """Narrower ranges in words, and whether a setting is verified for them."""
    if any(uncertainty.input_bias):
        key = f"input_bias_{COMMANDS[command_unit(servo)][0]}"
        ranges = uncertainty.replace(input_bias=(0.0, 0.0))
        yield f"where there is no input bias ({key})", _is_verified(servo, ranges, demands, trial)
    low, most = uncertainty.gap
    for part in _GAPS:
        ranges = uncertainty.replace(gap=(min(low, part * most), part * most))
        words = f"for gaps of at most {math.degrees(part * most):.3g} deg (gap_deg)"
        yield words, _is_verified(servo, ranges, demands, trial)


def _cascades(servo: Plant, uncertainty: Uncertainty, demands: Demands) -> Iterator[tuple[str, bool]]:
    """Commands that make the axis's controller a cascade, in words, and whether a setting is then verified."""
    if not (isinstance(servo, Axis) and isinstance(servo.controller, Controller) and servo.sensors.motor_encoder):
        return
    for crossover in servo.margins().gain_crossovers[:1]:
        for part in _CROSSOVERS:
            omega = float(f"{part * crossover.omega:.3g}")
            try:
                axis = under_cascade(servo, omega)
                axis = axis.replace(controller=tune_cascade(axis, omega, math.radians(_MARGIN_DEG)).controller)
                verified = _is_verified(axis, uncertainty, demands, None)
            except InvalidInput:
                continue
            yield (
                f"with a cascade and an encoder at the motor (servotwin tune {omega:g} {_MARGIN_DEG:g} --type cascade)",
                verified,
            )


def _is_verified(servo: Plant, uncertainty: Uncertainty, demands: Demands, trial: Trial | None) -> bool:
    return isinstance(certify(servo, uncertainty, demands, trial), Certificate)
