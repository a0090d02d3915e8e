"""Scenario: everything that a co-simulation needs, as one frozen value that a TOML file can describe."""

from __future__ import annotations

import dataclasses
import os
import re
from dataclasses import dataclass, field
from functools import cached_property
from importlib import resources
from pathlib import Path
from typing import Annotated, Any

from servotwin.commissioning.edge_settings import Commissioning, Recording, check_samples
from servotwin.config.keys import check, key
from servotwin.config.table import Table, did_you_mean, named, parse_toml, read_toml
from servotwin.config.toml import attribute, read
from servotwin.control.gains import with_gains
from servotwin.control.laws import AnyController
from servotwin.cosim.scenario_file import GAPS, REFERENCES, gap_maker, read_parts
from servotwin.edge.parameters import Parameters
from servotwin.edge.settings import AgentSettings, Supervision
from servotwin.errors import InvalidInput
from servotwin.link.simulated import LinkSettings, derive_seed
from servotwin.messages import NAME_PATTERN
from servotwin.plant.noise import Noise
from servotwin.plant.own_units import INPUT_BIAS_KEYS, own_units
from servotwin.plant.plants import PLANT_KEY, Plant
from servotwin.plant.signals import SignalLike, as_gap, as_pieces
from servotwin.runtime.notebook import html_table
from servotwin.simulation.inputs import whole_ratio
from servotwin.twin.model import TwinModel
from servotwin.twin.settings import TwinSettings

BOOT = "boot-1"
PRESETS = ("fig15", "fig15-sampled", "fig16", "calm", "certified")


