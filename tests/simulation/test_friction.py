"""Coulomb friction on the motor's shaft: closed forms, scipy as an oracle, invariants; stuck on a flank while the gap
changes."""

import itertools
import math

import numpy as np
import pytest
from exploration import examples
from friction_oracle import FrictionOracle
from hypothesis import example, given
from hypothesis import strategies as st
from scipy.linalg import expm
from scipy.optimize import brentq

from benchmarks.policies.machines import machines
from servotwin.hybrid.trajectory import Trajectory
from servotwin.plant.automaton import Shape, continuous_loop, sampled_plant
from servotwin.plant.servo import Servo
from servotwin.plant.signals import PiecewiseCubic, SCurve, SquareWave
from servotwin.redesign.certified.uncertainty import Uncertainty
from servotwin.simulation import Run, Simulation, simulate

PAPER = Servo.preset("paper")
OPEN_LOOP = PAPER.controller.replace(Kp=0.0, Ki=0.0, Kd=0.0)
RATES = [None, 1000.0]
VOLT = PAPER.k_T / PAPER.R  # N m of a stalled motor at 1 V


@examples(25)
@given(speed=st.floats(0.1, 50.0), friction=st.floats(1e-3, 1.0), side=st.sampled_from([-1, 1]))
def test_a_free_motor_stops_where_the_closed_form_says(speed: float, friction: float, side: int) -> None:
    """No voltage, no contact: current and speed are one exponential until the speed is zero; then nothing moves."""
    plant = sampled_plant(PAPER, 0, friction=True)
    index, torque = plant.automaton.index, friction * VOLT
    start = np.zeros(len(plant.automaton.names))
    start[index("speed")], start[index("gap")], start[index("friction")] = side * speed, 1e6, torque
    mode = [m.name for m in plant.automaton.modes].index(f"open/slip {'+' if side > 0 else '-'}/held")
    run = Trajectory(plant.automaton, start, mode, 1e-3)
    run.advance(20_000)
    A, _, E = PAPER.motor()
    motion = np.block([[A, -side * torque * E[:, None]], [np.zeros((1, 4))]])

    def after(time: float) -> np.ndarray:
        return expm(motion * time) @ np.array([0.0, side * speed, 0.0, 1.0])

    events = run.events()
    assert events[0][1:3] == ("stick", side)
    guess = events[0][0]
    assert side * after(0.5 * guess)[1] > 0.0
    stop = brentq(lambda t: after(t)[1], 0.5 * guess, 1.5 * guess, xtol=1e-15)
    assert guess == pytest.approx(stop, rel=1e-11, abs=2e-12)  # it stops a hair beyond zero
    assert [event[1] for event in events] == ["stick"]
    angle = run.sampled(np.eye(len(start))[index("theta_m")])
    assert angle[-1] == pytest.approx(after(stop)[2], rel=1e-11)
    assert np.all(angle[math.ceil(stop / 1e-3) :] == angle[-1])
    assert np.all(run.state[index("speed")] == 0.0)


