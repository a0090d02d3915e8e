"""Cascades on axes: against scipy's integrator, sampled and continuous; margins; what makes no sense."""

import math
from dataclasses import dataclass

import numpy as np
import pytest
from law_oracle import IDLE, ContinuousOracle, HeldOracle, continuous_positions
from test_axis import ELASTIC, TWO_MASS

from servotwin.analysis.limit_cycles.cycle import limit_cycle
from servotwin.control.cascade import Cascade
from servotwin.control.linear_tick import linear_tick
from servotwin.errors import InvalidInput
from servotwin.plant.actuator import TorqueDrive, VelocityDrive
from servotwin.plant.axis import Axis
from servotwin.plant.load import Load
from servotwin.plant.noise import Noise
from servotwin.plant.sensors import Sensors
from servotwin.plant.servo import Servo
from servotwin.plant.signals import PiecewiseCubic, SquareWave
from servotwin.plant.transmission import Transmission
from servotwin.simulation import Simulation, simulate
from servotwin.simulation.ensemble import Cases, simulate_members

P = 1e-3 / math.pi
# Axis with its cascade, amplitude (m or rad) and gap (rad).
AXES = {
    "two masses": (
        TWO_MASS.replace(
            controller=Cascade(
                2.0, 1.0, velocity_gain=30.0, integral_time=0.5, speed_filter=2e-3, velocity_feedforward=0.5,
                acceleration_feedforward=2.0, reference_filter=0.02, voltage_limit=60.0,
            )
        ),
        0.2,
        0.03,
    ),
    "ball screw": (
        Axis(
            TorqueDrive(J=2e-5, lag=1e-3, friction=2e-5),
            ELASTIC,
            Load((20.0,), (0.0,), (60.0,)),
            Cascade(8.0, P, velocity_gain=2e-3, integral_time=0.1, speed_filter=1e-3, on="motor", low_pass_hz=400.0),
        ),
        1e-3,
        0.2,
    ),
    "velocity drive": (
        Axis(
            VelocityDrive(5e-3),
            Transmission(P),
            Load((20.0,)),
            Cascade(6.0, P, velocity_feedforward=0.8, reference_filter=0.01, notch_hz=30.0, voltage_limit=40.0),
        ),
        1e-3,
        0.3,
    ),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("name", AXES)
def test_a_continuous_cascade_agrees_with_an_independent_integrator(name: str) -> None:
    axis, amplitude, gap = AXES[name]
    axis.check_loop()
    run = simulate(axis, 4.0, reference=SquareWave(amplitude, 4.0), gap=gap, sample_rate=100.0)
    oracle = ContinuousOracle(axis, gap, law=axis.controller.linear())
    expected = continuous_positions(oracle, amplitude, 2.0, run.time[:-1])
    assert np.abs(run.position[:-1] - expected).max() < 1e-8 * np.ptp(expected)
    assert oracle.seen >= {"contact"}


@dataclass
class HandWritten:
    """A cascade's tick as a drive computes it: P, PI with back-calculation, speed as a difference of counts."""

    cascade: Cascade
    integral: float = 0.0
    before: float = 0.0
    speed: float = 0.0
    active: bool = True

    def __call__(self, reference: float, y_motor: float, y_load: float, tolerance: float) -> float:
        c = self.cascade
        assert c.velocity_gain is not None
        assert c.integral_time is not None
        assert c.voltage_limit is not None
        assert c.sample_rate is not None
        step, error = 1.0 / c.sample_rate, reference - y_load
        self.active = abs(error) > tolerance
        wanted = c.position_gain * error / c.ratio
        # The difference of two ticks behind a low-pass.
        decay = math.exp(-step / c.speed_filter)
        self.speed = decay * self.speed + (1.0 - decay) * (y_motor - self.before) / step
        self.before = y_motor
        unlimited = c.velocity_gain * (wanted - self.speed) + self.integral
        command = min(max(unlimited, -c.voltage_limit), c.voltage_limit)
        if self.active:
            self.integral += step / c.integral_time * c.velocity_gain * (wanted - self.speed)
            self.integral += step / c.integral_time * (command - unlimited)
        return command


@pytest.mark.slow
def test_a_sampled_cascade_agrees_with_one_written_by_hand() -> None:
    cascade = Cascade(
        2.0, 1.0, velocity_gain=30.0, integral_time=0.5, speed_filter=2e-3, voltage_limit=10.0, sample_rate=200.0
    )
    axis, gap, rate, tolerance, count = TWO_MASS.replace(controller=cascade), 0.03, 200.0, 0.05, 500
    axis.check_loop()
    oracle, law = HeldOracle(axis.replace(controller=IDLE), gap), HandWritten(cascade)
    x, found, active = oracle.start(), [], []
    for k in range(count):
        y_motor, y_load = oracle.measured(x)
        oracle.held = law(0.2 if k < 400 else -0.1, y_motor, y_load, tolerance)
        found.append((y_load, oracle.held))
        active.append(law.active)
        x, _ = oracle.run(x, k / rate, (k + 1) / rate, np.zeros(0))
    position, command = np.array(found).T
    steps = PiecewiseCubic.zero_order_hold([0.0, 2.0], [0.2, -0.1])
    run = simulate(axis, count / rate, reference=steps, gap=gap, tolerance=tolerance, sample_rate=rate)
    assert np.abs(run.position[:-1] - position).max() < 1e-8 * np.ptp(position)
    assert np.abs(run.voltage[:-1] - command).max() < 1e-8 * np.ptp(command)
    assert {True, False} == set(active)
    assert np.abs(command).max() == 10.0


@pytest.mark.parametrize("name", AXES)
def test_margins_agree_with_python_control(name: str) -> None:
    """The loop cut at the command."""
    control = pytest.importorskip("control")
    axis = AXES[name][0]
    margins, loop = axis.margins(), axis.loop()
    assert margins.stable
    assert axis.closed_loop().response(1e-6) == pytest.approx(1.0, rel=1e-4)
    found = control.stability_margins(loop.to_control(), returnall=True)
    crossovers = np.sort(np.asarray(found[4]))
    assert [each.omega for each in margins.gain_crossovers] == pytest.approx(crossovers, rel=1e-5)
    distance = np.abs(1.0 + loop.response(np.geomspace(1e-2, 1e5, 200_000))).min()
    assert 1.0 / distance == pytest.approx(margins.Ms, rel=1e-6)


def test_sampled_poles_and_margins_tend_to_the_continuous_ones() -> None:
    axis = AXES["two masses"][0]
    exact = axis.margins()
    held = axis.controller.replace(sample_rate=2e4).linear()
    sampled = axis.margins(held)
    assert sampled.stable
    assert sampled.gain_crossovers[0].omega == pytest.approx(exact.gain_crossovers[0].omega, rel=1e-3)
    assert sampled.Ms == pytest.approx(exact.Ms, rel=1e-2)
    with pytest.raises(InvalidInput, match="its loop has no continuous-time system"):
        axis.loop(held)


def test_counts_and_noise_reach_the_law() -> None:
    """The motor's counts and the load's: what was measured is whole counts, with the noise of the load's encoder."""
    axis = AXES["two masses"][0].replace(sensors=Sensors(encoder_resolution=1e-3, position_resolution=2e-4))
    law = axis.controller.replace(sample_rate=500.0)
    options = {"reference": 0.1, "gap": 0.03, "sample_rate": 500.0}
    runs = [simulate(axis, 1.0, controller=law, noise=noise, **options) for noise in (None, Noise(std=1e-3))]
    for run in runs:
        counts = run.measured_position / 2e-4
        assert np.abs(counts - np.round(counts)).max() < 1e-6
    assert np.std(runs[1].measured_position - runs[1].position) == pytest.approx(1e-3, rel=0.2)
    ideal = simulate(axis.replace(sensors=Sensors()), 1.0, controller=law, **options)
    assert 0.0 < np.abs(ideal.position - runs[0].position).max() < 2e-3


def test_the_compiled_loop_gives_the_edge_s_bits() -> None:
    """The interpreted law, fed with what was measured in the compiled loop, gives the same commands."""
    axis, amplitude, gap = AXES["two masses"]
    axis = axis.replace(sensors=Sensors(encoder_resolution=1e-4, position_resolution=2e-5))
    law, tolerance = axis.controller.replace(sample_rate=2e3, voltage_limit=20.0, leave=1.5), 5e-3
    signals = {"reference": SquareWave(amplitude, 2.0), "gap": gap, "tolerance": tolerance, "noise": Noise(std=1e-4)}
    run = simulate(axis, 4.0, controller=law, sample_rate=2e3, **signals)
    parameters, state, commands = law.linear().parameters(tolerance), law.linear().start(0.0, 0.0), []
    measured = (run.reference, run.measured("theta_m"), run.measured_position)
    for row in zip(*(each.tolist() for each in measured), strict=True):
        state = linear_tick(parameters, state, *row)
        commands.append(state.command)
    assert np.array_equal(run.voltage, commands)
    assert {"enter", "leave"} <= set(run.events.kind)
    assert np.abs(run.voltage).max() == 20.0


@pytest.mark.parametrize("sample_rate", [None, 1e3])
def test_a_change_of_gains_in_the_run_does_not_bump(sample_rate: float | None) -> None:
    axis = AXES["two masses"][0]
    first = axis.controller.replace(sample_rate=sample_rate, voltage_limit=None)
    simulation = Simulation(axis, 1.0, first, reference=0.1, gap=0.03, tolerance=0.0, sample_rate=1e3)
    simulation.advance(300)
    simulation.set_controller(first.replace(position_gain=1.0, velocity_gain=20.0), 0.01)
    simulation.advance(1000)
    voltage = simulation.run().voltage
    # The last tick of the old law and the first of the new one differ as two ticks of one law do.
    assert abs(voltage[300] - voltage[299]) < 2.0 * abs(voltage[299] - voltage[298]) + 1e-9


@pytest.mark.parametrize("name", AXES)
def test_a_file_of_an_axis_holds_its_cascade(name: str) -> None:
    axis = AXES[name][0]
    text = axis.dumps()
    assert 'kind = "cascade"' in text
    again = Axis.loads(text, "axis.toml")
    assert again.controller == axis.controller
    assert (again.transmission, again.load, again.actuator) == (axis.transmission, axis.load, axis.actuator)
    if name == "two masses":
        short = "\n".join(line for line in text.splitlines() if not line.startswith("travel"))
        assert Axis.loads(short, "axis.toml").controller == axis.controller
        with pytest.raises(InvalidInput, match="velocity_gain_n_m_s_per_rad"):
            Axis.loads(
                text.replace("velocity_gain_n_m_s_per_rad = 30.0", "velocity_gain_n_m_s_per_rad = -3.0"), "a.toml"
            )


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (
            lambda: Servo.preset("paper").margins(AXES["two masses"][0].controller.linear()),
            "must be a Controller, a filtered PID",
        ),
        (lambda: AXES["two masses"][0].check_loop(Cascade(900.0, 1.0, velocity_gain=30.0)), "is unstable on this axis"),
        (
            lambda: simulate(AXES["two masses"][0].replace(sensors=Sensors(feedback="motor")), 1.0),
            'sensors feedback = "motor": the controller reads y_load, .* or on = "motor" in .controller. of a cascade',
        ),
        (
            lambda: simulate(
                AXES["ball screw"][0], 1.0, controller=AXES["ball screw"][0].controller.replace(sample_rate=1e3),
                noise=Noise(std=1e-6),
            ),
            "noise is on the load's encoder, which the controller does not read",
        ),
        (
            lambda: simulate(AXES["ball screw"][0], 1.0, noise=Noise(std=1e-6)),
            "noise is on the load's encoder, which the controller does not read",
        ),
    ],
)  # fmt: skip
def test_refusals_are_one_sentence(make: object, words: str) -> None:
    with pytest.raises(InvalidInput, match=words):
        make()  # type: ignore[operator]


