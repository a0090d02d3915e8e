"""Margins of a law over every plant of the uncertainty, and the candidates that keep to the demands on them."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import fields, replace
from functools import lru_cache
from typing import TypeAlias

import numpy as np

from servotwin.control.cascade import Cascade
from servotwin.control.controller import Controller
from servotwin.control.laws import AnyController, law_of
from servotwin.control.linear_law import LinearLaw
from servotwin.control.retuning import (
    integrates,
    law_for_margins,
    only_integrates,
    scaled,
    slowed,
    strength,
    without_integral,
)
from servotwin.errors import InvalidInput
from servotwin.plant.axis import Axis
from servotwin.plant.basis import BacklashKind
from servotwin.plant.law_set import LawSet
from servotwin.plant.loop_set import PlantSet, sampled_margins
from servotwin.plant.margins import GainCrossover, Margins
from servotwin.plant.plants import Plant
from servotwin.redesign.certified.certificate import LoopMargins
from servotwin.redesign.certified.demands import Demands
from servotwin.redesign.certified.machines import extreme_plants, parameters_of
from servotwin.redesign.certified.uncertainty import Uncertainty

# The same of a cascade whose gain must be less than half of the own one: its integral stays slower than the position
# loop, and still takes away what friction leaves.
_LITTLE_INTEGRAL = (0.03,)
AnyPlantSet: TypeAlias = PlantSet | LawSet
# Plants within the ranges, beside the model and the corners.
_WITHIN = 32
# Delays between the shortest and the longest.
_MOST_DELAYS = 8
_WORTH_TRYING = 0.5
# The servo's own PD and the constant that was near the best at every gap with hindsight: so the search is no worse.
_ALWAYS = (0.6, 1.0)
_ROUNDED = 1.0 + 1e-6
# Damping ratio of a notch's poles, and least one of its zeros: a deeper notch is a worse one as soon as the resonance
# is a little off. Resonances up to a share of the rate; centres per octave.
_NOTCH_DAMPING, _LEAST_DAMPING, _RESOLVED, _PER_OCTAVE = 0.5, 0.05, 0.1, 24


def widened(uncertainty: Uncertainty, demands: Demands) -> Uncertainty:
    """Uncertainty of the plant with the ranges that nobody stated."""
    known, beyond = parameters_of(uncertainty), demands.beyond
    learnt = known.learnt is not None and "k_T" in known.learnt.names
    gain = known.k_T if learnt else 1.0 - (1.0 - known.k_T) * (1.0 - beyond.k_T)
    return known.replace(k_T=gain, delay=max(known.delay, beyond.delay))


@lru_cache(maxsize=16)
def plant_set(servo: Plant, uncertainty: Uncertainty, rate: float | None) -> AnyPlantSet:
    """The model, the corners of the uncertainty and plants within, for a law like the servo's own with this rate."""
    servos = extreme_plants(servo, uncertainty, _WITHIN, seed=0)
    if isinstance(servo.controller, Controller):
        return PlantSet.of([each.plant() for each in servos], rate, servo.sensors.fed_back(servo.p).late(rate))
    return LawSet.of([each for each in servos if isinstance(each, Axis)], rate)


def delays_of(law: AnyController, uncertainty: Uncertainty) -> tuple[int, ...]:
    """Shortest and longest delay in samples."""
    return (0,) if law.sample_rate is None or uncertainty.delay == 0 else (0, uncertainty.delay)


def _every_delay(law: AnyController, uncertainty: Uncertainty) -> tuple[int, ...]:
    """Delays from the shortest to the longest, in samples: where resonances add crossovers one between may be worst."""
    least, longest = delays_of(law, uncertainty)[0], delays_of(law, uncertainty)[-1]
    return tuple(np.unique(np.linspace(least, longest, min(longest - least, _MOST_DELAYS) + 1).astype(int)).tolist())


