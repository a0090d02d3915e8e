"""Sampled responses of linear systems with their exact derivatives by parameters.

For x' = A x + B u whose matrices depend on parameters, the derivative of exp(A T) in a direction A' is the upper right
block of exp([[A, A'], [0, A]] T): the discretised system's derivatives are as exact as the system itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import NamedTuple

import numpy as np
from scipy.linalg.lapack import dgebal

from servotwin.hybrid.compiled import compiled
from servotwin.plant.servo import Servo
from servotwin.plant.signals import Array
from servotwin.plant.structure import chain

_TERMS = 18  # of the series, for a norm below 1/4
MOTOR = ("J", "L", "R", "k_T", "k_B")
STRUCTURE = ("k/m", "c/m", "pitch", "k_d")


class InputHold(StrEnum):
    """Course of an input between its samples."""

    CONSTANT = "zero-order hold"
    LINEAR = "linear"


class Matrices(NamedTuple):
    """A (N, N), B (N,), C (N,), D of one system, or their derivatives by one parameter."""

    A: Array
    B: Array
    C: Array
    D: float


@dataclass(frozen=True, eq=False)
class Family:
    """A linear system and its derivatives by the logarithms of its parameters.

    Attributes
    ----------
    names : tuple of str
        The parameters.
    system : Matrices
    by : tuple of Matrices
        One for each parameter: the derivative by its logarithm.
    """

    names: tuple[str, ...]
    system: Matrices
    by: tuple[Matrices, ...]

    def select(self, names: Sequence[str]) -> Family:
        """The same system with the derivatives by some of its parameters only."""
        return Family(tuple(names), self.system, tuple(self.by[self.names.index(name)] for name in names))

    def sampled(self, sample_rate: float, hold: InputHold = InputHold.LINEAR) -> Sampled:
        """Discretise at a sample rate (Hz)."""
        steps, size = _discretised(self.system, self.by, 1.0 / sample_rate, hold), self.system.B.size
        F, G, H = (np.ascontiguousarray(steps[:, :size, part]) for part in (slice(size), size, size + 1))
        rows = (self.system, *self.by)
        return Sampled(F, G - H, H, np.array([one.C for one in rows]), np.array([one.D for one in rows]))


@dataclass(frozen=True, eq=False)
class Sampled:
    """x[i+1] = F x[i] + now u[i] + after u[i+1], y = C x + D u; index 0 the system, index p its p-th derivative.

    Attributes
    ----------
    F : (P + 1, N, N) array
    now, after, C : (P + 1, N) arrays
    D : (P + 1,) array
    """

    F: Array
    now: Array
    after: Array
    C: Array
    D: Array

    def respond(self, signal: Array, initial: Array | None = None) -> Array:
        """(P + 1, n) output and its derivatives by the parameters, for an input (n,).

        Parameters
        ----------
        signal : (n,) array
        initial : (N,) array, optional
            State at the first sample, the same whatever the parameters; zero by default.
        """
        start = np.zeros(self.C.shape[1]) if initial is None else initial
        out = np.empty((len(self.D), signal.size))
        # Read-only or strided signals would be compiled once more.
        _respond(self.F, self.now, self.after, self.C, self.D, np.require(signal, requirements=("C", "W")), start, out)
        return out

    def plain(self, signals: Array) -> Array:
        """(k, n) outputs alone, from rest, for inputs (k, n)."""
        bare = Sampled(self.F[:1], self.now[:1], self.after[:1], self.C[:1], self.D[:1])
        return np.array([bare.respond(signal)[0] for signal in signals]).reshape(signals.shape)

    def free(self, samples: int) -> Array:
        """(N, n) outputs of the unforced system from each unit state."""
        rows, jump = np.empty((samples, self.C.shape[1])), self.F[0]
        rows[:1], known = self.C[0], 1
        # Row i is C F^i: those known, moved on by as many samples, are the next ones.
        while known < samples:
            more = min(known, samples - known)
            rows[known : known + more] = rows[:more] @ jump
            known, jump = known + more, jump @ jump
        return np.ascontiguousarray(rows.T)


def _discretised(system: Matrices, by: Sequence[Matrices], interval: float, hold: InputHold) -> Array:
    """(P + 1, N + 2, N + 2) exp of the system with its input's value and slope as states, over an interval, and its
    derivatives."""
    flow = _flow(system, interval, hold)
    changes = np.array([_flow(one, interval, hold, constant=False) for one in by]).reshape(len(by), *flow.shape)
    scale = dgebal(flow, scale=1)[3]
    ratio = scale[None, :] / scale[:, None]
    steps = np.zeros((len(by) + 1, *flow.shape))
    _exponential(flow * ratio, changes * ratio, steps)
    return steps / ratio


@compiled
def multiplied(one: Array, other: Array) -> Array:
    """Product of two small square matrices."""
    size = len(one)
    out = np.zeros((size, size))
    for a in range(size):
        for k in range(size):
            for b in range(size):
                out[a, b] += one[a, k] * other[k, b]
    return out


@compiled
def _exponential(flow: Array, changes: Array, steps: Array) -> None:
    """exp(flow) into steps[0], its derivatives in the directions `changes` into the others: Taylor, then squaring.

    Compiled, because the libraries' threads can lose milliseconds over a small matrix on a busy machine.
    """
    size = len(flow)
    largest = 0.0
    for a in range(size):
        largest = max(largest, np.sum(np.abs(flow[a])))
    halvings = max(0, int(np.ceil(np.log2(max(largest, 1e-300)))) + 2)
    small, turns = flow / 2.0**halvings, changes / 2.0**halvings
    term, slopes = np.eye(size), np.zeros(changes.shape)
    steps[0] = np.eye(size)
    for order in range(1, _TERMS):
        for p in range(len(changes)):
            slopes[p] = (multiplied(slopes[p], small) + multiplied(term, turns[p])) / order
            steps[p + 1] += slopes[p]
        term = multiplied(term, small) / order
        steps[0] += term
    for _ in range(halvings):
        # The derivatives of a square, before the square itself replaces its factor.
        for p in range(1, len(steps)):
            steps[p] = multiplied(steps[0], steps[p]) + multiplied(steps[p], steps[0])
        steps[0] = multiplied(steps[0], steps[0])


def _flow(system: Matrices, interval: float, hold: InputHold, constant: bool = True) -> Array:
    """(N + 2, N + 2) generator for (state, input, its increment over the interval), times the interval."""
    size = system.B.size
    flow = np.zeros((size + 2, size + 2))
    flow[:size, :size], flow[:size, size] = system.A * interval, system.B * interval
    if constant and hold is InputHold.LINEAR:
        flow[size, size + 1] = 1.0
    return flow


@compiled
def _respond(F: Array, now: Array, after: Array, C: Array, D: Array, signal: Array, start: Array, out: Array) -> None:
    count, size = C.shape
    states = np.zeros((count, size))
    states[0] = start
    ahead = np.zeros((count, size))
    for i in range(signal.size):
        u = signal[i]
        v = signal[min(i + 1, signal.size - 1)]
        for p in range(count):
            y = D[p] * u
            for a in range(size):
                y += C[0, a] * states[p, a]
                if p > 0:
                    y += C[p, a] * states[0, a]
                s = now[p, a] * u + after[p, a] * v
                for b in range(size):
                    s += F[0, a, b] * states[p, b]
                    if p > 0:
                        s += F[p, a, b] * states[0, b]
                ahead[p, a] = s
            out[p, i] = y
        states, ahead = ahead, states


def motor_family(servo: Servo) -> Family:
    """Voltage (V) to the motor's angle (rad), for (current, speed, angle); by J, L, R, k_T, k_B (Eqs 1-8)."""
    A, B, _ = servo.motor()
    powers = {"J": (0, 0, -1), "L": (-1, -1, 0), "R": (1, 0, 0), "k_T": (0, 0, 1), "k_B": (0, 1, 0)}
    by = []
    for name in MOTOR:
        change = np.zeros((3, 3))
        change[0, 0], change[0, 1], change[1, 0] = np.array(powers[name]) * (A[0, 0], A[0, 1], A[1, 0])
        by.append(Matrices(change, -B if name == "L" else np.zeros(3), np.zeros(3), 0.0))
    return Family(MOTOR, Matrices(A, B, np.array([0.0, 0.0, 1.0]), 0.0), tuple(by))


