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

from servotwin.config.toml import dumps
from servotwin.edge.agent import Agent
from servotwin.edge_process.config_file import load
from servotwin.edge_process.run import _drive_of
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
EDGE = """
servo = "ax-1"
role = "supervise"
sample_rate_hz = 1000.0
update_gains = true
[drive]
kind = "simulated"
address = "unix:nothing.sock"
[controller]
kp_v_per_m = 1377.7
ki_v_per_m_s = 0.0
kd_v_s_per_m = -135.1
filter_time_s = 0.1
[twin]
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
    _drive_of(config, path).close()
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
