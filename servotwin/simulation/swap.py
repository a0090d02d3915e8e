"""Another controller in the running continuous loop: what the two have in common goes on, the voltage does not jump.

As `control.law.transfer` does for the sampled law: what the new controller would give less, or more, at this instant is
an offset that it lets go exponentially.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from servotwin.control.controller import Controller
from servotwin.hybrid.automaton import Array
from servotwin.plant.automaton import ServoAutomaton


@dataclass(frozen=True)
class Place:
    """Where a continuous loop stands."""

    loop: ServoAutomaton
    state: Array
    mode: int

    @property
    def zone(self) -> str:
        """The controller's zone."""
        return self.loop.zones[self.mode % len(self.loop.zones)]

    def output(self, name: str) -> float:
        """An output at this instant."""
        return float(self.loop.rows[name][self.mode] @ self.state)

    def value(self, name: str) -> float:
        """A state by name."""
        return float(self.state[self.loop.automaton.index(name)])


def swapped(
    now: Place, controller: Controller, values: Mapping[str, float], loop: Callable[[bool], ServoAutomaton]
) -> Place:
    """The place from which another controller goes on.

    Parameters
    ----------
    now : Place
    controller : Controller
        The one to come; what the old one wanted beyond its voltage limit is forgotten.
    values : dict
        States by name that the change sets.
    loop : callable
        The automaton with the new controller, with or without a state "offset".
    """
    place = _carried_over(now, controller, loop(False), values)
    offset = now.output("voltage") - place.output("voltage")
    if offset == 0.0:
        return place
    return _carried_over(now, controller, loop(True), {**values, "offset": offset})


def _carried_over(now: Place, controller: Controller, loop: ServoAutomaton, values: Mapping[str, float]) -> Place:
    """States by name. Without integral action nothing would ever correct the integral: it goes into the offset."""
    kept = {name: now.value(name) for name in now.loop.automaton.names if name != "offset"}
    kept |= {"integral": 0.0} if controller.Ki == 0.0 else {}
    kept = {"filtered": now.output("measured_position")} | kept | dict(values)
    state = np.array([kept.get(name, 0.0) for name in loop.automaton.names])
    zone = now.zone.split()[0]
    if zone != "on":
        error, tolerance = float(loop.rows["error"][0] @ state), kept["tolerance"]
        zone = _zone_after(zone, error, controller.enter * tolerance, controller.leave * tolerance)
    mechanics = now.mode // len(now.loop.zones)
    return Place(loop, state, mechanics * len(loop.zones) + loop.zones.index(zone))


def _zone_after(zone: str, error: float, enter: float, leave: float) -> str:
    """The dead zone's mode for new thresholds, by the hysteresis of the law."""
    side = "+" if error > 0.0 else "-"
    if zone == "inside":
        return side if abs(error) > leave else zone
    return "inside" if abs(error) < enter else (side if error else zone)
