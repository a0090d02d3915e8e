"""Margins of a law of two encoders over many axes: those of each axis alone."""

import numpy as np
import pytest

from servotwin.control.cascade import Cascade
from servotwin.control.laws import AnyController
from servotwin.control.retuning import scaled
from servotwin.plant.axis import Axis
from servotwin.plant.law_set import LawSet

AXIS = Axis.preset("two-mass-drive")
AXES = [AXIS, AXIS.scaled({"k": 0.7, "m": 1.3}), AXIS.scaled({"k_T": 1.2})]
CASCADE = Cascade(2.0, AXIS.p, velocity_gain=30.0, integral_time=0.5, sample_rate=1000.0)


@pytest.mark.parametrize("law", [CASCADE, CASCADE.linear(), CASCADE.replace(sample_rate=None, on="motor")])
def test_margins_are_those_of_each_axis(law: AnyController) -> None:
    found, each = LawSet.of(AXES, law.sample_rate).margins(law), [axis.margins(law) for axis in AXES]
    assert found.Ms == pytest.approx([one.Ms for one in each], rel=1e-6)
    phases = [min(abs(crossover.phase_margin) for crossover in one.gain_crossovers) for one in each]
    assert found.phase_margin == pytest.approx(phases, rel=1e-6)
    assert found.stable.all()


def test_a_delay_that_makes_a_loop_unstable_is_seen() -> None:
    """At the delay margin and beyond; the poles and the response agree."""
    law = scaled(CASCADE, 4.0, (1.0, 1.0), 1.0)
    axes = LawSet.of(AXES[:1], law.sample_rate)
    late = float(axes.margins(law, 0).delay_margin[0]) * 1000.0
    assert bool(axes.stable(law, int(np.floor(late)))[0])
    assert not bool(axes.stable(law, int(np.ceil(late)))[0])
    assert axes.peaks(law, 1)[0] <= axes.margins(law, 1).Ms[0] * (1.0 + 1e-9)
