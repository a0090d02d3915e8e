"""The gap of a loop that never overshoots: two windows of one contact each, on opposite sides."""

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from servotwin.estimation import whitened
from servotwin.estimation.core.response import response
from servotwin.estimation.estimate import CarriedOffset, GapBetween, GapEstimate, GapStatus, LastContact, OffsetReading
from servotwin.estimation.learning.machine import LearningSettings
from servotwin.estimation.learning.trend import TrendSettings
from servotwin.estimation.learning.wear import Wear
from servotwin.estimation.whitened import estimate_carrying
from servotwin.estimation.whitened.free_model import FactorPrior
from servotwin.estimation.window import Window
from servotwin.plant.servo import Servo
from servotwin.plant.signals import Samples, SCurve, SquareWave
from servotwin.simulation import Run, simulate

DEG = math.radians(1.0)
GAP = 28.0 * DEG
MODEL = Servo.preset("paper")
# Half the gain and no integral action: every step ends without overshoot, and pushes the screw one way only.
OWN = MODEL.controller
CALM = MODEL.replace(Kp=0.4 * OWN.Kp, Kd=0.4 * OWN.Kd, Ki=0.0)
LIVELY = MODEL.replace(Kp=0.8 * OWN.Kp, Kd=0.8 * OWN.Kd, Ki=0.0)
KNOWN = FactorPrior.of_spreads(0.001, 0.01, 0.0005, 0.001)
SETTINGS = whitened.WhitenedSettings()
STARTS = (9.7, 19.7, 29.7, 39.7)
"""Of windows about steps back, forth, back and forth, s."""
JUMPED = (
    "2 times the motor met the screw elsewhere than before on the same side, by more than wear moves it: an encoder "
    "slips, or the windows are of two machines; no gap is read from such windows together"
)
REFUSED = {GapStatus.UNIDENTIFIABLE, GapStatus.LOWER_BOUND}


@cache
def run(worn: float = 0.0) -> Run:
    """Steps of 0.5 mm to and fro; `worn`: growth of the gap in 50 s, rad."""
    gap = SCurve(GAP, GAP + worn, 50.0)
    return simulate(CALM, 50.0, reference=SquareWave(2.5e-4, 20.0), gap=gap, theta_d0=0.2 * GAP, sample_rate=1e3)


def windows(noise: float = 0.0, seed: int = 0, worn: float = 0.0) -> list[Window]:
    return noisy([Window.from_run(run(worn), start, 2.0) for start in STARTS], noise, seed)


def noisy(made: list[Window], noise: float = 1e-7, seed: int = 0) -> list[Window]:
    """With white noise (m) on the position."""
    rng = np.random.default_rng(seed)
    return [each.replace(position=each.position + noise * rng.standard_normal(each.position.size)) for each in made]


def later(window: Window, time: float) -> Window:
    """The same window, by `time` (s) later."""
    channels = {"position": window.position, "theta_m": window.theta_m, "voltage": window.voltage}
    return Window(**channels, sample_rate=window.sample_rate, start=window.start + time)


def estimates(made: list[Window], gap_rate: float = 0.0, servo: Servo = CALM) -> list[GapEstimate]:
    """Estimates one after the other, each with the contact of the one before; `gap_rate`: assumed growth, rad/s."""
    results: list[GapEstimate] = []
    for window in made:
        before = results[-1].contact if results else None
        settings = replace(SETTINGS, gap_rate=gap_rate)
        results.append(estimate_carrying(window, servo, None, settings, None, KNOWN, before))
    return results


def holds(estimate: GapEstimate, gap: float) -> bool:
    return estimate.interval[0] <= gap <= estimate.interval[1]


def test_two_windows_show_the_gap_and_a_third_confirms_it():
    """Without noise and growth, to a hundredth of a degree."""
    first, second, *later = estimates(windows())
    for alone in (first, second):
        assert alone.status in REFUSED
        assert alone.contact is not None
    assert first.contact.between is None
    assert second.contact.between.gap == pytest.approx(GAP, abs=0.01 * DEG)
    assert "another window must confirm it" in second.reasons[-1]
    for made, start in zip(later, STARTS[1:], strict=False):
        assert made.ok
        assert made.gap == pytest.approx(GAP, abs=0.01 * DEG)
        assert made.time == pytest.approx(start + 11.0, abs=0.01)
        assert made.offset.offset == pytest.approx(0.0, abs=0.01 * DEG)
        assert holds(made, GAP)
    assert [e.contact.side for e in (first, second, *later)] == [-1.0, 1.0, -1.0, 1.0]


