"""Residual of a stored window: repeated from what is stored, and its whiteness."""

import dataclasses
import math
import re
import time

import dashboard_fleet
import msgspec
import numpy as np
import pytest
from dashboard_fleet import WEARING, wearing_fleet

import servotwin as st
from servotwin.dashboard.residual_view import StoredFit, autocorrelation, residual_view
from servotwin.errors import InvalidInput
from servotwin.estimation.learning.trend import TrendSettings
from servotwin.estimation.learning.wear import Expectation
from servotwin.messages import MAX_BYTES, WindowMessage, checksum, encode
from servotwin.messages.codec import decompress
from servotwin.messages.windows import pack_finely
from servotwin.store.store import open_store
from servotwin.twin.context import context_of
from servotwin.twin.estimating import decode_window, estimator_of
from servotwin.twin.evidence import GapEstimateRecord
from servotwin.twin.evidence_rows import rows
from servotwin.twin.settings import TwinSettings


@pytest.fixture(scope="module")
def fits(tmp_path_factory):
    """The windows of a machine that wears, with what is stored of them."""
    return stored_fits(wearing_fleet(tmp_path_factory.mktemp("twin"), time.time()))


def stored_fits(path):
    store = open_store(f"sqlite:///{path.parent}/twin.db")
    found = []
    for trace in store.audit(WEARING):
        stored = store.window(WEARING, trace.window.boot, trace.window.sequence)
        for each in (one for one in trace.evidence if one.kind == "estimate"):
            context = store.contexts([each.context])[each.context]
            found.append(StoredFit(decompress(stored.body, stored.encoding, MAX_BYTES), each.body, context))
    store.close()
    return found


@pytest.mark.slow
def test_the_residual_is_that_of_the_stored_estimate(fits):
    assert len(fits) > 2
    for fit in fits:
        view = residual_view(fit)
        stated = msgspec.msgpack.decode(fit.body)["estimate"]["rms"]
        assert view["rms"] == pytest.approx(stated, rel=0.05)
        assert len(view["autocorrelation"]) == len(view["autocorrelation_white"]) == view["lags"]
        assert view["band"] == pytest.approx(1.96 / math.sqrt(len(view["residual"])), rel=0.9)
        assert max(map(abs, view["residual"])) < 20.0 * view["rms"]
        msgspec.json.encode(view)


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    """The same of a drive whose shaft is free in the gap."""
    with pytest.MonkeyPatch.context() as patched:
        for name in ("SERVOS", "SCENARIO"):
            text = getattr(dashboard_fleet, name).replace('servo = "paper"', 'servo = "two-mass-drive"')
            text = re.sub(r"\[models.axis.controller\]\nsample_rate_hz = .*\n|controller = .*\n", "", text)
            text = text.replace("amplitude_mm = 1.0, period_s = 20.0", "amplitude_deg = 10.0, period_s = 4.0")
            text = text.replace('"hysteresis"', '"paper"').replace("sample_rate_hz = 1000.0", "sample_rate_hz = 500.0")
            text = text.replace("duration_s = 40.0", "duration_s = 8.0")
            patched.setattr(dashboard_fleet, name, text)
        return stored_fits(wearing_fleet(tmp_path_factory.mktemp("drive"), time.time()))


@pytest.mark.slow
def test_an_output_error_fit_has_a_residual_too(drive):
    assert len(drive) > 1
    for fit in drive[:2]:
        view = residual_view(fit)
        assert view["of"] == "position"
        assert view["rms"] == pytest.approx(msgspec.msgpack.decode(fit.body)["estimate"]["rms"], rel=1e-6)
        assert len(view["autocorrelation_white"]) == view["lags"]
        msgspec.json.encode(view)


@pytest.mark.slow
def test_what_cannot_be_read_is_one_sentence(fits):
    fit = fits[0]
    for broken in (
        msgspec.structs.replace(fit, window=b"none"),
        msgspec.structs.replace(fit, body=b"none"),
        msgspec.structs.replace(fit, context="{}"),
    ):
        with pytest.raises(InvalidInput):
            residual_view(broken)


def test_white_noise_has_no_autocorrelation_and_a_swing_has():
    noise = np.random.default_rng(7).normal(size=4000)
    white = autocorrelation(noise, 60)
    assert np.mean(np.abs(white) > 1.96 / math.sqrt(noise.size)) < 0.1
    swing = autocorrelation(np.sin(0.1 * np.arange(4000)), 60)
    assert swing[0] == pytest.approx(math.cos(0.1), abs=2e-3)
    assert autocorrelation(np.ones(100), 60).tolist() == [0.0] * 25


@pytest.fixture(scope="module")
def motor_fit():
    """A window of a ball screw whose controller reads the motor's encoder, with its estimate, as a twin stores them."""
    light = st.Axis.preset("ball-screw")
    sensors = dataclasses.replace(light.sensors, feedback="motor")
    screw = light.replace(load=dataclasses.replace(light.load, m=(100.0,)), sensors=sensors)
    gap, begin, rate = 25e-6 / screw.p, 0.38, 2000.0
    run = st.simulate(screw, 0.6, reference=st.SquareWave(2.5e-4, 0.8), gap=gap, sample_rate=rate)
    seen = st.Window.from_run(run, begin, 0.2)
    angle, command = (*pack_finely("theta_m", "rad", seen.theta_m),), pack_finely("voltage", "V", seen.voltage)
    channels = (*angle, *command, *pack_finely("position", "m", screw.p * seen.theta_m))
    sent = WindowMessage("s", "b", 1, begin, rate, channels, (), 0, screw.version, "test", checksum(channels))
    settings = TwinSettings(policy="paper", k_dz=0.0, trend=TrendSettings.for_wear(gap, 3600.0))
    expected = Expectation(gap)
    estimate = estimator_of(screw, settings)(decode_window(sent), expected)
    (row,) = rows([GapEstimateRecord(sent, estimate, expected, None)], 1, "")
    assert estimate.ok, estimate.reasons
    return StoredFit(encode(sent), row.body, context_of(screw, settings)[1]), estimate


@pytest.mark.slow
def test_a_fit_of_the_motor_s_side_leaves_the_residual_of_the_motor_s_angle(motor_fit):
    fit, estimate = motor_fit
    view = residual_view(fit)
    assert view["of"] == "motor"
    assert view["rms"] == pytest.approx(estimate.rms, rel=1e-6)
    assert len(view["autocorrelation"]) == len(view["autocorrelation_white"]) == view["lags"] == 60
    assert max(map(abs, view["residual"])) < 20.0 * view["rms"]
    msgspec.json.encode(view)


@pytest.mark.slow
def test_the_published_method_leaves_no_residual_and_says_so(fits):
    settings = TwinSettings(policy="paper", method="paper")
    fit = msgspec.structs.replace(fits[0], context=context_of(st.Servo.preset("paper"), settings)[1])
    with pytest.raises(InvalidInput, match="method 'paper' compares channels that it has filtered"):
        residual_view(fit)
