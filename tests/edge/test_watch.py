"""The loop's own evidence: cycles, errors, energies; and no verdict without evidence."""

import math
import random
from collections.abc import Callable
from typing import Any

import pytest

from servotwin.edge.watch import TurningPoints, Violation, Watch, WatchSettings
from servotwin.errors import InvalidInput
from servotwin.messages import Band, Cause

RATE, BLOCK = 1000.0, 50
BAND = Band(error=1e-4, error_rms=3e-5, effort=0.1, settling=2.0)
Signal = Callable[[float], float]


def watched(
    error: Signal, voltage: Signal = lambda _: 0.0, seconds: float = 20.0, band: Band | None = BAND, **settings: Any
) -> tuple[float, Violation] | None:
    """Time of the first verdict, and the verdict; the reference steps once, at 1 s."""
    watch = Watch(WatchSettings(**settings), RATE)
    watch.restart(band, 0)
    for first in range(0, round(seconds * RATE), BLOCK):
        times = [k / RATE for k in range(first, first + BLOCK)]
        reference = [1e-3 if t >= 1.0 else 0.0 for t in times]
        position = [r - error(t) for r, t in zip(reference, times, strict=True)]
        verdict = watch.update(first, reference, position, [voltage(t) for t in times])
        if verdict is not None:
            return (first + BLOCK) / RATE, verdict
    return None


def cycle(amplitude: float, frequency: float = 1.5, mean: float = 0.0) -> Signal:
    return lambda t: mean + amplitude * math.sin(2.0 * math.pi * frequency * t)


def ringing(ratio: float, amplitude: float = 9e-5) -> Signal:
    """A free oscillation whose amplitude falls by `ratio` each half period."""
    return lambda t: amplitude * ratio ** (3.0 * (t - 3.0)) * math.sin(2.0 * math.pi * 1.5 * t)


@pytest.mark.parametrize("frequency", [0.5, 1.5, 4.0])
@pytest.mark.parametrize("mean", [0.0, 2e-5])
def test_a_limit_cycle_is_found_within_five_periods(frequency: float, mean: float) -> None:
    found = watched(cycle(6e-5, frequency, mean), band=Band(1.0, 4e-5, 1.0, 2.0))
    assert found is not None
    time, verdict = found
    assert verdict.cause is Cause.LIMIT_CYCLE
    assert verdict.measured == pytest.approx(6e-5, rel=0.05)
    assert 3.0 < time < 3.0 + 5.0 / frequency + 0.05


def test_without_a_band_only_cycles_count() -> None:
    assert watched(lambda _: 1e-2, lambda _: 24.0, band=None) is None
    found = watched(cycle(2e-5), band=None)
    assert found is not None
    assert found[1].cause is Cause.LIMIT_CYCLE
    assert found[0] > 1.0 + WatchSettings().settling_s


def test_a_growing_oscillation_is_a_limit_cycle() -> None:
    found = watched(ringing(1.1, 2e-5), band=None)
    assert found is not None
    assert found[1].cause is Cause.LIMIT_CYCLE


@pytest.mark.parametrize("ratio", [0.5, 0.65, 0.9])
def test_a_decaying_oscillation_is_no_limit_cycle(ratio: float) -> None:
    assert watched(ringing(ratio), band=None, settling_s=0.0) is None


def test_cycles_inside_the_band_are_allowed() -> None:
    assert watched(cycle(4e-5)) is None  # sqrt(2) 3e-5 is predicted


@pytest.mark.slow
def test_noise_is_no_limit_cycle() -> None:
    noise = random.Random(5)
    for _ in range(6):
        assert watched(lambda _: noise.gauss(0.0, 5e-5), band=None, seconds=60.0, error_floor=2e-5) is None


@pytest.mark.parametrize(("error", "found"), [(1.2e-4, False), (1.3e-4, True), (-1.3e-4, True)])
def test_an_error_outside_the_band(error: float, found: bool) -> None:
    band = Band(1e-4, 1.0, 1.0, 2.0)
    result = watched(lambda _: error, band=band)
    assert (result is not None) is found
    if result is not None:
        assert result[1] == Violation(Cause.ERROR, pytest.approx(1.3e-4), pytest.approx(1.25e-4))
        assert result[0] == pytest.approx(3.05, abs=0.051)


def test_a_short_blow_is_forgiven() -> None:
    assert watched(lambda t: 1e-3 if 5.0 <= t < 5.04 else 0.0, band=Band(1e-4, 1.0, 1.0, 2.0)) is None


