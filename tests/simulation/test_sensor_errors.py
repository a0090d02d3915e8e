"""Encoders that are late, offset and noisy, in the sampled and the continuous loop."""

from __future__ import annotations

from collections import deque
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import servotwin as st
from servotwin.control import law
from servotwin.control.laws import law_of
from servotwin.control.linear_law import LinearLaw
from servotwin.control.linear_tick import linear_tick
from servotwin.errors import InvalidInput
from servotwin.plant.linear import zero_order_hold
from servotwin.redesign.certified.margins import nominal_margins, plant_set
from servotwin.redesign.certified.uncertainty import Uncertainty
from servotwin.simulation.endless import FOREVER, OpenLoopPlant, UnboundedSimulation
from servotwin.simulation.inputs import quantised
from servotwin.simulation.sampled_ensemble import SampledCases, simulate_sampled
from servotwin.simulation.simulate import Simulation

RATE, SAMPLES = 1000.0, 600


def drive(controller: str, **sensors: Any) -> st.Axis:
    """A torque drive that moves a damped slide through a screw, without gap, friction or limit."""
    axis = st.Axis.loads(
        f"""
[actuator]
kind = "torque"
inertia_kg_m2 = 2e-4
current_loop_time_s = 8e-4
viscous_friction_n_m_s_per_rad = 1e-3
[transmission]
kind = "screw"
lead_mm_per_rev = 10.0
stiffness_n_per_m = 2e6
damping_n_s_per_m = 900.0
in_gap = "free"
[load]
kind = "linear"
mass_kg = 12.0
damping_n_s_per_m = 200.0
[controller]
{controller}
sample_rate_hz = {RATE}
""",
        "drive.toml",
    )
    return axis.replace(sensors=st.Sensors(**sensors))


PID = "kp_n_m_per_m = 40.0\nki_n_m_per_m_s = 60.0\nkd_n_m_s_per_m = 2.0\nfilter_time_s = 2e-3"
CASCADE = 'kind = "cascade"\nposition_gain_per_s = 12.0\nvelocity_gain_n_m_s_per_rad = 0.03\nintegral_time_s = 0.1'
LATE = {"position_delay": 3e-3, "encoder_delay": 1e-3}


def stepped(axis: st.Axis, reference: float) -> tuple[np.ndarray, np.ndarray]:
    """Positions and commands tick by tick: matrices of the plant, the edge's tick, and readings that wait in lines."""
    motor, load = axis.plants()
    advance, hold = zero_order_hold(load.A, load.B, 1.0 / RATE)
    running, x = law_of(axis.controller), np.zeros(load.B.size)
    readings = [deque([0.0] * encoder.late(RATE)) for encoder in (axis.sensors.motor, axis.sensors.load)]
    linear = isinstance(running, LinearLaw)
    parameters = running.parameters() if linear else running.law(None)
    state: Any = running.start(0.0, 0.0) if linear else law.start(0.0)
    positions, commands = [], []
    for _ in range(SAMPLES + 1):
        for line, row in zip(readings, (motor.C, load.C), strict=True):
            line.append(float(row @ x))
        y_motor, y_load = (line.popleft() for line in readings)
        if linear:
            state = linear_tick(parameters, state, reference, y_motor, y_load)
        else:
            state = law.tick(parameters, state, reference, y_load)
        command = state.command if linear else state.voltage
        positions.append(float(load.C @ x))
        commands.append(command)
        x = advance @ x + hold * command
    return np.array(positions), np.array(commands)


@pytest.mark.parametrize("controller", [PID, CASCADE])
def test_a_loop_with_late_encoders_is_that_of_its_matrices(controller: str) -> None:
    axis = drive(controller, **LATE)
    run = st.simulate(axis, SAMPLES / RATE, reference=1e-3, sample_rate=RATE)
    positions, commands = stepped(axis, 1e-3)
    assert run.position == pytest.approx(positions, abs=1e-12)
    assert run.voltage == pytest.approx(commands, abs=1e-9)
    prompt = st.simulate(drive(controller), SAMPLES / RATE, reference=1e-3, sample_rate=RATE)
    assert np.abs(run.position - prompt.position).max() > 1e-5


@pytest.mark.parametrize("controller", [PID, CASCADE])
def test_late_encoders_show_what_was(controller: str) -> None:
    run = st.simulate(drive(controller, **LATE), SAMPLES / RATE, reference=1e-3, sample_rate=RATE)
    assert np.array_equal(run.measured("position")[3:], run.position[:-3])
    assert np.array_equal(run.measured("theta_m")[1:], run.theta_m[:-1])


