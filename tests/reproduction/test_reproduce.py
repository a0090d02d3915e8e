"""`servotwin reproduce`: figures, report and selection, from end to end on a small part."""

import io
import json
import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from markupsafe import escape
from rich.console import Console

from servotwin.errors import InvalidInput
from servotwin.report import style
from servotwin.reproduction import claims, figures, report, reproduce
from servotwin.reproduction.claims import ClaimResult, Finding, Verdict
from servotwin.reproduction.figures import DrawnFigure, backlash, observer
from servotwin.reproduction.runs import Runs


@pytest.fixture(scope="module")
def runs():
    return Runs("paper")


def quiet():
    return Console(file=io.StringIO())


def test_every_figure_of_the_paper_is_there_and_ours_come_last():
    names = [figure.name for figure in figures.FIGURES]
    ours = ["estimator", "policies", "policies-noise", "policies-bias"]
    assert names == [*("fig4", "fig5", "fig7", "fig9", "fig10b", "fig11", "fig12", "fig15", "fig16", "figA1"), *ours]
    assert all(figure.title and figure.caption for figure in figures.FIGURES)


@given(st.integers(1, 30000), st.integers(0, 2**32 - 1), st.integers(2, 400))
def test_the_envelope_keeps_extremes_and_ends(size, seed, columns):
    values = np.random.default_rng(seed).standard_normal(size)
    time = np.arange(size) * 0.1
    t, v = style.envelope(time, values, columns)
    assert len(t) <= max(4 * columns, 2 * columns + 2)
    assert (v.min(), v.max()) == (values.min(), values.max())
    assert (t[0], t[-1], v[0], v[-1]) == (time[0], time[-1], values[0], values[-1])
    assert np.all(np.diff(t) > 0.0)


@pytest.mark.slow
def test_the_same_figure_is_the_same_bytes(runs):
    vectors = [style.svg(reproduce.figure_spec("fig7").draw(runs), "fig7") for _ in range(2)]
    assert vectors[0] == vectors[1]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["fig4", "fig5", "fig10b", "fig12", "figA1"])
def test_figures_have_labels_with_units_and_a_legend(runs, name):
    drawn = reproduce.figure_spec(name).draw(runs)
    labels = [text for axes in drawn.axes for text in (axes.get_xlabel(), axes.get_ylabel()) if text]
    assert labels
    assert all(re.search(r"\((s|mm|deg|V|rad/s|dB.*)\)|dB", label) for label in labels)
    assert name == "fig4" or any(axes.get_legend() for axes in drawn.axes)


def test_fig_7_is_a_play_of_20_degrees():
    d = backlash.fig7_data()
    assert np.ptp(np.degrees(d.theta_m - d.theta_d)) == pytest.approx(20.0)


def test_fig_10b_switches_where_the_error_crosses_the_tolerance(runs):
    d = backlash.fig10b_data(runs)
    for begin, end in d.open_intervals:
        inside = (d.time > begin) & (d.time < end)
        assert np.all(np.abs(d.error[inside]) <= d.tolerance * (1.0 + 1e-9))
        assert np.all(d.dead_zone_error[inside] == 0.0)
        assert np.all(d.voltage[inside] == 0.0)


def test_fig_a1_observers_forget_as_their_formula_says(runs):
    """The simulated observers against the matrix exponential of their error."""
    d = observer.figA1_data(runs)
    for alpha, estimate in d.estimates.items():
        one = observer.observer(runs.servo, alpha)
        exact = one.error(one.initial_state(observer.INITIAL), d.time[250::500])
        assert (d.position - estimate)[250::500] == pytest.approx(exact, abs=2e-5)


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """Two figures in this process."""
    out = tmp_path_factory.mktemp("reproduction") / "new"
    reproduce.reproduce(out, only=("fig7,fig4",), console=quiet())
    return out


@pytest.mark.slow
def test_a_small_reproduction_writes_its_report_and_claims(small):
    names = ["claims.json", "fig4.png", "fig4.svg", "fig7.png", "fig7.svg", "report.html"]
    assert sorted(path.name for path in small.iterdir()) == names
    assert json.loads((small / "claims.json").read_text())["claims"] == []
    assert (small / "fig4.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
def test_a_pool_of_processes_gives_the_same(small, tmp_path):
    reproduce.reproduce(tmp_path, only=("fig7", "crossover"), workers=2, console=quiet())
    assert (tmp_path / "fig7.svg").read_bytes() == (small / "fig7.svg").read_bytes()
    (claim,) = json.loads((tmp_path / "claims.json").read_text())["claims"]
    assert list(claim["results"]) == ["paper", "table1", "paper-gain2"]


def assert_self_contained(text):
    for match in re.finditer(r"""(?:src|href)\s*=\s*["']([^"']*)""", text):
        assert match[1].startswith(("data:", "#")), match[1][:80]
    assert not re.search(r"<(script|link|iframe)|url\(|@import", text)


def test_the_report_is_self_contained_and_responsive(small):
    text = (small / "report.html").read_text()
    assert_self_contained(text)
    assert 'name="viewport"' in text
    assert "@media (max-width" in text
    assert text.count("data:image/svg+xml;base64,") == 2


def test_the_report_holds_every_erratum():
    listed = report.errata()
    assert [erratum["id"] for erratum in listed] == [f"E{i}" for i in range(1, 22)]
    text = report.report([], [], "paper")
    assert all(str(escape(erratum["decision"])) in text for erratum in listed)


def test_the_report_shows_verdicts_first_and_escapes_texts():
    claim = claims.claims()[0]
    results = [ClaimResult(claim, p, Finding(Verdict.NOT_AS_STATED, "a < b & c")) for p in ("paper", "table1")]
    text = report.report(results, [DrawnFigure("fig4", "Title", "Caption.", b"<svg/>")], "paper")
    assert_self_contained(text)
    assert text.index("Verdicts</h2>") < text.index("Figures</h2>") < text.index("Errata and decisions")
    assert "a &lt; b &amp; c" in text
    assert "0 of 1" in text


def test_selection_takes_commas_repeats_and_keeps_the_papers_order():
    chosen = reproduce.select(("fig12,crossover", "fig4"))
    assert chosen.figures == ("fig4", "fig12")
    assert [claim.id for claim in chosen.claims] == ["crossover"]
    assert len(reproduce.select(()).claims) == len(claims.claims())


def test_an_unknown_name_is_refused():
    with pytest.raises(InvalidInput, match="did you mean 'fig12'"):
        reproduce.select(("fig112",))


def test_every_claim_is_planned_once_per_preset():
    tasks = reproduce.planned(reproduce.select(()), "paper", None)
    planned = [(task.preset, claim.id) for task in tasks if hasattr(task, "claims") for claim in task.claims]
    assert len(planned) == len(set(planned)) == 3 * len(claims.claims())
