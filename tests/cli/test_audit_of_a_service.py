"""`servotwin audit --url`: what goes wrong is one sentence that names the cause."""

from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from threading import Thread

import pytest
from mosquitto import free_port

from servotwin.cli.audit import Source, audit, servos
from servotwin.errors import InvalidInput


@contextmanager
def answering(status: int, text: bytes, data: bytes | None = None) -> Iterator[str]:
    """A service with one answer, or another one to all but its health; its URL."""

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            other = data is not None and self.path != "/healthz"
            self.send_response(200 if other else status)
            self.end_headers()
            self.wfile.write(data if other and data is not None else text)

        def log_message(self, *_args: object) -> None:
            pass

    with HTTPServer(("127.0.0.1", 0), Handler) as server:
        thread = Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        try:
            yield f"http://127.0.0.1:{server.server_port}"
        finally:
            server.shutdown()
            thread.join()


def said(url: str) -> str:
    with pytest.raises(InvalidInput) as refused:
        audit("ax-9", Source(Path("twin.toml"), url, None, None), 20, False, False)
    return str(refused.value)


def test_an_unknown_servo_is_not_called_out_of_reach() -> None:
    with answering(404, b'{"code": "unknown_servo", "detail": "servo \'ax-9\' has never sent a message"}') as url:
        assert said(url) == f"{url}: servo 'ax-9' has never sent a message"


def test_a_page_is_not_taken_for_a_twin() -> None:
    with answering(200, b"<html>") as url:
        assert said(url).startswith(f"{url}: its answer is not JSON (")


def test_a_service_that_is_away_is_named_once() -> None:
    url = f"http://127.0.0.1:{free_port()}"
    assert said(url).startswith(f"{url}: cannot be reached (")
    assert said(url).count(url) == 1


def test_a_service_whose_store_is_damaged_says_so_after_what_it_still_gives(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with answering(503, b'{"ok": false, "damage": "page 3 is noise"}', b"[]") as url:
        with pytest.raises(InvalidInput) as refused:
            servos(Source(Path("twin.toml"), url, None, None), True)
        assert str(refused.value).startswith(f"{url}: the twin's store is damaged (page 3 is noise)")
    assert capsys.readouterr().out == "[]\n"


def test_a_service_that_works_without_a_servo_names_it_after_the_others(capsys: pytest.CaptureFixture[str]) -> None:
    health = b'{"ok": true, "damage": "", "set_aside": {"ax-1": "column twins.gap holds a text"}}'
    with answering(200, health, b"[]") as url:
        with pytest.raises(InvalidInput) as refused:
            servos(Source(Path("twin.toml"), url, None, None), True)
        why = "the twin's record of ax-1 is damaged (column twins.gap holds a text)"
        assert str(refused.value).startswith(f"{url}: {why}")
    assert capsys.readouterr().out == "[]\n"
