"""Demands on a setting before it is sent."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Annotated

from servotwin.config.keys import check, key, settings
from servotwin.redesign.certified.uncertainty import LARGEST_DELAY


@settings("beyond")
@dataclass(frozen=True)
class Beyond:
    """Ranges beyond the stated ones: a setting must settle in them too, though nobody stated them.

    Parameters
    ----------
    machines : int
        Machines that are simulated there.
    """

    k_T: Annotated[
        float,
        key("k_t_percent", minimum=0.0, below=1.0, help="Half-width of the motor's gain, relative."),
    ] = 0.1
    delay: Annotated[
        int,
        key(
            "delay_samples",
            minimum=0,
            maximum=LARGEST_DELAY,
            help="Longest delay between a measurement and its voltage, of a sampled controller.",
        ),
    ] = 3
    friction: Annotated[
        float,
        key(
            "friction_percent",
            minimum=0.0,
            help="Largest Coulomb friction, relative to the torque with which the servo's own Kp answers the smallest "
            "step; none with an elastic screw.",
        ),
    ] = 0.2
    machines: int = 60

    def __post_init__(self) -> None:
        check(self)


@settings("demands")
@dataclass(frozen=True)
class Demands:
    """Demands on a setting, and the effort of the search for one.

    Parameters
    ----------
    tail, tolerance : float
        m: largest error of a machine in the last part, widest dead zone.
    friction_limit : float
        V, largest friction feedforward.
    scales : tuple of float
        Factors on Kp and Kd.
    shapes : tuple of (float, float)
        Factors on Kd / (Kp Tf) and on Tf, tried with every scale: they move the derivative action.
    learnt_shapes : tuple of (float, float)
        Further ones, tried on a machine that was learnt.
    notch_shapes : tuple of (float, float)
        Shapes tried with a notch at the structure's first resonance, on a machine that was learnt; on any other one
        only where nothing else is within the bounds.
    motor_shapes : tuple of (float, float)
        Shapes tried where a filtered PID reads the motor and nothing with half of its gain is within the bounds: a
        shorter filter leaves the derivative action its phase at the resonance of the shaft, which it then damps.
    integral : tuple of float
        Factors on Ki, tried where there is friction, where the input bias is known to no better than `known`, or where
        the load holds the motor off its reference.
    known : float
        Share of the smallest step: a bias that leaves a smaller error under the servo's own Kp counts as known.
    velocity : tuple of float
        Velocity feedforwards, relative to the back EMF of that speed, tried beside none.
    stops : tuple of (float, float)
        Dead zones that stop the integral only, tried beside none wherever integral action is: half-width as a share of
        the smallest step, two counts of the sensor on top, and `leave`. The integral of a loop with friction hunts less
        where it begins again later than it stops.
    hysteresis : tuple of (float, float)
        enter and leave of a dead zone of p gap, tried beside no dead zone where there is noise.
    effort_weight : float
        Cost of measurement noise in the voltage, in periods 1 / crossover, where it is as large (rms) as the answer of
        the servo's own Kp to the largest step.
    screened, conditions : int
        Plants that rank the candidates, and conditions of each.
    machines : int
        Machines of the first sample of a verification, drawn independently of one another and of those that rank.
    failures : int
        Machines that may fail in a larger sample, where so few of the first one do; 0: there is no larger sample.
    attempts : int
        Candidates that are verified before the search gives up, each on machines of its own; then as many of each
        kind that settles most surely.
    """

    Ms: Annotated[
        float, key(minimum=1.0, help="Largest sensitivity peak of the loop without a gap on the model itself.")
    ] = 2.0
    Ms_worst: Annotated[
        float,
        key(
            minimum=1.0,
            help="Largest sensitivity peak of the loop without a gap on any plant of the stated ranges and beyond.",
        ),
    ] = 2.2
    settled: Annotated[
        float,
        key(
            "settled_percent",
            minimum=0.0,
            maximum=1.0,
            help="Share of machines that settles at least, at the stated confidence (a binomial lower bound).",
        ),
    ] = 0.99
    confidence: Annotated[
        float, key("confidence_percent", above=0.0, below=1.0, help="Confidence of that lower bound.")
    ] = 0.95
    overshoot: Annotated[
        float, key("overshoot_percent", minimum=0.0, help="Largest overshoot of a member, per step.")
    ] = 0.5
    error: Annotated[
        float,
        key(
            "error_percent",
            above=0.0,
            help="Largest error in the end, relative to the largest step; the dead zone and two counts of the sensor "
            "come on top.",
        ),
    ] = 0.1
    beyond: Annotated[Beyond, key(help="Ranges outside of the stated ones, in which a setting must settle too.")] = (
        field(default_factory=Beyond)
    )
    velocity_feedforward: Annotated[
        bool,
        key(
            help="Candidates with a velocity feedforward are tried too; false for machines whose own controller has "
            "none."
        ),
    ] = True
    friction_feedforward: Annotated[
        bool,
        key(
            help="Candidates with a friction feedforward are tried too, where friction is known; false for machines "
            "whose own controller has none."
        ),
    ] = True
    notch: Annotated[
        bool,
        key(
            help="Candidates with a notch at the resonance of a learnt machine are tried too, on any other one where "
            "nothing else is within the bounds; false for machines whose own controller has none."
        ),
    ] = True
    tail: float = math.inf
    tolerance: float = math.inf
    friction_limit: float = math.inf
    scales: tuple[float, ...] = (0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.85, 1.0, 1.2, 1.5, 2.0)
    shapes: tuple[tuple[float, float], ...] = ((1.0, 1.0), (1.5, 0.85), (2.0, 0.7))
    learnt_shapes: tuple[tuple[float, float], ...] = ((1.2, 0.85), (1.5, 0.7))
    notch_shapes: tuple[tuple[float, float], ...] = ((1.0, 0.25), (1.0, 1.0))
    motor_shapes: tuple[tuple[float, float], ...] = ((5.0, 0.1), (10.0, 0.1))
    integral: tuple[float, ...] = (0.0, 0.01, 0.02, 0.03)
    stops: tuple[tuple[float, float], ...] = ((0.02, 1.0), (0.05, 2.0), (0.1, 2.0))
    velocity: tuple[float, ...] = (0.3, 0.5)
    known: float = 0.0726
    hysteresis: tuple[tuple[float, float], ...] = ((0.5, 1.5),)
    effort_weight: float = 14.0
    screened: int = 4
    conditions: int = 8
    machines: int = 300
    failures: int = 3
    attempts: int = 6
    seed: int = 0

    def __post_init__(self) -> None:
        check(self, but=("overshoot",))  # inf: no demand, where an input bias or friction disturbs
