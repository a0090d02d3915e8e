"""Faults of a window's channels, common wrong units and signs, and the motor's angle filtered for the play operator."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from servotwin.errors import InvalidInput
from servotwin.estimation.core.decimation import decimation
from servotwin.estimation.core.least_squares import least_squares
from servotwin.estimation.core.motor_angle import without_noise
from servotwin.estimation.core.response import response
from servotwin.estimation.core.upsampling import upsampled
from servotwin.estimation.core.visible import counted
from servotwin.estimation.estimate import GapEstimate, GapStatus
from servotwin.estimation.paper.zero_phase import ZeroPhase
from servotwin.estimation.whitened.fit import gaps_to_try
from servotwin.estimation.whitened.gate import slow
from servotwin.estimation.whitened.reduction import CONSTANT, RESIDUAL, Reduction, factor_for
from servotwin.estimation.whitened.saturation import RUN, STEEP, runs, saturation
from servotwin.estimation.whitened.search import search
from servotwin.estimation.whitened.settings import WhitenedSettings
from servotwin.estimation.window import Window
from servotwin.plant.load import LINEAR
from servotwin.plant.servo import Servo
from servotwin.plant.signals import Array

_JUMP = 50.0  # times the usual fastest motion
# Of the median step, of the motion's range; counts, of which noise makes two. A half more: whole counts differ in their
# last digits.
_SPIKE, _SHOWN, _SPIKE_COUNTS = 8.0, 0.01, 2.5
_SLIP_SHOWN, _SLIP_COUNTS = 0.001, 5.5  # of the motion's range; counts, of which noise and rounding make three
_SLIP_BESIDE, _BESIDE = 3.0, 10  # of the changes of the steps beside it; so many on each side
# Equal samples; times the usual change of speed there, at which motion begins or ends; times the next steps.
_REPEATED, _ABRUPT, _LEAP = 4, 4.0, 2.0
_THIRD_DIFFERENCES = math.sqrt(20.0)  # gain on white noise
_QUIET, _LOUD = math.radians(0.002), math.radians(0.03)  # noise of the encoder: below, nothing; above, the lowest cut
_HIGHEST_HZ, _LOWEST_HZ, _ORDER = 200.0, 60.0, 3  # of the servo's own seconds
_TAKEN, _PEAK = 1.5, 8.0  # standard deviations of the noise: what a low-pass may take away, rms and in a sample
_NYQUIST = 0.45  # of the sample rate: the highest cut-off


def faults(window: Window, motion: str = LINEAR) -> tuple[str, ...]:
    """List the faults of theta_m and position, one sentence each; `motion` as in `servotwin.plant.load.Load`."""
    assert window.theta_m is not None
    degrees = (math.degrees(1.0), "deg")
    units = {"theta_m": degrees, "position": (1e3, "mm") if motion == LINEAR else degrees}
    channels = {name: (window.channels[name], *unit) for name, unit in units.items()}
    sentences = [_fault(name, samples, factor, unit) for name, (samples, factor, unit) in channels.items()]
    # A position that is held is late, as others are; an angle moves the screw by leaps.
    found = tuple(sentence for sentence in sentences if sentence)
    found = upsampled(window.theta_m, window.sample_rate) or found
    return found or _slip(window.theta_m, window.position, *units["position"])


def refused(blank: GapEstimate, sentences: tuple[str, ...]) -> GapEstimate:
    """A blank estimate that says with which faults its channels are of no use; a dead one shows nothing."""
    dead = any("constant" in sentence for sentence in sentences)
    status = GapStatus.UNIDENTIFIABLE if dead else GapStatus.MODEL_MISMATCH
    return replace(blank, status=status, reasons=sentences)


def _fault(name: str, samples: Array, factor: float, unit: str) -> str:
    steps = np.abs(np.diff(samples))
    span = float(np.ptp(samples))
    if span * span == 0.0:  # also of a motion whose square underflows
        return f"{name} is constant at {factor * samples[0]:.6g} {unit}: nothing moved, or the sensor is dead"
    index = int(np.argmax(steps))
    if steps[index] > 0.2 * span and steps[index] > _JUMP * max(_usual(steps), 1e-9 * span):
        return (
            f"{name} jumps by {factor * steps[index]:.6g} {unit} between samples {index} and {index + 1}: a wrapped "
            "encoder, or samples are missing"
        )
    return (
        saturation(name, samples, steps, factor, unit)
        or _repeating(name, np.diff(samples))
        or _spike(name, samples, factor, unit)
    )


def _spike(name: str, samples: Array, factor: float, unit: str) -> str:
    """Describe a sample that leaves its neighbours and comes back at once; empty without one."""
    index, size = _loner(samples)
    if size <= _SHOWN * float(np.ptp(samples)) or size <= _SPIKE_COUNTS * counted(samples):
        return ""
    return f"{name} leaves its neighbours by {factor * size:.6g} {unit} in sample {index} alone: a fault of the sensor"


def _slip(theta_m: Array, position: Array, factor: float, unit: str) -> tuple[str, ...]:
    """Describe a position that moves on in one step alone and stays there, at most one sentence.

    No load does, which has a speed before and after. Where the motor does, as one that is told to step, the load may
    follow, or the samples of both are missing.
    """
    if _slipped(theta_m)[1] > 0.0:
        return ()
    index, size = _slipped(position)
    if size == 0.0:
        return ()
    words = "the motor does not: the load or its scale slipped, or samples are missing"
    return (f"position slips by {factor * size:.6g} {unit} between samples {index} and {index + 1}, and {words}",)


def _slipped(samples: Array) -> tuple[int, float]:
    """Sample before the step that leaves its neighbours, and by how much; 0 without one."""
    index, size = _loner(np.diff(samples))
    changes = np.abs(np.diff(samples, 2))
    # Where the times of the samples jitter, steps change the more the faster the motion is.
    beside = np.concatenate([changes[max(0, index - _BESIDE) : index - 1], changes[index + 1 : index + _BESIDE]])
    shown = size > _SLIP_SHOWN * float(np.ptp(samples)) and size > _SLIP_COUNTS * counted(samples)
    return index, size if shown and size > _SLIP_BESIDE * float(beside.max(initial=0.0)) else 0.0


def _loner(values: Array) -> tuple[int, float]:
    """Index of the value that leaves both of its neighbours farthest, and by how much; 0 where no value clearly does.

    No motion does: at its crests both steps are smaller than those beside them. Noise does by a few of its standard
    deviations, which the median step is, and a counter by one count.
    """
    steps = np.diff(values)
    sizes = np.pad(np.abs(steps), 1)
    back, beside = np.minimum(sizes[2:-1], sizes[1:-2]), np.maximum(sizes[3:], sizes[:-3])
    back[(steps[1:] * steps[:-1] >= 0.0) | (back <= beside)] = 0.0
    index = int(np.argmax(back))
    size = float(back[index])
    return index + 1, size if size > _SPIKE * float(np.median(np.abs(steps))) else 0.0


def _usual(steps: Array) -> float:
    """Usual fastest motion: only few steps are larger."""
    return float(np.partition(steps, -20)[-20]) if steps.size > 400 else math.inf


def _repeating(name: str, steps: Array) -> str:
    """Describe samples that repeat the one before them in full motion; empty without them.

    What comes to rest slows down, and what starts is no faster in its first sample than in the next ones, as a motor
    that friction held until its voltage stepped. A channel that stands still with the next sample, or leaves with a
    leap, was held: samples are missing. A count more or less is no motion, and a channel that is
    recorded more often than measured repeats most values: `upsampled` speaks of it.
    """
    begins, ends = runs(steps == 0.0)
    long = ends - begins >= _REPEATED - 1
    if not np.any(long):
        return ""
    moving, sizes = np.flatnonzero(steps), np.abs(steps)
    if moving.size < 2 or np.median(np.diff(moving)) > 1.0:
        return ""
    least = max(_ABRUPT * float(np.min(sizes[moving])), STEEP * float(np.max(sizes)))
    for begin, end in zip(begins[long], ends[long], strict=True):
        before, after = steps[max(0, begin - RUN) : begin][::-1], steps[end : end + RUN]
        leaps = _abrupt(after, least) and abs(after[0]) > _LEAP * float(np.max(np.abs(after[1:])))
        if leaps or _abrupt(before, least):
            repeats = f"{name} repeats one value in full motion, in samples {begin} to {end}"
            return f"{repeats}: it was held while samples were missing"
    return ""


def _abrupt(side: Array, least: float) -> bool:
    """True where the first of some steps is beyond `least` and beyond the change of speed in the others.

    All go one way: steps to and fro are the noise of a channel at rest, whose counts repeat by chance.
    """
    if side.size < RUN or np.any(side * side[0] <= 0.0):
        return False
    return bool(abs(side[0]) > max(least, _ABRUPT * float(np.max(np.abs(np.diff(side[1:]))))))


def _encoder_noise(theta_m: Array) -> float:
    """Standard deviation (rad) of the noise on an angle that moves smoothly: third differences leave little else.

    The median over blocks counts, because an angle is not smooth where the voltage jumps. Blocks at rest, where
    a quantised angle shows no noise, do not count.
    """
    differences = np.diff(theta_m, 3)
    blocks = differences[: differences.size // 20 * 20].reshape(20, -1)
    sizes = np.sqrt(np.mean(blocks * blocks, axis=1)) / _THIRD_DIFFERENCES
    return float(np.median(sizes[sizes > 0.0])) if np.any(sizes > 0.0) else 0.0


def motor_angle(window: Window, resolution: float, settings: WhitenedSettings, second: float) -> Array:
    """(n,) theta_m, low-passed without phase where the encoder is noisy.

    The play operator would ratchet to the extremes of the noise. The cut-off goes from 200 Hz for little noise down to
    60 Hz, on the paper's servo, but no lower than the motion allows. Louder noise than that one takes away, beyond the
    counts, is smoothed as far as the motion allows.

    Parameters
    ----------
    window : Window
    resolution : float
        rad, one count of the encoder.
    settings : WhitenedSettings
    second : float
        s, one of the servo's own (`plant.scales`).
    """
    assert window.theta_m is not None
    cutoff, rate = settings.prefilter_hz, window.sample_rate
    if cutoff is None:
        noise = _encoder_noise(window.theta_m)
        if max(noise, resolution / math.sqrt(12.0)) <= _QUIET:
            return window.theta_m
        if noise > _LOUD:
            smooth = without_noise(window.theta_m, max(resolution, counted(window.theta_m))).angle
            if smooth is not window.theta_m:
                return smooth
        share = math.log(max(noise, _QUIET) / _QUIET) / math.log(_LOUD / _QUIET)
        lowest = _HIGHEST_HZ / second * (_LOWEST_HZ / _HIGHEST_HZ) ** min(1.0, share)
        return _low_passed(window.theta_m, lowest, rate, max(noise, resolution / math.sqrt(12.0)))
    if cutoff == 0.0:
        return window.theta_m
    if cutoff >= 0.5 * rate:
        raise InvalidInput(f"estimator prefilter_hz = {cutoff!r} Hz: must be below half of {rate:.6g} Hz")
    return _zero_phase(window.theta_m, cutoff, rate)


def _low_passed(theta_m: Array, cutoff: float, rate: float, noise: float) -> Array:
    """(n,) theta_m, low-passed at the lowest cut-off from `cutoff` (Hz) on that takes away no more than noise (rad).

    A machine that moves faster than its stated loop would lose its motion by a lower one.
    """
    while cutoff < _NYQUIST * rate:
        smooth = _zero_phase(theta_m, cutoff, rate)
        taken = smooth - theta_m
        if float(np.std(taken)) <= _TAKEN * noise and float(np.max(np.abs(taken))) <= _PEAK * noise:
            return smooth
        cutoff *= 2.0
    return theta_m


def _zero_phase(theta_m: Array, cutoff: float, rate: float) -> Array:
    """(n,) theta_m, low-passed without phase at a cut-off (Hz)."""
    return ZeroPhase(cutoff, _ORDER, rate, "odd", min(round(rate / cutoff), theta_m.size - 1)).respond(theta_m)


_EXPLAINS, _BETTER = 0.05, 0.2  # share left that counts as a fit; of what the channels as given leave
_POSITION_UNITS = {"mm": 1e-3, "micrometres": 1e-6, "units of 1000 m": 1e3}
_ROTARY_UNITS = {"degrees": math.pi / 180.0, "turns": 2.0 * math.pi}
_ANGLE_UNITS = _ROTARY_UNITS | {"units of 57.3 rad": 180.0 / math.pi}
_WIDER = (180.0 / math.pi, 1e3, 1e6, 0.5 / math.pi)  # counts in degrees, in thousandths, in millionths, in turns
_ALIKE = 0.02
_PITCHES = (0.5, 2.0)
_RATES = (0.1, 0.2, 0.5, 2.0, 5.0, 10.0)


def other_units(window: Window, angle_count: float, position_count: float) -> tuple[str, ...]:
    """Sentence for channels both of whose counts are those of other units; empty where a count is unknown or unseen.

    A machine moves alike at any scale, so that nothing else in a window tells units by which both channels are wrong.

    Parameters
    ----------
    window : Window
    angle_count, position_count : float
        One count of each encoder as stated, rad and m (rotary: rad); 0: unknown.
    """
    assert window.theta_m is not None
    if not (angle_count > 0.0 and position_count > 0.0):
        return ()
    wider = counted(window.theta_m) / angle_count, counted(window.position) / position_count
    if not all(any(abs(each / unit - 1.0) < _ALIKE for unit in _WIDER) for each in wider):
        return ()
    return (
        f"theta_m counts in steps {wider[0]:.3g} times as wide as its encoder's, and position {wider[1]:.3g} times: "
        "both seem to be in other units",
    )


def likely_fault(window: Window, theta_m: Array, servo: Servo, unexplained: float, second: float) -> tuple[str, ...]:
    """Find the first fault whose correction lets the model explain the window; empty where none does or is needed."""

    def left(angle: Array, position: Array, rate: float) -> float:
        return _unexplained_share(angle, position, rate, servo, second)

    return corrected(window, theta_m, left, unexplained)


def corrected(
    window: Window,
    theta_m: Array,
    left: Callable[[Array, Array, float], float],
    unexplained: float,
    motion: str = LINEAR,
    explains: float = _EXPLAINS,
) -> tuple[str, ...]:
    """Find the first fault whose correction explains the window; empty where none does or is needed.

    Parameters
    ----------
    window : Window
    theta_m : (n,) array
        rad.
    left : callable
        Share of the position's motion that a model leaves of a corrected angle (n,), position (n,) and rate (Hz).
    unexplained : float
        The same of the channels as given.
    motion : str
        As in `servotwin.plant.load.Load`.
    explains : float
        Share left that counts as a fit.
    """
    if unexplained <= explains:
        return ()
    for sentence, angle, position, rate in _candidates(window, theta_m, motion):
        if left(angle, position, rate) < min(explains, _BETTER * unexplained):
            return (sentence,)
    return ()


def _candidates(window: Window, theta_m: Array, motion: str) -> Iterator[tuple[str, Array, Array, float]]:
    """Yield possible faults, each with the corrected angle, position and rate."""
    position, rate = window.position, window.sample_rate
    yield "position and theta_m seem to be swapped", position, theta_m, rate
    yield "position or theta_m seems to have the wrong sign", theta_m, -position, rate
    si, units = ("m", _POSITION_UNITS) if motion == LINEAR else ("rad", _ROTARY_UNITS)
    for unit, factor in units.items():
        yield f"position seems to be in {unit}, not in {si}", theta_m, factor * position, rate
    for unit, factor in _ANGLE_UNITS.items():
        yield f"theta_m seems to be in {unit}, not in rad", factor * theta_m, position, rate
    for factor in _PITCHES:
        yield f"the pitch seems to be {factor:g} times the model's", theta_m, position / factor, rate
    for factor in _RATES:
        wrong = f"the sample rate seems to be {factor * rate:.6g} Hz, not {rate:.6g} Hz"
        yield wrong, theta_m, position, factor * rate


def _unexplained_share(theta_m: Array, position: Array, rate: float, servo: Servo, second: float) -> float:
    """Slow part of a plain fit's residual over that of the position."""
    reduce = decimation(factor_for(response(servo, rate), theta_m.size))
    angle, reduced = reduce.rows(np.vstack([theta_m - theta_m[0], position - position[0]]))
    reduction = Reduction.of(angle, reduced, response(servo, rate / reduce.factor), skew=False)
    span = float(np.ptp(angle))
    fit = min(search(reduction.coarse(), gaps_to_try(span, 9), span, 1e-4 * span), key=lambda fit: fit.slopes.cost)
    table = reduction.table(fit.point)
    residual = table[RESIDUAL] - least_squares(table[CONSTANT:], table[RESIDUAL]).coefficients @ table[CONSTANT:]
    interval = reduction.response.interval * reduction.decimation.factor / second
    variation = float(np.std(slow(reduction.position, interval)))
    return float(np.sqrt(np.mean(slow(residual, interval) ** 2))) / variation if variation > 0.0 else math.inf
