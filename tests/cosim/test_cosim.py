"""The whole loop on the paper's servo: timing, determinism, faults of the link, Fig 15's oracle, quantisation."""

import math
from collections import Counter
from functools import cache

import numpy as np
import pytest
from quantisation import quantisation

from servotwin.cosim import Loop, cosimulate
from servotwin.cosim.scenario import Recording, Scenario
from servotwin.edge.guard import Limits
from servotwin.estimation.estimate import GapStatus
from servotwin.link.simulated import Fate, LinkSettings
from servotwin.messages import Acknowledge, Hello, LetterAcknowledge, Reason, Receipt, Update, WindowMessage
from servotwin.plant.noise import Noise
from servotwin.plant.servo import Servo
from servotwin.plant.signals import SquareWave
from servotwin.reproduction import measures
from servotwin.runtime.retry import Retry
from servotwin.simulation import Simulation, simulate
from servotwin.twin.estimating import known_gap
from servotwin.twin.settings import TwinSettings

GAP = math.radians(10.0)
PAPER = Servo.preset("paper")
SAMPLED = PAPER.controller.replace(sample_rate=5000.0)
SLOW = LinkSettings(delay_s=1.0)


def short(**changes) -> Scenario:
    """A gap of 10 deg, steps of 1 mm at 0 and 5 s, the paper's delays."""
    values = {"reference": SquareWave(1e-3, 10.0), "gap": GAP, "uplink": SLOW, "downlink": SLOW, "duration": 9.0}
    values["twin"] = TwinSettings(policy="paper")
    return Scenario(PAPER, **{**values, **changes})


@cache
def fig15() -> Loop:
    return cosimulate(Scenario.preset("fig15"))


def steps_of(loop: Loop):
    run = loop.run
    return measures.steps(run.time, run.position, run.reference, run.gap, measures.Settling(1e-3))


@pytest.mark.parametrize("controller", [None, SAMPLED], ids=["continuous", "sampled"])
def test_an_update_lands_three_seconds_after_the_reference_step(controller):
    loop = cosimulate(short(controller=controller))
    assert [window.start for window in loop.windows] == [0.0, 5.0]
    assert [estimate.status for estimate in loop.estimates] == [GapStatus.OK] * 2
    assert [receipt.sample for receipt in loop.receipts] == [15000, 40000]
    kinds = [(type(m.message), m.sent, m.arrival) for m in loop.messages[:4]]
    assert kinds == [(WindowMessage, 1.0, 2.0), (Acknowledge, 2.0, 3.0), (Update, 2.0, 3.0), (Receipt, 3.0, 4.0)]
    expected = np.zeros(loop.scenario.samples)
    expected[15000:40000], expected[40000:] = (update.setting.tolerance for update in loop.updates)
    assert np.array_equal(loop.run.tolerance, expected)


@pytest.mark.parametrize(("method", "error_deg"), [("paper", 0.6), ("whitened", 0.02)])
def test_the_estimate_is_near_the_truth_and_eq_21_follows_it(method, error_deg):
    loop = cosimulate(short(twin=TwinSettings(policy="paper", method=method)))
    for update, estimate in zip(loop.updates, loop.estimates, strict=True):
        assert abs(update.gap - GAP) < math.radians(error_deg)
        assert update.gap == estimate.gap
        assert update.setting.tolerance == PAPER.tolerance_for(estimate.gap, 1.0)
    assert loop.updates[0].window == ("boot-1", 0)
    assert loop.updates[1].base_version == loop.updates[0].version


def test_the_twin_settles_what_oscillates_without_it():
    with_twin = cosimulate(short(duration=30.0, reference=1e-3)).run
    alone = cosimulate(short(duration=30.0, reference=1e-3, twin=TwinSettings(policy="paper", enabled=False))).run
    last = slice(-25000, None)
    assert measures.amplitude(alone.position[last]) > 0.1e-3
    assert measures.amplitude(with_twin.position[last]) < 1e-6


def test_the_law_starts_linear_when_nothing_is_known():
    loop = cosimulate(short(duration=3.0))
    linear = simulate(PAPER, 3.0, reference=1e-3, gap=GAP)
    assert np.max(np.abs(loop.run.position - linear.position)[:15000]) < 1e-12


