"""The alert rules and the dashboard: Prometheus takes them, and they ask for metrics that exist."""

import json
import re
import shutil
import subprocess
from pathlib import Path

import pytest
from monitoring_files import DASHBOARD, EDGE, FOLDER, RULES
from servers import needed
from service_system import twin_file

from servotwin.dashboard.machine_metrics import machine_metrics
from servotwin.edge_process.metrics import metrics_text
from servotwin.store.store import open_store
from servotwin.twin_service.service import TwinService
from servotwin.twin_service.twin_file import read_twin
from servotwin.twin_service.worker_pool import WorkerPool


def exported(folder: Path) -> str:
    """Metrics of a twin that has a broker, of an edge, and of a fleet."""
    twin = read_twin(twin_file(folder, '[service.mqtt]\nurl = "mqtt://127.0.0.1:1"\n'))
    store = open_store(twin.service.store)
    system = TwinService(twin, store, pool=WorkerPool(0, twin.start, 1.0))
    try:
        app_metrics = system.http_app() and system.metrics.text()
    finally:
        system.commits.close()
        system.executor.close()
        store.close()
    return app_metrics + metrics_text({"servo": "ax-1", **EDGE}) + machine_metrics([])


def queries() -> list[str]:
    """Of the dashboard's panels."""
    return [target["expr"] for panel in DASHBOARD["panels"] for target in panel.get("targets", ())]


def test_rules_and_dashboard_ask_for_metrics_and_labels_that_exist(tmp_path: Path) -> None:
    text = exported(tmp_path)
    kinds = dict(re.findall(r"^# TYPE (\S+) (\S+)", text, re.MULTILINE))
    series = {name for name, kind in kinds.items() if kind != "histogram"}
    parts = {f"{name}_{part}" for name, kind in kinds.items() if kind == "histogram" for part in ("bucket", "sum")}
    expressions = [*queries(), *re.findall(r"expr: (.+)", RULES)]
    asked = {name for each in expressions for name in re.findall(r"\bservotwin_\w+", each)}
    assert len(expressions) > 35
    assert asked - series - parts == set()
    selectors = [inner for each in expressions for inner in re.findall(r"\{(.*?)\}", each)]
    labels = {name for inner in selectors for name in re.findall(r"(\w+)[=!]", inner)}
    assert labels - {"job"} <= set(re.findall(r'[{,](\w+)="', text)) | {"kind", "put"}
    rates = {name for each in expressions for name in re.findall(r"(?:rate|increase)\((\w+)", each)}
    assert {kinds.get(name, "histogram") for name in rates} <= {"counter", "histogram"}
    # A series that first appears with its first event shows no increase: the alarm would miss it.
    for name, label, values in re.findall(r'(servotwin_\w+)\{(\w+)=~?"([^"]+)"\}\[', RULES):
        for value in values.split("|"):
            assert re.search(rf'^{name}{{(.*,)?{label}="{re.escape(value)}"}} 0$', text, re.MULTILINE)


def test_prometheus_takes_the_rules_and_they_fire_when_they_must(tmp_path: Path) -> None:
    promtool = needed("promtool")
    shutil.copytree(FOLDER, tmp_path, dirs_exist_ok=True)
    asked = [f"  - record: panel:{number}\n    expr: {json.dumps(each)}" for number, each in enumerate(queries())]
    (tmp_path / "panels.yml").write_text("groups:\n- name: panels\n  rules:\n" + "\n".join(asked) + "\n")
    test = [promtool, "test", "rules", "servotwin.rules.test.yml"]
    for command in ([promtool, "check", "rules", "servotwin.rules.yml", "panels.yml"], test):
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout + done.stderr
    (tmp_path / "servotwin.rules.yml").write_text(RULES.replace("store_damaged == 1", "store_damaged == 2"))
    assert subprocess.run(test, cwd=tmp_path, capture_output=True, check=False).returncode != 0


def test_every_panel_has_its_place() -> None:
    identifiers = [panel["id"] for panel in DASHBOARD["panels"]]
    assert len(set(identifiers)) == len(identifiers)
    taken: set[tuple[int, int]] = set()
    for panel in DASHBOARD["panels"]:
        place = panel["gridPos"]
        cells = {(place["x"] + k, place["y"] + j) for k in range(place["w"]) for j in range(place["h"])}
        assert not cells & taken, panel["title"]
        assert max(x for x, _ in cells) < 24
        taken |= cells


@pytest.mark.parametrize("alert", re.findall(r"alert: (\w+)", RULES))
def test_every_alert_says_what_happened(alert: str) -> None:
    [block] = [each for each in RULES.split("- alert: ")[1:] if each.startswith(f"{alert}\n")]
    assert re.search(r'severity: (critical|warning)\}\n.*summary: "[^"]{20,}\."', block)
