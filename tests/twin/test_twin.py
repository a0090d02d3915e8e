"""The twin in memory: once per window, forward only, rebased when refused."""

import math
from dataclasses import replace

import numpy as np
import pytest
from twin_messages import PITCH, eq_21, known_gap, make, receipt, twin_of, window_message

from servotwin import messages
from servotwin.errors import InvalidInput
from servotwin.estimation.estimate import GapEstimate, GapStatus
from servotwin.estimation.learning.trend import TrendSettings
from servotwin.estimation.learning.wear import Expectation
from servotwin.estimation.window import Window
from servotwin.messages import (
    Acknowledge,
    Hello,
    InvalidMessage,
    Reason,
    Setting,
    pack_channel,
)
from servotwin.twin.estimating import decode_channel, decode_window
from servotwin.twin.evidence_log import EvidenceLog
from servotwin.twin.model import TwinModel
from servotwin.twin.settings import TwinSettings
from servotwin.twin.twin import Twin


def test_a_window_is_acknowledged_and_answered_with_an_update():
    twin, store = make(validity=7.0)
    acknowledge, update = twin.receive(window_message(3, start=20.0), now=22.0)
    assert acknowledge == Acknowledge("axis", "boot-1", 3)
    assert update.window == ("boot-1", 3)
    assert (update.version, update.base_version, update.data_time, update.not_after) == (1, 0, 20.0, 27.0)
    assert update.gap == pytest.approx(0.2)
    assert update.setting.tolerance == pytest.approx(PITCH * 0.2)
    assert store.updates == [update]
    assert messages.decode(messages.encode(update)) == update


def test_a_duplicate_is_acknowledged_again_but_not_estimated_again():
    calls = []

    def counting(window, prior):
        calls.append(window.start)
        return known_gap(window, prior)

    twin, store = make(counting)
    first = twin.receive(window_message(1), 0.0)
    second = twin.receive(window_message(1), 1.0)
    assert second == first[:1]
    assert len(calls) == len(store.windows) == 1


def test_the_window_is_safe_before_it_is_acknowledged():
    class Broken(EvidenceLog):
        def add_window(self, _):
            raise OSError("disk full")

    twin = Twin("axis", TwinModel(known_gap, eq_21(), TwinSettings()), Broken())
    with pytest.raises(OSError, match="disk full"):
        twin.receive(window_message(), 0.0)


def test_the_previous_estimate_is_the_next_ones_prior():
    priors = []

    def keeping(window, expected):
        priors.append(expected.previous)
        return known_gap(window, expected)

    twin, _ = make(keeping, initial_gap=0.5)
    for sequence, start in enumerate((10.0, 30.0, 20.0, 40.0)):
        twin.receive(window_message(sequence, start), start)
    assert priors == pytest.approx([0.5, 0.1, 0.3, 0.3])


def test_an_older_window_is_estimated_but_moves_nothing():
    twin, store = make()
    twin.receive(window_message(1, 20.0), 21.0)
    answer = twin.receive(window_message(0, 10.0), 22.0)
    assert [type(m) for m in answer] == [Acknowledge]
    assert len(store.estimates) == 2


@pytest.mark.parametrize("status", [s for s in GapStatus if s is not GapStatus.OK])
def test_only_a_good_estimate_sets_parameters(status):
    twin, store = make(lambda w, p: replace(known_gap(w, p), status=status))
    assert len(twin.receive(window_message(start=20.0), 0.0)) == 1
    assert next(iter(store.estimates.values())).status is status


def measured(gaps: dict[float, float]):
    """A fake estimator: the gap (rad) by the window's start (s), with a spread of 0.001 rad, always sure of itself."""

    def estimate(window: Window, _expected: Expectation) -> GapEstimate:
        gap = gaps[window.start]
        return GapEstimate(gap, 1e-3, 1e-3, (gap - 2e-3, gap + 2e-3), GapStatus.OK, window.mid_time)

    return estimate


def fed(gaps: dict[float, float]):
    """The updates that a twin sends for windows with these gaps, by their window's start, and its store."""
    slow = TwinSettings(trend=TrendSettings.for_wear(0.1, 1000.0))
    twin = twin_of(measured(gaps), eq_21(), slow)
    answers = {start: twin.receive(window_message(k, start), start)[1:] for k, start in enumerate(gaps)}
    return {start: update.gap for start, answer in answers.items() for update in answer}, twin.log


