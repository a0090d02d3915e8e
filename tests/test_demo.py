"""`servotwin demo`: the twin wins back what the servo alone loses, and the report says so."""

import io

import pytest
from rich.console import Console

from servotwin import demo


@pytest.fixture(scope="module")
def shown(tmp_path_factory):
    console = Console(file=io.StringIO(), width=80)
    path = demo.demo(tmp_path_factory.mktemp("demo"), console=console)
    return path, console.file.getvalue()


def test_the_terminal_shows_every_step_within_eighty_columns(shown):
    _, text = shown
    rows = [line for line in text.splitlines() if line[:2].strip().isdigit()]
    assert [int(line.split()[0]) for line in rows] == list(range(1, 11))
    assert all("settled" in line or "oscillates" in line for line in rows)
    assert "…" not in text
    assert f"report: {shown[0]}" in text


def test_the_report_stands_alone(shown):
    path, _ = shown
    page = path.read_text()
    assert "data:image/svg+xml;base64," in page
    assert 'src="http' not in page
    assert sorted(p.name for p in path.parent.iterdir()) == ["demo.png", "demo.svg", "report.html"]


def test_the_twin_settles_more_steps_than_the_servo_alone(tmp_path):
    console = Console(file=io.StringIO())
    ours, published = (demo.LoopJob("paper", method=method).described() for method in ("whitened", "paper"))
    found = demo.compare(ours, published, console)
    rows = demo.verdicts(found)
    assert sum(row.alone.settled for row in rows) < 5 < sum(row.twinned.settled for row in rows)
    # Wear from 2 deg on: alone every step oscillates, and more the larger the gap; with the twin every step rests.
    assert [row.alone.settled for row in rows[2:]] == [False] * 8
    swings = [row.alone.amplitude for row in rows[2:]]
    assert swings == sorted(swings)
    assert [row.twinned.settled for row in rows[2:]] == [True] * 8
    assert not found.alone.applied
    assert len(found.twinned.applied) == 10
    # The estimates are at least ten times nearer to the truth than the published ones, which the report says as well.
    worst = [max(abs(row.estimate.error) for row in rows), max(abs(row.published_estimate.error) for row in rows)]
    assert 10.0 * worst[0] < worst[1]
    assert demo.comparison(rows)[1].startswith("Estimates from 10 of 10 windows, off by 0.3")