@pytest.mark.parametrize("controller", [None, SAMPLED], ids=["continuous", "sampled"])
def test_a_twin_switched_off_is_a_plain_simulation(controller):
    off = TwinSettings(policy="paper", enabled=False, initial_gap=GAP)
    loop = cosimulate(short(twin=off, controller=controller))
    tolerance = PAPER.tolerance_for(GAP)
    alone = simulate(PAPER, 9.0, controller=controller, reference=SquareWave(1e-3, 10.0), gap=GAP, tolerance=tolerance)
    assert np.max(np.abs(loop.run.position - alone.position)) < 1e-12
    assert loop.updates == loop.receipts == loop.windows == ()
    assert loop.accounts == Counter({"in flight": 2})
    assert {m.direction for m in loop.messages} == {"up"}


@pytest.mark.parametrize("controller", [PAPER.controller, SAMPLED], ids=["continuous", "sampled"])
def test_a_part_of_the_measurements_equals_the_whole(controller):
    simulation = Simulation(PAPER, 2.0, controller=controller, reference=1e-3, gap=GAP, tolerance=1e-4)
    draw = np.random.default_rng(1)
    for stop in range(500, 10_000, 500):
        simulation.advance(stop)
        run = simulation.run()
        first, last = sorted(draw.choice(stop, 2, replace=False))
        for name in ("reference", "theta_m", "position", "voltage"):
            assert np.array_equal(simulation.measured(name, first, last), run.measured(name)[first:last])


NOISY = {"controller": SAMPLED.replace(loop_filter_hz=20.0), "noise": Noise(0.1e-3), "duration": 6.0}
HOSTILE = LinkSettings(delay_s=0.1, jitter_s=1.0, loss=0.3, duplicate=0.3, reorder=0.3)


def test_equal_seeds_give_equal_bytes_and_others_do_not():
    scenario = short(**NOISY, uplink=HOSTILE, downlink=HOSTILE)
    digests = [cosimulate(scenario.replace(seed=seed)).digest() for seed in (1, 1, 2)]
    assert digests[0] == digests[1] != digests[2]
    assert cosimulate(scenario.replace(seed=1, name="other")).digest() != digests[0]


@pytest.mark.parametrize("change", [{"theta_d0": 0.01}, {"gap": GAP * 1.001}, {"downlink": LinkSettings(delay_s=1.1)}])
def test_the_digest_sees_every_difference(change):
    assert cosimulate(short(duration=2.5)).digest() != cosimulate(short(duration=2.5, **change)).digest()


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("controller", [None, SAMPLED], ids=["continuous", "sampled"])
def test_no_fate_of_the_link_breaks_the_order(seed, controller):
    recording = Recording(retry=Retry(1.5, 2.0, 4.0))
    twin = TwinSettings(policy="paper", retry=1.5, attempts=10)
    scenario = short(seed=seed, controller=controller, uplink=HOSTILE, downlink=HOSTILE, recording=recording, twin=twin)
    loop = cosimulate(scenario)
    versions = [receipt.version for receipt in loop.applied]
    assert versions == sorted(set(versions))
    data_times = {update.version: update.data_time for update in loop.updates}
    assert [data_times[v] for v in versions] == sorted(data_times[v] for v in versions)
    assert sum(loop.accounts.values()) == 2
    assert loop.run.tolerance[-1] == {u.version: u.setting.tolerance for u in loop.updates}.get(
        max(versions, default=0), 0.0
    )


def test_a_lost_update_and_a_lost_acknowledgement_are_made_good():
    down = LinkSettings(delay_s=1.0, outages=((1.9, 2.1),))
    loop = cosimulate(short(downlink=down, reference=1e-3))
    lost = [type(m.message) for m in loop.messages if m.fate is Fate.OUTAGE]
    assert lost == [Acknowledge, Update]
    assert [receipt.sample for receipt in loop.applied] == [40000]  # sent at 2 s, again at 7 s, there at 8 s
    assert len(loop.windows) == 1
    sent = [m.sent for m in loop.messages if isinstance(m.message, WindowMessage)]
    assert sent == [1.0, 6.0]


def test_an_update_that_comes_too_late_is_refused():
    loop = cosimulate(short(duration=5.0, twin=TwinSettings(policy="paper", validity=2.5)))
    assert [receipt.reason for receipt in loop.receipts] == [Reason.EXPIRED]
    assert not loop.run.tolerance.any()


