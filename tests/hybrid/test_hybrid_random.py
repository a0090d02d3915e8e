"""The kernel on random linear automata, against scipy's expm and an integrator of its own."""

import numpy as np
import pytest
from event_oracle import OracleGuard, OracleMode, follow
from exploration import examples
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.linalg import expm

from servotwin.errors import InvalidInput
from servotwin.hybrid.automaton import Array, Automaton, Guard, Mode
from servotwin.hybrid.trajectory import Jump, Trajectory, ZenoError

seeds = st.integers(0, 2**32 - 1)


def random_flow(rng: np.random.Generator, size: int, fastest: float) -> Array:
    """A random matrix of eigenvalues up to `fastest`, moved left until none grows by more than exp(3) in 1 s."""
    flow = rng.standard_normal((size, size))
    flow *= fastest / np.abs(np.linalg.eigvals(flow)).max()
    growth = np.linalg.eigvals(flow).real.max() - 3.0
    return flow - max(growth, 0.0) * np.eye(size)


@examples(30)
@given(seeds, st.integers(1, 6), st.sampled_from([0.1, 3.0, 40.0]), st.sampled_from([1e-3, 0.0123, 0.25]))
def test_dense_output_is_the_exponential(seed: int, size: int, fastest: float, step: float) -> None:
    rng = np.random.default_rng(seed)
    flow, x, row = random_flow(rng, size, fastest), rng.standard_normal(size), rng.standard_normal(size)
    automaton = Automaton((Mode(flow),), tuple(f"x{i}" for i in range(size)))
    run = Trajectory(automaton, x, 0, step)
    run.advance(int(1.0 / step))
    times = np.sort(rng.uniform(0.0, run.time, 12))
    grid = rng.integers(0, run.samples, 12)
    exact = np.array([row @ expm(flow * t) @ x for t in times])
    sampled = np.array([row @ expm(flow * (k * step)) @ x for k in grid])
    # What rounding of the flow itself may do: the norm of the way there and back.
    size_ = (
        max(np.linalg.norm(expm(flow * t), 2) for t in np.linspace(0.0, 1.0, 9))
        * np.linalg.norm(x)
        * np.linalg.norm(row)
    )
    bound = 1e-13 * size_ * max(fastest, 1.0)
    assert np.abs(run.at(times, row) - exact).max() < bound
    assert np.abs(run.sampled(row)[grid] - sampled).max() < bound


def relay_loop(rng: np.random.Generator) -> tuple[list[Array], list[Array], Array | None, Array]:
    """Flows and guard rows of a relay with hysteresis on a random stable plant, a reset that leaves the output, and a
    start."""
    size = int(rng.integers(2, 6))
    plant = rng.standard_normal((size, size))
    plant -= (np.linalg.eigvals(plant).real.max() + rng.uniform(0.1, 1.0)) * np.eye(size)
    plant *= rng.uniform(0.5, 20.0)
    drive, output = rng.standard_normal(size), rng.standard_normal(size)
    gain = -output @ np.linalg.solve(plant, drive)
    drive *= np.sign(gain)
    width = abs(gain) * rng.uniform(0.02, 0.5)
    flows, rows = [], []
    for sign in (1.0, -1.0):
        flow = np.zeros((size + 1, size + 1))
        flow[:size, :size], flow[:size, size] = plant, sign * drive
        flows.append(flow)
        rows.append(np.append(sign * output, -width))
    reset = None
    if rng.random() < 0.5:
        kick = 0.02 * rng.standard_normal((size, size))
        reset = np.eye(size + 1)
        reset[:size, :size] += kick - np.outer(output, output @ kick) / (output @ output)
    return flows, rows, reset, np.append(np.zeros(size), 1.0)


def ours(flows: list[Array], rows: list[Array], reset: Array | None, step: float, refine: int = 1) -> Trajectory:
    size = len(flows[0])
    modes = tuple(Mode(flows[k], (Guard(rows[k], 1 - k, reset, "switch", k),), str(k)) for k in (0, 1))
    return Trajectory(Automaton(modes, tuple(f"x{i}" for i in range(size))), np.eye(size)[-1], 0, step, refine)


@pytest.mark.slow
@examples(12)
@given(seeds)
def test_random_relay_loops(seed: int) -> None:
    """Every switch of a random loop, with resets in half of them, and the state between."""
    rng = np.random.default_rng(seed)
    flows, rows, reset, x = relay_loop(rng)
    end = 200.0 / max(np.abs(np.linalg.eigvals(flow)).max() for flow in flows)
    run = ours(flows, rows, reset, end / 900.0)
    oracle = [OracleMode(flows[k], (OracleGuard(rows[k], 1 - k, "switch", reset),)) for k in (0, 1)]
    try:
        run.advance(900)
    except ZenoError:
        assume(False)
    slow = follow(oracle, x, 0, end, end / 5000.0)
    times = np.array([event[0] for event in run.events()])
    expected = np.array([event[0] for event in slow.events])
    assert len(times) == len(expected)
    assert np.all(np.abs(times - expected) < 1e-9 * end)
    places = np.sort(rng.uniform(0.0, end, 10))
    scale = np.abs(slow.at(np.linspace(0.0, end, 30), rows[0])).max()
    assert np.abs(run.at(places, rows[0]) - slow.at(places, rows[0])).max() < 1e-8 * scale