def test_error_energy_outside_the_band() -> None:
    result = watched(lambda t: 9e-5 * (-1) ** int(t * RATE), band=BAND)  # too quick for the slots' mean
    assert result is not None
    assert result[1] == Violation(Cause.ERROR_ENERGY, pytest.approx(9e-5), pytest.approx(1.25 * 3e-5))
    assert result[0] == pytest.approx(3.0 + WatchSettings().window_s, abs=0.06)


def test_effort_outside_the_band() -> None:
    result = watched(lambda _: 0.0, lambda t: 0.2 * math.sin(60.0 * t))
    assert result is not None
    assert result[1].cause is Cause.EFFORT
    assert result[1].measured == pytest.approx(0.2 / math.sqrt(2.0), rel=0.02)


def test_values_below_the_floors_are_no_evidence() -> None:
    assert watched(lambda _: 0.9e-5, lambda _: 0.015, band=Band(0.0, 0.0, 0.0, 1.0)) is None


def test_a_moving_reference_is_never_judged() -> None:
    watch = Watch(WatchSettings(), RATE, 0.0, BAND)
    for first in range(0, 20_000, BLOCK):
        reference = [math.sin((first + k) / RATE) for k in range(BLOCK)]
        position = [0.7 * math.sin((first + k) / RATE - 0.9) for k in range(BLOCK)]
        assert watch.update(first, reference, position, [9.0] * BLOCK) is None
    assert not watch.verified


def test_a_loop_that_runs_away_is_stopped_before_it_should_have_settled() -> None:
    result = watched(lambda t: 1e-3 * math.exp(5.0 * (t - 1.0)) * (t >= 1.0), band=None)
    assert result is None
    watch = Watch(WatchSettings(), RATE, 0.0, BAND)
    verdicts = []
    for first in range(0, 2000, BLOCK):
        times = [(first + k) / RATE for k in range(BLOCK)]
        reference = [1e-3 * (t >= 1.0) for t in times]
        position = [(t >= 1.0) * (1e-3 - 1e-3 * math.exp(5.0 * (t - 1.0))) for t in times]
        verdicts.append(watch.update(first, reference, position, [0.0] * BLOCK))
    caught = next(k for k, verdict in enumerate(verdicts) if verdict is not None)
    verdict = verdicts[caught]
    assert verdict is not None
    assert verdict.allowed == pytest.approx(1.25e-4 + 1.3e-3)
    assert 1.0 + math.log(1.425) / 5.0 < (caught + 1) * BLOCK / RATE < 1.25


def test_new_parameters_must_keep_the_certified_band_until_the_predicted_one_holds() -> None:
    watch = Watch(WatchSettings(), RATE, 0.0, BAND)
    calm = [0.0] * BLOCK
    for first in range(0, 5000, BLOCK):
        watch.update(first, calm, calm, calm)
    watch.restart(Band(1e-5, 1.0, 1.0, 1.0), 5000)
    verdicts = [watch.update(first, calm, [-1.1e-4] * BLOCK, calm) for first in range(5000, 7000, BLOCK)]
    assert next(k for k, verdict in enumerate(verdicts) if verdict) == 20
    watch.restart(Band(1e-5, 1.0, 1.0, 1.0), 7000)
    assert watch.update(7000, calm, [-1.3e-4] * BLOCK, calm) == Violation(
        Cause.ERROR, pytest.approx(1.3e-4), pytest.approx(1.25e-4)
    )


def test_new_parameters_are_judged_by_their_own_evidence() -> None:
    watch = Watch(WatchSettings(settling_s=0.0), RATE)
    watch.restart(Band(1.0, 1.0, 1.0, 0.0), 0)
    calm = [0.0] * BLOCK
    for first in range(0, 5000, BLOCK):
        assert watch.update(first, calm, calm, calm) is None
    assert watch.verified
    watch.restart(Band(1e-4, 1.0, 1.0, 1.0), 5000)
    assert not watch.verified
    verdicts = [watch.update(first, calm, [9e-4] * BLOCK, calm) for first in range(5000, 7000, BLOCK)]
    assert [verdict is None for verdict in verdicts[:20]] == [True] * 20
    assert verdicts[20] is not None


def test_samples_that_are_not_finite_are_no_evidence() -> None:
    assert watched(lambda t: math.nan if t > 4.0 else 0.0) is None


@pytest.mark.parametrize("values", [{"slot_s": 0.0}, {"margin": 0.9}, {"swings": 1}, {"settling_s": math.inf}])
def test_bad_settings_are_refused(values: dict[str, Any]) -> None:
    with pytest.raises(InvalidInput, match="watch"):
        WatchSettings(**values)


def test_turns_need_more_than_the_reversal() -> None:
    turns = TurningPoints(1.0, 2)
    assert [turns.add(value) for value in (0.0, 5.0, 4.5, 5.2, 4.1, 0.0, 3.0)] == [False] * 4 + [True, False, True]
