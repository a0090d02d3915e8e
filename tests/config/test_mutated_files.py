"""Each key of an edge's and of a twin's file with wrong values: accepted, or refused in one sentence."""

import copy
import json
import tomllib
from array import array
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from edge_files import edge_file

from servotwin.config.toml import dumps
from servotwin.edge.agent import Agent
from servotwin.edge_process.config_file import load
from servotwin.edge_process.drive import drive_of
from servotwin.edge_process.startup import check
from servotwin.errors import InvalidInput
from servotwin.store.engine import parse_address, sqlite_file
from servotwin.twin_service.http_server import check_tls
from servotwin.twin_service.twin_file import read_twin

SCHEMAS = Path(__file__).parents[2] / "docs" / "schemas"
WRONG: list[Any] = [
    "", "\0", "a\nb", "x" * 900, "x" * 5000, ".", -1, 10**30, 1e308, 5e-324,
    float("inf"), float("nan"), True, [], {}, [1, "a"],
]  # fmt: skip
TABLES = """[twin]
url = "https://h"
token_file = "token"
[probe]
size_mm = 0.1
[supervision.fallback]
tolerance_mm = 0.01
gains_stay = true
[supervision.fallback.band]
error_mm = 1.0
error_rms_mm = 1.0
effort_v = 1.0
settling_s = 1.0
"""
EDGE = edge_file("supervise", "update_gains = true\n", TABLES)
TWIN = """
[service]
port = 0
[service.webhook]
url = "https://h/hook"
[service.mqtt]
url = "mqtt://127.0.0.1"
[models.axis]
servo = "paper"
[models.axis.twin]
policy = "paper"
[servos]
ax-1 = "axis"
"""


def paths(schema: dict[str, Any], above: tuple[str, ...] = ()) -> list[tuple[str, ...]]:
    """Dotted paths of all keys of a schema; a table of any name is called axis."""
    found = []
    for part in (schema, *schema.get("oneOf", ()), *schema.get("anyOf", ())):
        inner = dict(part.get("properties", {}))
        if isinstance(part.get("additionalProperties"), dict):
            inner["axis"] = part["additionalProperties"]
        for name, value in inner.items():
            found += [(*above, name), *paths(value, (*above, name))]
    return list(dict.fromkeys(found))


def mutants(kind: str, text: str) -> list[tuple[str, str]]:
    """(key and value, text) of files with one wrong value."""
    base, made = tomllib.loads(text), []
    for path in paths(json.loads((SCHEMAS / f"{kind}.json").read_text())):
        for wrong in WRONG:
            values = copy.deepcopy(base)
            table: Any = values
            for name in path[:-1]:
                table = table.setdefault(name, {})
            if isinstance(table, dict):
                table[path[-1]] = wrong
                made.append((f"{'.'.join(path)} = {str(wrong)[:20]!r}", dumps(values)))
    return made


def run_edge(path: Path) -> None:
    """As at the start of an edge, and some samples."""
    config = load(path)
    check(config)
    drive_of(config, path).close()
    agent = Agent(replace(config.agent, boot="b0"))
    agent.absorb_block(*(array("d", [value] * 100) for value in (1e-3, 0.0, 0.0, 0.0)))


def start_twin(path: Path) -> None:
    """As at the start of a twin, until it opens its store."""
    twin = read_twin(path)
    check_tls(twin.service)
    sqlite_file(parse_address(twin.service.store))


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "text", "start"), [("edge", EDGE, run_edge), ("twin", TWIN, start_twin)])
def test_a_wrong_value_of_any_key_is_refused_in_one_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str, text: str, start: Callable[[Path], None]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("token").write_text("t\n")
    Path("token").chmod(0o600)
    path = Path(f"{kind}.toml")
    path.write_text(text)
    start(path)
    before, faults, refused = sorted(tmp_path.iterdir()), [], 0
    for what, mutant in mutants(kind, text):
        path.write_text(mutant)
        try:
            start(path)
        except InvalidInput as error:
            refused += 1
            if not str(error).isprintable() or len(str(error)) > 1500 or "is not a TOML file" in str(error):
                faults.append(f"{what}: {error}"[:300])
        except Exception as error:
            faults.append(f"{what}: {type(error).__name__}: {error}"[:300])
    assert faults == []
    assert refused > 2000
    assert sorted(tmp_path.iterdir()) == before