@lru_cache(maxsize=256)
def loop_margins(servo: Plant, uncertainty: Uncertainty, law: AnyController, between: bool = True) -> LoopMargins:
    """Margins of a law on the model and over all plants of an uncertainty.

    Parameters
    ----------
    servo : Servo or Axis
    uncertainty : Uncertainty
        Of the plant alone, as `widened` makes it: equal ones share a stored result.
    law : Controller, Cascade or LinearLaw
    between : bool
        False: the shortest and the longest delay alone, in half of the time.
    """
    plants = plant_set(servo, uncertainty, law.sample_rate)
    delays = _every_delay(law, uncertainty) if between else delays_of(law, uncertainty)
    found = [plants.margins(law, delay) for delay in delays]
    nominal = nominal_margins(servo, law)
    crossover = nominal.gain_crossovers[-1] if nominal.gain_crossovers else GainCrossover(0.0, math.pi)
    return LoopMargins(
        plants=plants.count,
        delay=delays[-1],
        Ms=nominal.Ms,
        crossover=crossover.omega,
        phase_margin=crossover.phase_margin,
        Ms_worst=max(float(each.Ms.max()) for each in found),
        gain_margin_worst=min(float(each.gain_margin.min()) for each in found),
        phase_margin_worst=min(float(each.phase_margin.min()) for each in found),
        delay_margin_worst=min(float(each.delay_margin.min()) for each in found),
        decay=min(float(each.decay.min()) for each in found),
        passivity=min(float(each.passivity.min()) for each in found) if _gap_is_play(servo, law) else -math.inf,
    )


def _gap_is_play(servo: Plant, law: AnyController) -> bool:
    """True where the gap is a play in series with the loop, which the criterion is about: no load pushes the motor, the
    law reads nothing ahead of the gap, and it does not integrate beside the motor."""
    is_pushed = servo.backlash_kind is not BacklashKind.RIGID and servo.takes_friction
    if is_pushed or servo.backlash_kind is BacklashKind.FREE or servo.at_motor:
        return False
    return isinstance(law, Controller) and (not integrates(law) or only_integrates(law))


@lru_cache(maxsize=256)
def nominal_margins(servo: Plant, law: AnyController) -> Margins:
    """Margins of a law on the model itself, at the law's own rate."""
    if isinstance(law, Controller) and law.sample_rate is not None:
        return sampled_margins(servo.plant(), law, servo.sensors.fed_back(servo.p).late(law.sample_rate))
    running = law_of(law)
    if isinstance(servo, Axis):
        if isinstance(running, LinearLaw) and running.sample_rate is not None:
            running = running.held()
        return servo.margins(running)
    assert isinstance(running, Controller)
    return servo.margins(running)


@lru_cache(maxsize=16)
def laws_within(
    servo: Plant, uncertainty: Uncertainty, demands: Demands, integral: tuple[float, ...]
) -> tuple[AnyController, ...]:
    """Scaled controllers that are stable on all plants and keep to the bounds on Ms.

    Parameters
    ----------
    servo : Servo or Axis
    uncertainty : Uncertainty
        Of the plant alone, as `widened` makes it.
    demands : Demands
    integral : tuple of float
        Factors on Ki.

    Raises
    ------
    InvalidInput
        There is none, or the servo's controller has neither proportional action nor integral action alone.
    """
    own = servo.controller
    if isinstance(own, Controller) and own.Kp == 0.0 and not only_integrates(own):
        raise InvalidInput(
            "controller kp = 0: verified settings have scaled gains, proportional or integral alone, and this "
            'controller has neither; give one, or another policy than "certified"'
        )
    bounds = _Bounds(servo, uncertainty, demands, 0.0 in integral)
    laws = _scaled_laws(own, demands, demands.shapes, integral)
    laws += _scaled_laws(own, demands, demands.learnt_shapes, integral) if uncertainty.learnt is not None else []
    always = {scaled(own, scale, (1.0, 1.0), 0.0) for scale in _ALWAYS}
    within = _lively(laws, bounds.allow, always)
    if servo.at_motor and isinstance(own, Controller) and _all_slow(within, own):
        laws += _scaled_laws(own, demands, demands.motor_shapes, integral)
        within = _lively(laws, bounds.allow, always)
    notched = with_notch(servo) if demands.notch else None
    if isinstance(own, Cascade) and own.velocity_gain is not None and _all_slow(within, own):
        slow = _slower_cascades(own, notched, demands, integral)
        within = list(dict.fromkeys([*within, *_lively(slow, bounds.allow, set())]))
        laws += slow
    if notched is not None and (uncertainty.learnt is not None or not within):
        with_it = _scaled_laws(notched, demands, demands.notch_shapes, integral)
        within += _lively(with_it, bounds.allow, set())
        laws += with_it
    if not within:
        raise InvalidInput(_none_within(servo, uncertainty, demands, bounds.plants, laws))
    return tuple(within)


