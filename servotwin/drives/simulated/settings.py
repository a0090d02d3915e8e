"""Settings of a simulated machine, from its TOML file: a scenario, and the behaviour of its drive."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

from servotwin.config.keys import Form, check, key, settings
from servotwin.config.table import Table, did_you_mean, named, of_key, read_toml
from servotwin.config.toml import read
from servotwin.cosim.scenario import PRESETS, Scenario
from servotwin.drives.simulated import wire
from servotwin.drives.simulated.machine_state import read_speed, read_state
from servotwin.errors import InvalidInput
from servotwin.plant.signals import as_pieces

_NO_TWIN: Mapping[str, object] = {"enabled": False, "policy": "paper", "k_dz": 0.0}


def _scenario(table: Table, name: str, scenario: object, folder: Path) -> Scenario:
    """Read the scenario: a preset's name, a file, or a table, of which no twin is asked where it states none.

    A machine begins with its own controller, and gets its settings from its edge.
    """
    if isinstance(scenario, dict):
        stated = table.table(name)
        return Scenario.from_table(Table(stated.source, {"twin": _NO_TWIN, **stated.values}, stated.name), folder)
    given = table.text(name)
    if given in PRESETS:
        return Scenario.preset(given)
    if not (folder / given).is_file():
        paths = f"the path of a scenario's TOML, relative to this file, or a table{did_you_mean(given, PRESETS)}"
        raise table.invalid(name, f"one of {', '.join(PRESETS)}, {paths}")
    return Scenario.load(folder / given)


def _address(table: Table, name: str, text: str, folder: Path) -> wire.Address:
    try:
        address = wire.parse_address(text)
    except InvalidInput:
        raise table.invalid(name, "unix:PATH, relative to this file, or 127.0.0.1:PORT") from None
    return address if address.path is None else address._replace(path=str(folder / address.path))


@settings("machine")
@dataclass(frozen=True)
class MachineSettings:
    """A simulated machine and its drive.

    Parameters
    ----------
    begin : float
        s of machine time before this run.
    """

    scenario: Annotated[
        Scenario,
        key(
            form=Form.OTHER,
            parse=_scenario,
            help="A packaged scenario, the path of one relative to this file, or a table with its keys: servo, "
            "reference, gap, disturbances and noise; in the role supervise also controller and dead zone at the start.",
        ),
    ]
    role: Annotated[
        str,
        key(
            choices=tuple(wire.ROLES),
            help="control: the voltage comes from the edge; supervise: the machine's own controller runs.",
        ),
    ]
    address: Annotated[
        wire.Address,
        key("listen", form=Form.TEXT, parse=_address, help="unix:PATH, relative to this file, or 127.0.0.1:PORT."),
    ]
    speed: Annotated[
        float,
        key(
            minimum=0.0,
            help="Seconds of machine time per second; 0: lock-step, the machine advances on request of the edge.",
        ),
    ] = 1.0
    endless: Annotated[bool, key(help="Run on after the scenario's duration_s with the gap at its end.")] = True
    watchdog: Annotated[
        float,
        key("watchdog_s", minimum=0.0, help="Machine time without a voltage after which it is 0 V; control only."),
    ] = 0.1
    slack: Annotated[
        float,
        key(
            "slack_s",
            above=0.0,
            help="Longest delay (by the clock) that is caught up. A longer one of the edge is a missed tick, one of "
            "the machine is lost machine time.",
        ),
    ] = 0.25
    block: Annotated[
        float,
        key("block_s", above=0.0, help="Default length of a block of samples, in machine time; supervise only."),
    ] = 0.05
    retention: Annotated[
        float,
        key("keep_s", above=0.0, help="Machine time for which samples stay readable; supervise only."),
    ] = 10.0
    state_file: Annotated[
        Path | None,
        key(
            help="File that stores the machine time. A restart continues the wear from there; the machine starts at "
            "rest, and its reference begins anew."
        ),
    ] = None
    speed_file: Annotated[
        Path | None,
        key(
            help="File with a number that replaces speed, at the start and whenever the file changes. One that holds "
            "none is refused at the start; later it is said, and the speed stays."
        ),
    ] = None
    begin: float = 0.0

    def __post_init__(self) -> None:
        check(self)
        rate, law = self.rate, self.scenario.law.sample_rate
        if law is None:
            raise InvalidInput(
                "scenario controller sample rate: must be a number in Hz, but the controller is continuous"
            )
        if self.role == "control" and law != rate:
            raise InvalidInput(f"scenario controller sample rate = {law!r} Hz: must be the recording's, {rate!r} Hz")
        if not 1 <= self.block_samples <= wire.MAX_SAMPLES:
            raise InvalidInput(f"block_s = {self.block!r} s: must hold 1 to {wire.MAX_SAMPLES} samples at {rate!r} Hz")
        if self.retention < self.block:
            raise InvalidInput(f"keep_s = {self.retention!r} s: must be at least block_s = {self.block!r} s")
        if (self.state_file or self.speed_file) and not (self.speed > 0.0 and self.endless):
            raise InvalidInput("state_file and speed_file are allowed only with speed > 0 and endless = true")

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> MachineSettings:
        """Load from a TOML file; paths in the file are relative to its folder.

        Raises
        ------
        InvalidInput
            The file or its scenario is missing or not allowed.
        """
        table, folder = read_toml(path), Path(path).parent
        machine: MachineSettings = read(table, cls, folder)
        table.done()
        with named(table) if machine.speed_file is None else of_key(table, "speed_file"):
            speed = None if machine.speed_file is None else read_speed(machine.speed_file)
        with named(table) if machine.state_file is None else of_key(table, "state_file"):
            return replace(machine, speed=speed or machine.speed).resumed()

    def resumed(self) -> MachineSettings:
        """Continue from the state file.

        Raises
        ------
        InvalidInput
            The state file holds no state of a machine.
        """
        state = None if self.state_file is None else read_state(self.state_file)
        return replace(self, begin=0.0 if state is None else state.time_s)

    @property
    def present(self) -> Scenario:
        """The scenario from `begin` on, with another seed, so that a restart does not repeat the noise."""
        scenario = self.scenario
        if self.begin == 0.0:
            return scenario
        gap = as_pieces(scenario.gap, scenario.duration).later(self.begin)
        return scenario.replace(gap=gap, seed=scenario.seed + 1 + int(self.begin))

    def gap_at(self, sample: int) -> float:
        """Total gap (rad) at a sample of this run."""
        return self.gap_when(self.begin + sample / self.rate)

    def gap_when(self, time: float) -> float:
        """Total gap (rad) at a machine time (s), which counts all runs."""
        return float(as_pieces(self.scenario.gap, self.scenario.duration).value(time))

    @property
    def rate(self) -> float:
        """Samples per second of machine time, Hz."""
        return self.scenario.recording.sample_rate

    @property
    def block_samples(self) -> int:
        """Samples in one block."""
        return round(self.block * self.rate)

    @property
    def end(self) -> int | None:
        """Number of samples of the run, without the scenario's last instant; None: endless."""
        return None if self.endless else self.scenario.samples - 1
