"""The servo's loop written once more from the paper's equations, for integrators that share nothing with servotwin's.

One flow per side of the backlash (-1, 0, 1) and zone of the controller (-1, 0, 1); the order of the states is in
`Loop`. The gap is a cubic of time, the reference constant in pieces.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from event_oracle import OracleGuard, OracleMode, follow
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from servotwin.plant.servo import Servo

Array = NDArray[np.float64]
CURRENT, SPEED, MOTOR, SCREW = range(4)
# rad/s: a motor slower than this rests; what remains of its speed in the dead zone is the integrator's noise.
RESTING = 1e-11
# A play of -1, 0, 1 is the side of the flank in contact; HELD times the side: at rest there under part of the load.
HELD = 2


@dataclass
class Case:
    """One experiment: a square wave of the reference, a gap ``sum gap[k] t**k`` and a dead zone (0: none)."""

    servo: Servo
    amplitude: float
    half_period: float
    gap: Array
    tolerance: float
    duration: float = 20.0

    def stretches(self) -> list[tuple[float, float, float]]:
        """(begin, end, reference) of every constant stretch."""
        begins = np.arange(0.0, self.duration - 1e-9, self.half_period)
        return [
            (float(t), min(float(t) + self.half_period, self.duration), self.amplitude * (-1.0) ** k)
            for k, t in enumerate(begins)
        ]

    def gap_at(self, t: float) -> float:
        a, b, c, d = self.gap
        return a + t * (b + t * (c + t * d))

    def gap_rate(self, t: float) -> float:
        _, b, c, d = self.gap
        return b + t * (2.0 * c + t * 3.0 * d)


@dataclass
class Loop:
    """States: current, speed, motor angle, screw angle, positions, velocities, integral, filtered error and reference,
    band-pass and low-pass of the notch.

    A rigid screw carries the first mass with it (Eq 10), so that the positions start with the second; an elastic one
    pulls the first mass through k_d, and the load pulls the motor as long as there is contact.
    """

    case: Case
    size: int = field(init=False)

    def __post_init__(self) -> None:
        servo = self.case.servo
        self.elastic = np.isfinite(servo.k_d)
        self.moving = range(1 if self.elastic else 2, servo.n + 1)
        self.last = self.position(servo.n)
        self.integral = SCREW + 1 + 2 * len(self.moving)
        self.filtered, self.lagging, self.band, self.low, self.size = range(self.integral + 1, self.integral + 6)

    def position(self, mass: int) -> int:
        return SCREW + 1 + mass - self.moving[0]

    def velocity(self, mass: int) -> int:
        return self.position(mass) + len(self.moving)

    def flow(self, side: int, zone: int) -> tuple[Array, Array, Array]:
        """``x' = A x + reference a + gap' b`` (Eqs 1-4, 9, 10, 14, 16, 20)."""
        s, n = self.case.servo, self.size
        A, a, b = np.zeros((n, n)), np.zeros(n), np.zeros(n)
        A[CURRENT, CURRENT], A[CURRENT, SPEED] = -s.R / s.L, -s.k_B / s.L
        A[SPEED, CURRENT], A[MOTOR, SPEED] = s.k_T / s.J, 1.0
        if side:
            A[SCREW, SPEED], b[SCREW] = 1.0, -0.5 * side
        if side and self.elastic:
            A[SPEED, SCREW] -= s.p**2 * s.k_d / s.J
            A[SPEED, self.position(1)] += s.p * s.k_d / s.J
        for mass in self.moving:
            A[self.position(mass), self.velocity(mass)] = 1.0
            self._springs(A, b, mass)
        self._law(A, a, zone)
        return A, a, b

    def _springs(self, A: Array, b: Array, i: int) -> None:
        """What pulls mass i: spring and damper i towards mass i - 1 (the ground for i = 1), those of mass i + 1."""
        s = self.case.servo
        m, k, c = s.masses, s.stiffnesses, s.dampings
        pulls = [(k[i - 1], c[i - 1], i - 1)] + ([(k[i], c[i], i + 1)] if i < s.n else [])
        row = self.velocity(i)
        for stiffness, damping, other in pulls:
            A[row, self.position(i)] -= stiffness / m[i - 1]
            A[row, row] -= damping / m[i - 1]
            if other == 1 and not self.elastic:
                A[row, SCREW] += s.p * stiffness / m[i - 1]
                A[row] += s.p * damping / m[i - 1] * A[SCREW]
                b[row] += s.p * damping / m[i - 1] * b[SCREW]
            elif other > 0:
                A[row, self.position(other)] += stiffness / m[i - 1]
                A[row, self.velocity(other)] += damping / m[i - 1]
        if i == 1:
            A[row, SCREW] += s.p * s.k_d / m[0]
            A[row, self.position(1)] -= s.k_d / m[0]

    def _law(self, A: Array, a: Array, zone: int) -> None:
        s, law = self.case.servo, self.case.servo.controller
        A[self.filtered, self.filtered] = -1.0 / law.Tf
        A[self.lagging, self.lagging], a[self.lagging] = -1.0 / law.velocity_time, 1.0 / law.velocity_time
        kick = law.velocity_feedforward / law.velocity_time / s.L
        A[CURRENT, self.lagging], a[CURRENT] = -kick, kick
        omega = 2.0 * np.pi * law.notch_hz
        A[CURRENT, self.band] = -2.0 * law.notch_damping * (1.0 - law.notch_depth) / s.L if omega else 0.0
        A[self.band, self.band], A[self.band, self.low] = -2.0 * law.notch_damping * omega, -omega
        A[self.low, self.band] = omega
        if zone or law.integral_only:
            direct = law.Kp + law.Kd / law.Tf
            A[CURRENT, self.last], a[CURRENT] = -direct / s.L, direct / s.L + kick
            A[CURRENT, self.integral] = 1.0 / s.L
            A[CURRENT, self.filtered] = -law.Kd / law.Tf / s.L
            A[self.band, self.last], a[self.band] = -omega * direct, omega * direct
            A[self.band, self.integral], A[self.band, self.filtered] = omega, -omega * law.Kd / law.Tf
            A[self.filtered, self.last], a[self.filtered] = -1.0 / law.Tf, 1.0 / law.Tf
        if zone:
            A[self.integral, self.last], a[self.integral] = -law.Ki, law.Ki


def zone_of(case: Case, error: float) -> int:
    return 0 if abs(error) <= case.tolerance else (1 if error > 0.0 else -1)


def by_exponentials(case: Case, step: float = 2e-4) -> tuple[Callable[[Array], Array], list[tuple[float, str]]]:
    """Position of the last mass as a function of time, and the events, by `event_oracle`.

    Six more states: reference, tolerance, and the gap with its three derivatives.
    """
    loop, zones = Loop(case), (-1, 0, 1) if case.tolerance else (1,)
    n, plays = loop.size, (-1, 0, 1, -HELD, HELD) if loop.elastic else (-1, 0, 1)
    number = {key: k for k, key in enumerate(itertools.product(plays, zones))}
    modes = [OracleMode(_extended(loop, *key), _oracle_guards(loop, *key, number)) for key in number]
    x, play, runs, events = np.zeros(n + 6), 0, [], []
    x[n + 1] = case.tolerance
    for begin, end, reference in case.stretches():
        x[n] = reference
        x[n + 2 : n + 4] = case.gap_at(begin), case.gap_rate(begin)
        x[n + 4 :] = 2.0 * case.gap[2] + 6.0 * case.gap[3] * begin, 6.0 * case.gap[3]
        zone = zone_of(case, reference - x[loop.last]) if case.tolerance else 1
        run = follow(modes, x, number[play, zone], end - begin, step)
        time, mode, start = run.starts[-1]
        x, play = modes[mode].after(start, end - begin - time), plays[mode // len(zones)]
        runs.append((begin, run))
        events += [(begin + t, label) for t, label in run.events]
    return lambda t: _sampled(runs, t, np.eye(n + 6)[loop.last]), events


def _extended(loop: Loop, play: int, zone: int) -> Array:
    """The flow with reference, tolerance and gap as states; a held motor follows its flank."""
    n = loop.size
    A, a, b = loop.flow(0 if abs(play) == HELD else play, zone)
    full = np.zeros((n + 6, n + 6))
    full[:n, :n], full[:n, n], full[:n, n + 3] = A, a, b
    full[[n + 2, n + 3, n + 4], [n + 3, n + 4, n + 5]] = 1.0
    if abs(play) == HELD:
        full[SPEED] = np.eye(n + 6)[n + 4] * 0.5 * np.sign(play)
    return full


def _oracle_guards(loop: Loop, play: int, zone: int, number: dict[tuple[int, int], int]) -> list[OracleGuard]:
    unit, n, side = np.eye(loop.size + 6), loop.size, int(np.sign(play))
    r, tol, gap, rate, acceleration = unit[n : n + 5]
    apart, error = unit[MOTOR] - unit[SCREW], r - unit[loop.last]
    if play == 0:
        guards = [OracleGuard(s * apart - 0.5 * gap, number[s, zone], "contact", floor=1e-14) for s in (1, -1)]
    elif abs(play) == HELD:
        free, pressed = (side * _extended(loop, s, zone)[SPEED] - 0.5 * acceleration for s in (0, side))
        guards = [OracleGuard(pressed, number[side, zone], "contact", floor=1e-9)]
        guards += [OracleGuard(-free, number[0, zone], "release", floor=1e-9)]
    elif loop.elastic:
        stop = np.eye(n + 6)
        stop[SPEED] = 0.5 * side * rate
        guards = [OracleGuard(-side * unit[SPEED] + 0.5 * rate, number[HELD * side, zone], "hold", stop, RESTING)]
    else:
        guards = [OracleGuard(-side * unit[SPEED] + 0.5 * rate, number[0, zone], "release", floor=RESTING)]
    if loop.case.tolerance and zone:
        guards.append(OracleGuard(tol - zone * error, number[play, 0], "enter", floor=1e-17))
    elif loop.case.tolerance:
        guards += [OracleGuard(s * error - tol, number[play, s], "leave", floor=1e-17) for s in (1, -1)]
    return guards


def _sampled(runs: list, times: Array, row: Array) -> Array:
    begins = np.array([begin for begin, _ in runs])
    which = np.maximum(np.searchsorted(begins, times, side="right") - 1, 0)
    return np.concatenate([run.at(times[which == k] - begin, row) for k, (begin, run) in enumerate(runs)])


def by_solve_ivp(case: Case, times: Array, rtol: float = 1e-12) -> tuple[Array, int]:
    """Position of the last mass at `times`, and the number of events, by scipy's DOP853, restarted at each of them."""
    loop = Loop(case)
    x, side, count = np.zeros(loop.size), 0, 0
    result = np.full(len(times), np.nan)
    masses = len(loop.moving)
    scale = np.array([1e-2, 1.0, 1.0, 1.0, *[1e-3] * masses, *[1e-2] * masses, 1.0, 1e-3, 1e-3, 1.0, 1.0])
    for begin, end, reference in case.stretches():
        zone, t = (zone_of(case, reference - x[loop.last]) if case.tolerance else 1), begin
        while t < end:
            (A, a, b), guards = loop.flow(side, zone), _guards(case, loop, side, zone, reference, t, x)
            within = times[(times >= t) & (times <= end)]
            solution = solve_ivp(
                lambda t, x, A=A, c=a * reference, b=b: A @ x + c + b * case.gap_rate(t),
                (t, end), x, "DOP853", t_eval=np.unique([*within, end]), events=[g for g, _ in guards],
                rtol=rtol, atol=1e-3 * rtol * scale,
            )  # fmt: skip
            kept = np.asarray(solution.t)
            places = np.searchsorted(times, kept)
            good = (places < len(times)) & (times[np.minimum(places, len(times) - 1)] == kept)
            if good.any():
                result[places[good]] = solution.y[loop.last, good]
            if solution.status != 1:
                t, x = end, solution.y[:, -1]
                continue
            which = next(k for k, found in enumerate(solution.t_events) if len(found))
            t, x, count = float(solution.t_events[which][0]), solution.y_events[which][0], count + 1
            side, zone = guards[which][1]
    return result, count