class _Bounds:
    """Bounds on a law over every plant of an uncertainty; `stopped`: a dead zone may stop its integral."""

    def __init__(self, servo: Plant, uncertainty: Uncertainty, demands: Demands, stopped: bool) -> None:
        self.plants = plant_set(servo, uncertainty, servo.controller.sample_rate)
        self._delays = delays_of(servo.controller, uncertainty)
        self._demands, self._stopped = demands, stopped
        self._known: dict[AnyController, bool] = {}

    def allow(self, law: AnyController) -> bool:
        """Tell whether a law is stable on all plants and keeps to the bounds on Ms, without its integral too."""
        if law not in self._known:
            stopped = without_integral(law) if integrates(law) and self._stopped else law
            # A small peak alone says nothing: that of an unstable loop may be small.
            self._known[law] = (
                (stopped is law or self.allow(stopped))
                and _keeps_to(self.plants, law, self._delays, self._demands)
                and _stable(self.plants, law, self._delays)
            )
        return self._known[law]


def _slower_cascades(
    own: Cascade, notched: Controller | Cascade | None, demands: Demands, integral: tuple[float, ...]
) -> list[AnyController]:
    """Cascades with a slower velocity loop, with little integral action, and with a notch."""
    slow = _slowed_laws(own, demands, integral)
    slow += _scaled_laws(own, demands, demands.shapes, _LITTLE_INTEGRAL) if max(integral) > 0.0 else []
    if notched is not None:
        assert isinstance(notched, Cascade)
        slow += _slowed_laws(notched, demands, integral)
    return slow


def _scaled_laws(
    own: AnyController, demands: Demands, shapes: tuple[tuple[float, float], ...], integral: tuple[float, ...]
) -> list[AnyController]:
    # An edge allows less integral action than the own one, by default not more.
    scales = [each for each in demands.scales if each <= 1.0] if only_integrates(own) else demands.scales
    laws = [scaled(own, scale, shape, share) for share in integral for shape in shapes for scale in scales]
    return list(dict.fromkeys(laws))


def _slowed_laws(own: Cascade, demands: Demands, integral: tuple[float, ...]) -> list[AnyController]:
    """The cascade with less speed, with its integral action and without: a lower velocity gain alone brings the
    velocity loop down to the position loop and to its own integral, which then leave no margin."""
    shares = [scale for scale in demands.scales if scale <= 1.0]
    laws = [slowed(own, share) for share in shares] if max(integral) > 0.0 else []
    return [*laws, *(without_integral(slowed(own, share)) for share in shares)]


def _lively(
    laws: list[AnyController], passes: Callable[[AnyController], bool], always: set[AnyController]
) -> list[AnyController]:
    """Laws that pass and are of `always`, or have at least half of the gain of the fastest that passes: the others are
    slower, at every gap of the presets."""
    fastest = next((law for law in sorted(laws, key=lambda law: -abs(strength(law))) if passes(law)), None)
    least = math.inf if fastest is None else _WORTH_TRYING * abs(strength(fastest))
    return [law for law in laws if (abs(strength(law)) >= least or law in always) and passes(law)]


def _all_slow(laws: list[AnyController], own: AnyController) -> bool:
    """True where none of the laws has at least half of the own gain."""
    return all(abs(strength(law)) < _WORTH_TRYING * abs(strength(own)) for law in laws)