def test_an_update_out_of_bounds_is_refused():
    recording = Recording(limits=Limits(maximum=1e-6))
    loop = cosimulate(short(duration=5.0, recording=recording))
    assert [receipt.reason for receipt in loop.receipts] == [Reason.OUT_OF_BOUNDS]
    assert not loop.run.tolerance.any()


def test_the_twins_processing_delays_the_update_alone():
    loop = cosimulate(short(duration=5.0, twin=TwinSettings(policy="paper", processing=0.5)))
    sent = {type(m.message): m.sent for m in loop.messages if m.direction == "down"}
    assert sent == {Acknowledge: 2.0, Update: 2.5, LetterAcknowledge: 4.5}
    assert loop.receipts[0].sample == 17500


def test_jitter_lands_on_the_next_sample():
    loop = cosimulate(short(duration=6.0, uplink=LinkSettings(delay_s=0.7, jitter_s=0.5), seed=3))
    update = next(m for m in loop.messages if isinstance(m.message, Update))
    assert loop.receipts[0].sample == math.ceil(update.arrival * 5000.0)


def test_a_pre_trigger_records_what_came_before_the_step():
    loop = cosimulate(short(recording=Recording(window=2.0, pre_trigger=0.3)))
    assert [window.start for window in loop.windows] == [0.0, 4.7]
    assert loop.windows[1].reference_changes == ((5.0, -1e-3),)


def test_every_message_is_bytes_that_decode():
    loop = cosimulate(short())
    assert all(m.fate in (Fate.DELIVERED, Fate.IN_FLIGHT) for m in loop.messages)
    assert not any(isinstance(m.message, Hello) for m in loop.messages)
    window = loop.windows[0]
    assert sum(window.channel(name).samples for name in ("theta_m", "position")) == 10_000
    assert [m.message for m in loop.messages if isinstance(m.message, WindowMessage)] == list(loop.windows)


def test_progress_rises_to_one_in_few_blocks():
    shares = []
    cosimulate(short(), progress=shares.append)
    assert shares == sorted(shares)
    assert shares[-1] == 1.0
    assert 9 <= len(shares) < 50


@pytest.mark.slow
def test_quantisation_to_int16_moves_the_estimate_by_less_than_a_thousandth_of_a_degree():
    found = quantisation(fig15())
    assert len(found) == 10
    assert 0.0 < max(abs(q.gap_change) for q in found) < math.radians(1e-3)
    assert max(q.position_step for q in found) < 0.1e-6
    assert max(q.theta_m_step for q in found) < math.radians(0.011)


@pytest.mark.slow
def test_fig_15_with_the_gap_known_exactly():
    scenario = Scenario.preset("fig15")
    loop = cosimulate(scenario, estimator=known_gap(scenario.gap, scenario.duration))
    steps = steps_of(loop)
    assert [receipt.sample for receipt in loop.applied] == [5000 * (20 * k + 3) for k in range(10)]
    assert steps[0].amplitude == pytest.approx(0.009e-3, abs=0.0005e-3)
    assert steps[1].amplitude == pytest.approx(0.041e-3, abs=0.0005e-3)
    assert max(step.amplitude for step in steps[2:]) < 0.001e-3
    assert max(abs(step.bias) for step in steps if step.settled) == pytest.approx(0.072e-3, abs=0.0005e-3)


def test_fig_15_with_the_papers_own_estimates():
    loop = fig15()
    errors = [math.degrees(e.gap - float(loop.run.gap[round(e.time * 5000)])) for e in loop.estimates]
    assert all(estimate.ok for estimate in loop.estimates)
    assert max(map(abs, errors)) < 0.5
    assert -0.35 < np.mean(errors[2:]) < -0.25  # erratum E8: what the observer has not forgotten at 0.25 s
    settled = [step.settled for step in steps_of(loop)]
    assert not settled[1]
    # The others hang on 0.001 deg of an estimate (erratum E17): over 20 amplitudes within 1 %, at most one more moves.
    assert sum(settled) >= 8


@pytest.mark.slow
def test_fig_16_survives_its_noise():
    loop = cosimulate(Scenario.preset("fig16"))
    errors = [math.degrees(e.gap - float(loop.run.gap[round(e.time * 5000)])) for e in loop.estimates]
    assert all(estimate.ok for estimate in loop.estimates)
    assert max(map(abs, errors)) < 1.0
    assert max(step.amplitude for step in steps_of(loop)) < 0.15e-3
