"""The loop with backlash and Coulomb friction, integrated by scipy: its own equations of motion, its own switching.

Nothing of the automaton is used: per mode the right-hand side is written out from Eqs 1-20, a terminal event ends it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from servotwin.plant.servo import Servo

Array = NDArray[np.float64]
CURRENT, SPEED, MOTOR, SCREW, CHAIN = 0, 1, 2, 3, 4


@dataclass
class FrictionOracle:
    """Modes: flank (-1, 0 open, 1), motion (-1, 0 stuck, 1), zone (-1, 0 inside, 1); the gap's rate is constant.

    With an elastic screw also `resting`: on a flank under part of the load, which the screw's own friction holds.
    """

    servo: Servo
    reference: float
    first_gap: float
    gap_rate: float
    tolerance: float | None
    friction: float
    bias: float = 0.0
    flank: int = 0
    resting: bool = False
    motion: int = 0
    zone: int = 1
    events: list[tuple[float, str]] = field(default_factory=list)

    def run(self, times: Array) -> Array:
        """States at increasing times, the first of them 0: columns current, speed, motor, screw, positions of the
        masses that do not follow the screw, their velocities, integral of the error, its filtered value."""
        size = CHAIN + 2 * self.free + 2
        y, time, rows = np.zeros(size), 0.0, [np.zeros(size)]
        if self.tolerance is not None:
            self.zone = 0 if abs(self.reference) <= self.tolerance else int(np.sign(self.reference))
        self._lose_contact_if_stuck()
        while time < times[-1]:
            guards = self._guards()
            for _, guard, _ in guards:
                guard.terminal = True
                guard.direction = 1.0
            later = times[(times > time + 1e-13)]
            found = solve_ivp(
                self._flow(y.size),
                (time, times[-1]),
                y,
                "DOP853",
                rtol=1e-12,
                atol=1e-16,
                max_step=5e-3,
                events=[guard for _, guard, _ in guards],
                dense_output=True,
            )
            fired = [k for k, at in enumerate(found.t_events) if at.size]
            time = found.t_events[fired[0]][0] if fired else times[-1]
            if (due := later[later <= time]).size:
                rows += list(found.sol(due).T)
            y = found.sol(time)
            if fired:
                name, _, act = guards[fired[0]]
                self.events.append((time, name))
                act(time, y)
        return np.array(rows)

    @property
    def elastic(self) -> bool:
        return bool(np.isfinite(self.servo.k_d))

    @property
    def free(self) -> int:
        """Masses that do not follow the screw."""
        return self.servo.n if self.elastic else self.servo.n - 1

    def gap(self, time: float) -> float:
        return self.first_gap + self.gap_rate * time

    def error(self, y: Array) -> float:
        return self.reference - float(y[CHAIN + self.free - 1])

    def voltage(self, y: Array) -> float:
        law = self.servo.controller
        active = self.tolerance is None or self.zone != 0
        error = self.error(y)
        return (law.Kp * error + law.Ki * y[-2] + law.Kd * (error - y[-1]) / law.Tf) if active else 0.0

    def screw_rate(self, y: Array) -> float:
        moves = self.flank and not self.resting
        return float(y[SPEED] - 0.5 * self.flank * self.gap_rate) if moves else 0.0

    def load(self, y: Array) -> float:
        """Torque of the screw's spring against the motor, N m, were it in contact."""
        s = self.servo
        return s.p * s.k_d * (s.p * float(y[SCREW]) - float(y[CHAIN])) if self.elastic else 0.0

    def torque(self, y: Array, pressed: bool) -> float:
        """Torque on the motor without friction, with or without the load, N m."""
        return self.servo.k_T * float(y[CURRENT]) - (self.load(y) if pressed else 0.0)

    def _rate(self, _time: float, y: Array) -> Array:
        s, law, free = self.servo, self.servo.controller, self.free
        rate = np.zeros_like(y)
        rate[CURRENT] = (self.voltage(y) + self.bias - s.R * y[CURRENT] - s.k_B * y[SPEED]) / s.L
        if self.motion and not self.resting:
            rate[SPEED] = (self.torque(y, pressed=self.flank != 0) - self.motion * self.friction) / s.J
        rate[MOTOR] = y[SPEED]
        rate[SCREW] = self.screw_rate(y)
        own, speeds = y[CHAIN : CHAIN + free], y[CHAIN + free : CHAIN + 2 * free]
        # The first place is the screw's end, or the ground that the first mass hangs on beside the screw's spring.
        first = (0.0, 0.0) if self.elastic else (s.p * y[SCREW], s.p * rate[SCREW])
        q, v, k = np.append(first[0], own), np.append(first[1], speeds), slice(0 if self.elastic else 1, None)
        pulls = s.stiffnesses[k] * -np.diff(q) + s.dampings[k] * -np.diff(v)
        forces = pulls - np.append(pulls[1:], 0.0)
        if self.elastic:
            forces[0] += self.load(y) / s.p
        rate[CHAIN : CHAIN + free] = speeds
        rate[CHAIN + free : CHAIN + 2 * free] = forces / s.masses[k]
        driven = self.error(y) if self.tolerance is None or self.zone != 0 else 0.0
        rate[-2], rate[-1] = driven, (driven - y[-1]) / law.Tf
        return rate

    def _flow(self, size: int) -> Callable[[float, Array], Array]:
        """Rates of the present mode, which are affine, as a matrix and a vector: they cost a tenth."""
        constant = self._rate(0.0, np.zeros(size))
        matrix = np.array([self._rate(0.0, unit) - constant for unit in np.eye(size)]).T
        return lambda _t, y: matrix @ y + constant

    def _guards(self) -> list[tuple[str, Callable[[float, Array], float], Callable[[float, Array], None]]]:
        return [*self._of_motion(), *self._of_flank(), *self._of_zone()]

    def _of_motion(self) -> list:
        if self.motion:
            return [] if self.resting else [("stick", lambda _t, y: -self.motion * y[SPEED], self._stop)]
        return [
            ("slip", lambda _t, y, s=s: s * self._driving(y, s) - self.friction, lambda _t, _y, s=s: self._start(s))
            for s in (1, -1)
        ]

    def _driving(self, y: Array, side: int) -> float:
        """Torque that drives a stuck motor to a side: from a flank at rest it goes off without the load."""
        return self.torque(y, pressed=self.flank != 0 and not (self.resting and side != self.flank))

    def _stop(self, time: float, y: Array) -> None:
        y[SPEED] = 0.0
        self.motion = 0
        self._lose_contact_if_stuck()
        for side in (1, -1):
            if side * self._driving(y, side) > self.friction:
                self.events.append((time, "slip"))
                self._start(side)
                return

    def _start(self, side: int) -> None:
        self.motion = side
        if self.elastic and self.resting:
            self.flank, self.resting = (self.flank if side == self.flank else 0), False
        elif not self.elastic and self.flank == -side and self.gap_rate == 0.0:
            self.flank = 0

    def _lose_contact_if_stuck(self) -> None:
        if self.flank and self.gap_rate > 0.0:
            self.flank = 0
        self.resting = self.elastic and self.flank != 0 and self.gap_rate == 0.0

    def _of_flank(self) -> list:
        if self.flank and not self.motion:
            return []  # the screw's rate is the gap's alone: see _lose_contact_if_stuck
        if self.resting:
            return [
                ("pressed", lambda _t, y: self.flank * self._net(y, pressed=True), self._press),
                ("release", lambda _t, y: -self.flank * self._net(y, pressed=False), self._release),
            ]
        if self.flank:
            end = self._hold if self.elastic else self._release
            return [("release", lambda _t, y: -self.flank * self.screw_rate(y), end)]
        return [
            (
                "contact",
                lambda t, y, s=s: s * (y[MOTOR] - y[SCREW]) - 0.5 * self.gap(t),
                lambda t, y, s=s: self._touch(s, t, y),
            )
            for s in (1, -1)
        ]

    def _net(self, y: Array, pressed: bool) -> float:
        return self.torque(y, pressed) - self.motion * self.friction

    def _hold(self, _time: float, y: Array) -> None:
        self.resting, y[SPEED] = True, 0.5 * self.flank * self.gap_rate
        if self.flank * self._net(y, pressed=True) > 0.0:
            self.resting = False
        elif self.flank * self._net(y, pressed=False) < 0.0:
            self.flank, self.resting = 0, False

    def _press(self, _time: float, _y: Array) -> None:
        self.resting = False

    def _release(self, _time: float, _y: Array) -> None:
        self.flank, self.resting = 0, False

    def _touch(self, side: int, time: float, y: Array) -> None:
        self.flank = side
        y[SCREW] = y[MOTOR] - 0.5 * side * self.gap(time)

    def _of_zone(self) -> list:
        if self.tolerance is None:
            return []
        if self.zone:
            side = self.zone
            return [("enter", lambda _t, y: self.tolerance - side * self.error(y), lambda _t, _y: self._zone(0))]
        return [
            ("leave", lambda _t, y, s=s: s * self.error(y) - self.tolerance, lambda _t, _y, s=s: self._zone(s))
            for s in (1, -1)
        ]

    def _zone(self, zone: int) -> None:
        self.zone = zone