def with_notch(servo: Plant) -> Controller | Cascade | None:
    """The servo's controller with a notch at the first resonance of its structure; None: nothing resonates, or at a
    frequency that a sampled law hardly resolves; or the law has no place for one."""
    own = servo.controller
    if isinstance(own, LinearLaw) or (isinstance(own, Cascade) and own.notch_hz is not None):
        return None
    poles = servo.plant().poles()
    # The angle from the imaginary axis is the damping ratio's arcsine.
    resonant = poles[(poles.imag > 0.0) & (-poles.real < _NOTCH_DAMPING * np.abs(poles))]
    if not resonant.size:
        return None
    first = complex(resonant[np.argmin(np.abs(resonant))])
    hertz, damping = abs(first) / (2.0 * math.pi), -first.real / abs(first)
    rate = own.sample_rate
    if rate is not None and hertz > _RESOLVED * rate:
        return None
    # Rounded: what a window adds to a learnt resonance is not worth another notch.
    unit = _unit_hz(own)
    hertz = unit * 2.0 ** (round(_PER_OCTAVE * math.log2(hertz / unit)) / _PER_OCTAVE)
    depth = min(0.9, round(max(damping, _LEAST_DAMPING) / _NOTCH_DAMPING, 1))
    return own.replace(notch_hz=hertz, notch_damping=_NOTCH_DAMPING, notch_depth=depth)


def _unit_hz(law: Controller | Cascade) -> float:
    """Frequency of the law, whatever is learnt: 1 Hz at a rate of 1 kHz, or of the paper's law in continuous time."""
    if law.sample_rate is not None:
        return 1e-3 * law.sample_rate
    assert isinstance(law, Controller)
    return 0.5 / law.release if law.release > 0.0 else 1.0


def _keeps_to(plants: AnyPlantSet, law: AnyController, delays: tuple[int, ...], demands: Demands) -> bool:
    """True where no peak is beyond the bounds; what fails on the model itself is not tried elsewhere."""
    first = plants.peaks(law, delays[0])
    if first[0] > demands.Ms * _ROUNDED:
        return False
    return all(plants.peaks(law, delay).max() <= demands.Ms_worst * _ROUNDED for delay in delays)


def _none_within(
    servo: Plant, uncertainty: Uncertainty, demands: Demands, plants: AnyPlantSet, laws: list[AnyController]
) -> str:
    """Reason why none of the laws is within the bounds."""
    rate, delays = servo.controller.sample_rate, delays_of(servo.controller, uncertainty)
    at = "" if rate is None else f" at {rate:g} Hz with up to {uncertainty.delay} samples of delay"
    stable = [law for law in laws if _stable(plants, law, delays)]
    peaks = [max(float(plants.peaks(law, delay).max()) for delay in delays) for law in stable]
    found = f"; the least that any has is {min(peaks):.3g}" if peaks else "; none is stable there"
    return (
        f"no candidate has Ms <= {demands.Ms:g} on this servo and <= {demands.Ms_worst:g} on every plant of the "
        f"stated ranges{at}{found}: raise the bounds, narrow the ranges, or allow smaller scales than "
        f"{min(demands.scales):g}"
    )


def _stable(plants: AnyPlantSet, law: AnyController, delays: tuple[int, ...]) -> bool:
    return all(bool(plants.stable(law, delay).all()) for delay in delays)


def margins_in_every_zone(
    servo: Plant, uncertainty: Uncertainty, law: AnyController, between: bool = True
) -> LoopMargins:
    """`loop_margins`, for a dead zone that stops the integral only the worse of those with and without the integral.

    Without an integral that is all of a law there is no loop.
    """
    acting = loop_margins(servo, uncertainty, law_for_margins(law), between)
    if not law.integral_only or only_integrates(law):
        return acting
    stopped = loop_margins(servo, uncertainty, without_integral(law_for_margins(law)), between)
    most = {name: max(getattr(acting, name), getattr(stopped, name)) for name in ("Ms", "Ms_worst")}
    names = [field.name for field in fields(LoopMargins) if field.name.endswith("margin_worst")]
    least = {name: min(getattr(acting, name), getattr(stopped, name)) for name in (*names, "phase_margin", "passivity")}
    return replace(acting, **most, **least)


def with_margins(demands: Demands) -> Demands:
    """The part of the demands that the candidates depend on."""
    known = Demands()
    shapes = ("shapes", "learnt_shapes", "notch_shapes", "motor_shapes")
    names = ("Ms", "Ms_worst", "scales", "notch", "integral", "beyond", *shapes)
    return replace(known, **{name: getattr(demands, name) for name in names})