@pytest.mark.slow
@pytest.mark.parametrize("noise", [1e-7, 4e-7])
def test_intervals_hold_in_noise(noise):
    """Errors of up to 2.5 standard deviations; the offset, the middle of both contacts, is told as well as the gap."""
    made = [each for seed in range(4) for each in estimates(windows(noise, seed))[2:]]
    accepted = [each for each in made if each.ok]
    assert len(accepted) >= 6
    assert all(holds(each, GAP) for each in accepted)
    assert max(abs(each.gap - GAP) / each.std for each in accepted) <= 2.5
    assert max(abs(each.offset.offset) / each.offset.std for each in accepted) <= 2.5


def test_the_gap_of_a_worn_screw_is_that_of_the_window():
    """Not of the middle between both contacts, 5 s before, when the gap was up to 0.3 deg narrower."""
    worn = 2.0 * DEG
    # Without any noise rounding decides what is growth: one processor was 0.086 deg off, within its interval.
    for each in estimates(windows(1e-8, worn=worn), gap_rate=0.2 * DEG)[2:]:
        true = float(run(worn).gap[round(1e3 * each.time)])
        assert each.ok
        assert each.gap == pytest.approx(true, abs=0.05 * DEG)
        assert holds(each, true)
        assert abs(each.offset.offset) <= 2.0 * each.offset.std


def test_moves_that_no_window_shows_change_nothing():
    """Two more steps between the windows of a pair: the last mass is back where it was, and so is the screw."""
    made = estimates([windows()[0], windows()[3]])
    assert made[-1].contact.between.gap == pytest.approx(GAP, abs=0.01 * DEG)


@pytest.mark.parametrize("start", [9.7, 10.2, 10.4, 11.0])
def test_where_the_screw_rests_is_told_by_windows_that_begin_in_a_move(start):
    """Motions at first hide where the screw was then; where it is at last must not suffer from that."""
    contact = estimates(noisy([Window.from_run(run(), start, 2.0)]), gap_rate=0.1 * DEG)[0].contact
    screw = contact.motor - contact.side * 0.5 * GAP
    assert contact.position / response(CALM, 1e3).static_gain == pytest.approx(screw, abs=3.0 * contact.std)


def test_a_window_that_begins_with_a_short_push_the_other_way_shows_no_gap():
    """The screw goes on by a quarter of a degree first, by which the way to the contact is too short."""
    steps = Samples([0.0, 2.0, 10.0, 12.0], [0.0, 2.5e-4, -2.5e-4, 2.5e-4])
    turned = simulate(CALM, 14.0, reference=steps, gap=GAP, theta_d0=0.2 * GAP, sample_rate=1e3)
    first, second = estimates(noisy([Window.from_run(turned, 9.7, 2.25), Window.from_run(turned, 11.95, 2.0)]))
    assert first.contact.side == -1.0
    assert not second.ok
    assert second.contact.between is None
    assert "two contacts show the gap to" in second.reasons[-1]


def test_two_pushes_the_same_way_show_no_gap():
    first, second, third, _ = windows()
    made = estimates([first, third, second])
    assert not any(each.ok for each in made)
    assert made[1].contact.between is None
    assert made[2].contact is not None


def test_a_gap_that_is_hardly_known_confirms_none():
    """The pair before is right by chance only: the next one, after a slip, must not rest on it."""
    first, second, third, _ = windows()
    contact = estimates([first])[0].contact
    vague = replace(contact, motor=contact.motor - 1.0 * DEG, std=1.0 * DEG)
    before, slipped = vague, []
    for window in (second, third.replace(theta_m=third.theta_m - 1.0 * DEG)):
        slipped.append(estimate_carrying(window, CALM, None, SETTINGS, None, KNOWN, before))
        before = slipped[-1].contact
    assert slipped[0].contact.between is None
    assert not slipped[1].ok
    assert slipped[1].contact.between.gap == pytest.approx(GAP + 1.0 * DEG, abs=0.01 * DEG)


