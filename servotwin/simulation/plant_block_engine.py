"""Engine of a whole sampled run with noise or counts: the plant in blocks of ticks, the deployed law at every tick."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from servotwin.hybrid.automaton import Array, Automaton
from servotwin.hybrid.kernel import FULL
from servotwin.hybrid.response import TICKS, BlockResponses, build_responses, new_response_memory, output_responses
from servotwin.hybrid.trajectory import tables_for
from servotwin.simulation.plant_blocks import (
    more_blocks,
    new_blocks,
    note_block,
    run_plant_blocks,
    sample_blocks,
)
from servotwin.simulation.sampled import SampledEngine
from servotwin.simulation.ticks import TickInputs

_ROOM = 4096
_PAGE = 512
"""Numbers in a page of memory, or fewer."""
# Ticks below which compilation and tables do not pay, and search steps per tick above which a block has too many lanes.
_LEAST_TICKS, _MOST_SEARCHES = 20_000, 8


@lru_cache(maxsize=64)
def _responses_for(automaton: Automaton, step: float, searches: int, input_index: int, position: int) -> BlockResponses:
    return build_responses(automaton, tables_for(automaton, step), step, searches, input_index, position)


def fits_plant_blocks(engine: SampledEngine) -> bool:
    """True for a run of many ticks, with ticks at every sample, that has not begun."""
    ticks = (engine.samples - 1) * engine.record_every
    instant = engine.tick_every == 1 and engine.port.late.size == 0 and engine.output.motor.size == 0
    return instant and engine.port.searches <= _MOST_SEARCHES and ticks >= _LEAST_TICKS


def in_plant_blocks(engine: SampledEngine) -> PlantBlockEngine:
    """The engine of the same run, to be made in blocks: it takes over the noise."""
    every, inputs = engine.record_every, replace(engine.inputs, sample_rate=engine.tick_rate)
    samples = (engine.samples - 1) * every + 1
    result = PlantBlockEngine(
        engine.servo, engine.controller, inputs, engine.theta_d0, samples, None, engine.rng, delay=engine.delay
    )
    result.noise, result.draws, result.every = engine.noise, engine.draws, every
    return result


@dataclass
class PlantBlockEngine(SampledEngine):
    """A sampled run from rest to its end, recorded at its ticks; channels are those of every `every`-th."""

    every: int = 1

    def __post_init__(self) -> None:
        super().__post_init__()
        n, port = len(self.state), self.port
        self.responses = _responses_for(self.plant.automaton, self.step, port.searches, port.voltage, port.position)
        self.memory = new_response_memory(self.responses, n)
        self.commands = np.zeros(TICKS)
        self.blocks = new_blocks(n, _ROOM)

    def _recorded(self) -> list[int]:
        return [self.plant.automaton.names.index("voltage"), int(np.argmax(self.plant.rows["sensed"][0]))]

    def _inputs_until(self, base: int, end: int) -> TickInputs:
        # The system provides the memory of what is recorded here, beside the run, not where the run waits for it.
        self.output.states[:, base:end:_PAGE] = 0.0
        self.output.measured[base:end:_PAGE] = 0.0
        return super()._inputs_until(base, end)

    def flow(self, end: int, tick_inputs: TickInputs) -> None:
        """Advance to a tick."""
        while self.base < end:
            status, self.base, self.mode, self.law_state = run_plant_blocks(
                self.tables,
                self.responses,
                self.state,
                self.base,
                end,
                self.mode,
                self.parameters,
                self.law_state,
                self.port,
                tick_inputs,
                self.output,
                self.record,
                self.blocks,
                self.scratch,
                self.memory,
                self.commands,
            )
            if status == FULL and self.blocks.size[0] == len(self.blocks.tick):
                self.blocks = more_blocks(self.blocks)
            else:
                self._check(status)

    def _tick_and_record(self, base: int) -> None:
        if self.blocks.size[0] == len(self.blocks.tick):
            self.blocks = more_blocks(self.blocks)
        self.state[self.port.voltage] = 0.0
        note_block(self.blocks, base, self.mode, self.state)
        super()._tick_and_record(base)

    def channel(self, name: str, first: int, last: int) -> Array:
        """A channel at samples first .. last - 1, of all samples."""
        ticks = slice(first * self.every, (last - 1) * self.every + 1, self.every)
        if name == "measured_position":
            return self.output.measured[ticks]
        row = self.plant.rows[name][0]
        for recorded, values in zip(self.port.recorded, self.output.states, strict=True):
            if row[recorded] == 1.0 and np.count_nonzero(row) == 1:
                return values[ticks]
        return self._at_ticks(row)[ticks]

    def _at_ticks(self, row: Array) -> Array:
        """``row @ state`` at every tick."""
        out = np.empty(self.samples)
        free, late = output_responses(self.responses, row, self.port.voltage)
        sample_blocks(self.blocks, self.responses, free, late, self.output.states[0], self.memory, out)
        return out
