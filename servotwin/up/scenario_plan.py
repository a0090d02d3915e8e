"""Machines of scenario files, deployed: the same axis, wear, controller and twin that `servotwin simulate` runs."""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

from servotwin.config.table import Table, parse_toml, read_toml
from servotwin.config.toml import Values, dumps
from servotwin.cosim.scenario import PRESETS, Scenario, preset_text
from servotwin.edge_process.config import UNBOOTED, EdgeConfig, TwinLink
from servotwin.edge_process.config_file import edge_toml
from servotwin.errors import InvalidInput
from servotwin.messages import NAME_PATTERN
from servotwin.plant.axis import AXES
from servotwin.plant.own_units import own_units
from servotwin.plant.servo import PRESETS as SERVO_PRESETS
from servotwin.plant.signals import SquareWave
from servotwin.runtime.files import make_directory, write_text
from servotwin.twin_service.config import ServiceConfig
from servotwin.up.enrolment import TOKEN, Enrolment, enroll
from servotwin.up.plan import DRIVE, EDGE, LOCK, MACHINE, PLACEHOLDER, RETRY, TWIN, ServoPlan
from servotwin.up.speed import FASTEST

MOST = 100
"""Machines: each is three processes."""
ROLE = "supervise"
"""The edges' role: a simulated drive that runs the law itself keeps up at every rate."""
VALIDITY_S = 1800.0
"""Validity of updates where a scenario states none: a search takes seconds, which are minutes of machine time at a high
speed."""
_AXIS = "axis.toml"
_BLOCK_S = 0.05
_SPEED = 1.0


class _Member(NamedTuple):
    """One machine."""

    name: str
    trait: str
    values: Values
    scenario: Scenario

    @property
    def own_axis(self) -> bool:
        """True where the servo is no preset."""
        return self.values["servo"] == _AXIS

    def model(self, folder: str) -> Values:
        """Table of the twin's model; the axis's file is in `folder`."""
        twin = {"validity_s": VALIDITY_S, **self.values.get("twin", {})}
        if self.scenario.twin.table is not None:
            twin["table"] = str(Path(self.scenario.twin.table).resolve())
        servo = f"{folder}/{_AXIS}" if self.own_axis else self.values["servo"]
        changes = {key: self.values[key] for key in ("controller",) if key in self.values}
        return {"servo": servo, **changes, "twin": twin}

    def machine(self) -> Values:
        """The machine's file. It begins with its own controller: what the twin says comes from the edge."""
        rate, twin = self.scenario.recording.sample_rate, self.values.get("twin", {})
        stated = {key: twin[key] for key in ("method", "estimator") if key in twin}
        inner = {
            **{key: each for key, each in self.values.items() if key not in ("link", "edge", "novelty")},
            "name": self.name,
            "recording": {"sample_rate_hz": rate},
            "twin": {"enabled": False, "policy": "paper", "k_dz": 0.0, **stated},
        }
        return {
            "role": ROLE,
            "listen": f"unix:{DRIVE}",
            "speed": _SPEED,
            "block_s": max(_BLOCK_S, 1.0 / rate),
            "state_file": "state.json",
            "speed_file": "speed",
            "scenario": inner,
        }

    def edge(self, folder: Path) -> EdgeConfig:
        """The edge's configuration: that of the simulated edge, with a drive and a link."""
        agent = replace(self.scenario.commissioning.agent_settings(self.name, UNBOOTED), retry=RETRY)
        units = own_units(self.scenario.servo)
        return EdgeConfig(
            agent,
            ROLE,
            agent.controller or self.scenario.law,
            {"kind": "simulated", "address": f"unix:{DRIVE}"},
            TwinLink(PLACEHOLDER, token_file=TOKEN, live=True),
            command_unit=units.command,
            position_unit=units.position,
            folder=folder,
        )