@pytest.mark.parametrize("rate", RATES)
@pytest.mark.parametrize("side", [1, -1])
def test_the_motor_starts_at_the_friction_s_voltage(rate: float | None, side: int) -> None:
    """Below T_c R / k_T it never moves; above, when the current has risen to T_c / k_T along its exponential."""
    threshold = 0.05

    def run_at(voltage: float) -> Run:
        law = OPEN_LOOP.replace(feedforward=side * voltage, sample_rate=rate)
        return simulate(PAPER, 5.0, controller=law, friction=threshold * VOLT, sample_rate=1000.0)

    below = run_at(threshold * (1.0 - 1e-9))
    assert len(below.events) == 0
    assert np.all(below.theta_m == 0.0)
    for ratio in (1.0 + 1e-6, 1.1, 10.0):
        above = run_at(threshold * ratio)
        slip = above.events[above.events.kind == "slip"]
        assert slip.side.tolist() == [side]
        assert slip.time[0] == pytest.approx(-PAPER.L / PAPER.R * math.log(1.0 - 1.0 / ratio), rel=1e-9)
        assert side * above.theta_m[-1] > 0.0
        final = (above.theta_m[-1] - above.theta_m[-101]) / 0.1
        assert final == pytest.approx(side * threshold * (ratio - 1.0) / PAPER.k_B, rel=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("masses", "stiffness", "ki", "degrees", "growth", "zone", "volts", "bias"),
    [
        (3, math.inf, 18907.6, 10.0, 0.0, None, 0.05, 0.0),
        (3, math.inf, 18907.6, 12.0, 0.8, 4.0, 0.03, 0.02),
        (4, math.inf, 0.0, 12.0, -0.5, 3.0, 0.02, 0.0),
        (2, math.inf, 0.0, 4.0, 0.0, None, 0.08, -0.05),
        (3, math.inf, 200.0, 9.0, -0.5, 6.0, 0.09, 0.02),
        (3, 1e6, 18907.6, 10.0, 0.0, None, 0.05, 0.0),
        (3, 2e5, 18907.6, 12.0, 0.8, 4.0, 0.03, 0.02),
        (4, 5e5, 0.0, 12.0, -0.5, 3.0, 0.02, 0.0),
        (2, 1e6, 0.0, 4.0, 0.0, None, 0.08, -0.05),
        (3, 3e5, 200.0, 9.0, -0.5, 6.0, 0.09, 0.02),
    ],
)
def test_the_closed_loop_agrees_with_scipy(
    masses: int,
    stiffness: float,
    ki: float,
    degrees: float,
    growth: float,
    zone: float | None,
    volts: float,
    bias: float,
) -> None:
    servo = PAPER.replace(n=masses, Ki=ki, k=1.1 * PAPER.k, c=0.8 * PAPER.c, k_d=stiffness)
    gap = math.radians(degrees)
    tolerance = None if zone is None else servo.tolerance_for(math.radians(zone))
    oracle = FrictionOracle(servo, 1e-3, gap, growth * gap, tolerance, volts * VOLT, bias)
    run = simulate(
        servo,
        1.0,
        reference=1e-3,
        gap=PiecewiseCubic([0.0], [[gap, growth * gap, 0.0, 0.0]]),
        tolerance=tolerance,
        friction=volts * VOLT,
        input_bias=bias,
        sample_rate=500.0,
    )
    states = oracle.run(run.time)
    for ours, column in ((run.theta_m, 2), (run.theta_d, 3), (run.position, 3 + oracle.free)):
        assert np.abs(ours - states[:, column]).max() < 1e-9 * np.abs(ours).max()
    of_backlash = ("contact", "release", "hold", "pressed")
    ours = [str(kind) for kind in run.events.kind if kind not in of_backlash]
    assert ours == [name for _, name in oracle.events if name not in of_backlash]
    assert "stick" in run.events.kind


@pytest.mark.parametrize("rate", RATES)
def test_a_stuck_motor_pushes_the_screw_only_while_the_gap_shrinks(rate: float | None) -> None:
    """The screw is the play's, clamped by a gap that breathes around a motor that never turns (errata E3, E4)."""
    widths = np.radians([10.0, 4.0, 10.0, 2.0, 6.0])
    ramps = [[a, 0.0, 3.0 * (b - a), -2.0 * (b - a)] for a, b in itertools.pairwise(widths)]
    gap = PiecewiseCubic([0.0, 1.0, 2.0, 3.0, 4.0], [*ramps, [widths[-1], 0.0, 0.0, 0.0]])
    law = OPEN_LOOP.replace(sample_rate=rate)
    for start in (1.0, -1.0):
        run = simulate(PAPER, 5.0, controller=law, gap=gap, theta_d0=start, friction=0.05 * VOLT, sample_rate=1000.0)
        assert np.all(run.theta_m == 0.0)
        clamped = start * np.minimum.accumulate(0.5 * run.gap)
        assert np.abs(run.theta_d - clamped).max() < 1e-13
        flank = run.events[run.events.kind != "parameter"]
        assert set(flank.side.tolist()) == {-int(start)}
        # At the end of a ramp rounding may lose the contact and find it again.
        assert flank.kind.tolist()[:3] == ["contact", "release", "contact"]