def structure_family(servo: Servo) -> Family:
    """Screw angle (rad) to the last mass's position (m), for stiffnesses and dampings over the masses, p, and k_d.

    "k/m" scales every stiffness but that of an elastic screw, which "k_d" scales, "c/m" every damping, "pitch" the
    screw. The state is z = x - B_velocity d, whose derivative does not contain the input's.
    """
    p, whole = servo.p, servo.chain()
    by_k, by_c = np.zeros((2, *whole.A.shape))
    # The accelerations (lower half) are linear in the stiffnesses (by the positions) and the dampings (by the speeds).
    masses = len(whole.A) // 2
    by_k[masses:, :masses], by_c[masses:, masses:] = whole.A[masses:, :masses], whole.A[masses:, masses:]
    by_screw, position_by_screw = np.zeros_like(by_k), np.zeros_like(whole.B_position)
    if not servo.rigid:
        alone = chain(servo.masses, 0.0 * servo.stiffnesses, 0.0 * servo.dampings, servo.k_d)
        by_screw[masses:, :masses], position_by_screw = alone.A[masses:, :masses], alone.B_position
    by_k -= by_screw
    position_by_k = whole.B_position - position_by_screw
    velocity, row = whole.B_velocity, whole.C_last
    B, D = p * (whole.A @ velocity + whole.B_position), p * float(row @ velocity + whole.D[-1])
    none = np.zeros_like(B)
    stiffness = Matrices(by_k, p * (by_k @ velocity + position_by_k), none, 0.0)
    damping = Matrices(by_c, p * (by_c @ velocity + whole.A @ velocity), none, p * float(row @ velocity))
    pitch = Matrices(np.zeros_like(by_k), B, none, D)
    screw = Matrices(by_screw, p * (by_screw @ velocity + position_by_screw), none, 0.0)
    return Family(STRUCTURE, Matrices(whole.A, B, row, D), (stiffness, damping, pitch, screw))
