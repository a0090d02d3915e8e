"""An edge's metrics: what its status says, in a form that Prometheus takes."""

import subprocess

from servers import needed

from servotwin.edge_process.metrics import metrics_text

STATUS = {
    "servo": "ax-1", "samples": 5000, "version": 3, "tolerance_m": 2.5e-5, "fallback": False, "windows_cut": 7,
    "tick": {"number": 5000, "median_us": 40.0, "p99_us": 90.0, "p999_us": 200.0, "max_us": 1234.5},
    "windows": {"waiting": 2, "letters_waiting": 0, "dropped": {"refused: too_large": 3}},
    "disk": {"safe": True, "trouble": "", "faults": {"disk not writable": 1}}, "conflict": True,
    "up": {"trouble": "unreachable", "windows": 5}, "down": {"trouble": "", "received": 1}, "written": 1e9,
}  # fmt: skip


def test_every_number_of_the_status_is_a_metric() -> None:
    lines = metrics_text(STATUS).splitlines()
    assert 'servotwin_edge_windows_dropped_total{servo="ax-1",reason="refused: too_large"} 3' in lines
    for reason in ("outbox broken", "too_large"):
        assert f'servotwin_edge_windows_dropped_total{{servo="ax-1",reason="{reason}"}} 0' in lines
    assert 'servotwin_edge_disk_faults_total{servo="ax-1",fault="outbox moved"} 0' in lines
    expected = {
        "written_seconds": "1000000000", "samples_total": "5000", "windows_cut_total": "7", "windows_waiting": "2",
        "disk_safe": "1", "version": "3", "fallback": "0", "conflict": "1", "tolerance_metres": "2.5e-05",
        "tick_seconds_count": "5000",
    }  # fmt: skip
    for name, value in expected.items():
        assert f'servotwin_edge_{name}{{servo="ax-1"}} {value}' in lines, name
    assert [line.split()[1] for line in lines if "link_ok{" in line] == ["0", "1"]
    assert 'servotwin_edge_tick_seconds{servo="ax-1",quantile="1"} 0.0012345' in lines


def test_the_dead_zone_of_a_rotary_axis_is_a_metric_in_radians() -> None:
    text = metrics_text({"servo": "ax-1", "tolerance_rad": 2.5e-5})
    lines = [line for line in text.splitlines() if line[0] != "#"]
    assert lines == ['servotwin_edge_tolerance_radians{servo="ax-1"} 2.5e-05']


def test_an_edge_without_a_twin_or_a_tick_says_only_what_it_knows() -> None:
    text = metrics_text({"servo": 'a"b', "written": 1.0})
    assert [line for line in text.splitlines() if line[0] != "#"] == ['servotwin_edge_written_seconds{servo="a\\"b"} 1']


def test_prometheus_has_no_objection() -> None:
    command, text = [needed("promtool"), "check", "metrics"], metrics_text(STATUS)
    done = subprocess.run(command, input=text, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout + done.stderr) == (0, "")