@dataclass(frozen=True, repr=False)
class Scenario:
    """One servo, its wear, its link and its twin.

    Parameters
    ----------
    servo : Servo or Axis
    controller : Controller, Cascade or LinearLaw, optional
        The servo's own by default.
    recording : Recording
        By default a window is 1 s long and begins with the change of the reference. A loop with little or no integral
        action, which the certified policy designs, is calm: the screw turns back so late that one second often shows
        one side of the gap only. Its windows are 2 s long and begin 0.3 s before the change, or with the first sample.
        Values of `recording` take precedence; limits that it leaves open are derived from the policy.
    uplink, downlink : LinkSettings
        Edge to twin, and back.
    twin : TwinSettings
        Its `initial_gap` and `k_dz` also set the dead zone before the first update, also without a twin; 0: none.
        Under the policy "certified" the loop begins with the fallback set, also
        without a twin, which is verified for every
        gap of the stated range, unless `controller` has other gains than the servo's own, or `supervision` is given.
    supervision : Supervision, optional
        Supervision by the edge; with it updates may also set gains, in a box around the servo's own, and no change
        makes the voltage jump. None: derived from the verified settings for the policies that send gains ("certified"
        and "hysteresis"); under the others updates set the tolerance at once, and the edge does not supervise them.

    Raises
    ------
    InvalidInput
        A value is out of its range, the gap goes below zero, a rate does not divide, a window is too short.
    """

    servo: Annotated[Plant, PLANT_KEY]
    duration: Annotated[float, key("duration_s", above=0.0, help="Simulated time, a whole number of samples.")]
    seed: Annotated[
        int,
        key(help="Root of all randomness: each source has its own generator, from (seed, name, source)."),
    ] = 0
    name: Annotated[str, key(help="The servo's name in messages.")] = "servo"
    reference: Annotated[SignalLike, key(makers=REFERENCES, required=True, help="Reference, m.")] = 0.0
    gap: Annotated[
        SignalLike, key(makers=GAPS, select=gap_maker, required=True, help="Total gap, at the motor or at the load.")
    ] = 0.0
    theta_d0: Annotated[
        float,
        key(
            "theta_d0_deg",
            help="Angle of the screw at the start; the motor starts at 0, so 0 is the middle of the backlash.",
        ),
    ] = 0.0
    controller: AnyController | None = None
    noise: Annotated[
        Noise | None, key(help="Noise on the measured position, which needs a sampled controller; none where absent.")
    ] = None
    recording: Recording = field(default_factory=Recording)
    uplink: LinkSettings = field(default_factory=LinkSettings)
    downlink: LinkSettings = field(default_factory=LinkSettings)
    twin: TwinSettings = field(default_factory=TwinSettings)
    supervision: Supervision | None = None
    input_bias: Annotated[
        float, key(*INPUT_BIAS_KEYS, table="disturbances", help="Command that is added to the plant's input.")
    ] = 0.0
    friction: Annotated[
        float,
        key("friction_n_m", table="disturbances", minimum=0.0, help="Coulomb friction on the motor's shaft."),
    ] = 0.0

    def __post_init__(self) -> None:
        if not re.fullmatch(NAME_PATTERN, self.name):
            raise InvalidInput(f"name = {self.name!r}: 1 to 64 of A-Z a-z 0-9 . _ - are allowed")
        check(self)
        self._check_rates()
        as_pieces(self.reference, self.duration)
        as_gap(self.gap, self.duration, self.servo.largest_gap)
        self.commissioning.check_window()
        self.commissioning.check_recorder(self.name, BOOT)

    def __repr__(self) -> str:
        """Name, length, servo and policy in one line."""
        return f"<Scenario {self.name!r}: {self.duration:g} s, policy {self.twin.policy!r}, {self.servo!r}>"

    def _repr_html_(self) -> str:
        """Table for notebooks."""
        rows = {
            "servo": repr(self.servo),
            "controller": repr(self.law),
            "duration": f"{self.duration:g} s",
            "reference": repr(self.reference),
            "gap": repr(self.gap),
            "policy": self.twin.policy,
            "estimator": self.twin.method,
            "seed": str(self.seed),
        }
        return html_table(f"Scenario {self.name}", rows)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Scenario:
        """Load a scenario from a TOML file; a servo's path in the file is relative to its folder.

        Raises
        ------
        InvalidInput
            The file is missing, empty or not TOML, a key is unknown or missing, a value is not allowed, the controller
            is unstable on the servo even without a gap, nothing is verified for the stated range, the twin's
            method, policy or triage cannot work with the servo.
        """
        return cls.from_table(read_toml(path), Path(path).parent)

    @classmethod
    def preset(cls, name: str) -> Scenario:
        """Load one of the packaged scenarios: "fig15", "fig15-sampled", "fig16", "calm", "certified"."""
        return cls.from_table(parse_toml(preset_text(name), f"{name}.toml"), Path())

    @classmethod
    def from_table(cls, table: Table, folder: Path) -> Scenario:
        """Read a scenario from a parsed table; a servo's path in it is relative to `folder`."""
        with named(table):
            if "servo" not in table.values and table.values.keys() & {"structure", "actuator"}:
                raise InvalidInput(
                    "is a servo or an axis, not a scenario; write a scenario whose key 'servo' names this file"
                )
            servo: Plant = attribute(table, cls, "servo", folder)
            table = table.in_units(own_units(servo), servo.p)
            scenario: Scenario = read(table, cls, folder, servo=servo, **read_parts(table, folder, servo))
            table.done()
            scenario.servo.check_loop(scenario.law)
            try:
                scenario.commissioning.check_agent(scenario.name, BOOT)
                if scenario.twin.enabled:
                    TwinModel.of(scenario.model, scenario.twin)
            except InvalidInput as error:
                hint = "; without a twin it can be simulated: enabled = false in [twin], and no policy"
                raise InvalidInput(f"{error}{hint}") from None
            return scenario

    def replace(self, **changes: Any) -> Scenario:
        """Copy with some values changed, validated again."""
        return dataclasses.replace(self, **changes)

    def with_servo(self, servo: Plant) -> Scenario:
        """Copy with another servo and its controller, changed as this scenario changes its servo's controller."""
        if self.controller is None:
            return self.replace(servo=servo)
        if type(self.controller) is not type(servo.controller):
            return self.replace(servo=servo)
        names = [each.name for each in dataclasses.fields(self.controller)]
        own, default = (
            {name: getattr(law, name) for name in names} for law in (self.controller, self.servo.controller)
        )
        changes = {name: value for name, value in own.items() if value != default[name]}
        return self.replace(servo=servo, controller=servo.controller.replace(**changes))

    @property
    def law(self) -> AnyController:
        """The controller that runs."""
        return self.servo.controller if self.controller is None else self.controller

    @property
    def model(self) -> Plant:
        """The servo with the controller that runs; the twin designs for it."""
        return self.servo.replace(controller=self.law)

    @cached_property
    def commissioning(self) -> Commissioning:
        """Servo, law and twin from which the settings of its edge follow."""
        noise = 0.0 if self.noise is None else self.noise.std
        return Commissioning(self.servo, self.law, self.twin, self.recording, self.supervision, noise)

    @property
    def start(self) -> Parameters:
        """Parameters before the first update: the fallback set, or the controller and a dead zone by Eq 21."""
        return self.commissioning.start

    @property
    def start_law(self) -> AnyController:
        """The controller before the first update."""
        return with_gains(self.law, self.start.setting.gains)

    @property
    def start_tolerance(self) -> float:
        """Dead-zone half-width before the first update, m."""
        return self.start.setting.tolerance

    @property
    def samples(self) -> int:
        """Number of recorded samples, both ends included."""
        return round(self.duration * self.recording.sample_rate) + 1

    def agent_settings(self) -> AgentSettings:
        """Settings of its edge's agent.

        Raises
        ------
        InvalidInput
            No fallback set is verified for the whole stated range.
        """
        return self.commissioning.agent_settings(self.name, BOOT)

    def seed_of(self, source: str) -> int:
        """The seed of one named source of randomness: the same for equal (seed, name, source), on every machine."""
        return derive_seed(self.seed, self.name, source)

    def _check_rates(self) -> None:
        rate, law = self.recording.sample_rate, self.law.sample_rate
        samples = self.duration * rate
        check_samples("duration", self.duration, max(rate, law or 0.0))
        if abs(samples - round(samples)) > 1e-6:
            raise InvalidInput(f"duration = {self.duration!r} s: must be a whole number of samples at {rate!r} Hz")
        if law is None:
            if self.noise is not None:
                raise InvalidInput("noise needs a sampled controller: give the controller a sample rate in Hz")
            if self.law.rate_limit is not None:
                raise InvalidInput("a rate limit needs a sampled controller: give the controller a sample rate in Hz")
            return
        if not whole_ratio(rate, law):
            raise InvalidInput(
                f"recording sample_rate = {rate!r} Hz: it and the controller's {law!r} Hz must be whole multiples of "
                "one another"
            )


def preset_text(name: str) -> str:
    """TOML of a packaged scenario.

    Raises
    ------
    InvalidInput
        There is none of that name.
    """
    if name not in PRESETS:
        hint = did_you_mean(name, PRESETS)
        raise InvalidInput(f"scenario {name!r} does not exist{hint}; give one of {', '.join(PRESETS)}")
    return resources.files("servotwin.cosim").joinpath("scenarios", f"{name}.toml").read_text(encoding="utf-8")