@examples(15)
@given(seeds)
def test_the_sample_step_and_the_search_do_not_matter(seed: int) -> None:
    rng = np.random.default_rng(seed)
    flows, rows, reset, _ = relay_loop(rng)
    end = 100.0 / max(np.abs(np.linalg.eigvals(flow)).max() for flow in flows)
    found = []
    for samples, refine in ((1000, 1), (370, 1), (40, 1), (1000, 4), (40, 16)):
        run = ours(flows, rows, reset, end / samples, refine)
        try:
            run.advance(samples)
        except ZenoError:
            return
        found.append(np.array([event[0] for event in run.events()]))
    for times in found[1:]:
        assert len(times) == len(found[0])
        assert np.all(np.abs(times - found[0]) < 1e-10 * end)


def two_oscillators(slow: float, fast: float, level: float) -> Automaton:
    flow = np.zeros((5, 5))
    flow[0, 1], flow[1, 0], flow[2, 3], flow[3, 2] = 1.0, -(fast**2), 1.0, -(slow**2)
    row = np.array([1.0, 0.0, 1.0, 0.0, -level])
    below, above = (
        Mode(flow, (Guard(row, 1, None, "up"),), "below"),
        Mode(flow, (Guard(-row, 0, None, "down"),), "above"),
    )
    return Automaton((below, above), ("x", "v", "y", "u", "one"))


@pytest.mark.parametrize("turn", [0.2, 0.6, 1.3, 2.5])
def test_no_event_of_undamped_oscillations_is_missed(turn: float) -> None:
    """Two undamped oscillators reach a level now and then, however coarse the samples: `turn` is radians per sample."""
    rng = np.random.default_rng(int(100 * turn))
    total = 0
    for _ in range(12):
        slow, level, phase = rng.uniform(0.3, 0.95), rng.choice([1.5, 1.9, 1.98]), rng.uniform(0.0, 2.0 * np.pi)
        automaton = two_oscillators(slow, 1.0, level)
        run = Trajectory(automaton, np.array([np.sin(phase), np.cos(phase), 0.0, slow, 1.0]), 0, turn)
        run.advance(int(400.0 / turn))
        t = np.arange(0.0, run.time, 1e-3)
        high = np.sin(t + phase) + np.sin(slow * t) > level
        assert len(run.events()) >= np.count_nonzero(np.diff(high)), (slow, level, phase)
        labels = [event[1] for event in run.events()]
        assert labels == ["up", "down"] * (len(labels) // 2) + ["up"] * (len(labels) % 2)
        total += len(labels)
    assert total > 50


def test_record_grows() -> None:
    check_a_record_that_grows(25_000)


def check_a_record_that_grows(number: int) -> None:
    """So many events and as many segments: far beyond the first buffers; the times stay exact."""
    flow = np.array([[0.0, 1.0], [0.0, 0.0]])
    down, up = np.zeros((2, 2)), flow.copy()
    down[0, 1] = -1.0
    row = np.array([1.0, -1.0])
    automaton = Automaton(
        (Mode(up, (Guard(row, 1, None, "top"),), "up"), Mode(down, (Guard(np.array([-1.0, -1.0]), 0),), "down")),
        ("x", "one"),
    )
    run = Trajectory(automaton, np.array([0.0, 1.0]), 0, 0.31)
    run.advance(round(2 * number / 0.31))
    times = np.array([event[0] for event in run.events()])
    assert len(times) == number
    assert np.abs(times - (2.0 * np.arange(number) + 1.0)).max() < 1e-8
    samples = run.sampled([1.0, 0.0])
    t = np.arange(len(samples)) * 0.31
    assert np.abs(samples - (1.0 - np.abs((t + 1.0) % 4.0 - 2.0))).max() < 1e-7


FLOW = np.array([[-1.0, 0.5], [0.0, -2.0]])
GOOD = Mode(FLOW, (Guard([1.0, 0.0], 0),), "good")


@pytest.mark.parametrize(
    ("modes", "names", "text"),
    [
        ((Mode(np.eye(3), (), "wide"),), ("x", "y"), r"flow of mode 'wide' has shape \(3, 3\); it must be \(2, 2\)"),
        ((Mode(FLOW * np.nan, (), "bad"),), ("x", "y"), "flow of mode 'bad' holds a number that is not finite"),
        ((Mode(FLOW, (Guard([1.0], 0, None, "short"),)),), ("x", "y"), "guard 'short'.*shape"),
        ((Mode(FLOW, (Guard([np.inf, 0.0], 0, None, "far"),)),), ("x", "y"), "guard 'far'.*not finite"),
        ((Mode(FLOW, (Guard([1.0, 0.0], 2, None, "lost"),)),), ("x", "y"), "'lost' leads to mode 2; modes are 0 to 0"),
        ((Mode(FLOW, (Guard([1.0, 0.0], -1, None, "lost"),)),), ("x", "y"), "'lost' leads to mode -1"),
        ((Mode(FLOW, (Guard([1.0, 0.0], 0, np.eye(3), "big"),)),), ("x", "y"), "reset of guard 'big'"),
        ((), ("x", "y"), "at least one mode"),
        ((GOOD,), ("x", "x"), "state names.*differ"),
        ((Mode(np.zeros((0, 0))),), (), "at least one state"),
    ],
)
def test_a_wrong_automaton_is_refused(modes: tuple[Mode, ...], names: tuple[str, ...], text: str) -> None:
    with pytest.raises(InvalidInput, match=text):
        Automaton(modes, names)


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"state": np.zeros(3)}, r"shape \(3,\); it must be \(2,\)"),
        ({"state": np.array([np.nan, 0.0])}, "not finite"),
        ({"mode": 1}, "mode = 1"),
        ({"mode": -1}, "mode = -1"),
        ({"sample_step": 0.0}, "sample_step = 0.0 s"),
        ({"sample_step": np.inf}, "sample_step = inf s"),
        ({"refine": 0}, "refine = 0"),
    ],
)
def test_a_wrong_start_is_refused(changes: dict[str, object], text: str) -> None:
    good = {"state": np.zeros(2), "mode": 0, "sample_step": 0.1, "refine": 1}
    with pytest.raises(InvalidInput, match=text):
        Trajectory(Automaton((GOOD,), ("x", "y")), **(good | changes))


