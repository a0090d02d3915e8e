"""A command that was logged earlier or later than the position: the shift at which inertia and friction leave least."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from servotwin.estimation.inverse_dynamics.conditioning import DriveMotion, RegressionBand
from servotwin.estimation.inverse_dynamics.fit import SYMMETRIC, cycle_time, least_squares, rows_of
from servotwin.estimation.inverse_dynamics.recording import DriveRecording

_WELL = 0.05  # of the command: a model that leaves less needs no shift
_BETTER = 0.5  # of what is left without a shift
_SHIFTS = (1, 2, 3, 5, 8, 13, 21, 34, 55)  # samples
_FINER = 4


def delay_remark(recording: DriveRecording, motion: DriveMotion, band: RegressionBand) -> str:
    """Say that the command explains the motion far better at another time than it was logged; empty: it does not."""
    cycle = cycle_time(motion)

    def left(shift: int) -> float:
        usable = np.roll(recording.usable, shift)
        usable[: max(shift, 0)] = False
        usable[usable.size + min(shift, 0) :] = False
        moved = replace(recording, force=np.roll(recording.force, shift), usable=usable)
        rows = rows_of(moved, motion, band, cycle)
        return least_squares(SYMMETRIC, rows.design[:, : len(SYMMETRIC)], rows).relative_error

    now = left(0)
    if now < _WELL or recording.usable.size < 4 * _SHIFTS[-1]:
        return ""
    tried = {shift: left(shift) for each in _SHIFTS for shift in (each, -each)}
    near = min(tried, key=lambda shift: tried[shift])
    step = max(1, abs(near) // _FINER)
    tried |= {shift: left(shift) for shift in range(near - 2 * step, near + 2 * step + 1, step)}
    best = min(tried, key=lambda shift: tried[shift])
    if tried[best] > _BETTER * now:
        return ""
    sense = "later" if best > 0 else "earlier"
    return (
        f"the command explains the motion best {1e3 * abs(best) / recording.rate:.3g} ms {sense} than it was logged "
        f"(all but {100.0 * tried[best]:.2g} % of it, instead of {100.0 * now:.2g} %): command and position have "
        "different clocks, and the parameters are off; record both on one clock"
    )
