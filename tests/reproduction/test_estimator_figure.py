"""The figure that explains the estimator: what each window shows, in numbers."""

import math

import numpy as np
import pytest

from servotwin.estimation.estimate import GapStatus
from servotwin.report import style
from servotwin.reproduction.figures import estimator
from servotwin.reproduction.runs import Runs


@pytest.fixture(scope="module")
def drawn() -> tuple[estimator.WindowPanel, ...]:
    return estimator.estimator_data(Runs("paper"))


@pytest.mark.slow
def test_only_two_contacts_show_the_gap(drawn):
    both, one, none = drawn
    assert set(np.sign(both.pushed)) == {-1.0, 0.0, 1.0}
    assert len(set(np.sign(one.pushed)) - {0.0}) == 1
    assert set(none.pushed) == {0.0}
    assert math.degrees(both.spread) < 0.01
    assert both.estimate.ok
    assert abs(both.estimate.gap - estimator.GAP) < 4.0 * both.estimate.std_total
    for panel in (one, none):
        assert math.isinf(panel.spread)
        assert panel.estimate.status is not GapStatus.OK


@pytest.mark.slow
def test_one_contact_answers_but_the_screws_start_can_imitate_it(drawn):
    one, none = drawn[1:]
    assert np.abs(one.raw).max() > 1e-6
    assert np.abs(one.left).max() < 1e-9 * np.abs(one.raw).max()
    assert not np.any(none.raw)


def test_the_misfits_valley_is_a_point_a_line_or_a_plain(drawn):
    """Width of the gaps, with the screw's start at its best, before the misfit doubles."""
    widths = []
    for panel in drawn:
        least = panel.misfit.min(axis=0)
        widths.append(math.degrees(np.ptp(panel.gaps[0][least < 2.0 * least.min()])))
    assert widths[0] <= 1.0 < 15.0 < widths[1]
    plain = np.mean(drawn[2].misfit < 2.0 * drawn[2].misfit.min())
    assert plain > 0.8
    line = np.mean(drawn[1].misfit < 2.0 * drawn[1].misfit.min())
    assert line < 0.2


def test_the_sensitivity_is_the_derivative(drawn):
    """Against a difference of the positions that two gaps give."""
    from servotwin.estimation.core.contacts import SCREW, Gap, contacts
    from servotwin.estimation.core.response import response
    from servotwin.plant.servo import Servo

    panel, model = drawn[0], response(Servo.preset("paper"), estimator.RATE)
    begun, step = float(panel.theta_d[0]), 1e-7
    raw, left = estimator.sensitivity(panel.theta_m, Gap(estimator.GAP, begun), model)
    up, down = (
        model.respond(contacts(panel.theta_m, Gap(estimator.GAP + sign * step, begun))[[SCREW]])[0] for sign in (1, -1)
    )
    np.testing.assert_allclose((up - down) / (2.0 * step), raw, atol=2e-3 * np.abs(raw).max())
    assert np.linalg.norm(left) <= np.linalg.norm(raw)


@pytest.mark.slow
def test_drawn(drawn):
    with style.look():
        figure = estimator.plot(drawn)
        figure.canvas.draw()
    titles = [axes.get_title(loc="right") for axes in figure.axes]
    assert any(title.startswith("OK: 10.0") for title in titles)