@pytest.mark.parametrize("controller", [PID, CASCADE])
def test_an_offset_of_the_loads_encoder_moves_the_load(controller: str) -> None:
    axis = drive(controller, position_offset=2e-4, encoder_offset=0.3)
    run = st.simulate(axis, 6.0, reference=1e-3, sample_rate=RATE)
    assert run.measured("position") - run.position == pytest.approx(2e-4)
    assert run.measured("theta_m") - run.theta_m == pytest.approx(0.3)
    assert run.position[-1] == pytest.approx(8e-4, abs=1e-6)


def test_noise_is_white_and_of_the_stated_size_before_counts() -> None:
    axis = drive(CASCADE, position_noise=2e-6, encoder_noise=1e-3, position_resolution=1e-6, encoder_resolution=1e-3)
    run = st.simulate(axis, 20.0, reference=0.0, sample_rate=RATE, seed=3)
    for name, true, std, count in (
        ("position", run.position, 2e-6, 1e-6),
        ("theta_m", run.theta_m, 1e-3, 1e-3),
    ):
        noise = run.measured(name) - true
        size = float(np.hypot(std, count / np.sqrt(12.0)))
        assert float(np.std(noise)) == pytest.approx(size, rel=0.03)
        correlations = [float(np.mean(noise[k:] * noise[:-k])) / size**2 for k in (1, 2, 7)]
        assert np.abs(correlations).max() < 0.03
        assert np.allclose(run.measured(name) / count, np.round(run.measured(name) / count), atol=1e-6)
    # The cascade acted on it.
    assert float(np.std(run.voltage)) > 0.0


def test_a_noisy_run_is_the_same_in_pieces() -> None:
    axis = drive(CASCADE, position_noise=2e-6, encoder_noise=1e-3, position_delay=2e-3, encoder_delay=1e-3)
    run = st.simulate(axis, 1.0, reference=1e-3, sample_rate=RATE, seed=5)
    pieces = Simulation(axis, 1.0, reference=1e-3, sample_rate=RATE, seed=5)
    for index in (1, 2, 77, 600, 1000):
        pieces.advance(index)
    for name in ("position", "theta_m", "voltage"):
        assert np.array_equal(pieces.measured(name, 0, 1001), run.measured(name))
    few = Simulation(axis, 1.0, reference=1e-3, sample_rate=RATE, seed=5, keep=200)
    few.advance(1000)
    for name in ("position", "theta_m"):
        assert np.array_equal(few.measured(name, 850, 1001), run.measured(name)[850:])


FINE = 5  # samples of the record per tick


@pytest.mark.parametrize("feedback", ["load", "motor"])
@pytest.mark.parametrize("controller", [PID, CASCADE])
def test_between_two_ticks_an_encoder_reads_what_it_sees_then(controller: str, feedback: str) -> None:
    if feedback == "motor" and controller == CASCADE:
        controller += '\non = "motor"'
    sensors = {"position_noise": 2e-6, "encoder_noise": 1e-3, "position_resolution": 1e-6, "feedback": feedback}
    axis = drive(controller, **LATE, position_offset=1e-4, encoder_offset=0.1, **sensors)
    run = st.simulate(axis, 1.0, reference=1e-3, sample_rate=FINE * RATE, seed=5)
    read, late, offset = run.measured("position"), 3 * FINE, 1e-4
    if feedback == "motor":
        assert read == pytest.approx(axis.p * run.measured("theta_m"), abs=1e-15)
        late, offset = FINE, 0.1 * axis.p
    sensed = run.position if feedback == "load" else axis.p * run.theta_m
    errors = (read[late:] - sensed[:-late] - offset)[: 900 * FINE].reshape(-1, FINE)
    size = np.hypot(2e-6, 1e-6 / np.sqrt(12.0)) if feedback == "load" else 1e-3 * axis.p
    assert np.std(errors, axis=0) == pytest.approx(np.full(FINE, size), rel=0.1)
    assert np.abs(np.corrcoef(errors.T) - np.eye(FINE)).max() < 0.15


@pytest.mark.parametrize("noise", [None, st.Noise(1e-5, kind="white")])
def test_readings_between_ticks_are_the_same_in_pieces(noise: st.Noise | None) -> None:
    axis = drive(CASCADE, **LATE, position_noise=2e-6, position_resolution=1e-6)
    options: dict[str, Any] = {"reference": 1e-3, "sample_rate": FINE * RATE, "seed": 5, "noise": noise}
    whole = st.simulate(axis, 1.0, **options).measured("position")
    pieces, few = Simulation(axis, 1.0, **options), Simulation(axis, 1.0, **options, keep=203)
    for index in (1, 3, 78, 601, 604, 2999, 3003):
        pieces.advance(index)
        few.advance(index)
        assert np.array_equal(pieces.measured("position", 0, index), whole[:index])
        first = max(index - 203, 0)
        assert np.array_equal(few.measured("position", first, index), whole[first:index])
        # The present sample, unless its tick draws a noise that is still to come.
        if noise is None or index % FINE:
            assert few.measured("position", index, index + 1)[0] == whole[index]


