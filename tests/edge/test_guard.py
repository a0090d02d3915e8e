"""The guard applies what is newer, in bounds and unexpired, and names the reason for everything else."""

from math import inf, nan
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from servotwin.edge.guard import Instant, Limits, judge
from servotwin.edge.parameters import Parameters
from servotwin.edge.supervisor import Rules, Switch, offer
from servotwin.errors import InvalidInput
from servotwin.messages import Reason, Receipt, Setting, Update

HERE = Instant("axis-1", "b0", 110_000, 5000.0)
CURRENT = Parameters(2, Setting(0.9e-4), 0.0, ("b0", 0), 15_000)
LIMITS = Limits(minimum=0.2e-4, maximum=3e-4, max_step=1e-4, lifetime_s=10.0, interval_s=5.0)
UPDATE = Update("axis-1", 3, 2, ("b0", 1), 20.0, 0.1, 0.01, (0.08, 0.12), "OK", Setting(1e-4), 60.0)


def decide(update: Update, current: Parameters, limits: Limits, here: Instant) -> tuple[Parameters, Receipt]:
    """What is in force after the update, and the receipt, where nothing has to wait."""
    step = offer(Switch(current), update, Rules(limits), here, None)
    (receipt,) = step.messages
    assert isinstance(receipt, Receipt)
    return step.state.current, receipt


def test_a_good_update_is_applied_at_the_next_sample() -> None:
    parameters, receipt = decide(UPDATE, CURRENT, LIMITS, HERE)
    assert parameters == Parameters(3, Setting(1e-4), 20.0, ("b0", 1), 110_000, gap=0.1)
    assert (receipt.applied, receipt.sample, receipt.reason) == (True, 110_000, Reason.APPLIED)
    assert (receipt.version, receipt.parameter_version, receipt.boot) == (3, 3, "b0")


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"servo": "axis-2"}, Reason.WRONG_SERVO),
        ({"window": ("b1", 1)}, Reason.OTHER_BOOT),
        ({"version": 2}, Reason.OLD_VERSION),
        ({"version": 1}, Reason.OLD_VERSION),
        ({"data_time": 0.0}, Reason.OLD_DATA),
        ({"base_version": 1}, Reason.BASE_MISMATCH),
        ({"base_version": 3}, Reason.BASE_MISMATCH),
        ({"data_time": 22.001}, Reason.FUTURE_DATA),
        ({"not_after": 22.0}, Reason.EXPIRED),
        ({"not_after": 22.0, "base_version": 1}, Reason.EXPIRED),
        ({"data_time": 11.9}, Reason.EXPIRED),
        ({"setting": Setting(3.1e-4)}, Reason.OUT_OF_BOUNDS),
        ({"setting": Setting(0.1e-4)}, Reason.OUT_OF_BOUNDS),
        ({"setting": Setting(2e-4)}, Reason.STEP_TOO_LARGE),
    ],
)
def test_everything_else_is_refused_with_its_reason(changes: dict[str, Any], reason: Reason) -> None:
    parameters, receipt = decide(replace(UPDATE, **changes), CURRENT, LIMITS, HERE)
    assert parameters is CURRENT
    assert (receipt.applied, receipt.reason, receipt.sample) == (False, reason, 110_000)
    assert (receipt.servo, receipt.parameter_version) == ("axis-1", 2)


def test_updates_keep_their_distance() -> None:
    soon = Parameters(2, Setting(0.9e-4), 0.0, ("b0", 0), 110_000 - 24_999)
    assert judge(UPDATE, soon, LIMITS, HERE) is Reason.TOO_SOON
    assert (
        judge(UPDATE, Parameters(2, Setting(0.9e-4), 0.0, ("b0", 0), 110_000 - 25_000), LIMITS, HERE) is Reason.APPLIED
    )
    assert (
        judge(UPDATE, Parameters(2, Setting(0.9e-4)), LIMITS, Instant("axis-1", "b0", 110_000, 5000.0))
        is Reason.APPLIED
    )


