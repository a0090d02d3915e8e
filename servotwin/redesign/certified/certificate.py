"""Certificate of a setting: results of the simulations that it passed."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

from servotwin.control.retuning import integrates
from servotwin.plant.plants import Plant
from servotwin.redesign.certified.uncertainty import in_words
from servotwin.redesign.design import Design, with_feedforward

_NOT_TRIED = (
    "measurement noise, a gap that grows while the loop moves, compliance other than the model's, several axes, a "
    "sensor or drive that fails"
)


@dataclass(frozen=True)
class LoopMargins:
    """Margins of the linear loop without a gap, at the controller's own rate.

    Attributes
    ----------
    plants : int
        Number of plants: the model, every corner of the ranges, and others within.
    delay : int
        Largest delay, samples.
    Ms, crossover, phase_margin : float
        Of the model: the peak, the highest gain crossover in rad/s, its margin in rad; a loop whose gain is below one
        at every frequency has the crossover 0 and the margin pi.
    Ms_worst, gain_margin_worst, phase_margin_worst, delay_margin_worst : float
        Worst of all plants and delays: peak, factor, rad, s; Ms_worst is inf where one of them is unstable.
    decay : float
        1/s, of the slowest mode of all plants; negative: it grows.
    passivity : float
        Least 1 + Re L of all plants. Above 0 the circle criterion excludes a limit cycle in a gap of any width, where
        the law is continuous and linear; of a sampled law the describing function does. -inf where it says nothing: the
        shaft pushes the motor or is free in the gap, the law reads the motor, or it integrates beside its motor.
    """

    plants: int
    delay: int
    Ms: float
    crossover: float
    phase_margin: float
    Ms_worst: float
    gain_margin_worst: float
    phase_margin_worst: float
    delay_margin_worst: float
    decay: float
    passivity: float


@dataclass(frozen=True)
class BeyondResult:
    """Result of a setting in the ranges that nobody stated.

    Attributes
    ----------
    k_T : float
        Half-width of the motor's gain, relative.
    delay : int
        Longest delay, samples.
    friction : float
        N m, largest Coulomb friction.
    machines : int
    settled : float
        Share of the machines that came to rest; where friction holds them does not matter.
    tail : float
        m, largest error in the end.
    settled_least : float
        Lower bound of the share, at the certificate's confidence; 0 in certificates of versions that had none.
    """

    k_T: float
    delay: int
    friction: float
    machines: int
    settled: float
    tail: float
    settled_least: float = 0.0


@dataclass(frozen=True)
class RampResult:
    """Result of a setting on a ramp, its reversal and a stop.

    Attributes
    ----------
    machines : int
    settled : float
        Share of them that settled after the stop.
    error : float
        Largest error on the way, relative to the length of the ramp, which takes twelve periods of 1 / crossover.
    """

    machines: int
    settled: float
    error: float


@dataclass(frozen=True)
class LongResult:
    """Result of long runs of a law whose integral winds up while friction holds the motor, which may move much later.

    Attributes
    ----------
    machines : int
    duration : float
        s, of each run.
    settled : float
        Share of them that are settled in the second half.
    """

    machines: int
    duration: float
    settled: float


@dataclass(frozen=True, repr=False)
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
        m: 2 % of the largest step, plus the error that input bias and friction leave, plus the dead zone.
    Ms, crossover, phase_margin : float
        Of the model without a gap: the peak, the highest gain crossover in rad/s, its margin in rad; a loop whose gain
        is below one at every frequency has the crossover 0 and the margin pi.
    saturated : bool
        True when the voltage reached its limit on any machine.
    looked_at : int
        Number of candidates simulated, this one included.
    seconds : float
        Computing time.
    settled_least : float
        Lower bound of the share that settles, at `confidence`; 0 in certificates of versions that had none.
    confidence : float
    loop : LoopMargins, optional
        Margins over all plants; None in certificates of versions that had none.
    beyond : BeyondResult, optional
        Result in ranges beyond the stated ones.
    ramp : RampResult, optional
        Result on a ramp and its reversal.
    long : LongResult, optional
        Result of long runs, of a law with integral action where friction acts.
    rate : float, optional
        Hz, at which the law was simulated; None: in continuous time.
    delay : int
        Longest stated delay, samples.
    error_per_volt : float
        m/V: error that a constant input bias leaves; 0 with integral action.
    lag : float
        s: steady lag behind a ramp of the reference, on the model; 0 with integral action.
    own_friction : float
        Half-width of the friction that the model states, relative to it; 0 where it states none.
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
    settled_least: float = 0.0
    confidence: float = 0.95
    loop: LoopMargins | None = None
    beyond: BeyondResult | None = None
    ramp: RampResult | None = None
    long: LongResult | None = None
    rate: float | None = None
    delay: int = 0
    error_per_volt: float = 0.0
    lag: float = 0.0
    own_friction: float = 0.0

    def __repr__(self) -> str:
        """Setting, and what it was verified on, in one line."""
        low, high = (math.degrees(end) for end in self.gap)
        share = f"{100.0 * self.settled:.4g} % of {self.members} simulated machines settled"
        return f"<Certificate of {self.setting!r}: {share}, gaps {low:.4g} .. {high:.4g} deg, Ms {self.Ms:.3g}>"

    def fed(self, feedforward: float) -> Certificate:
        """The setting, verified without a feedforward, with one (V), and the input biases that leave what was verified.

        As long as no voltage meets its limit, the feedforward matters only through the bias that it leaves.
        """
        low, high = self.input_bias
        # What is fed forward is held at rest too.
        effort, setting = self.effort + abs(feedforward), with_feedforward(self.setting, feedforward)
        return replace(self, setting=setting, input_bias=(low - feedforward, high - feedforward), effort=effort)

    def tried(self, servo: Plant) -> str:
        """Sentence on what was tried and what was not, with ranges in the units of the servo or axis."""
        law = "in continuous time" if self.rate is None else f"at {self.rate:g} Hz, up to {self.delay} samples late"
        text = (
            f"verified on {self.members} simulated machines {law}: {in_words(self, servo)}; "
            f"{100.0 * self.settled_least:.4g} % settle at least, with {100.0 * self.confidence:g} % confidence"
        )
        if self.own_friction:
            text += f"; motor and load with friction up to {100.0 * self.own_friction:.3g} % off the model's"
        if self.loop is not None:
            text += f"; Ms at most {self.loop.Ms_worst:.3g} on {self.loop.plants} plants without a gap"
        if self.setting.controller.integral_only:
            text += ", with the integral acting and stopped; the simulations contain the switching in between"
        if servo.guide.force and integrates(self.setting.controller):
            text += "; every move begins with an integral that holds the load's constant force"
        if self.ramp is not None:
            text += f"; a ramp and its reversal on {self.ramp.machines} machines"
        if self.long is not None:
            text += f"; {self.long.machines} machines for {self.long.duration:.3g} s, for the integral to wind up"
        if self.beyond is not None:
            extra = self.beyond
            text += (
                f"; beyond that, {extra.machines} machines with the motor's gain up to {100.0 * extra.k_T:.3g} % off "
                f"and friction of up to {extra.friction:.3g} N m"
            )
            text += f", up to {extra.delay} samples late" if self.rate else ""
            text += f", of which {100.0 * extra.settled:.4g} % come to rest" if extra.settled < 1.0 else ""
        return f"{text}; not tried: {_NOT_TRIED}"


@dataclass(frozen=True)
class NotVerified:
    """Failed search: the reason, and the certificate of the best candidate."""

    reason: str
    best: Certificate | None = None