def test_a_stuck_motor_stays_in_contact_with_a_constant_gap() -> None:
    """Pushed to a flank and stopped there by friction, it goes on without another contact."""
    law = PAPER.controller.replace(Ki=200.0)
    run = simulate(PAPER, 60.0, controller=law, reference=1e-3, gap=math.radians(2.0), friction=0.05 * VOLT)
    kinds = run.events.kind.tolist()
    first = kinds.index("stick")
    again = next(k for k in range(first, len(kinds)) if kinds[k] == "slip")
    assert run.events.side[again] == 1 or kinds[again + 1] == "release"


FRICTION_CASES = {
    "degrees": st.floats(0.0, 15.0),
    "volts": st.floats(0.001, 0.1),
    "ki": st.sampled_from([0.0, 200.0, 18907.6]),
    "zone": st.sampled_from([None, 4.0]),
    "rate": st.sampled_from(RATES),
    "wearing": st.booleans(),
}
SCREWS = st.sampled_from([math.inf, 1e6, 2e5])


def options_of(degrees: float, volts: float, ki: float, zone: float | None, rate: float | None, wearing: bool) -> dict:
    gap = math.radians(degrees)
    return {
        "controller": PAPER.controller.replace(Ki=ki, sample_rate=rate),
        "reference": SquareWave(1e-3, 4.0),
        "gap": SCurve(0.0, gap, 6.0) if wearing else gap,
        "tolerance": None if zone is None else PAPER.tolerance_for(math.radians(zone)),
        "friction": volts * VOLT,
        "sample_rate": 1000.0,
    }


