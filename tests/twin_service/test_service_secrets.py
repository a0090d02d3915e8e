"""Secrets stay within the service and with those for whom they are meant."""

import threading
from http.server import BaseHTTPRequestHandler, HTTPServer

import pytest

from servotwin.cli.audit import Source, audit
from servotwin.errors import InvalidInput
from servotwin.link.seal import verifier_of
from servotwin.twin_service import auth, worker
from servotwin.twin_service.auth import TokenFile, Verifiers, read_tokens, write_private, write_tokens
from servotwin.twin_service.config import MQTT_PASSWORD, PASSWORD


def test_workers_do_not_get_the_passwords_of_the_service(monkeypatch):
    for name in (PASSWORD, MQTT_PASSWORD):
        monkeypatch.setenv(name, "hunter2")
    assert "hunter2" not in worker._environment().values()


def test_tokens_written_while_the_file_is_read_become_valid_too(tmp_path, monkeypatch):
    path = tmp_path / "tokens.toml"
    write_tokens(path, Verifiers({"ax-1": verifier_of("old")}))

    def reading(path):
        result = read_tokens(path)
        write_tokens(path, Verifiers({"ax-1": verifier_of("new")}))
        return result

    monkeypatch.setattr(auth, "read_tokens", reading)
    file = TokenFile(path)
    monkeypatch.undo()
    assert file.refresh()
    file.access.check_servo("ax-1", b"new")


def test_an_operator_s_token_follows_no_redirection(tmp_path):
    class Elsewhere(BaseHTTPRequestHandler):
        def do_GET(self):
            requests.append((self.path, self.headers["authorization"]))
            self.send_response(307)
            self.send_header("location", "/elsewhere")
            self.end_headers()

        def log_message(self, *_):
            pass

    requests = []
    write_private(tmp_path / "token", "hunter2")
    with HTTPServer(("127.0.0.1", 0), Elsewhere) as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        source = Source(tmp_path, f"http://127.0.0.1:{server.server_port}", tmp_path / "token")
        with pytest.raises(InvalidInput, match="307"):
            audit("ax-1", source, 1, changes=False, json=True)
        server.shutdown()
        thread.join()
    assert requests == [("/v1/servos/ax-1/audit?limit=1", "Bearer hunter2"), ("/healthz", None)]
