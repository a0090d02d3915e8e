"""Numbers that the simulation must hit: limit cycles, homogeneity, thresholds, Fig 12's verdicts, W1's events."""

import math
from functools import cache

import numpy as np
import pytest
from exploration import examples
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import brentq

from servotwin.hybrid.automaton import Array
from servotwin.hybrid.trajectory import Trajectory
from servotwin.plant.servo import Servo
from servotwin.plant.signals import SCurve, SquareWave, as_pieces
from servotwin.simulation import simulate
from servotwin.simulation.continuous import ContinuousEngine
from servotwin.simulation.inputs import RunInputs

DEGREE = math.pi / 180.0
RATE = 1000.0


def engine(
    servo: Servo, duration: float, refine: int = 1, theta_d0: float = 0.0, **signals: object
) -> ContinuousEngine:
    pieces = {"reference": 0.0, "gap": 0.0, **signals}
    inputs = {name: as_pieces(value, duration) for name, value in pieces.items()}
    made = ContinuousEngine(
        servo, servo.controller, RunInputs(**{"tolerance": None, **inputs}, sample_rate=RATE), theta_d0, refine
    )
    made.advance(round(duration * RATE))
    return made


def contacts(run: ContinuousEngine, side: int) -> Array:
    return np.array([time for time, kind, where, _ in run.events() if kind == "contact" and where == side])


@cache
def cycling(preset: str, gap_degrees: float, reference: float = 1e-3) -> ContinuousEngine:
    """Long enough for the slowest multiplier (0.5853 per half period) to reach rounding."""
    return engine(Servo.preset(preset), 80.0, reference=reference, gap=gap_degrees * DEGREE)


def amplitude(run: ContinuousEngine) -> float:
    """Half peak-to-peak of the position over the last period, its tops located by the velocity's zeros."""
    position = run.loop.rows["position"]
    velocity = np.einsum("mi,mij->mj", position, run.loop.automaton.flows)
    begin, end = contacts(run, 1)[-3:-1]
    grid = np.linspace(begin, end, 200)
    speeds = run.trajectory.at(grid, velocity)
    tops = [
        brentq(lambda t: run.trajectory.at([t], velocity)[0], grid[k], grid[k + 1], xtol=1e-13)
        for k in np.flatnonzero(speeds[:-1] * speeds[1:] < 0.0)
    ]
    return float(np.ptp(run.trajectory.at(np.sort(tops), position))) / 2.0


@pytest.mark.parametrize(
    ("preset", "hertz", "millimetres"),
    [("paper", 1.480016436988, 0.179574563547), ("table1", 0.910227448140, 0.054039772707)],
)
def test_limit_cycle(preset: str, hertz: float, millimetres: float) -> None:
    run = cycling(preset, 10.0)
    periods = np.diff(contacts(run, 1))[-10:]
    assert np.abs(1.0 / periods / hertz - 1.0).max() < 1e-9
    assert amplitude(run) * 1e3 == pytest.approx(millimetres, rel=1e-9)


@pytest.mark.parametrize("preset", ["paper", "table1"])
def test_amplitude_is_proportional_to_the_gap(preset: str) -> None:
    per_degree = amplitude(cycling(preset, 10.0)) / 10.0
    for gap in (2.5, 7.0, 13.3, 20.0):
        assert amplitude(cycling(preset, gap)) / gap == pytest.approx(per_degree, rel=1e-10), gap
    assert amplitude(cycling(preset, 10.0, 3e-3)) == pytest.approx(10.0 * per_degree, rel=1e-10)


def state_at_contact(run: Trajectory, side: int) -> tuple[float, int, Array]:
    """Time, mode and state right after the last contact on a side."""
    times = [event[0] for event in run.events() if event[1:3] == ("contact", side)]
    record, size = run.record, run.record.size[0]
    starts = (record.step[:size] + record.fraction[:size]) * run.step
    at = int(np.flatnonzero(starts == times[-1])[-1])
    return times[-1], int(record.mode[at]), record.state[at].copy()


def half_period_later(run: ContinuousEngine, mode: int, x: Array) -> Array:
    """State right after the next contact on the other side."""
    onward = Trajectory(run.loop.automaton, x, mode, 1.0 / RATE)
    while not any(event[1:3] == ("contact", -1) for event in onward.events()):
        onward.advance(onward.samples + 49)
    return state_at_contact(onward, -1)[2]


def test_multipliers_of_the_half_period() -> None:
    """Perturb every state at a contact and look half a period later: the cycle's symmetry makes the map's square the
    period's."""
    run = cycling("paper", 10.0)
    _, mode, x = state_at_contact(run.trajectory, 1)
    names = run.loop.automaton.names
    moving = list(range(names.index("derivative") + 1))
    jacobian = np.zeros((len(moving), len(moving)))
    for column, i in enumerate(moving):
        shift = np.zeros(len(x))
        shift[i] = 1e-6 * max(abs(x[i]), 1e-6)
        change = half_period_later(run, mode, x + shift) - half_period_later(run, mode, x - shift)
        jacobian[:, column] = -change[moving] / (2.0 * shift[i])
    sizes = np.sort(np.abs(np.linalg.eigvals(jacobian)))[::-1]
    assert sizes[:3] == pytest.approx([0.5853, 0.5513, 0.5513], abs=6e-5)
    assert sizes[3] < 0.5


START = {"reference": 1e-3, "gap": 12.0 * DEGREE, "theta_d0": 0.05}