def fresh() -> Trajectory:
    run = Trajectory(Automaton((GOOD, GOOD), ("x", "y")), np.array([-1.0, -1.0]), 0, 0.1)
    run.advance(10)
    return run


def test_going_back_is_refused() -> None:
    with pytest.raises(InvalidInput, match="sample 9"):
        fresh().advance(9)


@pytest.mark.parametrize(
    ("jumps", "text"),
    [
        ([Jump(0.95, {0: 1.0})], r"jump at 0\.95 s"),
        ([Jump(2.05, {0: 1.0})], r"jump at 2\.05 s"),
        ([Jump(1.5, {}), Jump(1.2, {})], r"jump at 1\.2 s"),
        ([Jump(np.nan, {})], "jump at nan s"),
        ([Jump(1.5, {2: 0.0})], "state 2"),
        ([Jump(1.5, {0: np.inf})], "finite"),
        ([Jump(1.5, {}, [0, 2])], "mode map"),
        ([Jump(1.5, {}, [0])], "mode map"),
    ],
)
def test_wrong_jumps_are_refused(jumps: list[Jump], text: str) -> None:
    with pytest.raises(InvalidInput, match=text):
        fresh().advance(20, jumps)


@pytest.mark.parametrize("times", [[1.1], [-0.1], [np.nan], [0.5, 1.0001]])
def test_output_outside_the_run_is_refused(times: list[float]) -> None:
    with pytest.raises(InvalidInput, match="outside"):
        fresh().at(times, [1.0, 0.0])


@pytest.mark.parametrize(("first", "last"), [(-1, 3), (0, 12), (5, 4)])
def test_samples_outside_the_run_are_refused(first: int, last: int) -> None:
    with pytest.raises(InvalidInput, match="outside"):
        fresh().sampled([1.0, 0.0], first, last)


def test_wrong_settings_are_refused() -> None:
    with pytest.raises(InvalidInput, match="state 5"):
        fresh().set({5: 1.0})
    with pytest.raises(InvalidInput, match="mode map"):
        fresh().set({}, [0, 7])


def test_after_zeno_a_run_stays_refused_and_its_past_readable() -> None:
    flow = np.array([[0.0, -1.0], [0.0, 0.0]])
    modes = (Mode(flow, (Guard([-1.0, 0.0], 1),), "a"), Mode(-flow, (Guard([1.0, 0.0], 0),), "b"))
    run = Trajectory(Automaton(modes, ("x", "one")), np.array([0.35, 1.0]), 0, 0.1)
    for _ in range(100):
        with pytest.raises(ZenoError, match=r"t = 0\.35 s"):
            run.advance(10)
    assert run.samples == 4
    assert np.abs(run.sampled([1.0, 0.0]) - [0.35, 0.25, 0.15, 0.05]).max() < 1e-15


def test_standing_still_for_ever_is_safe() -> None:
    """Advancing by nothing, over and over, fills no buffer to overflowing."""
    run = fresh()
    for _ in range(10_000):
        run.advance(10)
    assert run.samples == 11
    assert np.abs(run.sampled([0.0, 1.0]) + np.exp(-2.0 * np.arange(11) * 0.1)).max() < 1e-15