def test_the_limits_themselves_are_allowed() -> None:
    current = Parameters(2, Setting(2e-4), 0.0, ("b0", 0), 15_000)
    edges = replace(UPDATE, setting=Setting(3e-4), data_time=12.0, not_after=22.0 + 1e-9)
    assert (
        judge(edges, current, Limits(minimum=3e-4, maximum=3e-4, max_step=1e-4 * (1 + 1e-9), lifetime_s=10.0), HERE)
        is Reason.APPLIED
    )


def test_a_repeated_update_gets_its_first_receipt_again() -> None:
    parameters, first = decide(UPDATE, CURRENT, LIMITS, HERE)
    again, second = decide(UPDATE, parameters, LIMITS, Instant("axis-1", "b0", 500_000, 5000.0))
    assert again is parameters
    assert second == first


def test_another_update_with_the_same_version_is_not_a_repeat() -> None:
    parameters, _ = decide(UPDATE, CURRENT, LIMITS, HERE)
    other = replace(UPDATE, window=("b0", 2), data_time=21.0, setting=Setting(1.1e-4))
    assert decide(other, parameters, LIMITS, HERE)[1].reason is Reason.OLD_VERSION


UPDATES = st.builds(
    Update,
    servo=st.sampled_from(["axis-1", "axis-2"]),
    version=st.integers(1, 6),
    base_version=st.integers(0, 5),
    window=st.tuples(st.sampled_from(["b0", "b1"]), st.integers(0, 3)),
    data_time=st.floats(0.0, 6.0),
    gap=st.none(),
    std=st.none(),
    interval=st.just((None, None)),
    status=st.just("OK"),
    setting=st.builds(Setting, st.floats(0.0, 4e-4)),
    not_after=st.floats(0.0, 20.0),
)


@given(st.lists(st.tuples(UPDATES, st.integers(0, 20_000)), max_size=40))
def test_parameters_only_move_forward_and_stay_in_bounds(arrivals: list[tuple[Update, int]]) -> None:
    limits = Limits(maximum=3e-4, max_step=2e-4, lifetime_s=8.0)
    current, sample = Parameters(), 0
    for update, samples in arrivals:
        sample += samples
        after, receipt = decide(update, current, limits, Instant("axis-1", "b0", sample, 5000.0))
        assert receipt.parameter_version == after.version
        if after is not current:
            assert receipt.applied
            assert (after.version, after.sample) == (update.version, sample)
            assert after.version > current.version == update.base_version
            assert after.data_time > current.data_time
            assert after.setting.tolerance <= 3e-4
            assert abs(after.setting.tolerance - current.setting.tolerance) <= 2e-4
            assert sample / 5000.0 < update.not_after
        elif receipt.applied:
            assert (receipt.version, receipt.sample) == (current.version, current.sample)
        current = after


def test_two_updates_on_one_base_the_first_to_arrive_wins_and_the_newer_data_win_after_rebasing() -> None:
    older = replace(UPDATE, data_time=15.0)
    newer = replace(UPDATE, version=4, window=("b0", 2))
    current, _ = decide(older, CURRENT, LIMITS, HERE)
    later = Instant("axis-1", "b0", HERE.sample + 30_000, 5000.0)
    current, refused = decide(newer, current, LIMITS, later)
    assert (refused.reason, refused.parameter_version) == (Reason.BASE_MISMATCH, 3)
    rebased = replace(newer, version=5, base_version=refused.parameter_version)
    current, applied = decide(rebased, current, LIMITS, later)
    assert applied.applied
    assert current.window == ("b0", 2)


@pytest.mark.parametrize(
    "values",
    [
        {"minimum": -1.0}, {"minimum": 2.0, "maximum": 1.0}, {"minimum": nan}, {"minimum": inf}, {"max_step": 0.0},
        {"lifetime_s": nan}, {"interval_s": -1.0}, {"interval_s": inf},
    ],
)  # fmt: skip
def test_bad_limits_are_refused(values: dict[str, float]) -> None:
    with pytest.raises(InvalidInput, match="limits"):
        Limits(**values)


@pytest.mark.parametrize("values", [{"version": -1}, {"setting": Setting(nan)}, {"setting": Setting(-1e-9)}])
def test_bad_parameters_in_force_are_refused(values: dict[str, Any]) -> None:
    with pytest.raises(InvalidInput, match="in force"):
        Parameters(**values)
