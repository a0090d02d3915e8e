"""Which flank of the gap a machine's load touches, by the forces that its motion takes."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from servotwin.estimation.estimate import NOTHING_KNOWN, GapStatus
from servotwin.estimation.kinematic.lost_motion import LostMotion
from servotwin.estimation.kinematic.recording import EncoderRecording
from servotwin.estimation.kinematic.strokes import play_and_side
from servotwin.estimation.kinematic.travel import units_of
from servotwin.estimation.kinematic.wind_up import TransmissionGap, travel_of_machine
from servotwin.plant.axis import Axis
from servotwin.plant.plants import Plant
from servotwin.plant.signals import Array
from servotwin.plant.transmission import FREE

PAUSE = 12.0
"""Usual intervals, over which nothing says how the machine moved."""
# Of the motion: in 24 simulated logs of screws, gantries and telescopes, held by friction, none is on the other flank,
# and 3 to 64 % in 32 logs of drives and joints whose loads roll on.
_OTHER_FLANK = 0.01
_STROKE, _WINDOW, _LEAST = 0.1, 0.1, 7  # of the motor's range; of a stroke, and samples, at least, of a parabola
_AT_REST = 0.05  # of the fastest motion


def parts_without_pause(recording: EncoderRecording) -> list[NDArray[np.int_]]:
    """Rows of each part; those of a thinned log that stand alone belong to none."""
    intervals = np.diff(recording.time)
    breaks = np.flatnonzero(intervals > PAUSE * np.median(intervals)) + 1 if intervals.size else intervals.astype(int)
    parts = np.split(np.arange(recording.time.size), breaks)
    if recording.alone is None:
        return parts
    edges = np.flatnonzero(np.diff(recording.alone.astype(np.int8))) + 1
    finer = [each for part in parts for each in np.split(part, edges[np.isin(edges, part[1:])] - part[0])]
    return [part for part in finer if not recording.alone[part[0]]]


def reversals_of(motor: Array) -> int:
    """Reversals of a motor (n,) by more than a tenth of its range."""
    side = np.zeros(motor.size, dtype=np.int8)
    play_and_side(motor, _STROKE * float(np.ptp(motor)), side)
    return int(np.count_nonzero(np.diff(side[side != 0])))


def with_forces(recording: EncoderRecording, found: TransmissionGap, machine: Plant) -> TransmissionGap:
    """The gap, doubted where the machine's load rolls on at its motor's reversals instead of being held by friction.

    Play has the load on the flank that its motor pushes. A load whose inertia is larger than its friction changes to
    the other one as soon as the motor brakes, and no model without dynamics has that: what it fits, a load ahead of the
    motor for one, may be far off and leave next to nothing.
    """
    if not isinstance(machine, Axis) or machine.transmission.in_gap != FREE or found.interval_motor == NOTHING_KNOWN:
        return found
    share = share_on_other_flank(recording, found.lost, machine)
    if not share > _OTHER_FLANK or found.status is GapStatus.LOWER_BOUND:
        return found
    lost = found.lost
    # The largest lead with the lag left in, and its single samples: a gap that a fit takes for a lag is in it too.
    lead = float(np.ptp(recording.motor - recording.load / lost.ratio))
    reason = (
        f"in {100.0 * share:.2g} % of the motion the inertia of --axis's load is larger than its friction: there it "
        "runs ahead of its motor, to the other flank of the gap, which no model without dynamics has"
    )
    return replace(
        found,
        status=GapStatus.MODEL_MISMATCH if found.ok else found.status,
        interval_motor=(0.0, max(found.interval_motor[1], lead)),
        reasons=(reason, *found.reasons),
    )


def share_on_other_flank(recording: EncoderRecording, lost: LostMotion, machine: Axis) -> float:
    """Share of a motion in which the load has to be braked by its motor; NaN where no part is long enough to tell."""
    unit = units_of(recording, travel_of_machine(machine))[1]
    interval = float(np.median(np.diff(recording.time)))
    parts = parts_without_pause(recording)
    stroke = float(np.ptp(recording.time)) / (reversals_of(recording.motor) + 1)
    wanted = min(_WINDOW * stroke / interval, 0.5 * max(map(len, parts)))
    window = max(math.floor(wanted) | 1, _LEAST)
    motions = [
        _motion(recording.time[rows], unit * lost.ratio * recording.motor[rows], interval, window)
        for rows in parts
        if len(rows) > window
    ]
    if not motions:
        return math.nan
    speed, acceleration = np.concatenate(motions, axis=1)
    load, guide = machine.load, machine.guide
    moving = np.abs(speed) > _AT_REST * float(np.quantile(np.abs(speed), 0.95))
    force = load.masses.sum() * acceleration + load.c[0] * speed + guide.friction * np.sign(speed) - guide.force
    return float(np.mean((force * speed)[moving] < 0.0))


def _motion(time: Array, position: Array, interval: float, window: int) -> Array:
    """(2, m) speed and acceleration of parabolas through so many samples."""
    # Here, because scipy.signal takes long to import and most logs need no dynamics.
    from scipy.signal import savgol_filter

    grid = np.arange(time[0], time[-1], interval)
    even = np.interp(grid, time, position)
    if even.size <= window:
        return np.empty((2, 0))
    return np.array([savgol_filter(even, window, 2, deriv=order, delta=interval) for order in (1, 2)])