def with_values(text: str, table: str, values: dict[str, Any]) -> str:
    """Text of a file with values in a table."""
    base = tomllib.loads(text)
    inner: Any = base
    for name in table.split(".") if table else ():
        inner = inner.setdefault(name, {})
    inner.update(values)
    return dumps(base)


def refusal(path: Path, start: Callable[[Path], None], text: str) -> str:
    path.write_text(text)
    with pytest.raises(InvalidInput) as refused:
        start(path)
    return str(refused.value)


UNORDERED = {"models.axis.twin.estimator.offset_deg"}
"""Two numbers that are no range."""


@pytest.mark.parametrize(("kind", "text", "start"), [("edge", EDGE, load), ("twin", TWIN, read_twin)])
def test_a_range_that_is_reversed_is_refused_by_its_key(
    tmp_path: Path, kind: str, text: str, start: Callable[[Path], None]
) -> None:
    path, named, of_other_machines = tmp_path / f"{kind}.toml", 0, 0
    schema = json.loads((SCHEMAS / f"{kind}.json").read_text())
    for place in paths(schema):
        declared = schema_of(schema, place)
        if declared.get("maxItems") != 2 or ".".join(place) in UNORDERED:
            continue
        said = refusal(path, start, with_values(text, ".".join(place[:-1]), {place[-1]: [0.2, 0.1]}))
        if said.startswith(f"{path}: unknown key '{'.'.join(place)}'"):
            of_other_machines += 1
            continue
        assert said == f"{path}: {'.'.join(place)} = [0.2, 0.1] is not allowed; give two numbers, the lower one first"
        named += 1
    assert named >= 4
    assert of_other_machines > 0


def schema_of(schema: dict[str, Any], place: tuple[str, ...]) -> dict[str, Any]:
    """What a schema says of a key."""
    if not place:
        return schema
    for part in (schema, *schema.get("oneOf", ()), *schema.get("anyOf", ())):
        inner = dict(part.get("properties", {}))
        if isinstance(part.get("additionalProperties"), dict):
            inner.setdefault("axis", part["additionalProperties"])
        if place[0] in inner and (found := schema_of(inner[place[0]], place[1:])):
            return found
    return {}


CASCADE = EDGE.replace(EDGE[EDGE.index("[controller]") : EDGE.index("[twin]")], '[controller]\nkind = "cascade"\n'
    "travel_m_per_rad = 0.001\nposition_gain_per_s = 10.0\n"
    "velocity_gain_v_s_per_rad = 0.1\nintegral_time_s = 0.1\n")  # fmt: skip


