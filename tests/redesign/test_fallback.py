"""Certificates of fallback sets on disk: found again only by what they depend on, and harmless when damaged."""

import math
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from servotwin import Servo
from servotwin.errors import InvalidInput
from servotwin.redesign.certified import fallback
from servotwin.redesign.certified.certificate import BeyondResult, Certificate, LoopMargins, NotVerified
from servotwin.redesign.certified.demands import Demands
from servotwin.redesign.certified.fallback import cached_certificate, fallback_certificate
from servotwin.redesign.certified.trial import Trial
from servotwin.redesign.certified.uncertainty import Uncertainty
from servotwin.redesign.design import Design

SERVO = Servo.preset("paper")
CERTIFICATE = Certificate(
    setting=Design(SERVO.controller.replace(Ki=0.1 + 0.2, feedforward=1e-300), 1.0 / 3.0),
    gap=(0.0, 1.0), input_bias=(-0.1, 0.1), step=(1e-4, 2.5e-3), friction=(0.0, 0.0), members=300, settled=1.0,
    cost=0.2, tail=1e-5, tail_p95=1e-6, error_rms=1e-6, effort=0.1, overshoot=math.inf, settling=1.0,
    settling_worst=2.0, within=1e-4, Ms=1.5, crossover=3.0, phase_margin=1.0, saturated=False, looked_at=39,
    seconds=2.0,
    loop=LoopMargins(65, 3, 1.5, 3.0, 1.0, 1.9, math.inf, 0.9, 0.1, 0.5, -0.2),
    beyond=BeyondResult(0.1, 3, 0.0, 60, 1.0, 1e-5),
)  # fmt: skip
VALUES = {"servo.p": "0.001"}


def counted(certificate: Certificate = CERTIFICATE) -> tuple[Callable[[], Certificate], list[int]]:
    """A computation, and the list that grows with each of its calls."""
    calls: list[int] = []

    def compute() -> Certificate:
        calls.append(1)
        return certificate

    return compute, calls


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("SERVOTWIN_CACHE_DIR", str(tmp_path))
    return tmp_path / "certificates"


def file_of(folder: Path) -> Path:
    (path,) = folder.iterdir()
    return path


def test_it_is_computed_once_and_read_again_to_the_last_bit(folder: Path) -> None:
    compute, calls = counted()
    cached_certificate(VALUES, compute)
    again = cached_certificate(VALUES, compute)
    assert len(calls) == 1
    assert repr(again) == repr(CERTIFICATE)
    assert file_of(folder).stat().st_mode & 0o777 == 0o600


def test_other_values_code_or_processor_are_computed_anew(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    compute, calls = counted()
    cached_certificate(VALUES, compute)
    cached_certificate({"servo.p": "0.0010000000000000002"}, compute)
    assert len(calls) == 2
    environment = fallback._environment()
    for name in ("code", "numba", "processor"):
        with monkeypatch.context() as patch:
            patch.setattr(fallback, "_environment", lambda name=name: {**environment, name: "another"})
            cached_certificate(VALUES, compute)
    assert len(calls) == 5


def cut(data: bytes) -> bytes:
    return data[: len(data) // 2]


def one_bit(data: bytes) -> bytes:
    return data[:-9] + bytes([data[-9] ^ 1]) + data[-8:]


@pytest.mark.parametrize(
    "damage", [cut, one_bit, lambda _: b"", lambda _: b"no certificate", lambda _: bytes(2_000_000)]
)
def test_a_damaged_file_is_replaced(folder: Path, damage: Callable[[bytes], bytes]) -> None:
    compute, calls = counted()
    cached_certificate(VALUES, compute)
    path = file_of(folder)
    whole = path.read_bytes()
    path.write_bytes(damage(whole))
    assert cached_certificate(VALUES, compute) == CERTIFICATE
    assert len(calls) == 2
    assert path.read_bytes() == whole


def test_a_file_of_other_values_is_replaced(folder: Path) -> None:
    cached_certificate({"servo.p": "0.002"}, lambda: replace(CERTIFICATE, members=1))
    foreign = file_of(folder)
    cached_certificate(VALUES, lambda: CERTIFICATE)
    (path,) = set(folder.iterdir()) - {foreign}
    foreign.rename(path)
    assert cached_certificate(VALUES, lambda: CERTIFICATE).members == CERTIFICATE.members


def test_a_folder_that_cannot_be_made_costs_time_only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("SERVOTWIN_CACHE_DIR", str(tmp_path / "file"))
    compute, calls = counted()
    assert cached_certificate(VALUES, compute) == cached_certificate(VALUES, compute) == CERTIFICATE
    assert len(calls) == 2


def test_an_empty_variable_switches_the_cache_off(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SERVOTWIN_CACHE_DIR", "")
    monkeypatch.chdir(tmp_path)
    assert cached_certificate(VALUES, lambda: CERTIFICATE) == CERTIFICATE
    assert not list(tmp_path.iterdir())


def test_an_exception_passes_and_leaves_no_file(folder: Path) -> None:
    def refuse() -> Certificate:
        raise InvalidInput("no fallback set")

    with pytest.raises(InvalidInput, match="no fallback set"):
        cached_certificate(VALUES, refuse)
    assert not folder.exists()


def test_the_oldest_files_are_removed(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fallback, "MOST_FILES", 3)
    for k in range(6):
        cached_certificate({"servo.p": str(k)}, lambda: CERTIFICATE)
    assert len(list(folder.iterdir())) == 3
    compute, calls = counted()
    cached_certificate({"servo.p": "5"}, compute)
    assert not calls


def test_many_at_once_do_no_harm(folder: Path) -> None:
    results: list[Certificate] = []

    def often() -> None:
        results.extend(cached_certificate({"servo.p": str(k % 3)}, lambda: CERTIFICATE) for k in range(30))

    threads = [threading.Thread(target=often) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert results == [CERTIFICATE] * 120
    assert len(list(folder.iterdir())) == 3


def test_everything_that_is_given_counts(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also what a representation leaves out, as that of the uncertainty does; the number of threads does not."""
    seen: list[object] = []
    monkeypatch.setattr(fallback, "certify", lambda *given: seen.append(given) or CERTIFICATE)
    known, demands, trial = Uncertainty(), Demands(), Trial()
    given = [
        (SERVO, known, demands, trial),
        (SERVO.replace(k=9e3), known, demands, trial),
        (SERVO.replace(Kd=0.9 * SERVO.controller.Kd), known, demands, trial),
        (SERVO, known.replace(usual_step=(1e-3, 1e-3)), demands, trial),
        (SERVO, known, replace(demands, beyond=replace(demands.beyond, delay=2)), trial),
        (SERVO, known, demands, replace(trial, rate=49.0)),
    ]
    for each in given:
        fallback_certificate.cache_clear()
        fallback_certificate(*each)
    assert len(seen) == len(list(folder.iterdir())) == 6
    fallback_certificate.cache_clear()
    fallback_certificate(SERVO, known, demands, replace(trial, threads=2))
    assert len(seen) == 6
    fallback_certificate.cache_clear()


def test_where_nothing_is_verified_the_reason_is_said_every_time(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fallback, "certify", lambda *_: NotVerified("none of 39 candidates is verified"))
    monkeypatch.setattr(fallback, "ways_out", lambda servo, *_: f"another way out for {servo.p:g}")
    for _ in range(2):
        with pytest.raises(InvalidInput, match=r"range: none of 39 .* friction of 0 to 0 N m; another way out for "):
            fallback_certificate(SERVO.replace(k=8e3), Uncertainty(), Demands(), Trial())
    assert not folder.exists()