def test_the_law_gets_what_is_recorded() -> None:
    """The cascade, ticked by hand on the recorded readings, gives the recorded commands."""
    axis = drive(CASCADE, position_noise=2e-6, encoder_noise=1e-3, position_delay=2e-3, encoder_delay=1e-3)
    run = st.simulate(axis, 1.0, reference=1e-3, sample_rate=RATE, seed=5)
    running = law_of(axis.controller)
    assert isinstance(running, LinearLaw)
    y_motor, y_load = run.measured("theta_m"), run.measured("position")
    state, commands = running.start(float(y_motor[0]), float(y_load[0])), []
    for readings in zip(y_motor.tolist(), y_load.tolist(), strict=True):
        state = linear_tick(running.parameters(), state, 1e-3, *readings)
        commands.append(state.command)
    assert np.array_equal(np.array(commands), run.voltage)


def test_noise_that_is_given_takes_the_place_of_the_encoders() -> None:
    noise = st.Noise(1e-5, kind="white")
    noisy = st.simulate(drive(PID, position_noise=5e-5), 2.0, sample_rate=RATE, noise=noise, seed=1)
    assert float(np.std(noisy.measured("position") - noisy.position)) == pytest.approx(1e-5, rel=0.1)


def test_a_loop_on_the_motors_encoder_measures_with_its_noise() -> None:
    axis = drive(PID, encoder_noise=1e-3, encoder_offset=0.02, feedback="motor")
    for each in (axis, axis.replace(sample_rate=None)):
        run = st.simulate(each, 1.0, reference=1e-3, sample_rate=RATE, seed=2)
        assert run.measured("position") == pytest.approx(axis.p * run.measured("theta_m"), abs=1e-15)
        assert float(np.std(run.measured("theta_m") - run.theta_m)) == pytest.approx(1e-3, rel=0.1)


def test_a_change_of_the_controller_acts_on_what_is_read() -> None:
    """A change to the same law goes unnoticed, whatever the readings are off by."""
    for controller in (PID, CASCADE):
        axis = drive(controller, **LATE, position_noise=1e-6, encoder_noise=1e-4, position_offset=1e-4)
        plain = Simulation(axis, 0.5, reference=1e-3, sample_rate=RATE, seed=4, tolerance=0.0)
        changed = Simulation(axis, 0.5, reference=1e-3, sample_rate=RATE, seed=4, tolerance=0.0)
        plain.advance(500)
        changed.advance(200)
        changed.set_controller(axis.controller, 0.0)
        changed.advance(500)
        assert changed.measured("voltage", 0, 501) == pytest.approx(plain.measured("voltage", 0, 501), abs=1e-12)


@pytest.mark.parametrize(
    ("sensors", "words"),
    [
        ({"position_delay": 1.5e-3}, "position_delay = 0.0015 s: must be a whole number of the controller's samples"),
        ({"encoder_noise": -1.0}, "encoder_noise = -1.0 rad: must be a number, at least 0"),
        ({"position_resolution": 1e-6, "position_counts": 10.0}, "give only one of them"),
    ],
)
def test_what_sensors_cannot_be_is_said(sensors: dict[str, float], words: str) -> None:
    with pytest.raises(InvalidInput, match=words):
        drive(CASCADE, **sensors)


def test_continuous_laws_have_no_delay_and_no_noise_of_the_motor() -> None:
    axis = drive(CASCADE, encoder_noise=1e-3)
    with pytest.raises(InvalidInput, match="needs a sample rate"):
        st.simulate(axis, 1.0, controller=replace(axis.controller, sample_rate=None))  # type: ignore[type-var]
    late = drive(PID, position_delay=1e-3)
    with pytest.raises(InvalidInput, match=r"position_delay = 0\.001 s: needs a controller with a sample rate"):
        st.simulate(late, 1.0, controller=late.pidf.replace(sample_rate=None))


def test_counts_of_a_turn_stand_for_the_resolution() -> None:
    assert st.Sensors(encoder_counts=4096.0) == st.Sensors(encoder_resolution=2.0 * np.pi / 4096.0)
    run = st.simulate(drive(PID, encoder_counts=4000.0), 0.2, reference=1e-3, sample_rate=RATE)
    assert np.array_equal(run.measured("theta_m"), quantised(run.theta_m, 2.0 * np.pi / 4000.0))


