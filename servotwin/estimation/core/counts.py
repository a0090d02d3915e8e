"""An angle between the counts of its encoder, and the errors of counts."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from servotwin.plant.signals import Array


def between_counts(angle: Array, count: float) -> Array:
    """(n,) angle that comes in counts (rad), by straight lines between the instants at which it changes.

    There the angle is half-way between two counts. A count is reached and left as fast as the ones beside it, and holds
    in between. The error is at most half a count, and small where the angle moves: a staircase shakes a structure that
    it drives, and a fit that sees nothing of that takes it for damped.
    """
    runs = _Runs.of(angle, count)
    return runs.joined(0.5 * (angle[runs.changes] + angle[runs.changes + 1]), angle[runs.begins])


def errors_between(angle: Array, count: float, random: np.random.Generator) -> Array:
    """(n,) errors, drawn, that `between_counts` makes for an angle."""
    runs = _Runs.of(angle, count)
    # An instant is known to a sample, in which the angle passes as much of a count as the shorter count beside takes.
    passed = 1.0 / np.minimum(runs.lengths[:-1], runs.lengths[1:])
    held = np.where(runs.turned, 1.0, 1.0 - (runs.before + runs.after) / runs.lengths)
    at_changes, inside = (count * share * random.uniform(-0.5, 0.5, share.size) for share in (passed, held))
    return runs.joined(at_changes, inside)


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

    @property
    def before(self) -> Array:
        """(r,) samples in which half a count is passed at the run's begin: half of those of the run before."""
        return 0.5 * np.minimum(self.lengths, np.append(0, self.lengths[:-1]))

    @property
    def after(self) -> Array:
        """(r,) the same at its end, of the run after."""
        return 0.5 * np.minimum(self.lengths, np.append(self.lengths[1:], 0))

    def joined(self, at_changes: Array, inside: Array) -> Array:
        """(n,) straight lines between values at the changes (r - 1,) and `inside` the runs (r,)."""
        times = np.concatenate([self.changes + 0.5, self.begins - 0.5 + self.before, self.ends + 0.5 - self.after])
        order = np.argsort(times, kind="stable")
        values = np.concatenate([at_changes, inside, inside])
        return np.interp(np.arange(self.ends[-1] + 1), times[order], values[order])
