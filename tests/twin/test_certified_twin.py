"""The certified policy in the twin: what is sent where something is wrong, and what is not."""

import math
from dataclasses import replace

import msgspec
import numpy as np
import pytest
from twin_messages import twin_of

from servotwin import messages
from servotwin.control.gains import gains_of
from servotwin.estimation.disturbance import Disturbance
from servotwin.estimation.estimate import GapEstimate, GapStatus
from servotwin.messages import Acknowledge, Gains, Setting, Update, pack_channel
from servotwin.plant.servo import Servo
from servotwin.redesign.certified import policy as policies
from servotwin.redesign.certified.certificate import NotVerified
from servotwin.redesign.certified.demands import Demands
from servotwin.redesign.certified.policy import band_of
from servotwin.redesign.certified.uncertainty import Uncertainty
from servotwin.redesign.certified.verification import verification_of
from servotwin.redesign.registry import certified_policy, policy_of
from servotwin.twin.model import TwinModel
from servotwin.twin.settings import TwinSettings
from servotwin.twin.state import decode_state, encode_state
from servotwin.twin.twin import Twin

PAPER = Servo.preset("paper")
FEW = Demands(machines=16, screened=2, scales=(0.5, 0.7), settled=0.8)
SETTINGS = TwinSettings(demands=FEW)


def disturbed(bias, noise=0.0):
    """As a long rest shows it."""
    return Disturbance(bias, 1e-4, noise, 10.0, abs(bias))


def window(sequence=0, start=20.0):
    rng = np.random.default_rng(sequence)
    channels = tuple(
        pack_channel(name, unit, rng.normal(size=50)) for name, unit in (("position", "m"), ("theta_m", "rad"))
    )
    crc = messages.checksum(channels)
    return messages.WindowMessage("axis", "boot-1", sequence, start, 100.0, channels, (), 0, "model", "test", crc)


def answer(gap_deg=(4.9, 5.1), settings=SETTINGS, observed=None, status=GapStatus.OK):
    """What the twin says to a window, and its reason."""
    low, high = map(math.radians, gap_deg)
    middle = 0.5 * (low + high) if math.isfinite(high) else low

    def estimator(_window, _expected):
        return GapEstimate(middle, 0.0, 0.0, (low, high), status, 21.0)

    policy = policy_of(PAPER, settings)
    start = Setting(0.0, gains_of(PAPER.controller))
    twin = twin_of(estimator, policy, settings, observer=lambda _window: observed or disturbed(0.05), start=start)
    # Two rests before agree with this one: until then a voltage at rest may be that of friction.
    bias = (observed or disturbed(0.05)).bias
    twin._state = msgspec.structs.replace(twin._state, rests=(bias, bias) if abs(bias) > 0.0 else ())
    acknowledge, *sent = twin.receive(window(), 0.0)
    assert isinstance(acknowledge, Acknowledge)
    return sent, twin.log.redesigns["axis", "boot-1", 0]


@pytest.mark.slow
def test_what_is_verified_is_sent_with_its_certificate_and_band():
    (update,), redesign = answer()
    assert isinstance(update, Update)
    assert update.setting.gains.feedforward == pytest.approx(-0.05)
    assert update.setting.gains.Ki == 0.0
    assert update.verification == verification_of(redesign.certificate)
    assert update.verification.members == redesign.certificate.members
    assert update.setting.band == redesign.setting.band
    assert redesign.reason == ""


@pytest.mark.slow
@pytest.mark.parametrize("gap_deg", [(55.0, 61.0), (70.0, 80.0), (10.0, math.inf)])
def test_an_interval_wider_than_what_is_certified_sends_nothing(gap_deg):
    sent, redesign = answer(gap_deg)
    assert sent == []
    assert redesign.setting is None
    assert redesign.reason.startswith(f"the gap may be {gap_deg[0]:g} to ")
    assert "at most 60 deg are certified" in redesign.reason


def test_an_empty_set_of_candidates_sends_nothing():
    sent, redesign = answer(settings=SETTINGS.replace(demands=replace(FEW, Ms=1.01)))
    assert sent == []
    assert "no candidate has Ms <= 1.01 on this servo" in redesign.reason