@pytest.mark.parametrize("controller", [PID, CASCADE])
def test_margins_and_poles_know_the_delays(controller: str) -> None:
    axis = drive(controller, **LATE)
    margins, exact = axis.margins(), Uncertainty(k=0.0, c=0.0, m=0.0, k_T=0.0, k_B=0.0)
    assert margins.stable
    assert plant_set(axis, exact, RATE).margins(axis.controller).Ms[0] == pytest.approx(margins.Ms, rel=1e-6)
    prompt = nominal_margins(drive(controller), axis.controller)
    assert abs(margins.Ms / prompt.Ms - 1.0) > 1e-3
    late = axis.replace(sensors=replace(axis.sensors, position_delay=0.2, encoder_delay=0.02))
    with pytest.raises(InvalidInput, match="unstable"):
        late.check_loop()
    run = st.simulate(late, 3.0, reference=1e-3, sample_rate=RATE)
    assert np.abs(run.position[-500:]).max() > 1.5 * np.abs(run.position[:500]).max()


def test_a_late_sensor_takes_its_time_from_the_phase_margin() -> None:
    (late,) = drive(PID, position_delay=3e-3).margins().gain_crossovers
    (prompt,) = nominal_margins(drive(PID), drive(PID).controller).gain_crossovers
    assert late.omega == pytest.approx(prompt.omega, rel=1e-6)
    assert late.phase_margin == pytest.approx(prompt.phase_margin - 3e-3 * prompt.omega, abs=1e-6)


def test_a_voltage_from_outside_meets_the_same_readings() -> None:
    """As the drive that is simulated beside a deployed edge: sample by sample, the law outside."""
    axis = drive(PID, **LATE, position_noise=2e-6, encoder_noise=1e-3, encoder_offset=0.1)
    run = st.simulate(axis, 0.4, reference=1e-3, sample_rate=RATE, seed=5)
    endless = Simulation(axis, FOREVER, reference=1e-3, sample_rate=RATE, seed=5, keep=64)
    held, state = OpenLoopPlant(UnboundedSimulation(endless, 1e-3)), law.start(float(run.measured("position")[0]))
    seen = []
    while held.index < run.samples - 1:
        reference, *readings = held.sample()
        state = law.tick(axis.pidf.law(None), state, reference, readings[1])
        seen.append((*readings, state.voltage))
        held.hold(state.voltage)
    for values, name in zip(np.array(seen).T, ("theta_m", "position", "voltage"), strict=True):
        assert np.array_equal(values, run.measured(name)[:-1]), name


@pytest.mark.parametrize("controller", [PID, CASCADE])
def test_coarser_samples_are_some_of_the_finer_ones(controller: str) -> None:
    """Also where a reading is late by half a sample."""
    axis = drive(controller, **LATE, position_noise=2e-6, encoder_noise=1e-3, encoder_resolution=1e-4)
    fine = st.simulate(axis, 1.0, reference=1e-3, sample_rate=RATE, seed=5)
    coarse = st.simulate(axis, 1.0, reference=1e-3, sample_rate=RATE / 2.0, seed=5)
    for name in ("theta_m", "position", "voltage"):
        assert np.array_equal(coarse.measured(name), fine.measured(name)[::2])
    few = Simulation(axis, 1.0, reference=1e-3, sample_rate=RATE / 2.0, seed=5, keep=50)
    for index in range(40, 501, 20):
        few.advance(index)
        first = max(0, index - 50)
        assert np.array_equal(few.measured("theta_m", first, index), coarse.measured("theta_m")[first:index])


def test_ensembles_of_late_sensors_are_their_runs() -> None:
    """A filtered PID's, in blocks, so many samples later; a cascade's as it is."""
    for controller, later in ((PID, 3), (CASCADE, 0)):
        axis = drive(controller, **LATE, position_resolution=1e-7)
        cases = SampledCases(reference=[1e-3, 2e-3], resolution=1e-7)
        made = simulate_sampled(axis, None, 0.5, cases, outputs=("position",), sample_rate=RATE)["position"]
        for size, positions in zip((1e-3, 2e-3), made, strict=True):
            run = st.simulate(axis, 0.5, reference=size, sample_rate=RATE)
            assert positions[later:] == pytest.approx(run.position[: 501 - later], abs=1e-9)
            assert np.ptp(positions) > 0.5 * size


@pytest.mark.parametrize("controller", [PID, CASCADE])
@pytest.mark.parametrize("late", [{}, LATE])
def test_a_machine_that_stands_where_it_is_to_stand_is_not_moved_by_offsets(
    controller: str, late: dict[str, float]
) -> None:
    axis = drive(controller, position_offset=2e-4, encoder_offset=0.3, **late)
    run = st.simulate(axis, 0.2, reference=2e-4, sample_rate=RATE)
    assert np.abs(run.voltage).max() < 1e-12
    assert np.abs(run.position).max() < 1e-15