@pytest.mark.parametrize(
    ("text", "table", "values", "expected"),
    [
        (EDGE, "limits", {"minimum_mm": 2.0, "maximum_mm": 1},
         "limits.minimum_mm = 2.0: must be at most limits.maximum_mm = 1"),
        (EDGE, "limits", {"notch_min_hz": 9.0, "notch_max_hz": 8.0},
         "limits.notch_min_hz = 9.0: must be at most limits.notch_max_hz = 8.0"),
        (CASCADE, "limits", {"notch_max_hz": 600.0},
         "limits.notch_max_hz = 600.0: must be below half of the controller's 1000.0 Hz"),
        (EDGE, "limits", {"kd_v_s_per_m": [1.0, 2.0]},
         "limits.kd_v_s_per_m = [1.0, 2.0]: must reach to the side of zero of the servo's own -135.1"),
        (EDGE, "limits", {"speed_filter_s": [1.0, 2.0]},
         "limits.speed_filter_s = [1.0, 2.0]: the controller has no speed_filter; give ranges of Kp, Kd, Tf"),
        (EDGE, "retry", {"first_s": 3, "longest_s": 2.0}, "retry.first_s = 3: must be at most retry.longest_s = 2.0"),
        (EDGE, "retry", {"first_s": 61.0},
         "retry.first_s = 61.0: must be at most retry.longest_s = 60.0 (the default)"),
        (EDGE, "window", {"window_s": 0.5, "pre_trigger_s": 1.0},
         "window.pre_trigger_s = 1.0: must be below window.window_s = 0.5"),
        (EDGE, "window", {"window_s": 2.0, "longest_window_s": 1.0},
         "window.longest_window_s = 1.0: must be at least window.window_s = 2.0"),
        (EDGE, "controller", {"enter_tolerances": 2.0, "leave_tolerances": 1.0},
         "controller.leave_tolerances = 1.0: must be at least controller.enter_tolerances = 2.0"),
        (EDGE, "own", {"enter_tolerances": 2.0},
         "own.leave_tolerances = 1.0 (the default): must be at least own.enter_tolerances = 2.0"),
        (CASCADE, "controller", {"enter_tolerances": 2.0, "leave_tolerances": 1.0},
         "controller.leave_tolerances = 1.0: must be at least controller.enter_tolerances = 2.0"),
        (EDGE, "start", {"enter_tolerances": 2.0, "leave_tolerances": 1.0},
         "start.leave_tolerances = 1.0: must be at least start.enter_tolerances = 2.0"),
    ],
)  # fmt: skip
def test_values_that_contradict_each_other_are_named_by_their_keys(
    tmp_path: Path, text: str, table: str, values: dict[str, Any], expected: str
) -> None:
    path = tmp_path / "edge.toml"
    assert refusal(path, load, with_values(text, table, values)) == f"{path}: {expected}"


@pytest.mark.parametrize(
    ("table", "values", "expected"),
    [
        ("twin.excitation", {"window_s": 1.0, "pre_trigger_s": 2.0},
         "twin.excitation.pre_trigger_s = 2.0: must be below models.axis.twin.excitation.window_s = 1.0"),
        ("twin.excitation", {"window_s": 0.25},
         "twin.excitation.window_s = 0.25: must be above 0.3 s, the pre-trigger of the paper's servo"),
        ("twin.excitation", {"pre_trigger_s": 60.0},
         "twin.excitation.pre_trigger_s = 60.0: must be below 2.0 s, the paper's servo's window"),
        ("twin.estimator", {"offset_deg": [1.0, -1.0]},
         "twin.estimator.offset_deg = [1.0, -1.0]: must be (mean, standard deviation), the latter above 0"),
        ("controller", {"enter_tolerances": 2.0, "leave_tolerances": 1.0},
         "controller.leave_tolerances = 1.0: must be at least models.axis.controller.enter_tolerances = 2.0"),
    ],
)  # fmt: skip
def test_values_of_a_model_that_contradict_each_other_are_named_by_their_keys(
    tmp_path: Path, table: str, values: dict[str, Any], expected: str
) -> None:
    path = tmp_path / "twin.toml"
    said = refusal(path, read_twin, with_values(TWIN, f"models.axis.{table}", values))
    assert said == f"{path}: models.axis.{expected}"


def test_a_contradiction_is_named_in_the_units_of_the_machine(tmp_path: Path) -> None:
    path = tmp_path / "edge.toml"
    units = 'command_unit = "N m"\nposition_unit = "rad"\n'
    text = (
        CASCADE.replace("velocity_gain_v_s", "velocity_gain_n_m_s")
        .replace("travel_m", "travel_rad")
        .replace("_mm", "_deg")
    )
    text = text.replace("_v =", "_n_m =").replace("[drive]", f"{units}[drive]", 1)
    said = refusal(path, load, with_values(text, "limits", {"minimum_deg": 2.0, "maximum_deg": 1.0}))
    assert said == f"{path}: limits.minimum_deg = 2.0: must be at most limits.maximum_deg = 1.0"
