"""The plant under a held voltage, independent of the package: motor, screw and chain by scipy's expm and brentq."""

from dataclasses import dataclass

import numpy as np
from event_oracle import OracleGuard, OracleMode, follow
from paper_loop import CURRENT, MOTOR, RESTING, SCREW, SPEED, Case, Loop

from servotwin.plant.servo import Servo


@dataclass
class HeldPlant:
    """Motor, screw and chain with the voltage held and a gap that wears linearly, by scipy's expm and brentq."""

    servo: Servo
    gap: float
    wear: float
    interval: float

    def __post_init__(self) -> None:
        self.loop = Loop(Case(self.servo, 0.0, 1.0, np.zeros(4), 0.0))
        n = self.loop.size
        unit = np.eye(n + 3)
        self.volts, gap, rate = n, unit[n + 1], unit[n + 2]
        apart, self.modes = unit[MOTOR] - unit[SCREW], []
        for side in (-1, 0, 1):
            A, _, b = self.loop.flow(side, 0)
            full = np.zeros((n + 3, n + 3))
            full[:n, :n], full[:n, n + 2], full[n + 1, n + 2] = A, b, 1.0
            full[CURRENT, self.volts] = 1.0 / self.servo.L
            if side:
                guards = [OracleGuard(-side * unit[SPEED] + 0.5 * rate, 1, "release", floor=RESTING)]
            else:
                guards = [OracleGuard(s * apart - 0.5 * gap, s + 1, "contact", floor=1e-14) for s in (1, -1)]
            self.modes.append(OracleMode(full, guards))
        self.state, self.mode, self.contacts = np.zeros(n + 3), 1, 0
        self.state[n + 1 :] = self.gap, self.wear

    def step(self, voltage: float) -> None:
        """Hold a voltage over one interval."""
        self.state[self.volts] = voltage
        run = follow(self.modes, self.state, self.mode, self.interval, self.interval / 64.0)
        time, self.mode, start = run.starts[-1]
        self.state = self.modes[self.mode].after(start, self.interval - time)
        self.contacts += sum(label == "contact" for _, label in run.events)