@pytest.mark.slow
def test_where_the_whole_range_cannot_be_verified_nothing_is_sent():
    known = Uncertainty(input_bias=(0.0, 0.0))
    settings = SETTINGS.replace(uncertainty=known, demands=replace(FEW, overshoot=0.001))
    sent, redesign = answer(settings=settings)
    assert sent == []
    assert redesign.reason.startswith("no fallback set for the servo's stated range: none of ")


@pytest.mark.slow
def test_where_nothing_is_verified_the_fallback_set_is_sent_with_the_reason():
    """A bias beyond what may be fed forward leaves more error than the fallback set's band has room for.

    It is beyond the stated ones too: the fallback set is sent as it was verified.
    """
    settings = SETTINGS.replace(demands=replace(FEW, integral=(0.0,)))
    (update,), redesign = answer(settings=settings, observed=disturbed(0.4))
    fallback_certificate = certified_policy(PAPER, settings).fallback()
    assert "is verified: the best is off by" in redesign.reason
    assert redesign.reason.endswith("; the fallback set is sent")
    assert update.setting.gains == gains_of(fallback_certificate.setting.controller)
    assert update.setting.band == band_of(fallback_certificate)


def test_an_estimate_that_is_not_ok_sends_nothing_on_the_first_window_unless_it_shows_a_bias():
    unknown = Disturbance(math.nan, math.inf, math.nan, 0.0, 0.0)
    for observed in (unknown, disturbed(0.0)):
        sent, redesign = answer(status=GapStatus.UNIDENTIFIABLE, observed=observed)
        assert sent == []
        assert "unidentifiable" in redesign.reason


def test_a_bias_is_cancelled_whatever_the_gap():
    """Without a usable estimate the setting is verified for every gap of the stated range."""
    (update,), redesign = answer(status=GapStatus.UNIDENTIFIABLE)
    assert update.setting.gains.feedforward == -0.05
    assert update.status == GapStatus.UNIDENTIFIABLE.value
    assert redesign.certificate.gap == SETTINGS.uncertainty.gap


@pytest.mark.slow
def test_nothing_is_proposed_that_may_leave_the_fallback_sets_band():
    """Whatever the noise: a dead zone opens the loop inside the band only."""
    for gap in (2.0, 10.0, 40.0):
        noisy = disturbed(0.0, 2e-4)
        sent, redesign = answer((gap - 0.1, gap + 0.1), observed=noisy)
        fallback_certificate = certified_policy(PAPER, SETTINGS).fallback()
        assert sent
        assert isinstance(sent[0].setting.gains, Gains)
        assert redesign.certificate.tail <= fallback_certificate.tail
        assert sent[0].setting.tolerance * sent[0].setting.gains.leave <= band_of(fallback_certificate).error


def test_a_search_that_found_nothing_is_not_repeated_by_a_twin_that_was_restored(monkeypatch):
    """The state carries the question and its result: the second window is answered as the first one."""
    searches = []

    def nothing(*question):
        searches.append(question)
        return NotVerified("nothing found")

    monkeypatch.setattr(policies, "certify", nothing)
    gap = GapEstimate(math.radians(5.0), 0.0, 0.0, (math.radians(4.9), math.radians(5.1)), GapStatus.OK, 21.0)
    model = TwinModel(
        lambda _window, _expected: gap,
        policy_of(PAPER, SETTINGS),
        SETTINGS,
        observer=lambda _window: disturbed(0.05),
        start=Setting(0.0, gains_of(PAPER.controller)),
    )
    first = Twin("axis", model)
    first._state = msgspec.structs.replace(first._state, rests=(0.05, 0.05))
    _, sent = first.receive(window(), 0.0)
    again = Twin("axis", model, state=first.state())
    _, repeated = again.receive(window(1, 40.0), 20.0)
    assert len(searches) == 1
    assert repeated.setting == sent.setting
    assert again.log.redesigns["axis", "boot-1", 1].reason.startswith("nothing found; the ranges have not become")
    without = msgspec.structs.replace(decode_state("axis", first.state()), search=None)
    Twin("axis", model, state=encode_state(without)).receive(window(1, 40.0), 20.0)
    assert len(searches) == 2
