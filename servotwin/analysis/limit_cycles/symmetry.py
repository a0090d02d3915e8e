"""What maps motions of a servo's automaton to motions: a shift of everything that is a position, and the mirror.

Both are verified on the matrices, not assumed: a screw whose load acts back has no shift, a bias no mirror.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from servotwin.analysis.limit_cycles.poincare import Firing, Flags
from servotwin.hybrid.automaton import Array
from servotwin.plant.automaton import ServoAutomaton
from servotwin.plant.servo import Servo

# Lengths of a symmetric interval are not mirrored.
_WIDTHS = ("gap", "tolerance", "voltage limit")
_SWAPPED = str.maketrans("-+", "+-")
_ROUNDING = 1e-9


def moving(loop: ServoAutomaton) -> Flags:
    """(n,) booleans: the states that some mode's flow changes. The others (reference, gap, tolerance, limits, and an
    integral without gain) are constants: each would add a neutral direction to every orbit."""
    return np.asarray(np.any(loop.automaton.flows != 0.0, axis=(0, 2)))


def shift(servo: Servo, loop: ServoAutomaton) -> Array | None:
    """(n,) displacement of a motion per metre of reference, or None where a shifted motion is no motion.

    Motor, screw and masses are moved alike. Where every flow and every guard ignores that, orbits for any reference are
    one orbit; where the load holds the motor, they are not.
    """
    automaton, rest = loop.automaton, servo.chain().equilibrium(1.0)
    result = np.zeros(len(automaton.names))
    for name in automaton.names:
        if name in ("theta_m", "theta_d"):
            result[automaton.index(name)] = 1.0 / servo.p
        elif name in ("reference", "filtered"):
            result[automaton.index(name)] = 1.0
    first = automaton.index("chain0")
    result[first : first + rest.size] = rest
    rows = [np.asarray(guard.row, dtype=float) for mode in automaton.modes for guard in mode.guards]
    everything = np.vstack([automaton.flows.reshape(-1, len(automaton.names)), *rows])
    ignored = np.abs(everything @ result) <= _ROUNDING * (np.abs(everything) @ np.abs(result))
    return result if bool(np.all(ignored)) else None


@dataclass(frozen=True, eq=False)
class Mirror:
    """The reflection of a motion in its centre.

    Attributes
    ----------
    signs : (n,) array
        -1 for every state that changes its sign.
    firings : dict
        The event that mirrors each event.
    """

    signs: Array
    firings: dict[Firing, Firing]


def mirror(loop: ServoAutomaton) -> Mirror | None:
    """The mirror of a loop, or None where it has none."""
    automaton = loop.automaton
    signs = np.array([1.0 if name in _WIDTHS else -1.0 for name in automaton.names])
    names = [mode.name for mode in automaton.modes]
    firings: dict[Firing, Firing] = {}
    for index, mode in enumerate(automaton.modes):
        other = _opposite(mode.name)
        if other not in names:
            return None
        partner = automaton.modes[names.index(other)]
        if not np.array_equal(automaton.flows[names.index(other)], signs[:, None] * automaton.flows[index] * signs):
            return None
        for g, guard in enumerate(mode.guards):
            target = _opposite(names[guard.target])
            row = np.asarray(guard.row) * signs
            found = [
                k
                for k, candidate in enumerate(partner.guards)
                if names[candidate.target] == target and np.array_equal(np.asarray(candidate.row), row)
            ]
            if len(found) != 1:
                return None
            firings[Firing(index, g)] = Firing(names.index(other), found[0])
    return Mirror(signs, firings)


def _opposite(name: str) -> str:
    """The name of the mirrored mode: sides swapped, saturated high and low too."""
    swapped = name.translate(_SWAPPED)
    if swapped.endswith("high"):
        return swapped.removesuffix("high") + "low"
    return swapped.removesuffix("low") + "high" if swapped.endswith("low") else swapped
