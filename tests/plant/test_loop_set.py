"""Margins of a law on many plants, continuous and sampled: exact margins, python-control and the loop's own stability
are the judges."""

from __future__ import annotations

import math
import warnings

import control
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from servotwin.control.controller import Controller
from servotwin.plant import loop as loops
from servotwin.plant import loop_set
from servotwin.plant.actuator import VelocityDrive
from servotwin.plant.axis import Axis
from servotwin.plant.load import Load
from servotwin.plant.loop_set import PlantSet, SetMargins, sampled_margins
from servotwin.plant.servo import Servo
from servotwin.plant.transmission import Transmission

SERVO = Servo.preset("paper")
OWN = SERVO.controller
CALM = OWN.replace(Ki=0.0)
SLOW = CALM.replace(Kp=500.0, Kd=-49.0, loop_filter_hz=20.0, sample_rate=50.0)


def varied(count: int, seed: int = 0) -> list[Servo]:
    rng = np.random.default_rng(seed)
    factors = rng.uniform([0.85, 0.5, 0.9, 0.9], [1.15, 1.5, 1.1, 1.1], (count, 4))
    return [SERVO.replace(k=1e4 * k, c=36.9 * c, m=5.2 * m, k_B=0.1 * b) for k, c, m, b in factors.tolist()]


def margins_of(servos: list[Servo], law: Controller, delay: int = 0) -> SetMargins:
    return PlantSet.of([servo.plant() for servo in servos], law.sample_rate).margins(law, delay)


@pytest.mark.parametrize("law", [CALM, OWN, CALM.replace(loop_filter_hz=20.0)], ids=["PD", "PID", "filtered"])
def test_a_continuous_law_has_the_exact_margins_on_every_plant(law: Controller) -> None:
    servos = varied(6)
    found = margins_of(servos, law)
    for i, servo in enumerate(servos):
        exact = servo.margins(law)
        assert bool(found.stable[i]) is exact.stable
        assert found.Ms[i] == pytest.approx(exact.Ms, rel=1e-5)
        least = min(abs(crossover.phase_margin) for crossover in exact.gain_crossovers)
        assert found.phase_margin[i] == pytest.approx(least, abs=1e-2)
        gain = min(max(c.gain_margin, 1.0 / c.gain_margin) for c in exact.phase_crossovers)
        assert found.gain_margin[i] == pytest.approx(gain, rel=1e-2)
        assert found.decay[i] == pytest.approx(-servo.closed_loop(law).poles().real.max(), rel=1e-6)


@pytest.mark.parametrize("delay", [0, 1, 3])
def test_a_sampled_law_has_the_margins_of_python_control(delay: int) -> None:
    servos = varied(4)
    found = margins_of(servos, SLOW, delay)
    law, step = loops.sampled_law(SLOW), 1.0 / SLOW.sample_rate
    tick = control.ss(law.A, law.B[:, None], law.C[None], [[law.D]], step)
    late = control.ss(np.eye(delay, k=-1), np.eye(delay)[:, :1], np.eye(delay)[-1:], [[0.0]], step) if delay else 1.0
    for i, servo in enumerate(servos):
        loop = tick * control.c2d(servo.plant().to_control(), step, "zoh") * late
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            gain, phase, distance, _, omega, _ = control.stability_margins(loop)
        assert found.Ms[i] == pytest.approx(1.0 / distance, rel=1e-4)
        assert found.gain_margin[i] == pytest.approx(gain, rel=1e-2)
        assert math.degrees(found.phase_margin[i]) == pytest.approx(phase, abs=0.1)
        assert found.delay_margin[i] == pytest.approx(math.radians(phase) / omega, rel=1e-2)
        poles = control.feedback(loop, 1.0).poles()
        assert math.exp(-found.decay[i] * step) == pytest.approx(np.abs(poles).max(), rel=1e-9)
        assert np.abs(loops.sampled_poles(servo.plant(), SLOW, delay)).max() == pytest.approx(np.abs(poles).max())


