"""Report of a machine as one HTML file."""

import math
import re
import time

import pytest
from dashboard_fleet import SILENT, WEARING, wearing_fleet

from servotwin.cli.audit import Source, write_report
from servotwin.dashboard.machine_report import stamp
from servotwin.errors import InvalidInput
from servotwin.report.time_chart import ChartLine, ChartMark, TimeChart

NOW = 1_795_457_340.0


@pytest.fixture(scope="module")
def config(tmp_path_factory):
    return wearing_fleet(tmp_path_factory.mktemp("twin"), NOW)


def report(config, servo, folder):
    write_report(servo, Source(config), folder / "report.html")
    return (folder / "report.html").read_text()


def test_a_report_tells_what_is_known_and_needs_nothing_else(config, tmp_path):
    text = report(config, WEARING, tmp_path)
    assert "± 0.039 deg (95 %)" in text
    assert "limit 20 deg" in text
    assert len(re.findall(r"data:image/svg\+xml;base64", text)) == 2
    assert text.count("applied it") == 4
    assert "not simulated" in text
    assert not re.search(r"<script|<link|(src|href)=.?https?:|url\(", text)
    assert re.search(r"\d{4}-\d\d-\d\d \d\d:\d\d UTC", text)


def test_a_machine_without_a_window_has_a_report_too(config, tmp_path):
    text = report(config, SILENT, tmp_path)
    assert "No window of this machine has come yet" in text
    assert "The twin has sent no update yet" in text


def test_an_unknown_machine_has_none(config, tmp_path):
    with pytest.raises(InvalidInput, match="never sent a message"):
        report(config, "ax-9", tmp_path)
    assert not list(tmp_path.iterdir())


def test_times_are_in_iso_form():
    assert stamp(NOW) == "2026-11-23 18:09"


def test_a_chart_holds_its_points_and_escapes_words():
    lines = (ChartLine("a < b", "#000", [1.0, None, 3.0], dots=True), ChartLine("", "#000", [None, None, None]))
    marks = [ChartMark(5.0, "<v1>")]
    text = TimeChart("y", [0.0, 10.0, 20.0], lines, ([0.0, None, 2.0], [2.0, None, 99.0]), marks).svg().decode()
    assert text.count("<circle") == 2
    assert "&lt;v1&gt;" in text
    assert "a &lt; b" in text
    heights = [float(each) for each in re.findall(r'cy="([\d.]+)"', text)]
    assert 26.0 < heights[1] < heights[0] < 254.0


@pytest.mark.parametrize("span", [0.0, 3.0, 3e3, 3e5, 3e7, 3e9])
def test_a_chart_of_any_length_has_few_dates(span):
    text = TimeChart("y", [NOW, NOW + span], (ChartLine("a", "#000", [1e-9, 2e-9]),)).svg().decode()
    assert text.count('text-anchor="middle"') <= 14
    assert time.strftime("%Y", time.gmtime(NOW)) in text


def test_the_last_time_of_a_chart_is_not_cut_off():
    end = 60.0 * math.ceil(NOW / 60.0)
    text = TimeChart("y", [end - 400.0, end], (ChartLine("a", "#000", [1.0, 2.0]),)).svg().decode()
    last = time.strftime("%H:%M:%S", time.gmtime(end))
    word = re.search(rf'<text x="([\d.]+)"[^>]*text-anchor="(\w+)"[^>]*>{last}<', text)
    assert word.group(2) == "end"
    assert float(word.group(1)) <= 760.0