def test_an_outlier_does_not_reach_the_controller_however_sure_the_estimate_is():
    sent, store = fed({10.0: 0.1, 20.0: 0.1, 30.0: 0.4, 40.0: 0.1})
    assert sent == {10.0: 0.1, 20.0: 0.1, 40.0: 0.1}
    outlier = store.trends["axis", "boot-1", 2]
    assert outlier.refused == 1
    assert "being an outlier" in outlier.reasons[0]
    assert store.estimates["axis", "boot-1", 2].ok


def test_two_outliers_that_agree_are_a_real_change():
    sent, store = fed({10.0: 0.1, 20.0: 0.1, 30.0: 0.4, 40.0: 0.4, 50.0: 0.4})
    assert sent == {10.0: 0.1, 20.0: 0.1, 40.0: 0.4, 50.0: 0.4}
    assert "starts afresh" in store.trends["axis", "boot-1", 3].reasons[0]


def test_outliers_that_contradict_each_other_send_nothing():
    sent, _ = fed({10.0: 0.1, 20.0: 0.1, 30.0: 0.4, 40.0: 0.2, 50.0: 0.6, 60.0: 0.1})
    assert sent == {10.0: 0.1, 20.0: 0.1, 60.0: 0.1}


def test_updates_follow_each_other_without_waiting_for_receipts():
    twin, _ = make()
    _, first = twin.receive(window_message(0, 10.0), 11.0)
    _, second = twin.receive(window_message(1, 20.0), 21.0)
    assert (first.version, first.base_version, second.version, second.base_version) == (1, 0, 2, 1)


def test_a_refused_base_is_replaced_by_what_is_in_force():
    twin, _ = make()
    _, lost = twin.receive(window_message(0, 10.0), 11.0)
    _, update = twin.receive(window_message(1, 20.0), 21.0)
    (again,) = twin.receive(receipt(update, Reason.BASE_MISMATCH, in_force=0), 24.0)
    assert (again.version, again.base_version) == (3, 0)
    assert (again.setting.tolerance, again.window) == (update.setting.tolerance, update.window)
    assert twin.receive(receipt(again), 27.0) == []
    assert twin.next_wake() is None
    assert lost.version == 1


def test_what_follows_on_a_refused_update_is_put_on_what_is_in_force():
    """A twin that is behind: its updates follow on one another, and the first one comes too late."""
    twin, _ = make()
    sent = [twin.receive(window_message(k, 10.0 * (k + 1)), 10.0 * k + 11.0)[1] for k in range(4)]
    assert [update.base_version for update in sent] == [0, 1, 2, 3]
    (again,) = twin.receive(receipt(sent[0], Reason.EXPIRED, in_force=0), 45.0)
    assert (again.version, again.base_version, again.window) == (5, 0, sent[3].window)
    for update in sent[1:]:
        assert twin.receive(receipt(update, Reason.BASE_MISMATCH, in_force=0), 46.0) == []
    _, following = twin.receive(window_message(4, 50.0), 51.0)
    assert (following.version, following.base_version) == (6, 5)
    (last,) = twin.receive(receipt(again, Reason.EXPIRED, in_force=0), 52.0)
    assert (last.version, last.base_version) == (7, 0)
    assert twin.receive(receipt(last), 53.0) == []
    assert twin.next_wake() is None


@pytest.mark.parametrize(("reason", "in_force"), [(Reason.APPLIED, 1), (Reason.SUPERSEDED, 0), (Reason.OLD_VERSION, 1)])
def test_what_follows_on_an_update_that_may_hold_is_left_alone(reason, in_force):
    twin, _ = make()
    sent = [twin.receive(window_message(k, 10.0 * (k + 1)), 10.0 * k + 11.0)[1] for k in range(2)]
    assert twin.receive(receipt(sent[0], reason, in_force=in_force), 25.0) == []


def test_a_twin_that_lost_its_memory_catches_up_with_the_edge():
    twin, _ = make()
    _, update = twin.receive(window_message(0, 10.0, version=0), 11.0)
    (again,) = twin.receive(receipt(update, Reason.OLD_VERSION, in_force=17), 12.0)
    assert (again.version, again.base_version) == (18, 17)
    _, following = twin.receive(window_message(1, 20.0, version=18), 21.0)
    assert following.version == 19


