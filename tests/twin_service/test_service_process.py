"""The service as a process: kills, signals, TLS, workers that die; over real sockets."""

import json
import os
import signal
import socket
import ssl
import subprocess
import sys
import threading
from contextlib import closing, nullcontext, suppress
from pathlib import Path

import httpx
import pytest
from mosquitto import free_port
from notify_socket import listening
from selfsigned import self_made
from service_system import (
    MSGPACK,
    OPERATOR,
    TOKEN,
    bearer,
    hello,
    place,
    process,
    trusting,
    twin_file,
    unpacked,
    window,
)
from typer.testing import CliRunner
from waiting import PATIENCE, until

from servotwin.cli.app import app
from servotwin.errors import InvalidInput
from servotwin.messages import encode
from servotwin.store.store import open_store
from servotwin.twin_service import command as service
from servotwin.twin_service.twin_file import read_twin
from servotwin.twin_service.worker_pool import WorkerPool

pytestmark = pytest.mark.skipif(os.name == "nt", reason="signals, process groups")


def send(client: httpx.Client, sequence: int) -> httpx.Response:
    sent = window(sequence, start=0.001 * sequence)
    return client.put(place(sent), content=encode(sent), headers={**bearer(), **MSGPACK})


def alive(pid: int) -> bool:
    try:
        return "(zombie)" not in Path(f"/proc/{pid}/status").read_text()
    except OSError:
        return False


def children(pid: int) -> list[int]:
    result = Path(f"/proc/{pid}/task/{pid}/children").read_text()
    return [int(each) for each in result.split()]


@pytest.mark.slow
def test_a_window_is_processed_to_the_end_and_a_signal_stops_the_service_in_order(tmp_path, monkeypatch):
    with listening() as heard:
        monkeypatch.setenv("NOTIFY_SOCKET", str(heard.path))
        monkeypatch.setenv("WATCHDOG_USEC", "400000")
        process_a_window_and_stop(tmp_path, heard)
        assert (heard.received()[0], heard.states[-1]) == ("READY=1", "STOPPING=1")


def process_a_window_and_stop(tmp_path, heard):
    with process(twin_file(tmp_path)) as (running, url):
        heard.wait_for("WATCHDOG=1", 2)
        with httpx.Client(base_url=url, timeout=PATIENCE) as client:
            assert send(client, 0).status_code == 201
            links = until(
                lambda: [
                    link
                    for link in client.get("/v1/servos/ax-1/audit", headers=bearer(OPERATOR)).json()
                    if link["window"]["done"] is not None
                ]
            )
            assert {result["kind"] for result in links[0]["evidence"]} >= {"estimate"}
            summary = client.get("/v1/servos/ax-1", headers=bearer(OPERATOR)).json()
            assert (summary["windows"], summary["waiting"], summary["serial"]) == (1, 0, 1)
            assert client.get("/v1/servos/ax-1/events", headers=bearer(OPERATOR)).json() == []
            assert client.get("/healthz").json()["ok"] is True
            metrics = client.get("/metrics").text
            assert 'servotwin_messages_total{kind="window",put="new"} 1' in metrics
            assert 'servotwin_outcomes_total{result="committed"} 1' in metrics
            assert 'servotwin_waiting{kind="messages"} 0\n' in metrics
            assert "servotwin_waiting_seconds 0\n" in metrics
            client.post("/v1/servos/ax-1/letters", content=hello(boot="next"), headers=bearer())
            [greeting] = until(lambda: client.get("/v1/servos/ax-1/events", headers=bearer(OPERATOR)).json())
            assert (greeting["kind"], greeting["status"], greeting["body"]["boot"]) == ("hello", "next", "next")
            assert client.get("/openapi.json").json()["paths"]["/v1/servos/{servo}/windows/{boot}/{sequence}"]["put"]
        workers = children(running.pid)
        assert len(workers) == 1
        running.send_signal(signal.SIGTERM)
        assert running.wait(PATIENCE) == 0
        until(lambda: not any(map(alive, workers)))
    log = (tmp_path / "log").read_text()
    lines = [json.loads(line) for line in log.splitlines()]
    [estimate] = [line for line in lines if line["message"] == "estimate"]
    assert (estimate["servo"], estimate["window"], estimate["version"]) == ("ax-1", "b/0", 0)
    assert estimate["message_id"] == links[0]["window"]["id"]
    assert "Traceback" not in log
    for token in (TOKEN, OPERATOR):
        assert token not in log


