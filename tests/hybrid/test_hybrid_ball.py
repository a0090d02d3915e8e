"""The kernel on a bouncing ball: event times, heights and the Zeno point in closed form."""

import numpy as np
import pytest

from servotwin.hybrid.automaton import Automaton, Guard, Mode
from servotwin.hybrid.trajectory import Trajectory, ZenoError

G = 9.81
HEIGHT, SPEED = np.eye(3)[:2]
FALL = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, -G], [0.0, 0.0, 0.0]])


def ball(restitution: float) -> Automaton:
    """States (height, speed, 1); the ground reverses the speed."""
    bounce = Guard(-HEIGHT, 0, np.diag([1.0, -restitution, 1.0]), "bounce", 1)
    return Automaton((Mode(FALL, (bounce,), "flight"),), ("height", "speed", "one"))


def bounce_times(height: float, restitution: float, count: int) -> np.ndarray:
    """The first fall, then flights that shrink by the restitution."""
    fall = np.sqrt(2.0 * height / G)
    return fall * (1.0 + 2.0 * np.cumsum(np.concatenate([[0.0], restitution ** np.arange(1, count)])))


def dropped(height: float, restitution: float, step: float = 1e-3, refine: int = 1) -> Trajectory:
    return Trajectory(ball(restitution), np.array([height, 0.0, 1.0]), 0, step, refine)


def times_of(run: Trajectory) -> np.ndarray:
    return np.array([event[0] for event in run.events()])


@pytest.mark.parametrize("restitution", [0.5, 0.8, 0.95])
@pytest.mark.parametrize("step", [1e-4, 3e-3, 0.7])
def test_bounce_times(restitution: float, step: float) -> None:
    run = dropped(1.3, restitution, step)
    expected = bounce_times(1.3, restitution, 12)
    end = int(np.floor(0.5 * (expected[-1] + expected[-2]) / step))
    run.advance(end)
    inside = expected[expected < end * step]
    assert len(run.events()) == len(inside) > 0
    assert np.abs(times_of(run) / inside - 1.0).max() < 1e-13
    assert {event[1:] for event in run.events()} == {("bounce", 1, False)}


def test_heights() -> None:
    run, bounces = dropped(1.3, 0.9), bounce_times(1.3, 0.9, 30)
    run.advance(int(bounces[-1] / 1e-3))
    tops = 0.5 * (bounces[:-2] + bounces[1:-1])
    expected = 1.3 * 0.9 ** (2.0 * np.arange(1, len(tops) + 1))
    assert np.abs(run.at(tops, HEIGHT) / expected - 1.0).max() < 1e-12
    assert np.abs(run.at(tops, SPEED)).max() < 1e-13 * np.sqrt(2 * G * 1.3)


def test_energy_falls_only_at_bounces() -> None:
    run, bounces = dropped(0.7, 0.8), bounce_times(0.7, 0.8, 15)
    run.advance(int(bounces[-1] / 1e-3))
    times = np.random.default_rng(3).uniform(0.0, bounces[-2], 2000)
    energy = 0.5 * run.at(times, SPEED) ** 2 + G * run.at(times, HEIGHT)
    expected = G * 0.7 * 0.8 ** (2.0 * np.searchsorted(bounces, times))
    assert np.abs(energy / expected - 1.0).max() < 1e-11


def test_elastic_ball_for_thousands_of_bounces() -> None:
    run = dropped(0.02, 1.0)
    run.advance(400_000)
    fall = np.sqrt(2.0 * 0.02 / G)
    expected = fall * (2.0 * np.arange(len(run.events())) + 1.0)
    assert len(expected) == int((400.0 / fall + 1.0) / 2.0) > 3000
    assert np.abs(times_of(run) / expected - 1.0).max() < 1e-12
    assert run.sampled(HEIGHT).min() > -1e-15


@pytest.mark.parametrize("restitution", [0.3, 0.9, 0.99])
def test_zeno_point_is_named(restitution: float) -> None:
    end = np.sqrt(2.0 / G) * (1.0 + restitution) / (1.0 - restitution)
    run = dropped(1.0, restitution)
    with pytest.raises(ZenoError, match=r"flight.* Zeno") as caught:
        run.advance(int(2.0 * end / 1e-3))
    found = float(str(caught.value).split("t = ")[1].split(" s")[0])
    assert -1.1e-3 < found - end < 1e-8  # the message gives nine digits
    expected = bounce_times(1.0, restitution, len(run.events()))[:60]
    assert np.abs(times_of(run)[:60] / expected - 1.0).max() < 1e-13


def test_zeno_point_to_rounding_when_bounces_die_quickly() -> None:
    run = dropped(1.0, 0.5)
    with pytest.raises(ZenoError):
        run.advance(3000)
    assert run.time == pytest.approx(3.0 * np.sqrt(2.0 / G), rel=1e-12)


@pytest.mark.parametrize("speed", [0.0, -1.0])
def test_ball_without_rest_cannot_rest(speed: float) -> None:
    """On the ground, at rest or falling into it with no rebound, a ball with flight alone is Zeno at once."""
    run = Trajectory(ball(0.0), np.array([0.0, speed, 1.0]), 0, 1e-3)
    with pytest.raises(ZenoError, match="t = 0 s"):
        run.advance(10)


LIFT = 40.0


def lifted() -> Automaton:
    """States (height, speed, 1, push): rests until a push that grows by LIFT per second carries it (all per mass)."""
    height, push = np.eye(4)[[0, 3]]
    weight = np.array([0.0, 0.0, G, 0.0])
    ramp = np.zeros((4, 4))
    ramp[3, 2] = LIFT
    flight = ramp.copy()
    flight[0, 1], flight[1] = 1.0, push - weight
    land = Guard(-height, 1, np.diag([0.0, 0.0, 1.0, 1.0]), "land")
    return Automaton(
        (Mode(flight, (land,), "flight"), Mode(ramp, (Guard(push - weight, 0, None, "lift"),), "rest")),
        ("height", "speed", "one", "push"),
    )


def test_resting_ball_lifts_off_when_carried() -> None:
    """At the lift-off height, speed and acceleration vanish together: the guard of flight is decided by the jerk."""
    run = Trajectory(lifted(), np.array([0.0, 0.0, 1.0, 0.0]), 0, 1e-3)
    run.advance(1000)
    start = G / LIFT
    events = run.events()
    assert [event[1] for event in events] == ["land", "lift"]
    assert events[0][0] == 0.0
    assert events[0][3]
    assert events[1][0] == pytest.approx(start, rel=1e-14)
    time = np.linspace(0.0, 1.0, 1001)
    expected = LIFT * np.maximum(time - start, 0.0) ** 3 / 6.0
    assert np.abs(run.sampled(np.eye(4)[0]) - expected).max() < 1e-14 * expected[-1]
    assert run.mode == 0


def test_ball_falls_back_and_rests() -> None:
    run = Trajectory(lifted(), np.array([0.5, 0.0, 1.0, -2.0 * G]), 0, 1e-3)
    run.advance(400)
    # h = 1/2 - 3 G t^2 / 2 + LIFT t^3 / 6.
    roots = np.roots([LIFT / 6.0, -1.5 * G, 0.0, 0.5])
    landing = min(root.real for root in roots if abs(root.imag) < 1e-12 and root.real > 0.0)
    assert [event[1] for event in run.events()] == ["land"]
    assert run.events()[0][0] == pytest.approx(landing, rel=1e-14)
    assert np.all(run.sampled(np.eye(4)[0])[200:] == 0.0)