@settings(max_examples=8)
@given(seed=st.integers(0, 1000), delay=st.integers(0, 3))
def test_the_gain_margin_is_the_gain_at_which_the_loop_becomes_unstable(seed: int, delay: int) -> None:
    servos = varied(1, seed)
    margin = float(margins_of(servos, SLOW, delay).gain_margin[0])
    for factor, stable in ((0.97 * margin, True), (1.03 * margin, False)):
        scaled = SLOW.replace(Kp=factor * SLOW.Kp, Kd=factor * SLOW.Kd)
        assert bool(margins_of(servos, scaled, delay).stable[0]) is stable


def test_the_delay_margin_is_the_delay_at_which_the_loop_becomes_unstable() -> None:
    law = SLOW.replace(sample_rate=1000.0, Kp=1377.7, Kd=-135.1)
    servos = varied(3)
    late = margins_of(servos, law).delay_margin
    for i, servo in enumerate(servos):
        samples = int(late[i] * 1000.0)
        assert margins_of([servo], law, samples - 2).stable[0]
        assert not margins_of([servo], law, samples + 2).stable[0]


def test_a_fast_rate_has_nearly_the_margins_of_continuous_time() -> None:
    servos = varied(4)
    slow, fast = (margins_of(servos, CALM.replace(sample_rate=rate)) for rate in (1e3, 1e5))
    exact = margins_of(servos, CALM)
    assert np.allclose(fast.Ms, exact.Ms, rtol=1e-3)
    assert np.allclose(fast.decay, exact.decay, rtol=1e-3)
    # Half a sample of delay: the difference is of first order in the step.
    assert np.allclose((slow.Ms - exact.Ms) / (fast.Ms - exact.Ms), 100.0, rtol=0.1)


def test_a_loop_that_its_rate_makes_unstable_has_no_margins() -> None:
    """The continuous loop is calm, and says nothing of the one at 50 Hz."""
    heavy = SERVO.replace(m=20.0, k=1e9, c=2e4)
    law = CALM.replace(Kp=120.0 * heavy.k_B / heavy.p, Kd=0.0)
    assert margins_of([heavy], law).stable[0]
    sampled = margins_of([heavy], law.replace(sample_rate=50.0))
    assert not sampled.stable[0]
    # The motor is an integrator with a lag; what is left of the lag after a sample is nothing.
    lag = heavy.J * heavy.R / (heavy.k_T * heavy.k_B)
    poles = np.roots([1.0, 120.0 * (0.02 - lag) - 1.0, 120.0 * lag])
    assert math.exp(-sampled.decay[0] / 50.0) == pytest.approx(np.abs(poles).max(), rel=0.01)
    assert sampled.Ms[0] == math.inf
    assert sampled.decay[0] < 0.0


def test_margins_do_not_depend_on_the_unit_of_time() -> None:
    faster = SERVO.replace(J=5e-6 / 1e4, L=1e-3 / 1e2, k_B=0.1 / 1e2, k=1e4 * 1e4, c=36.9 * 1e2)
    law = SLOW.replace(sample_rate=5e3, Kd=-0.49, Tf=1e-3, loop_filter_hz=2e3)
    one, other = margins_of([SERVO], SLOW, 1), margins_of([faster], law, 1)
    assert other.Ms == pytest.approx(one.Ms, rel=1e-8)
    assert other.phase_margin == pytest.approx(one.phase_margin, rel=1e-8)
    assert 100.0 * other.delay_margin == pytest.approx(one.delay_margin, rel=1e-8)