@pytest.mark.slow
def test_killed_in_midstream_it_has_stored_what_it_acknowledged_and_the_next_one_takes_up_its_work(
    tmp_path, monkeypatch
):
    """Each window once. The workers end with it, and so does its lock, by which a second twin is refused."""
    path = twin_file(tmp_path, "rate_burst = 1e6")
    with process(path) as (running, url):
        check_that_a_second_twin_is_refused(path, monkeypatch)
        acknowledged, workers = 0, children(running.pid)
        killer = threading.Timer(0.02, running.kill)
        try:
            with httpx.Client(base_url=url, timeout=PATIENCE) as client:
                while True:
                    if acknowledged == 20:  # counted, not timed: a busy machine is as far when the kill comes
                        killer.start()
                    assert send(client, acknowledged).status_code == 201
                    acknowledged += 1
        except httpx.TransportError:
            running.wait(PATIENCE)
        killer.join()
        until(lambda: not any(map(alive, workers)))
    with process(path) as (_running, url), httpx.Client(base_url=url, timeout=PATIENCE) as client:
        assert send(client, acknowledged).status_code in (200, 201)
        until(lambda: client.get("/v1/servos/ax-1", headers=bearer(OPERATOR)).json()["waiting"] == 0)
        links = client.get("/v1/servos/ax-1/audit?limit=1000", headers=bearer(OPERATOR)).json()
    assert acknowledged >= 20
    assert sorted(link["window"]["sequence"] for link in links) == list(range(acknowledged + 1))
    # A window that a newer one has overtaken may be stored with a glance alone.
    processed = [[f["kind"] for f in link["evidence"] if f["kind"] in ("estimate", "glance")] for link in links]
    assert [len(kinds) for kinds in processed] == [1] * len(links)
    assert "estimate" in processed[0]


def check_that_a_second_twin_is_refused(path, monkeypatch):
    with monkeypatch.context() as patch:
        for name in ("configure_logging", "raise_descriptor_limit"):
            patch.setattr(service, name, lambda *_: None)
        patch.setattr(WorkerPool, "launched", lambda _: nullcontext())
        patch.setattr(service, "HttpServer", lambda *_: pytest.fail("it serves"))
        with pytest.raises(InvalidInput, match="another twin works on it"):
            service.run(path)


@pytest.mark.slow
def test_a_service_whose_output_goes_to_a_full_disk_serves(tmp_path):
    port = free_port()
    path = twin_file(tmp_path)
    path.write_text(path.read_text().replace("port = 0", f"port = {port}"))
    command = [sys.executable, "-m", "servotwin", "twin", "--config", str(path)]
    with Path("/dev/full").open("w") as full:
        running = subprocess.Popen(command, stdout=full, stderr=full)
    try:

        def answers():
            assert running.poll() is None
            with suppress(httpx.TransportError):
                return httpx.get(f"http://127.0.0.1:{port}/healthz").status_code == 200

        until(answers)
        assert send_to(f"http://127.0.0.1:{port}") == 201
    finally:
        running.terminate()
    # One that ends by itself has 1.
    assert running.wait(PATIENCE) == 2


def send_to(url):
    with httpx.Client(base_url=url, timeout=PATIENCE) as client:
        return send(client, 0).status_code


