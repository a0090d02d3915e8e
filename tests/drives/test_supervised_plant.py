"""Samples that a simulated machine retains, for readers that keep up and for one that is behind."""

from pathlib import Path

import numpy as np
import pytest

from servotwin.drives.simulated.plants import SupervisedPlant
from servotwin.drives.simulated.settings import MachineSettings

SCENARIO = """
servo = "paper"
duration_s = 1.0
[reference]
kind = "step"
size_mm = 1.0
[gap]
total_deg = 10.0
[recording]
sample_rate_hz = 2000.0
[controller]
sample_rate_hz = 2000.0
"""
MACHINE = 'scenario = "scenario.toml"\nrole = "supervise"\nlisten = "127.0.0.1:0"\nblock_s = 0.005\nkeep_s = 0.1\n'


@pytest.fixture
def plant(tmp_path: Path) -> SupervisedPlant:
    """Blocks of 10 samples, of which the last 200 samples stay."""
    (tmp_path / "scenario.toml").write_text(SCENARIO)
    (tmp_path / "machine.toml").write_text(MACHINE)
    return SupervisedPlant(MachineSettings.load(tmp_path / "machine.toml"))


def advance(plant: SupervisedPlant, blocks: int) -> np.ndarray:
    """(4, n) samples as a reader receives them that reads every block at once."""
    read = []
    for _ in range(blocks):
        first = plant.index
        plant.advance(plant.block)
        block = plant.read(first, 10)
        assert block is not None
        read.append(block.values)
    return np.hstack(read)


@pytest.mark.slow
def test_a_reader_that_is_behind_receives_many_blocks_at_once(plant: SupervisedPlant) -> None:
    at_once = advance(plant, 12)
    block = plant.read(5, 100)
    assert block is not None
    assert (block.first, block.last) == (5, 105)
    np.testing.assert_array_equal(block.values, at_once[:, 5:105])
    rest = plant.read(105, 100)
    assert rest is not None
    assert rest.last == 120
    assert plant.read(120, 100) is None


def test_what_is_no_longer_retained_is_missing_at_the_front(plant: SupervisedPlant) -> None:
    advance(plant, 50)
    block = plant.read(0, 100)
    assert block is not None
    assert (block.first, block.last) == (300, 400)


def test_samples_under_two_versions_come_in_two_parts(plant: SupervisedPlant) -> None:
    advance(plant, 2)
    plant.write(7, 1e-4, None)
    advance(plant, 2)
    parts = [plant.read(first, 100) for first in (0, 20)]
    assert [(part.first, part.last, part.version) for part in parts if part is not None] == [(0, 20, 0), (20, 40, 7)]
