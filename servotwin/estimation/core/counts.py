"""An angle between the counts of its encoder, and the errors of counts."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from servotwin.plant.signals import Array

_BENT = 0.5  # of a half count: error where a count is passed slowly, and not as evenly as a straight line


def between_counts(angle: Array, count: float) -> Array:
    """(n,) angle that comes in counts (rad), by straight lines between the instants at which it changes.

    There the angle is half-way between two counts. A count that is left to where it was reached, as at a turning point
    or a rest, is reached and left as fast as the ones beside it, and holds in between. The error is at most half a
    count, and small where the angle moves: a staircase shakes a structure that it drives, and a fit that sees nothing
    of that takes it for damped.
    """
    runs = _Runs.of(angle, count)
    if runs.changes.size == 0:
        return angle
    halves = 0.5 * (angle[runs.changes] + angle[runs.changes + 1])
    return runs.joined(halves, angle[runs.begins[runs.turned]], runs.turned)


def errors_between(angle: Array, count: float, random: np.random.Generator) -> Array:
    """(n,) errors, drawn, that `between_counts` makes for an angle."""
    runs = _Runs.of(angle, count)
    if runs.changes.size == 0:
        return np.full(angle.size, count * random.uniform(-0.5, 0.5))
    # An instant is known to a sample, in which the angle passes as much of a count as the shorter count beside takes.
    passed = 1.0 / np.minimum(runs.lengths[:-1], runs.lengths[1:])
    at_rest = np.where(runs.turned, 1.0, _BENT * (runs.lengths > 2))
    at_change, inside = (count * share * random.uniform(-0.5, 0.5, share.size) for share in (passed, at_rest))
    return runs.joined(at_change, inside, np.ones(runs.turned.size, dtype=bool))


def errors_of_counts(channel: Array, count: float, random: np.random.Generator) -> Array:
    """(n,) errors, drawn, of a channel that comes in counts: one for each run of equal ones."""
    lengths = _Runs.of(channel, count).lengths
    return np.repeat(count * random.uniform(-0.5, 0.5, lengths.size), lengths)


class _Runs(NamedTuple):
    """Runs of equal counts.

    Attributes
    ----------
    changes : (r - 1,) array of int
        Samples after which the count changes.
    begins, ends : (r,) arrays of int
        First and last samples.
    turned : (r,) array of bool
        True where a count is left to where it was reached, and at either end of the data.
    """

    changes: NDArray[np.intp]
    begins: NDArray[np.intp]
    ends: NDArray[np.intp]
    turned: NDArray[np.bool_]

    @classmethod
    def of(cls, channel: Array, count: float) -> _Runs:
        """Of a channel (n,)."""
        steps = np.diff(np.round(channel / count))
        changes = np.flatnonzero(steps)
        ways = np.sign(steps[changes])
        turned = np.concatenate([[True], ways[1:] != ways[:-1], [True]]) if changes.size else np.array([True])
        return cls(changes, np.append(0, changes + 1), np.append(changes, channel.size - 1), turned)

    @property
    def lengths(self) -> NDArray[np.intp]:
        """(r,) samples."""
        return np.asarray(self.ends - self.begins + 1)

    def joined(self, at_changes: Array, inside: Array, which: NDArray[np.bool_]) -> Array:
        """(n,) straight lines between values at the changes and those `inside` some of the runs."""
        begins, ends, lengths = self.begins - 0.5, self.ends + 0.5, self.lengths
        # Half a count takes half as long as the run before, or after.
        before = 0.5 * np.minimum(lengths, np.append(0, lengths[:-1]))
        after = 0.5 * np.minimum(lengths, np.append(lengths[1:], 0))
        times = np.concatenate([self.changes + 0.5, (begins + before)[which], (ends - after)[which]])
        order = np.argsort(times, kind="stable")
        values = np.concatenate([at_changes, inside, inside])
        return np.interp(np.arange(self.ends[-1] + 1), times[order], values[order])
