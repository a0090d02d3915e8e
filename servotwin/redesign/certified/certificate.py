"""Demands on a setting before it is sent, and the certificate of the simulations that it passed."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Annotated

from servotwin.config.keys import check, key, settings
from servotwin.redesign.design import Design


@settings("demands")
@dataclass(frozen=True)
class Demands:
    """Demands on a setting, and the effort of the search for one.

    Parameters
    ----------
    tail, tolerance : float
        m: largest error of a member in the last part, widest dead zone.
    scales : tuple of float
        Factors on Kp and Kd.
    integral : tuple of float
        Factors on Ki, tried where there is friction, or where the input bias is known to no better than `bias_known`.
    bias_known : float
        V.
    hysteresis : tuple of (float, float)
        enter and leave of a dead zone of p gap, tried beside no dead zone where there is noise.
    effort_weight : float
        s/V: cost of a volt (rms) of measurement noise in the voltage, beside seconds of error.
    screened, plants, conditions : int
        Plants that rank the candidates, plants of the verification, and conditions of each.
    attempts : int
        Candidates that are simulated on all machines before the search gives up.
    """

    Ms: Annotated[
        float, key(minimum=1.0, help="Largest sensitivity peak of the loop without a gap on the model itself.")
    ] = 2.0
    settled: Annotated[
        float, key("settled_percent", minimum=0.0, maximum=1.0, help="Least share of the members that settle.")
    ] = 0.99
    overshoot: Annotated[
        float, key("overshoot_percent", minimum=0.0, help="Largest overshoot of a member, per step.")
    ] = 0.5
    tail: float = math.inf
    tolerance: float = math.inf
    scales: tuple[float, ...] = (0.5, 0.6, 0.7, 0.85, 1.0, 1.2, 1.5, 2.0)
    integral: tuple[float, ...] = (0.0, 0.01, 0.05)
    bias_known: float = 0.01
    hysteresis: tuple[tuple[float, float], ...] = ((0.5, 1.5),)
    effort_weight: float = 1.0
    screened: int = 4
    plants: int = 32
    conditions: int = 8
    attempts: int = 4
    seed: int = 0

    def __post_init__(self) -> None:
        check(self, but=("overshoot",))  # inf: no demand, where an input bias or friction disturbs


@dataclass(frozen=True)
class Certificate:
    """A setting and its results on the simulated machines.

    Attributes
    ----------
    setting : Design
    gap, input_bias, step, friction : (float, float)
        rad, V, m, N m: ranges of the simulated machines.
    members : int
        Number of simulated machines.
    settled : float
        Share of them that settled.
    cost : float
        s: 95th percentile of the integral of abs(error) per step, plus the cost of noise.
    tail, tail_p95, error_rms, effort : float
        m, m, m, V: worst of all machines in the last part; the 95th percentile of the tail.
    overshoot : float
        Worst, per step.
    settling, settling_worst : float
        s until the error stays below `within`: the 95th percentile, and the worst.
    within : float
        m: 2 % of the largest step, plus the error that the input bias leaves, plus the dead zone.
    Ms, crossover, phase_margin : float
        Of the model without a gap: the peak, the highest gain crossover in rad/s, its margin in rad; a loop whose gain
        is below one at every frequency has the crossover 0 and the margin pi.
    saturated : bool
        True when the voltage reached its limit on any machine.
    looked_at : int
        Number of candidates simulated, this one included.
    seconds : float
        Computing time.
    """

    setting: Design
    gap: tuple[float, float]
    input_bias: tuple[float, float]
    step: tuple[float, float]
    friction: tuple[float, float]
    members: int
    settled: float
    cost: float
    tail: float
    tail_p95: float
    error_rms: float
    effort: float
    overshoot: float
    settling: float
    settling_worst: float
    within: float
    Ms: float
    crossover: float
    phase_margin: float
    saturated: bool
    looked_at: int
    seconds: float = field(compare=False)


@dataclass(frozen=True)
class NotVerified:
    """Failed search: the reason, and the certificate of the best candidate."""

    reason: str
    best: Certificate | None = None