def test_a_store_with_a_second_name_is_refused_until_it_has_one_again(tmp_path):
    """As of a copy by hard links: a lock and a log of its own lie beside each name."""
    file, other = tmp_path / "twin.db", tmp_path / "copy.db"
    open_store(str(file)).close()
    os.link(file, other)
    for each in (file, other):
        with pytest.raises(InvalidInput, match="has 2 names"), service._exclusive_store(str(each)):
            pytest.fail("it is locked")
    other.unlink()
    with service._exclusive_store(str(file)):
        pass


@pytest.mark.slow
def test_a_worker_that_dies_is_replaced_and_nothing_is_lost(tmp_path):
    with process(twin_file(tmp_path)) as (running, url), httpx.Client(base_url=url, timeout=PATIENCE) as client:
        for sequence in range(10):
            if sequence in (2, 6):
                [worker] = children(running.pid)
                os.kill(worker, signal.SIGKILL)
            assert send(client, sequence).status_code == 201
            if sequence in (2, 6):
                # Only now: that an idle worker died shows when it gets the next window.
                until(lambda gone=worker: [pid for pid in children(running.pid) if pid != gone])
        until(lambda: client.get("/v1/servos/ax-1", headers=bearer(OPERATOR)).json()["waiting"] == 0)
        assert client.get("/v1/servos/ax-1", headers=bearer(OPERATOR)).json()["windows"] == 10
        assert "servotwin_workers_lost_total" in client.get("/metrics").text


@pytest.mark.slow
def test_tls_with_a_self_made_certificate(tmp_path):
    certificate, key = self_made(tmp_path)
    service = f'tls_certificate = "{certificate.name}"\ntls_key = "{key.name}"'
    with process(twin_file(tmp_path, service)) as (_running, url):
        assert url.startswith("https://127.0.0.1:")
        with httpx.Client(base_url=url, verify=trusting(certificate), timeout=PATIENCE) as client:
            assert send(client, 0).status_code == 201
        with (
            pytest.raises(httpx.ConnectError),
            httpx.Client(base_url=url, verify=ssl.create_default_context()) as client,
        ):
            client.get("/healthz")


@pytest.mark.parametrize(
    ("more", "tokens", "expected"),
    [
        ('bind = "0.0.0.0"', False, "this requires tokens"),
        ('bind = "0.0.0.0"', True, "behind_proxy"),
        ('bind = "elsewhere"', True, "IP address"),
        ('store = "postgresql://me:secret@host/twin"', True, "store_password_file"),
        ('tls_key = "no.key"', True, "no.key"),
        ('store = "mysql://me@host/twin"', True, r"twin.toml: service.store: .* names 'mysql'"),
        ('store = "postgresql://me@host:port/twin"', True, r"twin.toml: service.store: .* cannot be read"),
        ('[service.mqtt]\nurl = "mqtts://here"\nca_file = "no.crt"', True, r"no.crt: holds no certificates"),
        ('[service.mqtt]\nurl = "mqtts://here"\nca_file = "twin.toml"', True, r"twin.toml: holds no certificates"),
        ("queue = 0", True, "at least 1"),
    ],
)
def test_a_file_that_is_not_allowed_is_refused_before_a_store_is_made(tmp_path, monkeypatch, more, tokens, expected):
    path = twin_file(tmp_path, more, tokens)
    for name in ("configure_logging", "raise_descriptor_limit"):
        monkeypatch.setattr(service, name, lambda *_: None)
    monkeypatch.setattr(service, "HttpServer", lambda *_: pytest.fail("it serves"))
    with pytest.raises(InvalidInput, match=expected) as refused:
        service.run(path)
    assert "secret" not in str(refused.value)
    assert "\n" not in str(refused.value)
    assert [each.name for each in tmp_path.iterdir() if each.suffix == ".db"] == []


def test_a_file_with_an_unknown_key_is_one_sentence_and_2(tmp_path):
    path = twin_file(tmp_path, "prot = 3")
    result = CliRunner().invoke(app, ["twin", "--config", str(path)])
    assert result.exit_code == 2
    assert result.stdout == ""
    assert "did you mean 'port'" in result.stderr
    assert result.stderr.count("\n") == 1
    assert [each.name for each in tmp_path.iterdir() if each.suffix == ".db"] == []


