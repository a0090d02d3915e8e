"""Residual of a stored window: repeated from what is stored, and its whiteness."""

import math
import re
import time

import dashboard_fleet
import msgspec
import numpy as np
import pytest
from dashboard_fleet import WEARING, wearing_fleet

from servotwin.dashboard.residual_view import StoredFit, autocorrelation, residual_view
from servotwin.errors import InvalidInput
from servotwin.messages import MAX_BYTES
from servotwin.messages.codec import decompress
from servotwin.store.store import open_store


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
            patched.setattr(dashboard_fleet, name, text)
        return stored_fits(wearing_fleet(tmp_path_factory.mktemp("drive"), time.time()))


@pytest.mark.slow
def test_an_output_error_fit_has_a_residual_too(drive):
    assert drive
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
