"""The reference of all configuration files, written to docs/configuration.md and docs/schemas by `make reference`."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from servotwin.commissioning.edge_settings import Recording
from servotwin.config.keys import Maker
from servotwin.config.own_units import COMMANDS, POSITIONS, OwnUnits
from servotwin.config.reference import TableSpec, in_units, markdown, schema
from servotwin.control.cascade import Cascade
from servotwin.control.controller import Controller
from servotwin.control.linear_law_file import matrices_law
from servotwin.cosim import scenario_file as tables
from servotwin.cosim.scenario import Scenario
from servotwin.drives.simulated.settings import MachineSettings
from servotwin.drives.table import SUPERVISED
from servotwin.edge.parameters import FallbackSet
from servotwin.edge.probe import ProbeLimits
from servotwin.edge.settings import AgentSettings, Supervision
from servotwin.edge.settings_file import gains_stay_table, setting_table, start_table
from servotwin.edge_process.config import EdgeConfig
from servotwin.edge_process.config_file import LAWS, update_gains_table
from servotwin.estimation.gap import METHODS
from servotwin.link.simulated import LinkSettings
from servotwin.messages import CascadeGains, Gains, LinearGains
from servotwin.novelty.settings import NoveltyRules, NoveltySettings
from servotwin.plant.actuator import ACTUATORS
from servotwin.plant.axis_file import LOADS, TRANSMISSIONS, units_of
from servotwin.plant.linear_law_file import linear_law
from servotwin.plant.sensors import Sensors
from servotwin.plant.servo import Servo
from servotwin.twin.model_registry import servo_table
from servotwin.twin.settings import TwinSettings
from servotwin.twin_service.config import ServiceConfig, mqtt_table, store_password_table
from servotwin.twin_service.webhook import webhook_table

HEAD = """# Configuration reference

Made by `make reference` from the declarations in the code: do not edit. A file may leave out every key that is not
required. Where a key has two names, a file may give either; the unit is the end of the name. Editors that know TOML
schemas (Even Better TOML, Taplo) check a file against the schema of its kind in `docs/schemas`. No number is above 1e30
in size, no time above 1e9 s (30 years), no integer above 1e15; a text has 1000 printable characters at most.

