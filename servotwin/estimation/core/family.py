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
from scipy.linalg import matrix_balance

from servotwin.hybrid.compiled import compiled
from servotwin.plant.servo import Servo
from servotwin.plant.signals import Array
from servotwin.plant.structure import chain

_TERMS = 18  # of the series, for a norm below 1/4
MOTOR = ("J", "L", "R", "k_T", "k_B")
STRUCTURE = ("k/m", "c/m", "pitch")


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
        interval = 1.0 / sample_rate
        parts = [_discretised(self.system, one, interval, hold) for one in (self.system, *self.by)]
        steps = [parts[0][0], *(derivative for _, derivative in parts[1:])]
        size = self.system.B.size
        F, G, H = (np.array([step[:size, part] for step in steps]) for part in (slice(size), size, size + 1))
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
        _respond(self.F, self.now, self.after, self.C, self.D, np.ascontiguousarray(signal), start, out)
        return out

    def plain(self, signals: Array) -> Array:
        """(k, n) outputs alone, from rest, for inputs (k, n)."""
        bare = Sampled(self.F[:1], self.now[:1], self.after[:1], self.C[:1], self.D[:1])
        return np.array([bare.respond(signal)[0] for signal in signals]).reshape(signals.shape)

    def free(self, samples: int) -> Array:
        """(N, n) outputs of the unforced system from each unit state."""
        bare = Sampled(self.F[:1], self.now[:1], self.after[:1], self.C[:1], self.D[:1])
        silence, states = np.zeros(samples), np.eye(self.C.shape[1])
        return np.array([bare.respond(silence, state)[0] for state in states])


def _discretised(system: Matrices, by: Matrices, interval: float, hold: InputHold) -> tuple[Array, Array]:
    """exp of the system with its input's value and slope as states, over an interval, and its derivative."""
    flow, change = _flow(system, interval, hold), _flow(by, interval, hold, constant=False)
    _, (scale, _) = matrix_balance(flow, permute=False, separate=True)
    ratio = scale[None, :] / scale[:, None]
    step = np.zeros((2, *flow.shape))
    _exponential(flow * ratio, change * ratio, step)
    return step[0] / ratio, step[1] / ratio


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
def _exponential(flow: Array, change: Array, step: Array) -> None:
    """exp(flow) into step[0], its derivative in the direction `change` into step[1]: Taylor, then squaring.

    Compiled, because the libraries' threads can lose milliseconds over a small matrix on a busy machine.
    """
    size = len(flow)
    largest = 0.0
    for a in range(size):
        largest = max(largest, np.sum(np.abs(flow[a])))
    halvings = max(0, int(np.ceil(np.log2(max(largest, 1e-300)))) + 2)
    small, turn = flow / 2.0**halvings, change / 2.0**halvings
    term, slope = np.eye(size), np.zeros((size, size))
    step[0] = np.eye(size)
    for order in range(1, _TERMS):
        slope = (multiplied(slope, small) + multiplied(term, turn)) / order
        term = multiplied(term, small) / order
        step[0] += term
        step[1] += slope
    for _ in range(halvings):
        # The derivative of a square, before the square itself replaces its factor.
        step[1] = multiplied(step[0], step[1]) + multiplied(step[1], step[0])
        step[0] = multiplied(step[0], step[0])


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
    """Screw angle (rad) to the last mass's position (m), for all stiffnesses, all dampings over the masses, and p.

    "k/m" scales every stiffness, "c/m" every damping, "pitch" the screw. The state is z = x - B_velocity d, whose
    derivative does not contain the input's. Only a rigid screw is a function of its angle alone.
    """
    m, k, c, p = servo.masses, servo.stiffnesses, servo.dampings, servo.p
    whole, bare = servo.chain(), chain(m, 0.0 * k, 0.0 * c).A
    by_k, by_c = chain(m, k, 0.0 * c).A - bare, chain(m, 0.0 * k, c).A - bare
    velocity, row = whole.B_velocity, whole.C_last
    B, D = p * (whole.A @ velocity + whole.B_position), p * float(row @ velocity + whole.D[-1])
    none = np.zeros_like(B)
    stiffness = Matrices(by_k, p * (by_k @ velocity + whole.B_position), none, 0.0)
    damping = Matrices(by_c, p * (by_c @ velocity + whole.A @ velocity), none, p * float(row @ velocity))
    pitch = Matrices(np.zeros_like(bare), B, none, D)
    return Family(STRUCTURE, Matrices(whole.A, B, row, D), (stiffness, damping, pitch))
