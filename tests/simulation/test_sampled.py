"""The sampled loop: against an interpreted one on a plant of its own, the continuous loop, and its invariants."""

import numpy as np
import pytest
from held_plant import HeldPlant
from paper_loop import MOTOR, SCREW, Array

from servotwin.control import law
from servotwin.control.controller import Controller
from servotwin.errors import InvalidInput
from servotwin.estimation.gap import estimate_gap
from servotwin.estimation.window import Window
from servotwin.hybrid.crossing import is_leaving
from servotwin.plant.noise import Noise
from servotwin.plant.servo import Servo
from servotwin.plant.signals import PiecewiseCubic, SCurve, SquareWave, as_pieces
from servotwin.simulation import Run, Simulation, simulate
from servotwin.simulation.sampled import SampledEngine

DEGREE = np.pi / 180.0
PAPER = Servo.preset("paper")


LAWS = {
    "plain": PAPER.controller,
    "hysteresis": PAPER.controller.replace(enter=0.6, leave=1.4),
    "limits": PAPER.controller.replace(voltage_limit=1.5, rate_limit=20.0, loop_filter_hz=40.0, tracking_time=0.05),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", LAWS)
def test_against_an_interpreted_loop(name: str) -> None:
    """The edge's tick on plain floats, with noise and a coarse sensor, and an exact plant that shares no code."""
    servo, rate, count = PAPER.replace(position_resolution=1e-6), 1000.0, 700
    controller = LAWS[name].replace(sample_rate=rate)
    gap, wear, tolerance = 2.0 * DEGREE, 1.0 * DEGREE, servo.tolerance_for(1.5 * DEGREE)
    noise = Noise(std=2e-6)
    drawn = noise.source(rate, np.random.default_rng(5)).block(count)
    plant, parameters, state = HeldPlant(servo, gap, wear, 1.0 / rate), controller.law(tolerance), law.start(0.0)
    last, rows = plant.loop.last, []
    for k in range(count):
        measured = round((plant.state[last] + drawn[k]) / 1e-6) * 1e-6
        reference = 1e-3 if k < 400 else -0.5e-3
        state = law.tick(parameters, state, reference, float(measured))
        rows.append((plant.state[last], plant.state[MOTOR], plant.state[SCREW], state.voltage, measured))
        plant.step(state.voltage)
    position, motor, screw, voltage, measured = np.array(rows).T
    run = simulate(
        servo,
        0.7,
        controller=controller,
        reference=PiecewiseCubic.zero_order_hold([0.0, 0.4], [1e-3, -0.5e-3]),
        gap=PiecewiseCubic([0.0], [[gap, wear, 0.0, 0.0]]),
        tolerance=tolerance,
        sample_rate=rate,
        noise=noise,
        seed=5,
    )
    assert plant.contacts >= 2
    for found, expected in (
        (run.position, position),
        (run.theta_m, motor),
        (run.theta_d, screw),
        (run.voltage, voltage),
        (run.measured_position, measured),
    ):
        assert np.abs(found[:-1] - expected).max() < 1e-11 * np.abs(expected).max()
    assert np.count_nonzero(run.events.kind == "contact") == plant.contacts


@pytest.mark.parametrize("name", LAWS)
def test_the_compiled_tick_gives_the_edge_s_bits(name: str) -> None:
    """Inside the compiled loop too: the interpreted law, fed with what was measured there, gives the same voltages."""
    controller, tolerance = LAWS[name].replace(sample_rate=5e3), PAPER.tolerance_for(1.5 * DEGREE)
    options = {"reference": SquareWave(1e-3, 2.0), "gap": 3.0 * DEGREE, "tolerance": tolerance}
    run = simulate(PAPER, 4.0, controller=controller, noise=Noise(std=1e-5), **options)
    parameters, state, voltages = controller.law(tolerance), law.start(0.0), []
    for reference, measured in zip(run.reference.tolist(), run.measured_position.tolist(), strict=True):
        state = law.tick(parameters, state, reference, measured)
        voltages.append(state.voltage)
    assert np.array_equal(run.voltage, voltages)
    assert len(np.unique(run.voltage)) > 1000


def sampled(rate: float, duration: float = 0.8, sample_rate: float = 1000.0, **options: object) -> Run:
    servo = options.pop("servo", PAPER)
    controller = options.pop("controller", servo.controller).replace(sample_rate=rate)
    return simulate(servo, duration, controller=controller, sample_rate=sample_rate, **options)


def slopes(errors: list[float]) -> Array:
    """By what power of two the error falls from one to the next."""
    return np.log2(np.array(errors[:-1]) / errors[1:])


def test_converges_to_the_continuous_loop() -> None:
    """As O(h): the hold delays the voltage by half a tick."""
    options = {"reference": SCurve(0.0, 1e-3, 0.5), "gap": 1.0 * DEGREE}
    exact = simulate(PAPER, 0.8, sample_rate=1000.0, **options).position
    errors = [np.abs(sampled(rate, **options).position - exact).max() for rate in (1e3, 2e3, 4e3, 8e3, 16e3)]
    assert np.all(np.abs(slopes(errors) - 1.0) < 0.05), errors


def test_saturated_loops_agree() -> None:
    """Continuous saturation with back-calculation is what a fast saturated tick does."""
    controller = PAPER.controller.replace(voltage_limit=1.0, tracking_time=0.08)
    options = {"controller": controller, "reference": 1e-3, "gap": 1.0 * DEGREE}
    exact = simulate(PAPER, 0.8, sample_rate=1000.0, **options)
    assert np.abs(exact.voltage).max() <= 1.0 + 1e-12
    assert np.count_nonzero(exact.events.kind == "saturate") >= 2
    assert 100 < np.count_nonzero(np.isclose(np.abs(exact.voltage), 1.0, rtol=1e-12)) < 700
    errors = [np.abs(sampled(rate, **options).position - exact.position).max() for rate in (4e3, 16e3, 64e3)]
    assert np.all(np.abs(slopes(errors) - 2.0) < 0.05), errors  # the rate grows fourfold


@pytest.mark.parametrize("limit", [0.5, 2.0])
def test_limits_are_kept(limit: float) -> None:
    controller = PAPER.controller.replace(voltage_limit=limit, rate_limit=20.0)
    run = sampled(5e3, 2.0, 5e3, controller=controller, reference=SquareWave(1e-3, 0.7), gap=3.0 * DEGREE)
    assert np.abs(run.voltage).max() <= limit
    steps = np.abs(np.diff(run.voltage, prepend=0.0))
    assert steps.max() <= 20.0 / 5e3 * (1.0 + 1e-12)
    assert np.count_nonzero(steps > 20.0 / 5e3 * (1.0 - 1e-9)) > 10


def test_anti_windup_shortens_the_overshoot() -> None:
    def peak(tracking: float) -> float:
        controller = PAPER.controller.replace(voltage_limit=1.0, tracking_time=tracking)
        return float(sampled(5e3, 6.0, controller=controller, reference=5e-3).position.max())

    assert peak(0.05) < 5.5e-3
    assert peak(1e6) > 9e-3


COMMON = {"reference": SquareWave(1e-3, 0.5), "gap": 4.0 * DEGREE, "tolerance": PAPER.tolerance_for(2.0 * DEGREE)}


def test_recording_does_not_touch_the_loop() -> None:
    """1 kHz ticks recorded at 1 and 5 kHz, 5 kHz ticks recorded at 5 and 1 kHz."""
    for tick in (1e3, 5e3):
        fine, coarse = sampled(tick, 1.0, 5e3, **COMMON), sampled(tick, 1.0, 1e3, **COMMON)
        for name in ("position", "theta_m", "theta_d", "voltage", "measured_position", "reference", "time"):
            a, b = getattr(fine, name)[::5], getattr(coarse, name)
            assert np.abs(a - b).max() <= 1e-12 * np.abs(b).max(), (tick, name)


def test_between_ticks_the_voltage_is_held_and_the_sensor_reads_on() -> None:
    run = sampled(1e3, 1.0, 5e3, **COMMON)
    groups = run.voltage[:-1].reshape(-1, 5)
    assert np.all(groups == groups[:, :1])
    assert np.array_equal(run.measured_position, run.position)
    assert not np.all(np.diff(run.position[:-1].reshape(-1, 5)) == 0.0)


@pytest.mark.parametrize("noise", [Noise(std=5e-5), Noise(std=5e-5, kind="white")])
def test_noise_between_ticks_is_as_large_and_changes_no_motion(noise: Noise) -> None:
    fine, coarse = (sampled(1e3, 4.0, rate, **COMMON, noise=noise, seed=3) for rate in (5e3, 1e3))
    for name in ("position", "voltage", "measured_position"):
        assert getattr(fine, name)[::5] == pytest.approx(getattr(coarse, name), abs=1e-11)
    errors = (fine.measured_position - fine.position)[:-1].reshape(-1, 5)
    assert np.std(errors, axis=0) == pytest.approx(np.full(5, 5e-5), rel=0.1)
    assert np.abs(np.corrcoef(errors[:, :2].T)[0, 1]) < 0.1


@pytest.mark.parametrize("tick", [1e3, 200.0, 100.0])
def test_the_gap_of_a_slow_controller_is_seen_at_every_sample(tick: float) -> None:
    """The default rate of the record is a multiple of the controller's."""
    servo = PAPER.replace(sample_rate=tick)
    run = simulate(servo, 2.0, reference=SquareWave(1e-3, 3.0), gap=np.radians(8.0))
    assert run.sample_rate == 5000.0
    estimate = estimate_gap(Window.from_run(run, 0.0, 1.5), servo)
    assert estimate.ok
    assert estimate.gap == pytest.approx(np.radians(8.0), abs=np.radians(1e-3))


@pytest.mark.parametrize(("tick", "sample"), [(5000.0, 3000.0), (3000.0, 5000.0), (1000.0, 1000.001)])
def test_rates_that_do_not_divide_are_refused(tick: float, sample: float) -> None:
    with pytest.raises(InvalidInput, match=rf"sample_rate = {tick} Hz.*sample_rate = {sample} Hz.*whole multiple"):
        sampled(tick, sample_rate=sample)


def test_noise_is_the_seed_s() -> None:
    noise = Noise(std=5e-5)
    one, same, other = (sampled(1e3, **COMMON, noise=noise, seed=seed) for seed in (3, 3, 4))
    assert np.array_equal(one.position, same.position)
    assert np.array_equal(one.measured_position, same.measured_position)
    assert not np.array_equal(one.measured_position, other.measured_position)
    spread = np.std(one.measured_position - one.position)
    assert 0.8 * 5e-5 < spread < 1.2 * 5e-5


def test_cutting_a_run_changes_no_bit() -> None:
    worn = PiecewiseCubic([0.0, 0.3003, 0.45], [[0.05, 0.1, 0.0, 0.0], [0.02, 0.0, 0.0, 0.0], [0.09, 0.0, 1.0, 0.0]])
    options = COMMON | {"gap": worn, "controller": PAPER.controller.replace(sample_rate=5e3), "noise": Noise(std=1e-6)}
    whole, cut = (Simulation(PAPER, 1.0, **options) for _ in range(2))
    whole.advance(5000)
    for index in (1, 2, 777, 1500, 1501, 1502, 2250, 2251, 4999, 5000):
        cut.advance(index)
        assert cut.index == index
    for name in ("position", "theta_m", "theta_d", "voltage", "measured_position"):
        assert np.array_equal(getattr(whole.run(), name), getattr(cut.run(), name)), name
    assert np.array_equal(whole.run().events, cut.run().events)


def test_noise_drawn_ahead_is_the_same_noise() -> None:
    """A long run draws it chunk by chunk beside the ticks, a run in short pieces when it is due."""
    options = COMMON | {"controller": PAPER.controller.replace(sample_rate=5e3), "noise": Noise(std=1e-6), "seed": 7}
    whole, cut = (Simulation(PAPER, 15.0, **options) for _ in range(2))
    whole.advance(75_000)
    for index in range(2500, 75_001, 2500):
        cut.advance(index)
    for name in ("position", "voltage", "measured_position"):
        assert np.array_equal(getattr(whole.run(), name), getattr(cut.run(), name)), name


def test_sensors_give_whole_counts() -> None:
    servo = PAPER.replace(position_resolution=2e-6, encoder_resolution=2.0 * np.pi / 4096)
    run = sampled(5e3, servo=servo, **COMMON, noise=Noise(std=1e-5))
    for values, count in ((run.measured("position"), 2e-6), (run.measured("theta_m"), 2.0 * np.pi / 4096)):
        assert np.abs(values / count - np.round(values / count)).max() < 1e-9
        assert len(np.unique(np.round(values / count))) > 10
    assert np.abs(run.measured("theta_m") - run.theta_m).max() <= np.pi / 4096 * (1.0 + 1e-12)


def knotted() -> dict[str, PiecewiseCubic]:
    """Gaps whose cubic changes inside and at the end of samples of 1 ms."""
    ramp = SCurve(1.0 * DEGREE, 6.0 * DEGREE, 0.31237, 0.2)
    return {
        "ramp that ends inside a sample": as_pieces(ramp, 1.0),
        "ramp that ends with one": as_pieces(SCurve(6.0 * DEGREE, 1.0 * DEGREE, 0.3, 0.2), 1.0),
        "jumps": PiecewiseCubic.zero_order_hold([0.0, 0.15, 0.30042, 0.5], np.array([3.0, 6.0, 0.5, 4.0]) * DEGREE),
        "closes": PiecewiseCubic.zero_order_hold([0.0, 0.25, 0.6], np.array([3.0, 0.0, 2.0]) * DEGREE),
        "many in one sample": PiecewiseCubic.zero_order_hold(
            [0.0, *(0.4 + np.arange(1, 9) * 1.1e-4)], np.array([3, 1, 2, 1, 2, 1, 2, 1, 2.0]) * DEGREE
        ),
    }


@pytest.mark.parametrize("name", knotted())
@pytest.mark.parametrize("rate", [None, 1e3, 5e3])
def test_the_screw_stays_in_the_gap(name: str, rate: float | None) -> None:
    gap = knotted()[name]
    controller = PAPER.controller.replace(sample_rate=rate)
    options = {"controller": controller, "reference": SquareWave(1e-3, 0.4), "sample_rate": 1e3}
    run = simulate(PAPER, 1.0, gap=gap, theta_d0=0.01, **options)
    beyond = np.abs(run.theta_m - run.theta_d) - 0.5 * run.gap
    assert beyond.max() < 1e-13 * max(1.0, np.abs(run.theta_m).max()), name
    assert np.count_nonzero(beyond > -1e-12) > 100


@pytest.mark.parametrize("name", knotted())
def test_worn_gaps_sampled_fast_are_nearly_continuous(name: str) -> None:
    options = {"reference": SquareWave(1e-3, 0.4), "gap": knotted()[name], "theta_d0": 0.01}
    exact = simulate(PAPER, 1.0, sample_rate=1e3, **options).position
    errors = [np.abs(sampled(rate, 1.0, **options).position - exact).max() for rate in (8e3, 32e3)]
    assert errors[1] < 5e-6
    assert 2.5 < errors[0] / errors[1] < 6.0


RESTING_LAW = PAPER.controller.replace(sample_rate=1e3)


@pytest.mark.parametrize("controller", [PAPER.controller, RESTING_LAW])
def test_a_gap_moves_a_screw_at_rest_only_by_closing(controller: Controller) -> None:
    """Erratum E4: loop open, motor at rest: the screw is where the narrowest gap so far has pushed it."""
    wide, start = 10.0 * DEGREE, 4.0 * DEGREE
    pieces = [[wide, 0.0, 0.0, 0.0], [wide, -wide, 0.0, 0.0], [0.4 * wide, wide, 0.0, 0.0], [0.5 * wide, 0, 0, 0]]
    gap = PiecewiseCubic([0.0, 0.1, 0.7, 1.2], pieces)
    run = simulate(PAPER, 2.0, controller=controller, gap=gap, tolerance=1.0, theta_d0=start, sample_rate=1e3)
    assert np.all(run.theta_m == 0.0)
    assert np.all(run.voltage == 0.0)
    narrowest = np.minimum.accumulate(run.gap)
    narrowest = np.where(run.time > 0.7, 0.4 * wide, narrowest)
    assert np.abs(run.theta_d - np.minimum(start, 0.5 * narrowest)).max() < 1e-14
    assert np.all(np.diff(run.theta_d) <= 0.0)


def test_a_free_structure_only_loses_energy() -> None:
    """Struck by a gap that jumps shut, with the motor at rest: kinetic and elastic energy fall from then on."""
    gap = PiecewiseCubic.zero_order_hold([0.0, 0.1], [10.0 * DEGREE, 2.0 * DEGREE])
    run = simulate(PAPER, 2.0, gap=gap, tolerance=1.0, theta_d0=5.0 * DEGREE, sample_rate=5e3)
    q, m, k = run.q, PAPER.masses, PAPER.stiffnesses
    speeds = np.gradient(q, 1.0 / 5e3, axis=0)
    energy = 0.5 * (speeds**2 @ m) + 0.5 * (np.diff(q, axis=1, prepend=0.0) ** 2 @ k)
    late = energy[510:-5]
    assert np.all(np.diff(late) < 1e-4 * late[0])
    assert late[-1] - late.min() < 1e-3 * late[0]
    assert late[0] > 1.5 * late[-1]


@pytest.mark.parametrize("controller", [PAPER.controller, PAPER.controller.replace(sample_rate=5e3)])
def test_setting_the_tolerance_is_planning_it(controller: Controller) -> None:
    first, second = PAPER.tolerance_for(1.0 * DEGREE), PAPER.tolerance_for(8.0 * DEGREE)
    options = {"controller": controller, "reference": SquareWave(1e-3, 1.0), "gap": 5.0 * DEGREE}
    planned = simulate(PAPER, 2.0, tolerance=PiecewiseCubic.zero_order_hold([0.0, 0.7312], [first, second]), **options)
    live = Simulation(PAPER, 2.0, tolerance=first, **options)
    live.advance(3656)
    live.set_tolerance(second)
    live.advance(10_000)
    assert np.abs(planned.position - live.run().position).max() < 1e-14
    assert np.array_equal(planned.tolerance, live.run().tolerance)
    assert list(planned.events.kind) == list(live.run().events.kind)


def test_the_first_and_the_last_tick_are_taken() -> None:
    run = sampled(1e3, 0.1, 1e3, reference=1e-3, gap=1.0 * DEGREE)
    first = law.tick(PAPER.controller.replace(sample_rate=1e3).law(None), law.start(0.0), 1e-3, 0.0)
    assert run.voltage[0] == first.voltage != 0.0
    longer = sampled(1e3, 0.2, 1e3, reference=1e-3, gap=1.0 * DEGREE)
    assert run.voltage[-1] == longer.voltage[100]


def test_dead_zone_events_of_the_ticks() -> None:
    """They alternate; what a jump of the reference between two ticks sets off is not the state's doing."""
    reference = PiecewiseCubic.zero_order_hold([0.0, 0.50037, 3.0], [0.0, 1e-3, -1e-3])
    run = sampled(1e3, 4.0, reference=reference, gap=3.0 * DEGREE, tolerance=PAPER.tolerance_for(4.0 * DEGREE))
    zone = run.events[np.isin(run.events.kind, ["enter", "leave"])]
    assert list(zone.kind[:2]) == ["leave", "enter"]
    assert all(a != b for a, b in zip(zone.kind, zone.kind[1:], strict=False))
    assert zone.time[0] == 0.501
    assert set(zone.time[~zone.state_triggered]) - {3.0} == {0.501}
    assert np.count_nonzero(zone.state_triggered) >= 3
    assert len(simulate(PAPER, 0.1, controller=PAPER.controller.replace(sample_rate=1e3), tolerance=1.0).events) == 0


def test_a_machine_at_rest_on_a_flank_stays_there() -> None:
    """Speed and acceleration are rounding; both the flank and the gap were once left at once, for ever."""
    controller = PAPER.controller.replace(sample_rate=1000.0)
    engine = Simulation(
        PAPER, 1.0, controller=controller, gap=26.0 * DEGREE, input_bias=0.05, sample_rate=1000.0
    ).engine
    assert isinstance(engine, SampledEngine)
    at_rest = [
        8.9388262268245e-16, -3.238578447934892e-14, -3.368443595238671, -3.141550792479408, -0.0009999866751965955,
        -0.0009999866751977627, -1.0130608536309195e-14, -1.5446491372043975e-14, -0.049999999999965204,
        0.4537856055185257, 0.05, 0.0,
    ]  # fmt: skip
    leaving = {
        (mode.name, guard.side): is_leaving(engine.tables, m, g, np.array(at_rest), 1.0, engine.scratch.series)
        for m, mode in enumerate(engine.plant.automaton.modes)
        for g, guard in enumerate(mode.guards)
    }
    assert not (leaving["-/held", -1] and leaving["open/held", -1])
