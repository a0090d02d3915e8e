"""The reference in docs/ is that of the code, and its schemas accept what the program reads."""

import json
import re
import tomllib
from pathlib import Path

import jsonschema_rs
import pytest

from servotwin.cli.configuration import texts
from servotwin.errors import InvalidInput
from servotwin.plant.axis import AXES

ROOT = Path(__file__).parents[2]
TEXTS = texts()
PACKAGED = [
    *(("scenario", path) for path in sorted((ROOT / "servotwin/cosim/scenarios").glob("*.toml"))),
    *(
        ("axis" if path.stem in AXES else "servo", path)
        for path in sorted((ROOT / "servotwin/plant/presets").glob("*.toml"))
    ),
]


@pytest.mark.parametrize("name", TEXTS)
def test_the_reference_is_up_to_date(name: str) -> None:
    assert (ROOT / "docs" / name).read_text(encoding="utf-8") == TEXTS[name], "run `make reference`"


@pytest.mark.parametrize(("kind", "path"), PACKAGED, ids=lambda value: getattr(value, "name", value))
def test_a_packaged_file_fits_its_schema(kind: str, path: Path) -> None:
    schema = json.loads(TEXTS[f"schemas/{kind}.json"])
    values = tomllib.loads(path.read_text(encoding="utf-8").replace("= inf", "= 1e300"))  # JSON has no inf
    jsonschema_rs.validate(schema, values)
    assert not jsonschema_rs.is_valid(schema, {**values, "unknown_key": 1})


def test_an_edge_s_file_fits_its_schema_as_it_is_written() -> None:
    from servotwin.control.controller import Controller
    from servotwin.edge.settings import AgentSettings
    from servotwin.edge_process.config import UNBOOTED, EdgeConfig
    from servotwin.edge_process.config_file import edge_toml

    law = Controller(1377.7, 18907.6, -135.1, 0.1, sample_rate=1000.0)
    agent = AgentSettings("axis-1", UNBOOTED, 1000.0, controller=law)
    text = edge_toml(EdgeConfig(agent, "control", law, {"kind": "simulated", "address": "unix:s"}))
    schema, values = json.loads(TEXTS["schemas/edge.json"]), tomllib.loads(text.replace("= inf", "= 1e300"))
    jsonschema_rs.validate(schema, values)
    assert not jsonschema_rs.is_valid(schema, {**values, "unknown_key": 1})


def test_gains_stay_is_listed_only_where_it_is_read(tmp_path: Path) -> None:
    """In [own] and [supervision.fallback] of an edge's file; [start] and a scenario's [edge.fallback] refuse it."""
    from servotwin.edge_process.config_file import load

    tables = json.loads(TEXTS["schemas/edge.json"])["properties"]
    listed = {
        "own": tables["own"]["properties"],
        "start": tables["start"]["properties"],
        "supervision.fallback": tables["supervision"]["properties"]["fallback"]["properties"],
    }
    head = (
        'servo = "axis"\nrole = "supervise"\nsample_rate_hz = 1000.0\n[drive]\nkind = "simulated"\naddress = "unix:s"\n'
    )
    for table, keys in listed.items():
        (tmp_path / "edge.toml").write_text(f"{head}[{table}]\ngains_stay = true\n")
        if "gains_stay" in keys:
            load(tmp_path / "edge.toml")
        else:
            with pytest.raises(InvalidInput, match=f"unknown key '{table}.gains_stay'"):
                load(tmp_path / "edge.toml")
    edge = json.loads(TEXTS["schemas/scenario.json"])["properties"]["edge"]["properties"]
    assert "gains_stay" not in edge["fallback"]["properties"]


def test_a_twin_s_file_fits_its_schema() -> None:
    values = tomllib.loads(
        """
        [service]
        port = 0
        [models.axis]
        servo = "paper"
        [models.axis.twin]
        policy = "certified"
        [models.axis.twin.trend]
        wear_deg = 20
        over_s = 200
        [servos]
        "ax-*" = "axis"
        """
    )
    schema = json.loads(TEXTS["schemas/twin.json"])
    jsonschema_rs.validate(schema, values)
    values["service"]["port"] = -1
    assert not jsonschema_rs.is_valid(schema, values)


def test_no_key_is_read_by_hand() -> None:
    """Values of a table come from its declaration; only `config` itself calls the readers of single keys."""
    by_hand = re.compile(r"\b(?:table|inner|edge|values)\.(?:text|numbers?|integer|boolean)(?:_in)?\(\"")
    found = [
        f"{path.relative_to(ROOT)}: {line.strip()}"
        for path in sorted((ROOT / "servotwin").rglob("*.py"))
        if path.parent.name != "config"
        for line in path.read_text(encoding="utf-8").splitlines()
        if by_hand.search(line)
    ]
    assert found == []
