"""A real Prometheus scrapes a started twin: every query of the dashboard's file has data, every rule is evaluated."""

import math
import re
import socket
import subprocess
import time
from collections.abc import Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from threading import Thread
from typing import Any

import httpx
import pytest
from dashboard_fleet import SILENT, WEARING, wearing_fleet
from monitoring_files import DASHBOARD, EDGE, FOLDER, RULES
from servers import needed
from service_system import OPERATOR, OTHER, bearer, place, process, window

from servotwin.edge_process.metrics import metrics_text
from servotwin.messages import encode

pytestmark = pytest.mark.slow

WAIT_S = 60.0
CONFIG = """
global: {{scrape_interval: 1s, evaluation_interval: 1s}}
rule_files: [{rules}]
scrape_configs:
- job_name: servotwin
  static_configs: [{{targets: ["{twin}"]}}]
- job_name: machines
  metrics_path: /metrics/machines
  authorization: {{credentials_file: {token}}}
  static_configs: [{{targets: ["{twin}"]}}]
- job_name: edges
  metrics_path: /edge.prom
  static_configs: [{{targets: ["{edges}"]}}]
"""
"""The edge's file is served as node_exporter's textfile collector would."""


class Quiet(SimpleHTTPRequestHandler):
    """Serves a folder and says nothing."""

    def log_message(self, *_: object) -> None:
        pass


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
    return port


class NotReady(Exception):
    """Prometheus listens, but has not started yet: it answers with 503 until then."""


class Monitoring:
    """A Prometheus that has scraped all of it twice."""

    def __init__(self, url: str, twin: str) -> None:
        self.url, self.twin = url, twin

    def get(self, path: str, **parameters: str) -> Any:
        answer = httpx.get(f"{self.url}/api/v1/{path}", params=parameters, timeout=20.0)
        if answer.status_code == httpx.codes.SERVICE_UNAVAILABLE:
            raise NotReady
        assert answer.status_code == 200, answer.text
        return answer.json()["data"]

    def values(self, query: str) -> list[dict[str, Any]]:
        found: list[dict[str, Any]] = self.get("query", query=query)["result"]
        return found

    def until(self, query: str, number: int) -> None:
        end = time.monotonic() + WAIT_S
        while True:
            try:
                if len(self.values(query)) >= number:
                    return
            except (httpx.TransportError, NotReady):
                pass
            assert time.monotonic() < end, f"{query}: waited in vain"
            time.sleep(0.2)


@pytest.fixture(scope="module")
def monitoring(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Monitoring]:
    program = needed("prometheus")
    folder = tmp_path_factory.mktemp("prometheus")
    twin_folder = tmp_path_factory.mktemp("twin")
    (folder / "operator.token").write_text(OPERATOR)
    (folder / "edge.prom").write_text(metrics_text({"servo": WEARING, **EDGE}))
    files = ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=str(folder)))
    serving = Thread(target=files.serve_forever, args=(0.05,))
    serving.start()
    path = wearing_fleet(twin_folder, time.time(), service="machine_metrics = true")
    with process(path, "--port", "0") as (_, url):
        sent = window(9, SILENT)
        httpx.put(url + place(sent), content=encode(sent), headers=bearer(OTHER))
        (folder / "prometheus.yml").write_text(
            CONFIG.format(
                rules=FOLDER / "servotwin.rules.yml",
                twin=url.removeprefix("http://"),
                token=folder / "operator.token",
                edges=f"127.0.0.1:{files.server_address[1]}",
            )
        )
        address = f"127.0.0.1:{free_port()}"
        command = [str(program), "--config.file=prometheus.yml", "--storage.tsdb.path=data", "--log.level=error"]
        running = subprocess.Popen([*command, f"--web.listen-address={address}"], cwd=folder)
        try:
            scraped = Monitoring(f"http://{address}", url)
            scraped.until("count_over_time(up[1m]) >= 3 and up == 1", 3)
            yield scraped
        finally:
            running.kill()
            running.wait()
            files.shutdown()
            files.server_close()
            serving.join()


def test_every_query_of_the_dashboard_s_file_returns_data(monitoring: Monitoring) -> None:
    queries = [target["expr"] for panel in DASHBOARD["panels"] for target in panel.get("targets", ())]
    assert len(queries) > 30
    without = [each for each in queries if not monitoring.values(each)]
    # These are empty as long as nothing is wrong.
    assert [each for each in without if not each.endswith("> 0")] == []


def test_the_metrics_of_a_machine_are_the_fleet_s_row(monitoring: Monitoring) -> None:
    rows = httpx.get(f"{monitoring.twin}/v1/fleet", headers=bearer(OPERATOR)).json()["rows"]
    [row] = [each for each in rows if each["servo"] == WEARING]
    wanted = {
        "gap_radians": row["gap"],
        "gap_low_radians": row["interval"][0],
        "gap_high_radians": row["interval"][1],
        "gap_limit_radians": math.radians(20.0),
        "wear_radians_per_second": row["rate"],
        "version": row["version_in_force"],
        "connected": 0.0,
    }
    for name, value in wanted.items():
        [found] = monitoring.values(f'servotwin_machine_{name}{{servo="{WEARING}"}}')
        assert float(found["value"][1]) == pytest.approx(value, rel=1e-6), name


def test_every_alert_rule_is_evaluated_and_a_silent_edge_fires(monitoring: Monitoring) -> None:
    monitoring.until('ALERTS{alertname="EdgeSilent",alertstate="firing"}', 1)
    rules = [rule for group in monitoring.get("rules")["groups"] for rule in group["rules"]]
    assert {rule["name"] for rule in rules} == set(re.findall(r"alert: (\w+)", RULES))
    assert [rule["name"] for rule in rules if rule["health"] != "ok" or rule.get("lastError")] == []
    firing = {each["labels"]["alertname"] for each in monitoring.get("alerts")["alerts"] if each["state"] == "firing"}
    assert "TwinAway" not in firing
