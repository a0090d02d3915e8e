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
    """Modes: flank (-1, 0 open, 1), motion (-1, 0 stuck, 1), zone (-1, 0 inside, 1); the gap's rate is constant."""

    servo: Servo
    reference: float
    first_gap: float
    gap_rate: float
    tolerance: float | None
    friction: float
    bias: float = 0.0
    flank: int = 0
    motion: int = 0
    zone: int = 1
    events: list[tuple[float, str]] = field(default_factory=list)

    def run(self, times: Array) -> Array:
        """States at increasing times, the first of them 0: columns current, speed, motor, screw, positions 2 .. n,
        their velocities, integral of the error, its filtered value."""
        n = self.servo.n
        y, time, rows = np.zeros(CHAIN + 2 * (n - 1) + 2), 0.0, [np.zeros(CHAIN + 2 * (n - 1) + 2)]
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

    def gap(self, time: float) -> float:
        return self.first_gap + self.gap_rate * time

    def error(self, y: Array) -> float:
        return self.reference - float(y[CHAIN + self.servo.n - 2])

    def voltage(self, y: Array) -> float:
        law = self.servo.controller
        active = self.tolerance is None or self.zone != 0
        error = self.error(y)
        return (law.Kp * error + law.Ki * y[-2] + law.Kd * (error - y[-1]) / law.Tf) if active else 0.0

    def screw_rate(self, y: Array) -> float:
        return float(y[SPEED] - 0.5 * self.flank * self.gap_rate) if self.flank else 0.0

    def _rate(self, _time: float, y: Array) -> Array:
        s, law, free = self.servo, self.servo.controller, self.servo.n - 1
        rate = np.zeros_like(y)
        rate[CURRENT] = (self.voltage(y) + self.bias - s.R * y[CURRENT] - s.k_B * y[SPEED]) / s.L
        if self.motion:
            rate[SPEED] = (s.k_T * y[CURRENT] - self.motion * self.friction) / s.J
        rate[MOTOR] = y[SPEED]
        rate[SCREW] = self.screw_rate(y)
        q = np.concatenate([[s.p * y[SCREW]], y[CHAIN : CHAIN + free]])
        v = np.concatenate([[s.p * rate[SCREW]], y[CHAIN + free : CHAIN + 2 * free]])
        pulls = s.stiffnesses[1:] * -np.diff(q) + s.dampings[1:] * -np.diff(v)
        rate[CHAIN : CHAIN + free] = v[1:]
        rate[CHAIN + free : CHAIN + 2 * free] = (pulls - np.append(pulls[1:], 0.0)) / s.masses[1:]
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
        torque = self.servo.k_T
        if self.motion:
            return [("stick", lambda _t, y: -self.motion * y[SPEED], self._stop)]
        return [
            ("slip", lambda _t, y, s=s: s * torque * y[CURRENT] - self.friction, lambda _t, _y, s=s: self._start(s))
            for s in (1, -1)
        ]

    def _stop(self, time: float, y: Array) -> None:
        y[SPEED] = 0.0
        torque = self.servo.k_T * y[CURRENT]
        self.motion = 0 if abs(torque) <= self.friction else int(np.sign(torque))
        if self.motion:
            self.events.append((time, "slip"))
            self._leave_flank_with_motion()
        else:
            self._lose_contact_if_stuck()

    def _start(self, side: int) -> None:
        self.motion = side
        self._leave_flank_with_motion()

    def _leave_flank_with_motion(self) -> None:
        if self.flank == -self.motion and self.gap_rate == 0.0:
            self.flank = 0

    def _lose_contact_if_stuck(self) -> None:
        if self.flank and self.gap_rate > 0.0:
            self.flank = 0

    def _of_flank(self) -> list:
        if self.flank and not self.motion:
            return []  # the screw's rate is the gap's alone: see _lose_contact_if_stuck
        if self.flank:
            return [("release", lambda _t, y: -self.flank * self.screw_rate(y), self._release)]
        return [
            (
                "contact",
                lambda t, y, s=s: s * (y[MOTOR] - y[SCREW]) - 0.5 * self.gap(t),
                lambda t, y, s=s: self._touch(s, t, y),
            )
            for s in (1, -1)
        ]

    def _release(self, _time: float, _y: Array) -> None:
        self.flank = 0

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