The files of a scenario, of an edge and of a twin name commands and positions in the units of their machine. Below are
those of a voltage and of a position in metres. Of an axis that commands a torque `v` is `n_m` and `voltage` `torque`,
of a speed `rad_per_s` and `speed`, of an angle `rad` and `angle`; of a rotary axis `m` is `rad`, `mm` `deg` and `um`
`mdeg`: `kp_n_m_per_rad`, `torque_limit_n_m`, `tolerance_deg`. The file of an edge says so with `command_unit` and
`position_unit`.
"""


_LAWS = (Controller, Cascade, matrices_law)
_GAINS = tuple({name: None for kind in (Gains, CascadeGains, LinearGains) for name in kind.__struct_fields__})
_CHANGED = TableSpec((Controller,), "Changes of the servo's own controller.", partial=True)
_FALLBACK_HELP = (
    "Setting that the edge falls back to; gains that are left out are those of the controller, and it has those of "
    "its own kind only."
)
_FALLBACK_KEYS = ("tolerance", "band", "silence_s", "refuse_s", *_GAINS)
_SCENARIO_FALLBACK = TableSpec((setting_table, FallbackSet, *_LAWS), _FALLBACK_HELP, only=_FALLBACK_KEYS, partial=True)
_EDGE_FALLBACK = TableSpec(
    (setting_table, FallbackSet, *_LAWS, gains_stay_table),
    _FALLBACK_HELP,
    only=("gains_stay", *_FALLBACK_KEYS),
    partial=True,
)
_START = TableSpec(
    (setting_table, start_table, *_LAWS),
    "Parameters before the first update.",
    only=("tolerance", "band", "fallback", *_GAINS),
    partial=True,
)
_OWN = TableSpec(
    (*_LAWS, gains_stay_table),
    "The servo's own gains, from which the limits of updates count; the controller's where absent.",
    only=("gains_stay", *_GAINS),
    partial=True,
)
_ESTIMATOR = TableSpec(
    help="Settings of the estimator that `method` names.",
    kinds={f"method {name}": TableSpec((method.settings,)) for name, method in METHODS.items()},
)
_TWIN = TableSpec((TwinSettings,), "The twin.", {"estimator": _ESTIMATOR})
_DRIVES = {f'kind = "{name}"': TableSpec((maker,)) for name, maker in SUPERVISED.items()}


def _controller_of(unit: str, motion: str, kind: Maker = Controller) -> TableSpec:
    """Keys of a controller in the units of an axis."""
    return TableSpec((kind,), units=(units_of(unit, motion),))


def _kinds(words: str, makers: Mapping[str, Maker]) -> TableSpec:
    return TableSpec(help=words, kinds={f'kind = "{kind}"': TableSpec((maker,)) for kind, maker in makers.items()})


def _axis(controller: TableSpec, sensors: TableSpec) -> TableSpec:
    """File of an axis with some controller and sensors."""
    return TableSpec(
        tables={
            "actuator": _kinds("The actuator.", ACTUATORS),
            "transmission": _kinds("Transmission; the gap counts at the motor.", TRANSMISSIONS),
            "load": _kinds("The load.", LOADS),
            "sensors": sensors,
            "controller": controller,
        }
    )


_SENSORS = TableSpec(
    help="Encoders; ideal where the table is absent.",
    kinds={f"load {motion}": TableSpec((Sensors,), units=(units_of("V", motion),)) for motion in LOADS},
)
_SENSORS_SHOWN = TableSpec(
    (Sensors,),
    "Encoders; ideal where the table is absent. With a rotary load keys that end with `_m` end with `_rad`.",
)
_CONTROLLERS = TableSpec(
    help="The controller that runs; its keys have the units of command and position.",
    kinds={
        # Partial, for the ratio of a cascade may be the transmission's.
        f"command {unit}, load {motion}{tagged}": replace(_controller_of(unit, motion, kind), partial=kind is Cascade)
        for tagged, kind in (("", Controller), (', kind = "cascade"', Cascade), (', kind = "linear"', linear_law))
        for unit in ("V", "N m", "rad/s", "rad")
        for motion in LOADS
    },
)
_SHOWN = _controller_of("N m", "linear")
_SHOWN_HELP = (
    "The controller that runs, a filtered PID where `kind` is absent. "
    "Its keys have the units of command and position: here those of a torque and a linear "
    "load. With a voltage `n_m` is `v` and the limit `voltage_limit_v`, with a speed `rad_per_s` and "
    "`speed_limit_rad_per_s`, with an angle `rad` and `angle_limit_rad`; with a rotary load `m` is `rad`: "
    "`kp_v_per_m`, `ki_rad_per_s_per_rad_s`."
)
_EITHER = {
    'kind = "filtered_pid"': _SHOWN,
    'kind = "cascade"': _controller_of("N m", "linear", Cascade),
    'kind = "linear"': _controller_of("N m", "linear", linear_law),
}
AXIS_SHOWN = _axis(TableSpec(help=_SHOWN_HELP, kinds=_EITHER), _SENSORS_SHOWN)
"""File of an axis for the reference, with one controller for all units."""
_TAGGED = _kinds(
    "Controller, a filtered PID where `kind` is absent; needed to control and where updates set gains.",
    {kind: maker for kind, maker in LAWS.items() if maker is not Controller},
)
_EDGE_CONTROLLER = replace(_TAGGED, kinds={"filtered PID": TableSpec((Controller,)), **_TAGGED.kinds})
FILES = {
    "servo": ("Servo: `servo.toml`", TableSpec((Servo,))),
    "axis": ("Axis made of parts: `axis.toml`", _axis(_CONTROLLERS, _SENSORS)),
    "scenario": (
        "Scenario of a co-simulation: `scenario.toml`",
        TableSpec(
            (Scenario,),
            tables={
                tables.CONTROLLER: _CHANGED,
                tables.RECORDING: TableSpec((Recording,), "Windows that the edge records and sends."),
                tables.EDGE: TableSpec(
                    (Supervision,),
                    "Supervision by the edge; with this table updates may also set gains.",
                    {
                        "fallback": _SCENARIO_FALLBACK,
                        tables.PROBE: TableSpec(
                            (ProbeLimits,), "Probing moves of the reference that the twin may request."
                        ),
                    },
                ),
                tables.NOVELTY: TableSpec(
                    (NoveltyRules,), "Rules that select the windows to send; where absent the edge sends all."
                ),
                tables.LINK: TableSpec(
                    (LinkSettings,),
                    "Both directions of the link.",
                    {
                        tables.UP: TableSpec((LinkSettings,), "Changes for edge to twin.", partial=True),
                        tables.DOWN: TableSpec((LinkSettings,), "Changes for twin to edge.", partial=True),
                    },
                ),
                tables.TWIN: _TWIN,
            },
        ),
    ),
    "edge": (
        "Edge: `edge.toml`",
        TableSpec(
            (AgentSettings, EdgeConfig, update_gains_table),
            tables={
                "drive": TableSpec(help="The drive.", kinds=_DRIVES),
                "controller": _EDGE_CONTROLLER,
                "own": _OWN,
                "start": _START,
                "supervision": TableSpec((Supervision,), "Supervision of the loop.", {"fallback": _EDGE_FALLBACK}),
                "novelty": TableSpec(
                    (NoveltySettings,), "Filter that selects the windows to send; where absent the edge sends all."
                ),
            },
        ),
    ),
    "twin": (
        "Twin: `twin.toml`",
        TableSpec(
            tables={
                "service": TableSpec(
                    (ServiceConfig, store_password_table),
                    "The service.",
                    {
                        "mqtt": TableSpec((mqtt_table,), "Broker over which edges may reach the service as well."),
                        "webhook": TableSpec((webhook_table,), "Address to which each alarm is posted as JSON."),
                    },
                ),
                "models": TableSpec(
                    help="Any number of models, each in a table with its name.",
                    tables={"NAME": TableSpec((servo_table,), tables={"controller": _CHANGED, "twin": _TWIN})},
                    repeated="NAME",
                ),
                "servos": TableSpec(help='Lines `"NAME" = "MODEL"`; a name may hold `*`.', text=True),
            },
        ),
    ),
    "machine": ("Simulated machine: `machine.toml`", TableSpec((MachineSettings,))),
}
"""The kinds of files: name of the schema, title, keys."""


_ANY = tuple(OwnUnits(command, position) for command in COMMANDS for position in POSITIONS)
_OWN_UNITS = ("scenario", "edge", "twin")
"""Files whose keys are named in the units of their machine."""


def texts() -> dict[str, str]:
    """The files of the reference, by their path below docs/."""
    pages = [markdown(title, AXIS_SHOWN if name == "axis" else spec) for name, (title, spec) in FILES.items()]
    specs = {
        name: (title, in_units(spec, _ANY) if name in _OWN_UNITS else spec) for name, (title, spec) in FILES.items()
    }
    schemas = {f"schemas/{name}.json": _json(title, spec) for name, (title, spec) in specs.items()}
    return {"configuration.md": "\n".join([HEAD, *pages]).rstrip() + "\n", **schemas}


def _json(title: str, spec: TableSpec) -> str:
    return json.dumps(schema(title.partition(":")[0], spec), indent=1, ensure_ascii=False) + "\n"


def main(folder: Path) -> None:
    """Write the reference below a folder."""
    for name, text in texts().items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "docs"))
