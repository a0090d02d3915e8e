"""A piecewise-affine automaton: per mode a linear flow, linear guards and linear resets.

Everything is homogeneous in the state: constants, ramps and polynomial inputs are states of an exosystem (a constant
``1`` with zero derivative makes a flow affine). So no threshold in the whole kernel is absolute, and scaling a start by
a power of two scales the whole trajectory bit for bit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from servotwin.errors import InvalidInput

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Guard:
    """Leave the mode when ``row @ x`` becomes positive.

    Parameters
    ----------
    row : (n,) array
        The mode admits flow where ``row @ x <= 0``.
    target : int
        Index of the mode entered.
    reset : (n, n) array, optional
        ``x`` becomes ``reset @ x`` at the event; None leaves it.
    label, side : str, int
        Names for the event table.
    """

    row: ArrayLike
    target: int
    reset: ArrayLike | None = None
    label: str = ""
    side: int = 0


@dataclass(frozen=True)
class Mode:
    """Flow ``x' = flow @ x`` while no guard is positive."""

    flow: ArrayLike
    guards: tuple[Guard, ...] = ()
    name: str = ""


@dataclass(frozen=True, eq=False)
class Automaton:
    """Modes over one common state; compared and hashed by identity.

    Parameters
    ----------
    modes : tuple of Mode
        Flows are ``(n, n)``, guard rows ``(n,)``.
    names : tuple of str
        One name per state.

    Raises
    ------
    InvalidInput
        When shapes disagree, a number is not finite, a target does not exist or a name is used twice.
    """

    modes: tuple[Mode, ...]
    names: tuple[str, ...]
    flows: Array = field(init=False, repr=False)

    def __post_init__(self) -> None:
        n = len(self.names)
        if n == 0 or not self.modes:
            raise InvalidInput("an automaton needs at least one mode and at least one state")
        if len(set(self.names)) < n:
            raise InvalidInput(f"state names {self.names} must differ from one another")
        for mode in self.modes:
            _check(f"flow of mode {mode.name!r}", mode.flow, (n, n))
            for guard in mode.guards:
                _check(f"guard {guard.label!r} of mode {mode.name!r}", guard.row, (n,))
                if guard.reset is not None:
                    _check(f"reset of guard {guard.label!r}", guard.reset, (n, n))
                if not 0 <= guard.target < len(self.modes):
                    raise InvalidInput(
                        f"guard {guard.label!r} leads to mode {guard.target}; modes are 0 to {len(self.modes) - 1}"
                    )
        object.__setattr__(self, "flows", np.array([mode.flow for mode in self.modes], dtype=float))

    @cached_property
    def fastest(self) -> float:
        """Largest eigenvalue magnitude of any mode, 1/s."""
        return float(self._speeds[0])

    @cached_property
    def fastest_lasting(self) -> float:
        """Largest magnitude among the eigenvalues of lasting motions, with a damping ratio below 1 / sqrt(2), 1/s."""
        return float(self._speeds[1])

    @cached_property
    def _speeds(self) -> tuple[Array, Array]:
        return speeds(self.flows)

    def index(self, name: str) -> int:
        """Index of the state called `name`."""
        return self.names.index(name)


@dataclass(frozen=True, eq=False)
class AutomatonStack:
    """Automata of one structure: their states, guards and targets are those of the first; their numbers differ.

    Parameters
    ----------
    first : Automaton
    flows : (A, M, n, n) array
    rows : (A, M, G, n) array
        Guards; 0 where a mode has fewer.
    resets : (A, M, G, n, n) or (1, M, G, n, n) array
        0 where there is none; one where all automata have the same.

    Raises
    ------
    InvalidInput
        A number is not finite.
    """

    first: Automaton
    flows: Array
    rows: Array
    resets: Array

    def __post_init__(self) -> None:
        for what, values in (("flow", self.flows), ("guard", self.rows), ("reset", self.resets)):
            if not np.isfinite(values).all():
                raise InvalidInput(f"a {what} of a stack of automata holds a number that is not finite")

    @cached_property
    def speeds(self) -> tuple[Array, Array]:
        """(A,) of each automaton, as of `speeds`."""
        return speeds(self.flows)

    @cached_property
    def shared_flows(self) -> NDArray[np.int64]:
        """(M,), as of `shared_flows`."""
        return shared_flows(self.flows)

    @classmethod
    def of(cls, automata: Sequence[Automaton]) -> AutomatonStack:
        """Numbers of automata.

        Raises
        ------
        InvalidInput
            They differ in structure.
        """
        structure = structure_key(automata[0])
        if any(structure_key(automaton) != structure for automaton in automata[1:]):
            raise InvalidInput("the automata of an ensemble must have the same states, modes, guards and targets")
        modes, n = automata[0].modes, len(automata[0].names)
        most = max(1, *(len(mode.guards) for mode in modes))
        rows, resets = (np.zeros((len(automata), len(modes), most, *size)) for size in ((n,), (n, n)))
        for a, automaton in enumerate(automata):
            for m, mode in enumerate(automaton.modes):
                for g, guard in enumerate(mode.guards):
                    rows[a, m, g] = guard.row
                    if guard.reset is not None:
                        resets[a, m, g] = guard.reset
        return cls(automata[0], np.array([automaton.flows for automaton in automata]), rows, resets)


def structure_key(automaton: Automaton) -> tuple[object, ...]:
    """States, guards, targets and places of resets: equal for automata that differ in numbers only."""
    targets = tuple(tuple((g.target, g.reset is None) for g in mode.guards) for mode in automaton.modes)
    return automaton.names, targets


def speeds(flows: Array) -> tuple[Array, Array]:
    """Largest eigenvalue magnitudes (1/s) for flows (..., M, n, n): of all eigenvalues, and of those with a damping
    ratio below 1 / sqrt(2)."""
    # Constant states only add eigenvalues of zero, and equal flows have equal eigenvalues.
    moving = np.flatnonzero(flows.any(axis=(*range(flows.ndim - 2), flows.ndim - 1)))
    if moving.size == 0:
        return np.zeros(flows.shape[:-3]), np.zeros(flows.shape[:-3])
    among = np.ascontiguousarray(flows[..., moving[:, None], moving])
    different = np.unique(shared_flows(among), return_index=True)[1]
    values = np.linalg.eigvals(among[..., different, :, :])
    sizes = np.abs(values)
    lasting = np.where(values.real > -sizes / np.sqrt(2.0), sizes, 0.0)
    return sizes.max(axis=(-2, -1)), lasting.max(axis=(-2, -1))


def shared_flows(flows: Array) -> NDArray[np.int64]:
    """(M,) index of each mode's flow among the different ones of (..., M, n, n), in the order of appearance."""
    result: list[int] = []
    # The flows of the first automaton tell most of them apart; the sum makes one zero of both.
    first = [(each + 0.0).tobytes() for each in flows.reshape(-1, *flows.shape[-3:])[0]]
    for m in range(flows.shape[-3]):
        here = flows[..., m, :, :]
        same = (k for k in range(m) if first[k] == first[m] and np.array_equal(flows[..., k, :, :], here))
        result.append(next((result[k] for k in same), max(result, default=-1) + 1))
    return np.array(result)


def _check(what: str, value: ArrayLike, shape: tuple[int, ...]) -> None:
    array = np.asarray(value, dtype=float)
    if array.shape != shape:
        raise InvalidInput(f"{what} has shape {array.shape}; it must be {shape}")
    if not np.isfinite(array).all():
        raise InvalidInput(f"{what} holds a number that is not finite")