@dataclass(frozen=True)
class ScenarioPlan:
    """Plan with the machines of scenarios, in real time.

    Parameters
    ----------
    members : tuple of _Member
    """

    members: tuple[_Member, ...]

    @classmethod
    def read(cls, files: Sequence[Path], machines: int = 1) -> ScenarioPlan:
        """Read scenario files.

        Parameters
        ----------
        files : sequence of Path
            Each a scenario's TOML, or the name of a packaged one.
        machines : int
            Machines of each scenario; where there is more than one, their names are numbered.

        Raises
        ------
        InvalidInput
            A scenario cannot be read, makes no sense deployed, or has the name of another one.
        """
        if not 1 <= machines * len(files) <= MOST:
            raise InvalidInput(f"--machines {machines}: must be 1 to {MOST} with those of all scenarios together")
        sources, members = dict[str, Path](), list[_Member]()
        for file in files:
            member = _read(file)
            where = f"{file}: name = {member.name!r}"
            if member.name in sources:
                remedy = "give each scenario another name, or --machines N for several machines of one"
                raise InvalidInput(f"{where}: {sources[member.name]} has it already; {remedy}")
            sources[member.name] = file
            members += _numbered(member, machines)
            if not re.fullmatch(NAME_PATTERN, members[-1].name):
                raise InvalidInput(f"{where}: is longer than 64 characters with a machine's number; give a shorter one")
        return cls(tuple(members))

    @property
    def servos(self) -> tuple[ServoPlan, ...]:
        """The servos."""
        return tuple(ServoPlan(each.name, each.trait, ROLE, each.scenario.twin.policy) for each in self.members)

    @property
    def speed(self) -> float | None:
        """Real time, as on the engineer's own machine."""
        return _SPEED

    @property
    def digest(self) -> str:
        """Digest of scenarios and axes."""
        texts = [dumps({**each.values, "name": each.name}) + each.scenario.servo.dumps() for each in self.members]
        return hashlib.sha256("\n".join(texts).encode()).hexdigest()

    def write_twin(self, path: Path) -> None:
        """Write the twin's file into the folder, and the axes that it names; equal machines have one model."""
        models, servos = dict[str, Values](), Values()
        for each in self.members:
            like = [name for name in models if each.model(name) == models[name]]
            same = [name for name in like if self._member(name).scenario.servo == each.scenario.servo]
            servos[each.name] = same[0] if same else each.name
            if not same:
                models[each.name] = each.model(each.name)
            if each.own_axis:
                write_text(make_directory(path / each.name) / _AXIS, each.scenario.servo.dumps())
        service = {**_SERVICE, "workers": min(len(self.members), os.cpu_count() or 1)}
        write_text(path / TWIN, dumps({"service": service, "models": models, "servos": servos}))

    def write_servo(self, servo: ServoPlan, path: Path) -> None:
        """Write the files of a servo's machine and edge into its folder in this one, and enrol it."""
        member, folder = self._member(servo.name), make_directory(path / servo.name)
        write_text(folder / MACHINE, dumps(member.machine()))
        write_text(folder / EDGE, edge_toml(member.edge(folder)))
        enroll(path / TWIN, Enrolment(servo.name, folder, ROLE))

    def _member(self, name: str) -> _Member:
        return next(each for each in self.members if each.name == name)


_SERVICE: Values = {
    "port": 0,
    "tokens": "tokens.toml",
    "speed": FASTEST,
    "retention_days": 0.1,
    "log_level": "warning",
}


def _read(file: Path) -> _Member:
    """Read one scenario file, and check that it makes sense deployed."""
    packaged = not file.exists() and str(file) in PRESETS
    table = parse_toml(preset_text(str(file)), f"{file}.toml") if packaged else read_toml(file)
    scenario = Scenario.from_table(table, Path() if packaged else file.parent)
    _check_deployable(table, scenario)
    servo = str(table.values["servo"])
    preset = servo in (*SERVO_PRESETS, *AXES)
    values = {**table.values, "servo": servo if preset else _AXIS}
    return _Member(scenario.name, Path(servo).stem, values, scenario)


def _check_deployable(table: Table, scenario: Scenario) -> None:
    """Refuse a scenario that processes cannot run, or in which they have nothing to do; raises InvalidInput."""
    if "." in scenario.name or scenario.name == LOCK:
        raise table.invalid("name", f"another name without dots than {LOCK!r}: it is that of a folder")
    reference = table.table("reference")
    if not isinstance(scenario.reference, SquareWave):
        why = "a machine that runs on sends a window after each change of its reference, so that has to go on changing"
        raise reference.invalid("kind", f"'square': {why}")
    if scenario.law.sample_rate is None:
        raise InvalidInput(
            f"{table.source}: controller.sample_rate_hz: is missing, and the controller is continuous; a deployed one "
            "needs its rate in Hz"
        )
    if not scenario.twin.enabled:
        allowed = "true: servotwin up runs a twin; servotwin simulate runs the servo without one"
        raise table.table("twin").invalid("enabled", allowed)
    samples, most = round(scenario.commissioning.window * scenario.recording.sample_rate), _samples_per_window()
    if samples > most:
        given = f"{scenario.commissioning.window:g} s are {samples} samples"
        raise InvalidInput(f"{table.source}: recording.window_s: {given}; the twin takes at most {most}")


def _samples_per_window() -> int:
    return ServiceConfig().samples_per_window


def _numbered(member: _Member, machines: int) -> Iterable[_Member]:
    if machines == 1:
        return [member]
    return [member._replace(name=f"{member.name}-{number}") for number in range(1, machines + 1)]