def test_a_gap_narrower_than_the_lead_of_the_motor_before_does_not_count():
    """It closes by a degree between both windows, and two pairs of before show its mean by chance."""
    closed = SCurve(GAP, GAP - 1.0 * DEG, 0.5, begin=15.0)
    closing = simulate(CALM, 30.0, reference=SquareWave(2.5e-4, 20.0), gap=closed, theta_d0=0.2 * GAP, sample_rate=1e3)
    first, second = noisy([Window.from_run(closing, start, 2.0) for start in STARTS[:2]])
    contact = estimates([first])[0].contact
    assert contact.lead == pytest.approx(GAP, abs=0.1 * DEG)
    before = replace(contact, between=GapBetween(GAP - 0.5 * DEG, 0.001 * DEG, 5.0))
    made = estimate_carrying(second, CALM, None, SETTINGS, None, KNOWN, before)
    assert not made.ok
    assert "the motor leads the screw by 28 deg" in made.reasons[-1]


def told(made: list[GapEstimate]) -> list[str]:
    """Alarms of a wear that some windows move."""
    wear, trends, learning, sentences = Wear(0.0), TrendSettings(), LearningSettings(), []
    for each in made:
        before = wear
        wear, _ = before.update(trends, "a", each, each.time)
        sentences += wear.alarms(before, each, trends, learning)
    return sentences


@pytest.mark.slow
@pytest.mark.parametrize("wide", [5.6, 12.0])
def test_two_machines_by_turns_show_no_gap_between_theirs(wide):
    """Each contact is followed by the other machine's on the same side, half of the difference further out."""
    chains = []
    for gap, seed in ((5.0, 7), (wide, 12)):
        swung = simulate(LIVELY, 30.0, reference=SquareWave(1e-3, 12.0), gap=gap * DEG, sample_rate=1e3)
        chains.append(noisy([Window.from_run(swung, start, 2.0) for start in (5.7, 11.7, 17.7, 23.7)], 4e-7, seed))
    narrow = chains[0]
    others = [later(each, 3.0) for each in chains[1]]
    assert estimates(narrow, 0.05 * DEG, LIVELY)[-1].ok
    made = estimates([each for pair in zip(narrow, others, strict=True) for each in pair], 0.05 * DEG, LIVELY)
    assert not any(each.ok for each in made)
    assert told(made) == [JUMPED]


def test_the_pair_before_grows_with_the_contact_on_its_side():
    """Between the first contact and the last one, on the other side, is the mean of the gaps at both."""
    grown = simulate(
        CALM, 50.0, reference=SquareWave(2.5e-4, 20.0), gap=SCurve(GAP, GAP + 2.0 * DEG, 50.0), sample_rate=1e3
    )
    made = estimates(noisy([Window.from_run(grown, start, 2.0) for start in (9.7, 19.7, 39.7)], 1e-8), 0.2 * DEG)
    first, *_, last = (each.contact for each in made)
    at_both = [float(grown.gap[round(1e3 * each.time)]) for each in (first, last)]
    assert last.between.gap == pytest.approx(np.mean(at_both), abs=0.05 * DEG)
    assert last.between.time == pytest.approx(0.5 * (first.time + last.time), abs=1.0)
    assert last.jumps == 0


@pytest.mark.parametrize("slip", [-1.0, 1.0])
def test_an_encoder_that_slips_between_two_windows_confirms_nothing(slip):
    """The pair that straddles the slip is off by it; neither it nor the next pair, which it contradicts, counts."""
    first, *later = windows()
    slipped = [each.replace(theta_m=each.theta_m + slip * DEG) for each in later]
    made = estimates([first, *slipped])
    assert made[1].contact.between.gap == pytest.approx(GAP + slip * DEG, abs=0.01 * DEG)
    assert not made[2].ok
    assert "the two before" in made[2].reasons[-1]
    assert made[3].ok
    assert holds(made[3], GAP)