@settings(max_examples=30)
@given(
    seed=st.integers(0, 1000),
    scale=st.floats(0.05, 20.0),
    share=st.sampled_from([0.0, 0.01, 1.0]),
    rate=st.sampled_from([None, 50.0, 300.0, 5000.0]),
    delay=st.integers(0, 3),
    filtered=st.sampled_from([None, 20.0]),
)
def test_the_turns_of_the_return_difference_tell_stability_as_the_poles_do(
    seed: int, scale: float, share: float, rate: float | None, delay: int, filtered: float | None
) -> None:
    own = OWN.replace(sample_rate=rate, loop_filter_hz=filtered)
    law = own.replace(Kp=scale * own.Kp, Kd=scale * own.Kd, Ki=share * own.Ki)
    late = delay if rate else 0
    systems = [servo.plant() for servo in varied(5, seed)]
    decays = PlantSet.of(systems, rate).decays(law, late)
    # Poles on the boundary to within what eigenvalues resolve belong to neither side.
    clear = np.abs(decays) > 1e-6
    assert np.array_equal(PlantSet.of(systems, rate).stable(law, late)[clear], decays[clear] > 0.0)


def test_stability_does_not_depend_on_what_was_asked_before(monkeypatch: pytest.MonkeyPatch) -> None:
    """Poles and turns may disagree at the boundary: one of the two must always decide."""
    monkeypatch.setattr(loop_set, "encirclements", lambda loop, _: (np.ones(len(loop)), np.ones(len(loop), dtype=bool)))
    plants = PlantSet.of([servo.plant() for servo in varied(3)], None)
    assert (plants.decays(CALM) > 0.0).all()
    assert not plants.stable(CALM).any()


@pytest.mark.parametrize("delay", [0, 3])
def test_a_gain_of_the_wrong_sign_is_unstable_though_its_derivative_action_hides_it(delay: int) -> None:
    """Beyond 2 rad/s, where the plant's frequencies begin, the loop looks like a stable one."""
    drive = Axis(
        VelocityDrive(2.37e-3),
        Transmission(3.15e-4, 5.5e6, 2.3e3, "free"),
        Load((42.5, 42.5), (0.0, 4.5e6), (914.0, 2.3e3)),
        Controller(-1.56e5, 6.26e5, 1.23e5, 0.646, sample_rate=634.0),
    )
    plants = PlantSet.of([drive.plant()], 634.0)
    bare = drive.pidf.replace(Ki=0.0)
    assert plants.stable(drive.pidf, delay).all()
    assert not plants.stable(bare, delay).any()
    # The integrator of the motor alone: a pole near minus the gain.
    assert plants.decays(bare, delay)[0] < -1.0


def test_a_law_that_is_much_slower_than_the_structure_has_its_crossover_and_its_peak() -> None:
    rigid = Axis(VelocityDrive(1e-3), Transmission(1e-3), Load((1.0,)), Controller(1.0, 0.0, 0.0, 1.0, sample_rate=1e3))
    # L = crossover (1 + corner / s) / s: an integral as fast as the loop has a peak of 1.15 at any speed.
    law = rigid.pidf.replace(Kp=0.5, Ki=0.25 * 1e-3)
    for margins in (sampled_margins(rigid.plant(), law), rigid.margins(rigid.pidf.replace(Kp=0.5, Ki=0.25 * 1e-3))):
        (crossover,) = margins.gain_crossovers
        golden = 5e-4 * math.sqrt(0.5 + math.sqrt(1.25))
        assert crossover.omega == pytest.approx(golden, rel=1e-3)
    found = PlantSet.of([rigid.plant()], 1e3).margins(law)
    assert found.phase_margin[0] == pytest.approx(math.atan(golden / 5e-4), rel=1e-3)
    assert found.Ms[0] == pytest.approx(1.1547, rel=1e-3)


def test_gains_of_numpy_are_gains() -> None:
    law = OWN.replace(Kp=np.float64(OWN.Kp), Ki=np.float64(OWN.Ki), sample_rate=500.0)
    assert np.array_equal(loops.sampled_law(law).A, loops.sampled_law(OWN.replace(sample_rate=500.0)).A)
