"""Many loops at once that move to and fro: each move begins as the one before left its loop."""

from __future__ import annotations

from typing import Any

import numpy as np

from servotwin.hybrid.automaton import Array
from servotwin.hybrid.ensemble import FigureOptions, figures_of_family
from servotwin.simulation.ensemble import Cases, members_of, samples_of


def errors_to_and_fro(
    servos: Any,
    controllers: Any,
    duration: float,
    cases: Cases,
    moves: int,
    sample_rate: float,
    threads: int | None = None,
) -> Array:
    """Mean size of the error (m) while a reference goes back to zero and again to its value of `cases`, in turn.

    Each move begins as the one before left the loop: the motor on one flank or inside the gap, the integral as it is.
    The first move, from rest at zero, does not count.

    Parameters
    ----------
    servos, controllers, cases, sample_rate, threads
        As for `summarise_members`.
    duration : float
        s, of each move.
    moves : int
        That count, at least 1.

    Returns
    -------
    array of shape S
        m.

    Raises
    ------
    InvalidInput
        As `simulate_members`.
    """
    members, samples = members_of(servos, controllers, cases), samples_of(duration, sample_rate)
    errors = np.zeros(len(members.servos))
    for group in members.groups(("error",)):
        place, ends = group.automata.first.index("reference"), np.empty_like(group.members.state)
        options = FigureOptions(np.full((len(group.which), 1), np.inf), 1)
        starts, goals = group.members, (0.0, group.members.state[:, place].copy())
        for move in range(moves + 1):
            figures = figures_of_family(
                group.automata, group.rows, starts, 1.0 / sample_rate, samples, options, threads, ends
            )
            errors[group.which] += figures.mean_size[:, 0] / moves if move > 0 else 0.0
            if "friction feedforward" in group.automata.first.names:
                fed = np.array([members.controllers[member].friction_feedforward for member in group.which])
                ends[:, group.automata.first.index("friction feedforward")] = fed * np.sign(
                    goals[move % 2] - ends[:, place]
                )
            ends[:, place] = goals[move % 2]
            starts = group.restarted(ends.copy())
    return errors.reshape(members.shape)