def homogeneous(scale: float, preset: str, wearing: bool) -> ContinuousEngine:
    servo = Servo.preset(preset)
    gap = SCurve(0.0, 14.0 * DEGREE * scale, 20.0) if wearing else START["gap"] * scale
    tolerance = servo.tolerance_for(2.0 * DEGREE) * scale
    reference = SquareWave(START["reference"] * scale, 8.0)
    return engine(servo, 20.0, reference=reference, gap=gap, tolerance=tolerance, theta_d0=START["theta_d0"] * scale)


CHANNELS = ("position", "theta_m", "theta_d", "voltage")


@pytest.mark.parametrize("power", [-60, -3, 1, 47])
@pytest.mark.parametrize("wearing", [False, True])
def test_powers_of_two_scale_bit_for_bit(power: int, wearing: bool) -> None:
    plain, scaled = (homogeneous(scale, "paper", wearing) for scale in (1.0, 2.0**power))
    assert plain.events() == scaled.events()
    assert len(plain.events()) > 50
    for name in CHANNELS:
        wanted = plain.channel(name, 0, plain.index + 1) * 2.0**power
        assert np.array_equal(wanted, scaled.channel(name, 0, scaled.index + 1)), name


@examples(10)
@given(st.floats(1e-3, 1e3), st.sampled_from(["paper", "table1"]), st.booleans())
def test_other_factors_scale_within_rounding(scale: float, preset: str, wearing: bool) -> None:
    plain, scaled = homogeneous(1.0, preset, wearing), homogeneous(scale, preset, wearing)
    assert len(plain.events()) == len(scaled.events())
    q, s = (run.channel("position", 0, run.index + 1) for run in (plain, scaled))
    assert np.abs(s / scale - q).max() < 1e-9 * START["reference"]


SETTLED, LOST = 5e-6, 50e-6


def swings(run: ContinuousEngine, duration: float, step: float) -> Array:
    """Half peak-to-peak of the position over the last 5 s of every step of the reference, m."""
    position = run.channel("position", 0, run.index + 1)
    ends = (np.arange(step, duration + step / 2.0, step) * RATE).astype(int)
    return np.array([np.ptp(position[end - round(5.0 * RATE) : end]) / 2.0 for end in ends])


@pytest.mark.parametrize("gap", [*np.arange(0.0, 17.5, 0.5).tolist(), 17.25])
def test_constant_gap_settles(gap: float) -> None:
    servo = Servo.preset("paper")
    run = engine(servo, 40.0, reference=1e-3, gap=gap * DEGREE, tolerance=servo.tolerance_for(10.0 * DEGREE))
    assert swings(run, 40.0, 40.0)[0] < 1e-9


@pytest.mark.parametrize("gap", [17.5, 18.0, 19.0, 20.0])
def test_constant_gap_cycles(gap: float) -> None:
    servo = Servo.preset("paper")
    run = engine(servo, 40.0, reference=1e-3, gap=gap * DEGREE, tolerance=servo.tolerance_for(10.0 * DEGREE))
    swing = swings(run, 40.0, 40.0)[0]
    assert 0.49e-3 < swing < 0.53e-3
    if gap == 17.5:
        assert swing == pytest.approx(0.495e-3, abs=0.5e-6)


@cache
def fig12(preset: str, end: float, refine: int) -> ContinuousEngine:
    servo = Servo.preset(preset)
    tolerance = servo.tolerance_for(10.0 * DEGREE)
    gap = SCurve(0.0, end * DEGREE, 200.0)
    return engine(servo, 200.0, refine, reference=SquareWave(1e-3, 40.0), gap=gap, tolerance=tolerance)


FIG12 = [("paper", 20.0, [9, 10]), ("paper", 30.0, [7, 8, 9, 10]), ("table1", 20.0, [5, 9, 10])]


@pytest.mark.parametrize(("preset", "end", "lost"), FIG12)
@pytest.mark.parametrize("refine", [1, 2, 8])
def test_fig12_verdicts(preset: str, end: float, lost: list[int], refine: int) -> None:
    """Which of the ten steps of 20 s oscillate, however fine the search for events."""
    found = swings(fig12(preset, end, refine), 200.0, 20.0)
    assert [k + 1 for k in range(10) if found[k] > LOST] == lost
    assert [k + 1 for k in range(10) if found[k] < SETTLED] == [k for k in range(1, 11) if k not in lost]
    plain = fig12(preset, end, 1).events()
    assert [event[1:] for event in fig12(preset, end, refine).events()] == [event[1:] for event in plain]


def test_fig12_gap_where_it_is_lost() -> None:
    """The last step that settles ends, and the first lost one begins, at 17.9 degrees (0 -> 20) or 19.4 (0 -> 30)."""
    for end, step, degrees in ((20.0, 8, 17.9), (30.0, 6, 19.4)):
        gap = float(SCurve(0.0, end, 200.0).pieces(200.0).value(20.0 * step))
        assert gap == pytest.approx(degrees, abs=0.05)


def test_w1_events() -> None:
    """performance.md's W1: 1740 events of the state alone, besides the contact of the degenerate start at 5.5e-11 s."""
    servo = Servo.preset("table1")
    tolerance = servo.tolerance_for(10.0 * DEGREE)
    gap = SCurve(0.0, 60.0 * DEGREE, 200.0)
    events = simulate(servo, 200.0, reference=SquareWave(1e-3, 40.0), gap=gap, tolerance=tolerance).events
    early = events[events.state_triggered & (events.time < 1e-6)]
    assert list(early.kind) == ["contact"]
    assert early.time[0] == pytest.approx(5.515e-11, rel=1e-3)
    events = events[events.state_triggered & (events.time >= 1e-6)]
    assert len(events) == 1740
    assert np.isin(events.kind, ["enter", "leave"]).sum() == 623
    assert np.isin(events.kind, ["contact", "release"]).sum() == 1117
