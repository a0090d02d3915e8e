"""The reference of all configuration files, written to docs/configuration.md and docs/schemas by `make reference`."""

from __future__ import annotations

import json
import sys
from pathlib import Path

from servotwin.commissioning.edge_settings import Recording
from servotwin.config.reference import TableSpec, markdown, schema
from servotwin.control.controller import Controller
from servotwin.cosim import scenario_file as tables
from servotwin.cosim.scenario import Scenario
from servotwin.drives.simulated.settings import MachineSettings
from servotwin.drives.table import SUPERVISED
from servotwin.edge.parameters import FallbackSet
from servotwin.edge.probe import ProbeLimits
from servotwin.edge.settings import AgentSettings, Supervision
from servotwin.edge.settings_file import gains_stay_table, setting_table, start_table
from servotwin.edge_process.config import EdgeConfig
from servotwin.edge_process.config_file import update_gains_table
from servotwin.estimation.gap import METHODS
from servotwin.link.simulated import LinkSettings
from servotwin.messages import Gains
from servotwin.novelty.settings import NoveltyRules, NoveltySettings
from servotwin.plant.servo import Servo
from servotwin.twin.model_registry import servo_table
from servotwin.twin.settings import TwinSettings
from servotwin.twin_service.config import ServiceConfig, mqtt_table, store_password_table

HEAD = """# Configuration reference

Made by `make reference` from the declarations in the code: do not edit. A file may leave out every key that is not
required. Where a key has two names, a file may give either; the unit is the end of the name. Editors that know TOML
schemas (Even Better TOML, Taplo) check a file against the schema of its kind in `docs/schemas`.
"""


_GAINS = Gains.__struct_fields__
_CHANGED = TableSpec((Controller,), "Changes of the servo's own controller.", partial=True)
_FALLBACK_HELP = "Setting that the edge falls back to; gains that are left out are those of the controller."
_FALLBACK_KEYS = ("tolerance", "band", "silence_s", "refuse_s", *_GAINS)
_SCENARIO_FALLBACK = TableSpec(
    (setting_table, FallbackSet, Controller), _FALLBACK_HELP, only=_FALLBACK_KEYS, partial=True
)
_EDGE_FALLBACK = TableSpec(
    (setting_table, FallbackSet, Controller, gains_stay_table),
    _FALLBACK_HELP,
    only=("gains_stay", *_FALLBACK_KEYS),
    partial=True,
)
_START = TableSpec(
    (setting_table, start_table, Controller),
    "Parameters before the first update.",
    only=("tolerance", "band", "fallback", *_GAINS),
    partial=True,
)
_OWN = TableSpec(
    (Controller, gains_stay_table),
    "Gains in the middle of the box that updates must stay in; the controller's where absent.",
    only=("gains_stay", *_GAINS),
    partial=True,
)
_ESTIMATOR = TableSpec(
    help="Settings of the estimator that `method` names.",
    kinds={f"method {name}": TableSpec((method.settings,)) for name, method in METHODS.items()},
)
_TWIN = TableSpec((TwinSettings,), "The twin.", {"estimator": _ESTIMATOR})
_DRIVES = {f'kind = "{name}"': TableSpec((maker,)) for name, maker in SUPERVISED.items()}

FILES = {
    "servo": ("Servo: `servo.toml`", TableSpec((Servo,))),
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
                "controller": TableSpec((Controller,), "Controller; needed to control and where updates set gains."),
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
                    {"mqtt": TableSpec((mqtt_table,), "Broker over which edges may reach the service as well.")},
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


def texts() -> dict[str, str]:
    """The files of the reference, by their path below docs/."""
    pages = [markdown(title, spec) for title, spec in FILES.values()]
    schemas = {f"schemas/{name}.json": _json(title, spec) for name, (title, spec) in FILES.items()}
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