def _guards(case: Case, loop: Loop, side: int, zone: int, reference: float, start: float, x0: Array) -> list:
    """Terminal events that rise through zero, with the (side, zone) that follows.

    A guard that starts above zero, by the rounding of the event just taken, would never rise through it: it is counted
    from where it starts.
    """
    found = []

    def add(value: Callable[[float, Array], float], after: tuple[int, int]) -> None:
        above = max(value(start, x0), 0.0)

        def event(t: float, x: Array) -> float:
            return value(t, x) - above

        event.terminal, event.direction = True, 1  # type: ignore[attr-defined]
        found.append((event, after))

    if side:
        add(lambda t, x: -side * x[SPEED] + 0.5 * case.gap_rate(t) - RESTING, (0, zone))
    else:
        add(lambda t, x: x[MOTOR] - x[SCREW] - 0.5 * case.gap_at(t), (1, zone))
        add(lambda t, x: x[SCREW] - x[MOTOR] - 0.5 * case.gap_at(t), (-1, zone))
    if case.tolerance and zone:
        add(lambda _, x: case.tolerance - zone * (reference - x[loop.last]), (side, 0))
    elif case.tolerance:
        add(lambda _, x: reference - x[loop.last] - case.tolerance, (side, 1))
        add(lambda _, x: x[loop.last] - reference - case.tolerance, (side, -1))
    return found
