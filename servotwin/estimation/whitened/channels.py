"""Whether a window's channels can be what they say they are, and the motor's angle as the play operator wants it."""

from __future__ import annotations

import math

import numpy as np

from servotwin.errors import InvalidInput
from servotwin.estimation.paper.zero_phase import ZeroPhase
from servotwin.estimation.whitened.settings import Settings
from servotwin.estimation.window import Window
from servotwin.plant.signals import Array

_FLAT, _RUN, _STEEP = 20, 6, 0.05  # samples at the extreme, and before it; share of the fastest motion there
_JUMP = 50.0  # times the usual fastest motion
_THIRD_DIFFERENCES = math.sqrt(20.0)  # gain on white noise
_QUIET, _LOUD = math.radians(0.002), math.radians(0.03)  # noise of the encoder: below, nothing; above, the lowest cut
_HIGHEST_HZ, _LOWEST_HZ, _ORDER = 200.0, 60.0, 3


def faults(window: Window) -> tuple[str, ...]:
    """What is plainly wrong with theta_m or position, one sentence each."""
    assert window.theta_m is not None
    channels = {"theta_m": (window.theta_m, math.degrees(1.0), "deg"), "position": (window.position, 1e3, "mm")}
    found = [_fault(name, samples, factor, unit) for name, (samples, factor, unit) in channels.items()]
    return tuple(sentence for sentence in found if sentence)


def _fault(name: str, samples: Array, factor: float, unit: str) -> str:
    steps = np.abs(np.diff(samples))
    span = float(np.ptp(samples))
    if span == 0.0:
        return f"{name} is constant at {factor * samples[0]:.6g} {unit}: nothing moved, or the sensor is dead"
    index = int(np.argmax(steps))
    usual = float(np.partition(steps, -20)[-20]) if steps.size > 400 else math.inf
    if steps[index] > _JUMP * max(usual, 1e-9 * span) and steps[index] > 0.2 * span:
        return (
            f"{name} jumps by {factor * steps[index]:.6g} {unit} between samples {index} and {index + 1}: a wrapped "
            "encoder, or samples are missing"
        )
    return _saturation(name, samples, steps, factor, unit)


def _saturation(name: str, samples: Array, steps: Array, factor: float, unit: str) -> str:
    """Samples that stay at an extreme value which was reached at speed."""
    run = np.abs(samples[_RUN:] - samples[:-_RUN])
    fastest = float(np.partition(run, -5)[-5])
    for extreme in (float(samples.max()), float(samples.min())):
        at = np.flatnonzero(samples == extreme)
        if at.size < _FLAT:
            continue
        entries = at[(at >= _RUN) & ~np.isin(at - 1, at)]
        reached = [entry for entry in entries if np.all(steps[entry - _RUN : entry] > 0.0)]
        if any(run[entry - _RUN] > _STEEP * fastest for entry in reached):
            value = f"{factor * extreme:.6g} {unit}"
            return f"{name} stays at its extreme of {value} for {at.size} samples: it is saturated"
    return ""


def encoder_noise(theta_m: Array) -> float:
    """Standard deviation (rad) of the noise on an angle that moves smoothly: third differences leave little else.

    Taken in blocks, of which the median counts: where the voltage jumps, an angle is not smooth. Blocks at rest, where
    a quantised angle shows no noise, do not count.
    """
    differences = np.diff(theta_m, 3)
    blocks = differences[: differences.size // 20 * 20].reshape(20, -1)
    sizes = np.sqrt(np.mean(blocks * blocks, axis=1)) / _THIRD_DIFFERENCES
    return float(np.median(sizes[sizes > 0.0])) if np.any(sizes > 0.0) else 0.0


def motor_angle(window: Window, resolution: float, settings: Settings) -> Array:
    """(n,) theta_m, low-passed without phase where the encoder is noisy: the play operator ratchets to the extremes of
    noise. The cut-off goes from 200 Hz for little noise down to 60 Hz.

    Parameters
    ----------
    window : Window
    resolution : float
        rad, one count of the encoder.
    settings : Settings
    """
    assert window.theta_m is not None
    cutoff, rate = settings.prefilter_hz, window.sample_rate
    if cutoff is None:
        noise = encoder_noise(window.theta_m)
        if max(noise, resolution / math.sqrt(12.0)) <= _QUIET:
            return window.theta_m
        share = math.log(max(noise, _QUIET) / _QUIET) / math.log(_LOUD / _QUIET)
        cutoff = _HIGHEST_HZ * (_LOWEST_HZ / _HIGHEST_HZ) ** min(1.0, share)
        if cutoff >= 0.45 * rate:
            return window.theta_m
    if cutoff == 0.0:
        return window.theta_m
    if cutoff >= 0.5 * rate:
        raise InvalidInput(f"estimator prefilter_hz = {cutoff!r} Hz: must be below half of {rate:.6g} Hz")
    padding = min(round(rate / cutoff), window.theta_m.size - 1)
    return ZeroPhase(cutoff, _ORDER, rate, "odd", padding).respond(window.theta_m)
