"""scipy's solve_ivp (LSODA) with terminal events, restarted after each: right, and slow (option --slow)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import numpy as np

from benchmarks.contest import Contestant, Job
from benchmarks.workloads import LoopEquations, WearWorkload, equations_of
from servotwin.hybrid.automaton import Array

NAME = "scipy LSODA, events"
RELATIVE, ABSOLUTE = 1e-10, 1e-14
SPEED, ANGLE, INTEGRAL, LAGGED, CHAIN = 1, 2, 3, 4, 5
STATES = 9
BLIND = 1e-8  # s after a restart without a search for events: the event just handled would be detected again
Guard: TypeAlias = Callable[[float, Array], float]


@dataclass
class SwitchedLoop:
    """State of a run: contact -1 or +1, or 0 in the gap; `on` while the error is outside the dead zone."""

    model: LoopEquations
    workload: WearWorkload
    reference: float = 0.0
    contact: int = 1
    on: bool = True
    screw: float = 0.0
    time: float = 0.0
    state: Array = field(default_factory=lambda: np.zeros(STATES))

    def half_gap(self, t: float) -> float:
        c0, c2, c3 = self.workload.half_gap
        return c0 + t * t * (c2 + c3 * t)

    def half_gap_rate(self, t: float) -> float:
        _, c2, c3 = self.workload.half_gap
        return t * (2.0 * c2 + 3.0 * c3 * t)

    def matrix(self) -> Array:
        """(9, 9) flow of the present mode."""
        m, A = self.model, np.zeros((STATES, STATES))
        A[:3, :3] = m.motor_A
        A[LAGGED, LAGGED] = -1.0 / m.Tf
        A[CHAIN:, CHAIN:] = m.chain_A
        if self.on:
            A[INTEGRAL, CHAIN:] = -m.position
            A[LAGGED, CHAIN:] = -m.position / m.Tf
            A[:3, CHAIN:] = -(m.Kp + m.N) * np.outer(m.motor_B, m.position)
            A[:3, INTEGRAL], A[:3, LAGGED] = m.Ki * m.motor_B, -m.N * m.motor_B
        if self.contact:
            A[CHAIN:, ANGLE] = m.chain_B
        return A

    def drives(self) -> tuple[Array, Array]:
        """(9,) columns: constant, and of the half gap."""
        m, constant, of_gap = self.model, np.zeros(STATES), np.zeros(STATES)
        if self.on:
            constant[:3] = (m.Kp + m.N) * self.reference * m.motor_B
            constant[INTEGRAL], constant[LAGGED] = self.reference, self.reference / m.Tf
        if self.contact:
            of_gap[CHAIN:] = -self.contact * m.chain_B
        else:
            constant[CHAIN:] = self.screw * m.chain_B
        return constant, of_gap

    def guards(self) -> list[Guard]:
        """Positive as long as the mode holds: first the dead zone's, then the gap's."""
        sign = 1.0 if self.on else -1.0
        reference, row, tolerance = self.reference, self.model.position, self.workload.tolerance
        guards: list[Guard] = [lambda _, x: sign * (abs(reference - float(row @ x[CHAIN:])) - tolerance)]
        if self.contact:
            guards.append(lambda t, x: self.contact * x[SPEED] - self.half_gap_rate(t))
            return guards
        guards.append(lambda t, x: self.half_gap(t) - (x[ANGLE] - self.screw))
        guards.append(lambda t, x: self.half_gap(t) + (x[ANGLE] - self.screw))
        return guards

    def switch(self, guard: int) -> None:
        """Enter the next mode."""
        if guard == 0:
            self.on = not self.on
        elif self.contact:
            self.screw = self.state[ANGLE] - self.contact * self.half_gap(self.time)
            self.contact = 0
        else:
            self.contact = 1 if guard == 1 else -1


def run(loop: SwitchedLoop, end: float, times: Array, out: Array) -> None:
    """Integrate to `end`; return the positions at the `times` (n,) on the way."""
    from scipy.integrate import solve_ivp

    while loop.time < end:
        A, (constant, of_gap) = loop.matrix(), loop.drives()
        first = int(np.searchsorted(times, loop.time))
        requested = times[first : int(np.searchsorted(times, end, side="right"))]
        answer = solve_ivp(
            lambda t, x, A=A, c=constant, g=of_gap: A @ x + c + g * loop.half_gap(t),
            (loop.time, end),
            loop.state,
            method="LSODA",
            t_eval=requested,
            events=[_terminal(guard, loop.time + BLIND) for guard in loop.guards()],
            jac=lambda _t, _x, A=A: A,
            rtol=RELATIVE,
            atol=ABSOLUTE,
        )
        passed = len(answer.t)
        if passed:
            out[first : first + passed] = loop.model.position @ answer.y[CHAIN:]
        if answer.status != 1:
            loop.time, loop.state = end, np.asarray(answer.y[:, -1])
            return
        guard = next(i for i, events in enumerate(answer.t_events) if len(events))
        loop.time, loop.state = float(answer.t_events[guard][0]), np.asarray(answer.y_events[guard][0])
        loop.switch(guard)


def _terminal(guard: Guard, after: float) -> Any:
    def event(t: float, x: Array) -> float:
        return guard(t, x) if t > after else 1.0

    event.terminal, event.direction = True, -1.0  # type: ignore[attr-defined]
    return event


def wearing(workload: WearWorkload) -> Contestant:
    """W1."""

    def prepare() -> Job:
        model = equations_of(workload.servo)
        times = np.arange(workload.samples) / workload.sample_rate

        def job() -> Array:
            loop, out = SwitchedLoop(model, workload), np.zeros(workload.samples)
            for turn in range(workload.turns):
                loop.reference = workload.level(turn)
                loop.on = bool(abs(loop.reference - model.position @ loop.state[CHAIN:]) > workload.tolerance)
                run(loop, 0.5 * workload.period * (turn + 1), times, out)
            return out

        return job

    return Contestant(NAME, prepare)
