"""A tight spot: a part of the travel where Coulomb friction is larger than elsewhere."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from servotwin.errors import InvalidInput
from servotwin.estimation.inverse_dynamics.conditioning import DriveMotion, RegressionBand, busiest
from servotwin.estimation.inverse_dynamics.fit import cycle_time, rows_of
from servotwin.estimation.inverse_dynamics.recording import DriveRecording
from servotwin.plant.signals import Array

_PARTS = 20  # of the travel
_WIDEST = 0.3  # of the travel: more is no spot
_MORE, _SURE, _EVEN = 0.2, 5.0, 2.0  # of the usual friction; standard deviations; times what any part else is off
_PER_MAD = 1.4826  # standard deviation of normal numbers over their median distance
_OWN = 2  # inertia and viscous friction, before those of the parts


class TightSpot(NamedTuple):
    """Ends of the part with more friction (m, rotary: rad), and its excess over the usual Coulomb friction."""

    begin: float
    end: float
    more: float

    def remark(self, unit: str) -> str:
        """One sentence."""
        return (
            f"a tight spot: between {self.begin:.4g} and {self.end:.4g} {unit} Coulomb friction is about "
            f"{100.0 * self.more:.0f} % larger than elsewhere; clean or align the guide there"
        )


def tight_spot(recording: DriveRecording, motion: DriveMotion, band: RegressionBand) -> TightSpot | None:
    """Fit Coulomb friction and a constant force in each part of the travel; None: no part stands out for sure."""
    recording, motion = busiest(recording, motion)
    place, side = recording.position, np.where(motion.resting, 0.0, motion.side)
    edges = np.linspace(place.min(), place.max(), _PARTS + 1)
    part = np.clip(np.searchsorted(edges, place) - 1, 0, _PARTS - 1)
    there = (part[:, None] == np.arange(_PARTS)).astype(float)
    # A force that depends on the place alone, as cogging does, is no friction.
    try:
        rows = rows_of(recording, motion, band, cycle_time(motion), np.column_stack([there * side[:, None], there]))
    except InvalidInput:
        # Of a long log with little motion the stretch may have too few moments of it.
        return None
    design = np.column_stack([rows.design[:, :_OWN], rows.extra])
    friction = _friction(design, rows.force)
    without = [
        _friction(design[rows.blocks != block], rows.force[rows.blocks != block]) for block in np.unique(rows.blocks)
    ]
    count = len(without)
    std = np.sqrt((count - 1) / count * np.sum((np.array(without) - friction) ** 2, axis=0))
    return _standing_out(friction, std, edges)


def _friction(design: Array, force: Array) -> Array:
    """(p,) Coulomb friction in each part of the travel, by least squares."""
    norm = np.linalg.norm(design, axis=0)
    scale = np.where(norm > 0.0, norm, 1.0)
    return np.asarray(np.linalg.lstsq(design / scale, force, rcond=1e-9)[0] / scale)[_OWN : _OWN + _PARTS]


def _standing_out(friction: Array, std: Array, edges: Array) -> TightSpot | None:
    """The neighbouring parts (p,) whose friction is larger than that of all others, between `edges` (p + 1,)."""
    usual = float(np.median(friction))
    more = friction - usual
    peak = int(np.argmax(more))
    high = more > 0.5 * more[peak]
    first, last = peak, peak
    while first > 0 and high[first - 1]:
        first -= 1
    while last + 1 < _PARTS and high[last + 1]:
        last += 1
    # Its neighbours may lie in it in part.
    others = np.delete(more, np.arange(max(first - 1, 0), min(last + 2, _PARTS)))
    narrow = last + 1 - first <= _WIDEST * _PARTS
    if usual <= 0.0 or not narrow or others.size == 0:
        return None
    spread = _PER_MAD * float(np.median(np.abs(others)))
    least = max(_MORE * usual, _SURE * max(float(std[peak]), spread), _EVEN * float(np.abs(others).max()))
    return (
        TightSpot(float(edges[first]), float(edges[last + 1]), float(more[peak] / usual))
        if more[peak] > least
        else None
    )