def test_a_second_copy_refused_as_old_ends_the_waiting():
    twin, _ = make()
    _, update = twin.receive(window_message(0, 10.0), 11.0)
    assert twin.receive(receipt(update, Reason.OLD_VERSION, in_force=update.version), 12.0) == []
    assert twin.next_wake() is None


@pytest.mark.parametrize("reason", [Reason.EXPIRED, Reason.OUT_OF_BOUNDS, Reason.STEP_TOO_LARGE, Reason.OLD_DATA])
def test_what_was_refused_for_its_content_is_not_insisted_on(reason):
    twin, _ = make()
    _, update = twin.receive(window_message(0, 10.0), 11.0)
    assert twin.receive(receipt(update, reason, in_force=0), 12.0) == []
    assert twin.next_wake() is None


def test_an_update_without_receipt_is_sent_again_a_few_times():
    twin, _ = make(retry=5.0, attempts=3)
    _, update = twin.receive(window_message(0, 10.0), 11.0)
    assert twin.wake(15.9) == []
    assert twin.wake(16.0) == [update]
    assert twin.wake(21.0) == [update]
    assert twin.wake(26.0) == []
    assert twin.next_wake() is None
    _, following = twin.receive(window_message(1, 20.0), 30.0)
    assert following.base_version == 0


def test_too_soon_is_tried_again_later():
    twin, _ = make(retry=5.0)
    _, update = twin.receive(window_message(0, 10.0), 11.0)
    assert twin.receive(receipt(update, Reason.TOO_SOON, in_force=0), 12.0) == []
    assert twin.wake(16.0) == [update]


def test_after_a_reboot_only_windows_of_the_new_boot_count():
    twin, store = make()
    twin.receive(window_message(0, 10.0), 11.0)
    twin.receive(Hello("axis", "boot-2", 0.0, 100.0, 1, Setting(0.0), "model"), 12.0)
    assert len(twin.receive(window_message(1, 99.0), 13.0)) == 1
    _, update = twin.receive(window_message(0, 9.0, boot="boot-2", version=1), 14.0)
    assert (update.version, update.base_version, update.window) == (2, 1, ("boot-2", 0))
    assert len(store.estimates) == 3


def test_a_window_that_cannot_be_used_is_recorded_with_the_reason():
    twin, store = make()
    message = window_message(channels=(pack_channel("theta_m", "rad", [0.0] * 20),))
    assert len(twin.receive(message, 0.0)) == 1
    (estimate,) = store.estimates.values()
    assert estimate.status is GapStatus.UNIDENTIFIABLE
    assert math.isnan(estimate.gap)
    assert "'position' is missing" in estimate.reasons[0]


def test_a_window_in_a_wrong_unit_is_refused():
    message = window_message(channels=(pack_channel("position", "mm", [0.0] * 20),))
    with pytest.raises(InvalidInput, match="'mm'; it must be in 'm'"):
        decode_window(message)


@pytest.mark.parametrize(
    "message", [window_message(servo="other"), Acknowledge("axis", "b", 0), Acknowledge("other", "b", 0)]
)
def test_foreign_messages_are_refused(message):
    twin, store = make()
    with pytest.raises(InvalidMessage):
        twin.receive(message, 0.0)
    assert not store.windows


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("k_dz", -1.0),
        ("retry", 0.0),
        ("validity", math.inf),
        ("processing", "1"),
        ("attempts", 0),
        ("initial_gap", math.nan),
    ],
)
def test_settings_out_of_range(name, value):
    with pytest.raises(InvalidInput, match=name):
        TwinSettings(**{name: value})


def test_a_fine_channel_joins_its_own():
    """With it an angle has 32 bits."""
    samples = 700.0 * np.random.default_rng(5).normal(size=1000)
    position = pack_channel("position", "m", samples)
    whole = decode_window(window_message(channels=(position, *messages.pack_finely("theta_m", "rad", samples))))
    half = decode_window(window_message(channels=(position, pack_channel("theta_m", "rad", samples))))
    assert np.max(np.abs(half.theta_m - samples)) > 1e-3
    assert np.max(np.abs(whole.theta_m - samples)) < 1e-6


def test_decoding_equals_the_edges_own():
    channel = pack_channel("position", "m", np.random.default_rng(5).normal(size=1000))
    assert decode_channel(channel).tolist() == list(messages.unpack_channel(channel))