@pytest.mark.slow
@pytest.mark.parametrize("in_gap", ["free", "held"])
def test_friction_and_gravity_act_under_a_cascade_too(in_gap: str) -> None:
    axis, amplitude, gap = AXES["two masses"]
    elastic = Transmission(1.0, 3300.0, 2.0, "free") if in_gap == "free" else Transmission(1.0, 3300.0)
    load = Load((5.6,), (0.0,), (0.3,), "rotary", friction=1.5, force=0.5)
    axis = axis.replace(transmission=elastic, load=load)
    run = simulate(axis, 2.0, reference=SquareWave(amplitude, 4.0), gap=gap, sample_rate=100.0)
    law = axis.controller.replace(sample_rate=1e5)
    sampled = simulate(axis, 2.0, controller=law, reference=SquareWave(amplitude, 4.0), gap=gap, sample_rate=100.0)
    assert {"stick", "slip"} <= set(run.events.kind)
    assert np.abs(sampled.position - run.position).max() < 2e-4 * amplitude


def test_the_limit_cycle_of_a_cascade_is_where_its_simulation_ends() -> None:
    """Position on the load around a velocity loop with integral action: the gap swings."""
    axis, _, gap = AXES["two masses"]
    law = axis.controller.replace(
        voltage_limit=None, position_gain=4.0, velocity_feedforward=0.0, acceleration_feedforward=0.0
    )
    result = limit_cycle(axis, gap, controller=law, step=0.1)
    assert result.orbit is not None
    run = simulate(axis, 120.0, controller=law, reference=0.1, gap=gap, sample_rate=200.0)
    tail = run.position[-8000:]
    assert 0.5 * np.ptp(tail) == pytest.approx(result.orbit.amplitude, rel=1e-3)
    spectrum = np.abs(np.fft.rfft((tail - tail.mean()) * np.hanning(tail.size)))
    assert np.argmax(spectrum) / 40.0 == pytest.approx(result.orbit.frequency, abs=0.03)
    with pytest.raises(InvalidInput, match=r"controller = Cascade\(.*must be a Controller, a filtered PID"):
        simulate_members(axis, law, 1.0, Cases(0.1, gap))


def test_a_continuous_cascade_is_replaced_within_rounding() -> None:
    """Another structure too: the notch is new, the integral is gone."""
    axis = AXES["two masses"][0]
    first = axis.controller.replace(voltage_limit=None)
    for second in (first.replace(position_gain=1.0, notch_hz=8.0), first.replace(integral_time=None, low_pass_hz=50.0)):
        simulation = Simulation(axis, 1.0, first, reference=0.1, gap=0.03, sample_rate=1e3)
        simulation.advance(300)
        before = simulation.engine.channel("voltage", 300, 301)[0]
        simulation.set_controller(second)
        after = simulation.engine.channel("voltage", 300, 301)[0]
        assert after == pytest.approx(before, abs=1e-12)
        simulation.advance(1000)
        assert np.isfinite(simulation.run().position).all()
