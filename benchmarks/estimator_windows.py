"""Random windows for the estimator: every loop, servo and motion that it must cope with, from the exact simulation."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from servotwin.errors import InvalidInput
from servotwin.estimation.core.response import response
from servotwin.estimation.window import Window
from servotwin.plant.noise import Noise
from servotwin.plant.servo import Servo
from servotwin.plant.signals import Array, SCurve, SquareWave
from servotwin.simulation import Run, simulate

RATE = 5000.0
PRESETS, MASSES = ("paper", "table1"), (2, 3, 5)
LOOPS = ("no dead zone", "dead zone", "calm", "ramping gap")
_TRAVEL = math.radians(0.5)
_GROWTH = math.radians(20.0) / 200.0  # rad/s, the paper's S-curve on average


@dataclass(frozen=True, eq=False)
class WindowCase:
    """A window and the truth about it.

    Attributes
    ----------
    window : Window
    servo : Servo
    gap : float
        rad, in the middle of the window.
    theta_d0 : float
        rad, the screw at the first sample.
    forwards, backwards : float
        rad, travel of the screw, without the end of the window, which does not reach the last mass.
    words : str
        Recipe of the case in words.
    """

    window: Window
    servo: Servo
    gap: float
    theta_d0: float
    forwards: float
    backwards: float
    words: str

    @property
    def two_contacts(self) -> bool:
        """True: the screw was pushed both ways as far as the gate demands."""
        return min(self.forwards, self.backwards) >= _TRAVEL

    def noisy(self, noise: Array) -> WindowCase:
        """The same with noise (n,) m on the position."""
        return self.replaced(self.window.replace(position=self.window.position + noise), self.servo)

    def replaced(self, window: Window, servo: Servo) -> WindowCase:
        """The same truth about another window, for another model."""
        return replace(self, window=window, servo=servo)


def cut(run: Run, start: float, duration: float, words: str = "") -> WindowCase:
    """The window of a servo's run from `start` (s) on, `duration` (s) long."""
    assert isinstance(run.servo, Servo)
    window = Window.from_run(run, start, duration)
    first = round(window.start * run.sample_rate)
    screw = run.theta_d[first : first + window.position.size]
    moved = np.diff(screw[: -round(response(run.servo, RATE).unseen * run.sample_rate)])
    gap = float(run.gap[first + (window.position.size - 1) // 2])
    forwards, backwards = float(moved[moved > 0.0].sum()), float(-moved[moved < 0.0].sum())
    return WindowCase(window, run.servo, gap, float(screw[0]), forwards, backwards, f"{words}, window at {start:.4f} s")


def random_servo(rng: np.random.Generator) -> Servo:
    """One of the presets with 2, 3 or 5 masses, its gains lowered until the loop without a gap is stable."""
    servo = Servo.preset(str(rng.choice(PRESETS))).replace(n=int(rng.choice(MASSES)))
    while True:
        try:
            servo.check_loop()
            return servo
        except InvalidInput:
            law = servo.controller
            servo = servo.replace(Kp=0.7 * law.Kp, Ki=0.5 * law.Ki, Kd=0.7 * law.Kd)


def random_run(rng: np.random.Generator, gap: float, duration: float, kind: str) -> tuple[Run, str]:
    """A run with a gap of about `gap` (rad), everything else drawn, and what was drawn."""
    servo = random_servo(rng)
    amplitude, period = float(rng.uniform(0.5e-3, 2e-3)), float(rng.uniform(6.0, 16.0))
    start = float(rng.uniform(-0.5, 0.5)) * gap
    law = servo.controller.replace(Ki=0.0) if kind == "calm" else servo.controller
    tolerance = servo.tolerance_for(gap, float(rng.uniform(0.7, 1.3))) if kind in ("dead zone", "ramping gap") else None
    wear = _GROWTH * duration * float(rng.uniform(0.0, 1.5)) if kind == "ramping gap" else 0.0
    profile = SCurve(gap, gap + wear, duration) if wear else gap
    reference = SquareWave(amplitude, period)
    run = simulate(
        servo, duration, controller=law, reference=reference, gap=profile, tolerance=tolerance, theta_d0=start
    )
    words = (
        f"{servo.n} masses, p = {servo.p:.4g}, {kind}, gap {math.degrees(gap):.4f} deg, amplitude "
        f"{1e3 * amplitude:.4f} mm, period {period:.4f} s, theta_d0 {math.degrees(start):.4f} deg"
    )
    return run, words


def random_cases(
    rng: np.random.Generator, count: int, largest: float, two_contacts: bool, constant: bool = False, per_run: int = 4
) -> Iterator[WindowCase]:
    """`count` windows of 1 s with gaps up to `largest` (rad), anywhere in their runs.

    On demand only those with two contacts, or only runs with a constant gap.
    """
    made = 0
    while made < count:
        loop = str(rng.choice(LOOPS[:-1] if constant else LOOPS))
        run, words = random_run(rng, float(rng.uniform(0.0, largest)), 20.0, loop)
        starts = rng.uniform(0.0, 18.9, 12)
        cases = [cut(run, float(start), 1.0, words) for start in starts]
        selected = [case for case in cases if case.two_contacts or not two_contacts][:per_run]
        yield from selected[: count - made]
        made += len(selected)


def paper_loop_cases(
    gaps: Array, per_gap: int, seed: int, noise: Noise | None, servo: Servo | None = None, seconds: float = 1.0
) -> list[WindowCase]:
    """Windows after the steps of the paper's loop: +-1 mm, a step every 5 s, the dead zone for the true gap.

    With noise the controller is section 4.3's, sampled, with a loop filter at 20 Hz.
    """
    cases = []
    servo = servo or Servo.preset("paper")
    noisy = servo.controller.replace(sample_rate=RATE, loop_filter_hz=20.0)
    for number, gap in enumerate(gaps):
        run = simulate(
            servo,
            5.0 * per_gap + 5.0 + seconds,
            controller=servo.controller if noise is None else noisy,
            reference=SquareWave(1e-3, 10.0),
            gap=float(gap),
            tolerance=servo.tolerance_for(float(gap)),
            noise=noise,
            seed=seed + number,
        )
        cases += [cut(run, 5.0 * (step + 1), seconds, f"gap {math.degrees(gap):.4f} deg") for step in range(per_gap)]
    return cases
