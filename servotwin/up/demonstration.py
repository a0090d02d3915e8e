"""Demonstration of `servotwin up`: three servos that wear at different rates."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from servotwin.edge_process.config_file import edge_toml, load
from servotwin.runtime.files import write_text
from servotwin.up.enrolment import Enrolment, StatedNoise, enroll
from servotwin.up.plan import DRIVE, EDGE, MACHINE, PLACEHOLDER, RETRY, TWIN, ServoPlan
from servotwin.up.speed import FASTEST

RATE = 1000.0
"""Hz. It resolves gaps to a thousandth of a degree; the cost grows with the number of ticks."""
WINDOW_S, PRE_TRIGGER_S = 4.0, 0.3
"""s. A slow loop reverses late: windows of 2 s show only one side of gaps from 26 deg on, windows of 3 s both sides of
40 deg."""
NEW_GAP, WORN_GAP = 0.0, 40.0
"""deg"""
HOUR = 3600.0
POLICIES = {"certified": "certified", "dead-zone": "hysteresis"}
"""Policy of each model."""


class WearingServo(NamedTuple):
    """One servo of the demonstration.

    Attributes
    ----------
    name : str
    trait : str
        Its special feature, for the display.
    role : str
        "control": the edge runs the law at every sample, which costs most processor time: only one servo does.
        "supervise": the machine has its own controller, and its samples come in blocks.
    model : str
        One of `POLICIES`.
    wears_h, age_h : float
        h of machine time from new to worn out, and h that have passed at the first start.
    noise_mm : float
        rms, of the position's encoder.
    bias_v : float
        On the motor's input, as of an amplifier.
    outages : bool
        Its link has outages.
    """

    name: str
    trait: str
    role: str
    model: str
    wears_h: float
    age_h: float
    noise_mm: float = 0.0
    bias_v: float = 0.0
    outages: bool = False

    @property
    def plan(self) -> ServoPlan:
        """The servo as it runs."""
        return ServoPlan(self.name, self.trait, self.role, POLICIES[self.model], self.outages)


SERVOS = (
    WearingServo("quick", "wears quickest", "control", "certified", 4.0, 1.0, bias_v=0.05),
    WearingServo("noisy", "noisy encoder", "supervise", "certified", 8.0, 2.0, noise_mm=0.05, bias_v=-0.03),
    WearingServo("remote", "outages", "supervise", "dead-zone", 12.0, 2.5, outages=True),
)


class Demonstration:
    """Plan with the three servos."""

    @property
    def servos(self) -> tuple[ServoPlan, ...]:
        """The servos."""
        return tuple(servo.plan for servo in SERVOS)

    @property
    def speed(self) -> float | None:
        """None: as fast as the processor's share allows."""
        return None

    @property
    def digest(self) -> str:
        """Digest of the files."""
        return hashlib.sha256("".join([_twin_toml(), *map(machine_toml, SERVOS)]).encode()).hexdigest()

    def write_twin(self, path: Path) -> None:
        """Write the twin's file into the folder."""
        write_text(path / TWIN, _twin_toml())

    def write_servo(self, servo: ServoPlan, path: Path) -> None:
        """Write the files of a servo's machine and edge into its folder in this one, and enrol it."""
        [wearing] = [each for each in SERVOS if each.name == servo.name]
        folder = path / servo.name
        request = Enrolment(
            servo=servo.name,
            folder=folder,
            role=servo.role,
            sample_rate=RATE,
            drive={"kind": "simulated", "address": f"unix:{DRIVE}"},
            url=PLACEHOLDER,
            noise=StatedNoise(1e3 * wearing.noise_mm),
        )
        enroll(path / TWIN, request)
        config = load(folder / EDGE)
        agent = replace(config.agent, retry=RETRY, window_s=WINDOW_S, pre_trigger_s=PRE_TRIGGER_S)
        link = None if config.twin is None else replace(config.twin, live=True)
        write_text(folder / EDGE, edge_toml(replace(config, agent=agent, twin=link)))
        write_text(folder / MACHINE, machine_toml(wearing))


def _twin_toml() -> str:
    """Text of the twin's file."""
    named = "".join(f'"{servo.name}" = "{servo.model}"\n' for servo in SERVOS)
    return _SERVICE.format(speed=FASTEST) + "".join(map(_model, POLICIES)) + f"\n[servos]\n{named}"


def machine_toml(servo: WearingServo) -> str:
    """Text of a machine's file."""
    values = {**servo._asdict(), "rate": RATE, "new": NEW_GAP, "worn": WORN_GAP, "over": servo.wears_h * HOUR}
    noise = f"\n[scenario.noise]\nstd_mm = {servo.noise_mm}\n" if servo.noise_mm else ""
    return _MACHINE.format(**values, begin=-servo.age_h * HOUR) + noise


def _model(name: str) -> str:
    return _MODEL.format(name=name, policy=POLICIES[name])


_SERVICE = """\
[service]
port = 0                      # any free port
tokens = "tokens.toml"
workers = 1
speed = {speed:.1f}                 # machine time passes that much faster than the clock, at most
retention_days = 0.1
log_level = "warning"
"""
_MODEL = """
[models.{name}]
servo = "paper"
[models.{name}.twin]
policy = "{policy}"
gap_limit_deg = 50.0
validity_s = 1800.0           # machine time: half a minute at sixty times real time
[models.{name}.twin.trend]
wear_deg = 10.0
over_s = 3600.0
[models.{name}.twin.triage]   # a window in which the gap has hardly moved is only screened
every = 10
"""
_MACHINE = """\
role = "{role}"
listen = "unix:drive.sock"
speed = 5.0
state_file = "state.json"     # machine time so far; without this file the machine is new again
speed_file = "speed"          # overrides speed; servotwin up writes it

[scenario]
servo = "paper"
name = "{name}"
duration_s = {over}

[scenario.reference]
kind = "square"
amplitude_mm = 1.0
period_s = 40.0

[scenario.gap]                # total gap
from_deg = {new}
to_deg = {worn}
over_s = {over}
begin_s = {begin}

[scenario.disturbances]
input_bias_v = {bias_v}

[scenario.recording]
sample_rate_hz = {rate}

[scenario.controller]
sample_rate_hz = {rate}

[scenario.twin]               # not used here: gains and dead zone come from the edge
policy = "paper"
"""