def test_a_position_that_drifts_to_and_fro_is_contained():
    """By 0.3 deg of the screw from window to window: the pairs are off by that, one way and the other."""
    gain = (windows()[1].position[0] - windows()[0].position[0]) / (57.0 * DEG)
    drifted = [each.replace(position=each.position + 0.3 * DEG * gain * k) for k, each in enumerate(windows())]
    accepted = [each for each in estimates(drifted, gap_rate=0.1 * DEG) if each.ok]
    assert accepted
    for each in accepted:
        assert abs(each.gap - GAP) >= 0.2 * DEG
        assert holds(each, GAP)


def test_contacts_contradict_a_wrong_offset():
    first, second, third, _ = windows(1e-7)
    contacts = [each.contact for each in estimates([first, second])]

    def estimated(window: Window, offset: float, before: LastContact | None) -> GapEstimate:
        return estimate_carrying(window, CALM, None, SETTINGS, (offset * DEG, 0.001 * DEG), KNOWN, before)

    for window, before in ((second, None), (second, contacts[0]), (third, contacts[1])):
        aided = estimated(window, 0.0, before)
        assert isinstance(aided.offset, CarriedOffset)
        assert holds(aided, GAP)
        assert aided.contact is not None
    # An offset that is half a degree off makes a gap that is a degree off, unless a contact contradicts it.
    assert not holds(estimated(second, 0.5, None), GAP)
    assert not estimated(second, 0.5, contacts[0]).ok
    corrected = estimated(third, 0.5, contacts[1])
    assert isinstance(corrected.offset, OffsetReading)
    assert holds(corrected, GAP)


def test_a_contact_that_has_jumped_or_a_gap_that_has_fallen_doubts_the_offset():
    """A new screw in the same boot: with the old offset a window was 0.6 deg off, and its pair took that for wear."""
    first, second, third, _ = windows(1e-7)
    contact = estimates([first, second])[1].contact
    offset = (0.0, 0.001 * DEG)

    def estimated(before: LastContact) -> GapEstimate:
        return estimate_carrying(third, CALM, None, replace(SETTINGS, gap_rate=0.1 * DEG), offset, KNOWN, before)

    assert isinstance(estimated(contact).offset, CarriedOffset)
    by_contacts = estimated(replace(contact, jumps=1))
    assert isinstance(by_contacts.offset, OffsetReading)
    assert by_contacts.contact.jumps == 0
    alone = replace(contact, jumps=1, between=None)
    assert not estimated(alone).ok
    assert estimated(alone).contact.jumps == 1
    wider = replace(contact.between, gap=contact.between.gap + 0.5 * DEG)
    assert not estimated(replace(contact, between=wider)).ok


def test_a_window_of_both_sides_ends_the_doubt_of_contacts_that_jumped():
    wear, settings = Wear(0.0), TrendSettings()
    second = estimates(windows()[:2])[1]
    jumped = replace(second, contact=replace(second.contact, jumps=1))
    after, _ = wear.update(settings, "a", jumped, 0.0)
    assert after.jumps == 1
    both = replace(second, status=GapStatus.OK, contact=None, gap=GAP, std=0.01 * DEG, std_total=0.02 * DEG)
    shown, _ = after.update(settings, "a", both, 0.0)
    assert (shown.jumps, shown.contact) == (0, None)
    assert after.update(settings, "a", replace(both, status=GapStatus.LOWER_BOUND), 0.0)[0].jumps == 1


def test_wear_keeps_the_newest_contact_of_a_boot():
    wear, settings = Wear(0.0), TrendSettings()
    first, second, *_ = estimates(windows())
    after, _ = wear.update(settings, "a", second, 0.0)
    assert after.expect(settings, "a", 30.0, 0.0).contact == second.contact
    assert after.expect(settings, "b", 30.0, 0.0).contact is None
    assert after.update(settings, "a", first, 0.0)[0].contact == second.contact
    assert after.update(settings, "b", first, 0.0)[0].contact == first.contact


def test_a_later_contact_is_not_used():
    second = windows()[1]
    later = LastContact(1.0, 1.0, 1e-3, 1e-6, 60.0, GapBetween(GAP, 1e-3, 55.0))
    alone = estimate_carrying(second, CALM, None, SETTINGS, None, KNOWN, later)
    assert not alone.ok
    assert alone.contact.between is None