@examples(30)
@given(SCREWS, st.fixed_dictionaries(FRICTION_CASES))
def test_stuck_is_stuck_and_slip_has_its_direction(stiffness: float, case: dict) -> None:
    run = simulate(PAPER.replace(k_d=stiffness), 6.0, **options_of(**case))
    changes = run.events[np.isin(run.events.kind, ["stick", "slip"])]
    assert changes.kind[::2].tolist() == ["slip"] * len(changes[::2])
    assert changes.kind[1::2].tolist() == ["stick"] * len(changes[1::2])
    assert np.array_equal(changes.side[0::2][: len(changes) // 2], changes.side[1::2])
    times = np.concatenate([[0.0], changes.time, [np.inf]])
    slack = 1e-12 * np.abs(run.theta_m).max()
    for k, (begin, end) in enumerate(itertools.pairwise(times)):
        moved = np.diff(run.theta_m[(run.time >= begin) & (run.time < end)])
        if k % 2:
            assert np.all(changes.side[k - 1] * moved >= -slack)
        else:
            assert np.all(moved == 0.0)
    assert np.all(np.abs(run.theta_m - run.theta_d) <= 0.5 * run.gap + slack)


@pytest.mark.slow
@examples(6)
@given(**(FRICTION_CASES | {"rate": st.just(None)}))
@example(degrees=9.864783163098648, volts=0.001, ki=18907.6, zone=4.0, rate=None, wearing=False)
def test_torque_and_work(**case: object) -> None:
    """Stuck, the motor's torque is within the friction's; what it works goes into its motion and into friction.

    The work is integrated by Gauss's rule between events, where everything is smooth: the trapezoidal rule on samples
    is off by several tenths of a percent where the current jumps up within its time constant L / R = 83 us.
    """
    simulation = Simulation(PAPER, 6.0, **(options_of(**case) | {"sample_rate": 10_000.0}))
    simulation.advance(simulation.samples - 1)
    run, trajectory = simulation.run(), simulation.engine.trajectory
    names = simulation.engine.loop.automaton.names
    rows = dict(zip(names, np.eye(len(names)), strict=True))
    ends = np.unique(np.concatenate([run.time, [event[0] for event in trajectory.events()]]))
    points, weights = np.polynomial.legendre.leggauss(4)
    half = 0.5 * np.diff(ends)[:, None]
    times = (0.5 * (ends[1:] + ends[:-1])[:, None] + half * points).ravel()
    current, speed = trajectory.at(times, rows["current"]), trajectory.at(times, rows["speed"])
    limit, torque, spans = case["volts"] * VOLT, PAPER.k_T * current, (half * weights).ravel()
    assert np.all(np.abs(torque[speed == 0.0]) <= limit * (1.0 + 1e-9))
    work, lost = np.sum(spans * torque * speed), limit * np.sum(spans * np.abs(speed))
    last = float(trajectory.sampled(rows["speed"])[-1])
    assert work - lost == pytest.approx(0.5 * PAPER.J * last**2, abs=1e-6 * (lost + np.abs(work)))


@examples(15)
@given(factor=st.sampled_from([0.25, 2.0, -1.0]), **FRICTION_CASES)
def test_scaled_and_mirrored(factor: float, **case: object) -> None:
    """Friction is homogeneous with the rest: bit for bit for powers of two, and odd."""
    options = options_of(**case)
    size = abs(factor)
    tolerance, gap = options["tolerance"], options["gap"]
    scaled = options | {
        "reference": SquareWave(factor * 1e-3, 4.0),
        "gap": SCurve(0.0, size * gap.end_value, 6.0) if isinstance(gap, SCurve) else size * gap,
        "tolerance": None if tolerance is None else size * tolerance,
        "friction": size * options["friction"],
    }
    one, other = simulate(PAPER, 6.0, **options), simulate(PAPER, 6.0, **scaled)
    assert np.array_equal(other.position, factor * one.position)
    assert np.array_equal(other.theta_m, factor * one.theta_m)
    assert other.events.kind.tolist() == one.events.kind.tolist()


def test_no_friction_is_the_frictionless_run() -> None:
    options = options_of(8.0, 0.0, 18907.6, 4.0, None, True)
    plain = simulate(PAPER, 6.0, **{name: value for name, value in options.items() if name != "friction"})
    assert np.array_equal(simulate(PAPER, 6.0, **options).position, plain.position)


@examples(15)
@given(**(FRICTION_CASES | {"rate": st.just(None), "volts": st.just(0.0), "wearing": st.just(False)}))
def test_a_member_of_an_ensemble_may_be_without_friction(**case: object) -> None:
    """The automaton with friction's modes and T_c = 0 gives the frictionless run, to what rounding grows to."""
    options = options_of(**case)
    plain = Simulation(PAPER, 6.0, **options)
    other = Simulation(PAPER, 6.0, **(options | {"friction": 1.0}))
    other.engine.trajectory.set({other.engine.loop.automaton.index("friction"): 0.0})
    for each in (plain, other):
        each.advance(each.samples - 1)
    assert np.abs(plain.run().position - other.run().position).max() < 1e-9 * 1e-3


def test_the_sampled_loop_converges_to_the_continuous_one() -> None:
    options = options_of(5.0, 0.04, 200.0, None, None, False)
    exact = simulate(PAPER, 1.5, **options).position
    errors = []
    for rate in (4000.0, 8000.0, 16000.0):
        law = options["controller"].replace(sample_rate=rate)
        errors.append(np.abs(simulate(PAPER, 1.5, **(options | {"controller": law})).position - exact).max())
    assert 1.7 < errors[0] / errors[1] < 2.3
    assert 1.7 < errors[1] / errors[2] < 2.3


def test_modes_and_states() -> None:
    loop = continuous_loop(PAPER, PAPER.controller, Shape(friction=True))
    names = [mode.name for mode in loop.automaton.modes]
    assert len(set(names)) == 27
    assert names[loop.mode("inside")] == "open/stick/inside"
    for mode, opened in zip(names, loop.opened, strict=True):
        assert names[opened].split("/") == ["open", *mode.split("/")[1:]]


def test_a_motor_whose_torque_is_its_frictions_to_within_rounding_rests() -> None:
    """Slow integral action on an error of rounding's size brought the current to the threshold: it stuck and slipped
    without end."""
    model = PAPER.replace(Kp=1.2 * PAPER.controller.Kp, Kd=1.2 * PAPER.controller.Kd, Ki=0.05 * PAPER.controller.Ki)
    for machine in machines(model, Uncertainty(input_bias=(-0.1, 0.1)), "friction", 8, 2026)[::7]:
        run = simulate(
            machine.servo,
            60.0,
            reference=machine.step,
            gap=machine.gap,
            tolerance=0.0,
            theta_d0=machine.theta_d0,
            sample_rate=500.0,
            friction=machine.friction,
        )
        assert len(run.events) < 1000
