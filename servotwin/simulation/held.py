"""The plant of a sampled simulation with the voltage given from outside, sample by sample.

It runs the sampled loop's own compiled step, with a law that has no gains and whose feedforward is the voltage: so it
is the same plant, bit for bit. Inputs are laid out for many samples at a time.
"""

from __future__ import annotations

from math import inf

import numpy as np

from servotwin.control.law import LawParameters, start
from servotwin.errors import InvalidInput
from servotwin.simulation.endless import Endless

CHUNK = 4096
_HELD = LawParameters(0.0, 0.0, 0.0, 0.0, -1.0, -1.0, inf, inf, 1.0, 0.0, 0.0, 1.0)


class Held:
    """A machine whose controller is elsewhere.

    Parameters
    ----------
    machine : Endless
        Its samples are its ticks, and it has no dead zone: its own controller never runs.

    Raises
    ------
    InvalidInput
        Samples and ticks are at different rates.
    """

    def __init__(self, machine: Endless) -> None:
        engine = machine.engine
        if engine.tick_every != 1 or engine.record_every != 1:
            raise InvalidInput(
                f"controller sample_rate = {engine.tick_rate} Hz: must be the recording's, {machine.rate} Hz, where "
                "the voltage comes from outside"
            )
        self._machine, self._engine = machine, engine
        engine.law_state = start(0.0)
        engine.parameters = _HELD
        self._theta_m = int(np.argmax(engine.plant.rows["theta_m"][0]))
        self._position = engine.port.position
        self._finest = engine.servo.encoder_resolution, engine.servo.position_resolution
        self._lay_out()

    @property
    def index(self) -> int:
        """The present sample."""
        return self._engine.base

    def sample(self) -> tuple[float, float, float]:
        """Reference (m), motor angle (rad) and measured position (m) of the present sample."""
        here, state = self._engine.base - self._first, self._engine.state
        angle, position = float(state[self._theta_m]), float(state[self._position]) + self._noise[here]
        return self._reference[here], _rounded(angle, self._finest[0]), _rounded(position, self._finest[1])

    def hold(self, voltage: float) -> None:
        """Let the plant flow to the next sample under a voltage (V)."""
        engine = self._engine
        base = engine.base
        engine.parameters = _HELD._replace(feedforward=voltage)
        engine.make_room(base + 1)
        if base in self._changes:
            engine.draws.put_back(self._drive.noise[base - self._first :])
            engine.advance(base + 1)
            self._lay_out()
            return
        engine.flow(base + 1, self._drive)
        if engine.base == self._last:
            self._lay_out()

    def _lay_out(self) -> None:
        """Inputs of the samples to come."""
        first, until = self._engine.base, self._machine.laid_out
        if until is not None and until <= first:
            self._machine.lay_out()
            until = self._machine.laid_out
        last = first + CHUNK if until is None else min(first + CHUNK, until)
        self._first, self._last = first, last
        self._drive = self._engine.drive(first, last)
        self._changes = {base for base, _ in self._engine.knots(last)}
        self._reference, self._noise = self._drive.reference.tolist(), self._drive.noise.tolist()


def _rounded(value: float, resolution: float) -> float:
    return value if resolution == 0.0 else round(value / resolution) * resolution
