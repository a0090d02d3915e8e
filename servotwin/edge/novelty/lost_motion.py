"""Lost motion at rest: by how much motor and load disagree. It needs no dynamics and cannot exceed the gap.

At rest the motor's angle less the load's, as an angle of the screw, is where in the gap the screw lies. Its range over
all rests since the encoder was set is a lower bound of the gap.
"""

from servotwin.edge.novelty.model import Signal

_BLOCK_S = 0.1
_PARTS = 5


def rests(theta_m: Signal, position: Signal, rate: float, static_gain: float, still: float) -> list[float]:
    """Leads (rad) of the motor over the load, one for each tenth of a second in which neither moves.

    Parameters
    ----------
    theta_m, position : (n,) sequences
        rad, m.
    rate : float
        Hz.
    static_gain : float
        m/rad.
    still : float
        rad: what moves by less rests. Of the load the means of fiftieths of a second count.
    """
    size = max(_PARTS, round(_BLOCK_S * rate))
    found = []
    for first in range(0, len(theta_m) - size + 1, size):
        angle = theta_m[first : first + size]
        if max(angle) - min(angle) >= still:
            continue
        part = size // _PARTS
        loads = [sum(position[k : k + part]) / (part * static_gain) for k in range(first, first + part * _PARTS, part)]
        if max(loads) - min(loads) < still:
            found.append(sum(angle) / size - sum(loads) / _PARTS)
    return found
