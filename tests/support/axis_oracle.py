"""Axes written once more as differential equations, for scipy's integrator: it shares nothing with servotwin's.

The elastic shaft follows Nordin and Gutman (2002): theta_b is the position inside the backlash, the shaft's twist is
what is left of the angle across both, and contact lasts as long as the shaft's torque presses on the flank.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from servotwin.plant.actuator import DcMotor, Stepper, TorqueDrive, VelocityDrive
from servotwin.plant.axis import Axis

Array = NDArray[np.float64]


@dataclass
class AxisOracle:
    """States: torque or current, speed, theta_m, theta_b (of a rigid screw: theta_d), q (n), v (n), integral, filtered
    error."""

    axis: Axis
    gap: float
    reference: float = 0.0
    side: int = 0
    changes: list[float] = field(default_factory=list)
    # Directions in which motor and last mass slide; 0: stuck.
    sliding: list[int] = field(default_factory=lambda: [0, 0])
    slips: list[float] = field(default_factory=list)

    def start(self) -> Array:
        """At rest, the motor in the middle of the gap; a pushed load of one mass hangs from its flank at zero."""
        x = np.zeros(6 + 2 * self.axis.n)
        load, shaft, p = self.axis.load, self.axis.transmission, self.axis.p
        if abs(load.force) > (load.static or load.friction):
            assert self.axis.n == 1
            assert not self.axis.rigid
            self.side = -1 if load.force > 0.0 else 1
            x[3] = 0.5 * self.gap * self.side
            x[2] = x[3] - load.force / (shaft.k_d * p)
            x[0] = x[-2] = -p * load.force
        return x

    def motor(self, x: Array, command: float, load: float) -> tuple[float, float]:
        """Rates of the first state and of the speed under a load torque."""
        a = self.axis.actuator
        if isinstance(a, DcMotor):
            if a.L == 0.0:
                current = (command - a.k_B * x[1]) / a.R
                return 0.0, (a.k_T * current - a.friction * x[1] + load) / a.J
            return (command - a.R * x[0] - a.k_B * x[1]) / a.L, (a.k_T * x[0] - a.friction * x[1] + load) / a.J
        if isinstance(a, TorqueDrive):
            torque = x[0] if a.lag else command
            rate = (command - x[0]) / a.lag if a.lag else 0.0
            return rate, (torque - a.friction * x[1] + load) / a.J
        if isinstance(a, VelocityDrive):
            return 0.0, (command - x[1]) / a.lag
        assert isinstance(a, Stepper)
        return 0.0, (command - x[2]) / a.smoothing**2 - 2.0 * x[1] / a.smoothing

    def across(self, x: Array) -> tuple[float, float]:
        """Angle across backlash and shaft at the motor's side, and its rate: theta_m less the first mass's."""
        n, p = self.axis.n, self.axis.p
        return x[2] - x[4] / p, x[1] - x[4 + n] / p

    def force(self, x: Array) -> float:
        """Force of the shaft on the first mass; the backlash is at a flank or closed to none."""
        if self.side == 0:
            return 0.0
        angle, rate = self.across(x)
        t, p = self.axis.transmission, self.axis.p
        return t.k_d * p * (angle - x[3]) + t.c_d * p * rate

    def slide(self, x: Array) -> float:
        """Rate of theta_b in the gap, where the shaft's spring and damper balance."""
        angle, rate = self.across(x)
        t = self.axis.transmission
        return rate + t.k_d / t.c_d * (angle - x[3])

    def command(self, x: Array) -> tuple[float, float]:
        """Command of the PIDF, and its error."""
        law, n = self.axis.controller, self.axis.n
        measured = self.axis.p * x[2] if self.axis.at_motor else x[3 + n]
        error = self.reference - measured
        return law.Kp * error + x[-2] + law.Kd / law.Tf * (error - x[-1]), error

    def rates(self, _t: float, x: Array) -> Array:
        n, law, p = self.axis.n, self.axis.controller, self.axis.p
        m, k, c = self.axis.load.m, self.axis.load.k, self.axis.load.c
        q, v = x[4 : 4 + n], x[4 + n : 4 + 2 * n]
        u, error = self.command(x)
        u = (
            u
            if self.axis.actuator.limit is None
            else float(np.clip(u, -self.axis.actuator.limit, self.axis.actuator.limit))
        )
        dx = np.zeros_like(x)
        rigid = self.axis.rigid
        force = 0.0 if rigid else self.force(x)
        dx[0], dx[1] = self.motor(x, u, -p * force - self.sliding[0] * self.friction(0, x[1]))
        if self.axis.motor_friction and not self.sliding[0]:
            dx[1] = 0.0
        dx[2] = x[1]
        if rigid:
            dx[3] = x[1] if self.side else 0.0
            q, v = q.copy(), v.copy()
            q[0], v[0] = p * x[3], p * dx[3]
            dx[4], dx[4 + n] = v[0], p * dx[1] if self.side else 0.0
        elif self.side == 0 and self.axis.transmission.c_d > 0.0:
            dx[3] = self.slide(x)
        elif self.side == 0:
            dx[3] = self.across(x)[1]
        for i in range(1 if rigid else 0, n):
            pull = -k[i] * (q[i] - (q[i - 1] if i else 0.0)) - c[i] * (v[i] - (v[i - 1] if i else 0.0))
            if i + 1 < n:
                pull += k[i + 1] * (q[i + 1] - q[i]) + c[i + 1] * (v[i + 1] - v[i])
            pull += self.axis.load.force - self.sliding[1] * self.friction(1, v[-1]) if i == n - 1 else 0.0
            dx[4 + i], dx[4 + n + i] = v[i], (pull + (force if i == 0 else 0.0)) / m[i]
        if self.axis.load.friction and not self.sliding[1]:
            dx[3 + 2 * n] = 0.0
        dx[-2], dx[-1] = law.Ki * error, (error - x[-1]) / law.Tf
        return dx

    def flow(self, size: int) -> Callable[[float, Array], Array]:
        """Rates of the present mode; where they are affine, as a matrix and a vector, which cost a tenth."""
        if self.axis.actuator.limit is not None or any(part.static for part in (self.axis.actuator, self.axis.load)):
            return self.rates
        constant = self.rates(0.0, np.zeros(size))
        matrix = np.array([self.rates(0.0, unit) - constant for unit in np.eye(size)]).T
        return lambda _t, x: matrix @ x + constant

    def friction(self, body: int, speed: float = 0.0) -> float:
        """Friction of motor (0) or last mass (1) at a speed, N m or N; above Coulomb's up to the Stribeck speed."""
        part = (self.axis.actuator, self.axis.load)[body]
        coulomb = (self.axis.motor_friction, self.axis.load.friction)[body]
        if part.static is None:
            return coulomb
        return coulomb + (part.static - coulomb) * max(0.0, 1.0 - abs(speed) / part.stribeck)

    def run(self, x: Array, begin: float, end: float, times: Array) -> tuple[Array, Array]:
        """State at the end and states at times in [begin, end)."""
        found, now = [], begin
        while now < end:
            self.slide_off(x)
            inside = times[(times >= now) & (times < end)]
            solution = solve_ivp(
                self.flow(x.size), (now, end), x, method="DOP853", rtol=1e-12, atol=1e-15, events=self.events(),
                t_eval=np.append(inside, end),
            )  # fmt: skip
            which = next((k for k, times_of in enumerate(solution.t_events) if times_of.size), None)
            now = end if which is None else float(solution.t_events[which][0])
            if count := np.count_nonzero(inside < now):
                found.append(solution.y[:, :count].T)
            if which is None:
                x = solution.y[:, -1].copy()
            else:
                x = self.changed(solution.y_events[which][0].copy(), now, which)
        return x, np.concatenate(found) if found else np.zeros((0, x.size))

    def slide_off(self, x: Array) -> None:
        """What the reference's jump or a contact drives beyond its friction slides at once."""
        for body, friction in enumerate((self.friction(0), self.friction(1))):
            if friction and not self.sliding[body] and abs(self.driven(body, x)) > friction * (1.0 + 1e-9):
                self.sliding[body] = int(np.sign(self.driven(body, x)))

    def events(self) -> list[object]:
        """Ends of the present mode."""
        half, rigid = 0.5 * self.gap, self.axis.rigid

        def apart(_t: float, x: Array) -> float:
            return half - abs(x[2] - x[3] if rigid else x[3])

        def leaving(_t: float, x: Array) -> float:
            return self.side * (x[1] if rigid else self.force(x))

        # A motor with friction leaves its flank as it slides off.
        grips = self.side != 0 and rigid and self.axis.motor_friction > 0.0
        chosen = [lambda _t, _x: 1.0] if grips else [apart if self.side == 0 else leaving]
        for body, friction in enumerate((self.friction(0), self.friction(1))):
            if friction:
                chosen.append(self.grip(body, friction))
        for each in chosen:
            each.terminal, each.direction = True, -1.0  # type: ignore[attr-defined]
        return list(chosen)

    def speed(self, body: int) -> int:
        """Place of the speed of motor (0) or last mass (1)."""
        return 1 if body == 0 else 3 + 2 * self.axis.n

    def driven(self, body: int, x: Array) -> float:
        """Torque on the motor or force on the last mass without friction."""
        before, self.sliding[body] = self.sliding[body], 2  # neither stuck nor, of no friction, sliding
        friction = self.friction(body, x[self.speed(body)])
        inertia = (getattr(self.axis.actuator, "J", 1.0), self.axis.load.m[-1])[body]
        rate = self.rates(0.0, x)[self.speed(body)] * inertia
        self.sliding[body] = before
        return float(rate + 2 * friction)

    def grip(self, body: int, friction: float) -> Callable[[float, Array], float]:
        """Event that ends sticking or sliding."""
        if self.sliding[body]:
            return lambda _t, x: self.sliding[body] * float(x[self.speed(body)])
        return lambda _t, x: friction - abs(self.driven(body, x))

    def changed(self, x: Array, now: float, which: int) -> Array:
        """The mode behind an event."""
        if which:
            body = 0 if self.axis.motor_friction and which == 1 else 1
            friction = self.friction(body)
            x[self.speed(body)] = 0.0
            drive = self.driven(body, x)
            stays = self.sliding[body] != 0 and abs(drive) <= friction
            self.sliding[body] = 0 if stays else int(np.sign(drive))
            self.slips.append(now)
            if self.axis.rigid and body == 0 and self.side and self.sliding[0] == -self.side:
                self.side = 0
                self.changes.append(now)
            return x
        self.changes.append(now)
        if self.side:
            self.side = 0
            return x
        inside = x[2] - x[3] if self.axis.rigid else x[3]
        self.side = 1 if inside > 0.0 else -1
        half = 0.5 * self.gap * self.side
        x[3] = x[2] - half if self.axis.rigid else half
        if self.axis.rigid:
            x[4], x[4 + self.axis.n] = self.axis.p * x[3], self.axis.p * x[1]
        return x


def positions(axis: Axis, gap: float, amplitude: float, half_period: float, times: Array) -> tuple[Array, list[float]]:
    """(N,) position of the last mass under a square wave that begins with +amplitude, and the times of contact changes.

    A rigid screw's first mass jumps in speed at contact; dampers beside it carry the jump in the flow.
    """
    oracle, found = AxisOracle(axis, gap), []
    x, begin, sign = oracle.start(), 0.0, 1.0
    while begin < times[-1]:
        oracle.reference = sign * amplitude
        x, states = oracle.run(x, begin, begin + half_period, times)
        found.append(states)
        begin, sign = begin + half_period, -sign
    states = np.concatenate(found)
    n = axis.n
    last = axis.p * states[:, 3] if axis.rigid and n == 1 else states[:, 3 + n]
    return last, oracle.changes
