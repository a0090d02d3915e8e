"""An edge whose twin's TLS has a fault: it keeps its windows, and sends them as soon as the fault is mended."""

import signal
import ssl
import time
from pathlib import Path

import pytest
from faketwin import FakeTwin
from running_edge import RATE, RunningEdge, is_complete, sequences
from selfsigned import self_made
from stubmachine import StubMachine
from waiting import until
from wiretap import wiretap

from servotwin.edge_process.config import TwinLink


def made_in(folder: Path, days: tuple[float, float] = (-1.0, 1.0)) -> tuple[Path, Path]:
    folder.mkdir()
    return self_made(folder, days=days)


@pytest.mark.slow
def test_windows_wait_for_a_certificate_that_is_trusted_and_valid(tmp_path: Path) -> None:
    """The system's certificates are replaced, as by an update; then the twin's. The edge runs on meanwhile."""
    old, good = made_in(tmp_path / "old", (-3.0, -1.0)), made_in(tmp_path / "good")
    other, system = made_in(tmp_path / "other"), tmp_path / "system.crt"
    system.write_bytes(other[0].read_bytes())
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(*old)
    with StubMachine(RATE) as machine, FakeTwin() as twin:
        twin.server.socket = context.wrap_socket(twin.server.socket, server_side=True)
        edge = RunningEdge(tmp_path, machine, TwinLink(twin.url.replace("http:", "https:"), "token", wait_s=1.0))
        edge.environment["SSL_CERT_FILE"] = str(system)
        edge.start()
        try:
            until(lambda: "signed by none that this computer trusts" in _trouble(edge))
            (tmp_path / "new").write_bytes(old[0].read_bytes() + good[0].read_bytes())
            (tmp_path / "new").replace(system)
            until(lambda: "a certificate has expired; the clock of this computer says" in _trouble(edge))
            until(lambda: edge.status()["windows"]["waiting"] >= 2)
            assert not twin.requests
            context.load_cert_chain(*good)
            until(lambda: len(twin.windows) >= 3)
            assert edge.signal(signal.SIGTERM) == 0
        finally:
            edge.kill()
        assert all(map(is_complete, sequences(twin).values()))
    assert "Traceback" not in edge.log()


@pytest.mark.slow
def test_an_edge_whose_twin_never_ends_a_handshake_stops_at_once(tmp_path: Path) -> None:
    with StubMachine(RATE) as machine, wiretap(mute=True) as server:
        edge = RunningEdge(tmp_path, machine, TwinLink(f"https://127.0.0.1:{server.port}", "token"))
        edge.start()
        try:
            until(lambda: edge.status().get("windows", {}).get("waiting", 0) >= 1)
            began = time.monotonic()
            assert edge.signal(signal.SIGTERM) == 0
            assert time.monotonic() - began < 8.0  # it was killed after 10 s
        finally:
            edge.kill()
    assert not server.received


def _trouble(edge: RunningEdge) -> str:
    return str(edge.status().get("up", {}).get("trouble", ""))