@pytest.mark.slow
def test_bytes_that_are_no_request_do_no_harm_and_a_poll_that_waits_does_not_hold_up_the_end(tmp_path):
    with process(twin_file(tmp_path)) as (running, url):
        address = ("127.0.0.1", int(url.rsplit(":", 1)[1]))
        endless = b"GET /healthz HTTP/1.1\r\n" + b"x: " + b"y" * 200_000
        for rubbish in (
            b"\x00" * 1000,
            b"PUT " + b"/" * 100_000,
            endless,
            b"GET /\xff HTTP/1.1\r\n\r\n",
            b"\r\n" * 50_000,
        ):
            with socket.create_connection(address, timeout=10.0) as line:
                line.settimeout(10.0)
                try:
                    line.sendall(rubbish)
                    line.shutdown(socket.SHUT_WR)
                    while line.recv(65536):
                        pass
                except TimeoutError:
                    raise
                except OSError:
                    pass  # the twin hung up
        for begun in ENDLESS:
            with socket.create_connection(address, timeout=10.0) as line:
                line.sendall(begun)
                with pytest.raises(ConnectionError):
                    line.sendall(b"y" * 64 * 1024 * 1024)
        assert httpx.get(f"{url}/healthz").json()["ok"] is True
        answers = []

        def poll():
            answers.append(httpx.get(f"{url}/v1/servos/ax-1/outgoing?wait=30", headers=bearer(), timeout=PATIENCE))

        thread = threading.Thread(target=poll)
        thread.start()
        until(lambda: "servotwin_polls 1" in httpx.get(f"{url}/metrics").text)
        running.send_signal(signal.SIGINT)
        assert running.wait(PATIENCE) == 0
        thread.join(PATIENCE)
        assert unpacked(answers[0].content) == []
    assert "Traceback" not in (tmp_path / "log").read_text()


ENDLESS = (
    b"GET /healthz HTTP/1.1\r\nX: ",
    b"PUT /v1/servos/ax-1/windows/b/0 HTTP/1.1\r\nAuthorization: Bearer token-of-ax-1\r\n"
    b"Transfer-Encoding: chunked\r\n\r\n0\r\nX: ",
    b"PUT /v1/servos/ax-1/windows/b/0 HTTP/1.1\r\nAuthorization: Bearer guess\r\nContent-Length: 1000000000\r\n\r\n",
)
"""A header and a trailer that are cut before they fill the memory, and a body that nobody asked for."""


@pytest.mark.slow
def test_a_model_that_is_not_allowed_is_refused_by_a_worker_before_a_store_is_made(tmp_path):
    path = twin_file(tmp_path)
    path.write_text(path.read_text().replace('servo = "paper"', 'servo = "papre"'))
    result = CliRunner().invoke(app, ["twin", "--config", str(path)])
    assert result.exit_code == 2
    assert result.stdout == ""
    assert "did you mean 'paper'" in result.stderr
    assert result.stderr.count("\n") == 1
    assert [each.name for each in tmp_path.iterdir() if each.suffix == ".db"] == []


@pytest.mark.slow
def test_the_service_leaves_numerics_to_its_workers():
    """Half of its start, and most of its memory."""
    code = "import sys, servotwin.twin_service.command; print(*{'numba', 'numpy', 'scipy'} & set(sys.modules))"
    completed = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True)
    assert completed.stdout.strip() == ""


@pytest.mark.slow
def test_a_service_that_cannot_start_exits_with_an_error(tmp_path):
    twin = read_twin(twin_file(tmp_path))
    pool = WorkerPool(1, twin.start, 5.0, (sys.executable, "-c", "pass"))
    with (
        pool.launched(),
        closing(open_store(twin.service.store)) as store,
        service.listening_socket(twin.service) as listener,
        pytest.raises(SystemExit) as ended,
    ):
        service.serve(twin, store, listener, pool)
    assert ended.value.code not in (None, 0)
