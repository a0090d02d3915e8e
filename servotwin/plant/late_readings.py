"""Plants in sampled time whose sensors are some samples late."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from servotwin.plant.signals import Array


def late_readings(
    A: Array, B: Array, rows: Sequence[Array], delays: Sequence[int], rate: float | None = None
) -> tuple[Array, Array, list[Array]]:
    """Plants and their readings (outputs) with a line of states for each late one, in which its values wait.

    Parameters
    ----------
    A, B : (P, n, n), (P, n) arrays
        Of the next state, or with a `rate` (Hz) of the delta operator, (next state - state) rate.
    rows : sequence of (P, n) arrays
    delays : sequence of int
        Samples, of each row.
    """
    n, more = B.shape[1], sum(delays)
    if more == 0:
        return A, B, list(rows)
    stay, shift = (0.0, 1.0) if rate is None else (-rate, rate)
    whole, drive = np.zeros((len(A), n + more, n + more)), np.zeros((len(A), n + more))
    whole[:, :n, :n], drive[:, :n] = A, B
    shown, first = [], n
    for row, delay in zip(rows, delays, strict=True):
        line, out = np.arange(first, first + delay), np.zeros((len(A), n + more))
        whole[:, line, line] = stay
        whole[:, line[1:], line[:-1]] = shift
        if delay:
            whole[:, first, :n] = shift * row
            out[:, line[-1]] = 1.0
        else:
            out[:, :n] = row
        shown.append(out)
        first += delay
    return whole, drive, shown
