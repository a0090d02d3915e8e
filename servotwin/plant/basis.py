"""Names of the states of the servo's automaton, the rows that pick them, and guards made of such rows."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from servotwin.plant.servo import Servo
from servotwin.plant.signals import Array


class GuardRow(NamedTuple):
    """A guard of one component of the automaton: its row, the component's mode entered, reset, label and side."""

    row: Array
    target: str
    reset: Array | None
    label: str
    side: int


class Basis:
    """States of an automaton by name."""

    def __init__(self, names: tuple[str, ...]) -> None:
        # Spare states that never move: the kernel's products run over whole vectors of the machine.
        self.names = (*names, *(f"spare{i}" for i in range(-len(names) % 4)))
        self._index = {name: i for i, name in enumerate(self.names)}
        self._rows = np.vstack([np.eye(len(self.names)), np.zeros(len(self.names))])
        self._rows.setflags(write=False)

    def __getitem__(self, name: str) -> int:
        return self._index[name]

    def __contains__(self, name: str) -> bool:
        return name in self._index

    def row(self, name: str) -> Array:
        """The row that picks a state, not to be written to; zero when there is no such state."""
        return np.asarray(self._rows[self._index.get(name, -1)])

    def positions(self, servo: Servo) -> Array:
        """(n, states) rows of the masses' positions."""
        chain = servo.chain()
        first = self["chain0"]
        rows = np.zeros((servo.n, len(self.names)))
        rows[:, first : first + chain.A.shape[0]] = chain.C
        rows[:, self["theta_d"]] += chain.D * servo.p
        return rows


def plant_names(servo: Servo) -> list[str]:
    """States of motor, screw and structure."""
    return ["current", "speed", "theta_m", "theta_d", *(f"chain{i}" for i in range(servo.chain().A.shape[0]))]


def input_names(key: str, order: int) -> list[str]:
    """An input that is a polynomial of degree `order`: its value and derivatives."""
    return [key + "'" * k for k in range(order + 1)]
