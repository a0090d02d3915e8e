"""Public data by name, from a server on this machine."""

import hashlib
import http.client
import http.server
import io
import threading
import zipfile
from dataclasses import replace

import pytest
from typer.testing import CliRunner

from servotwin import datasets
from servotwin.cli.app import app
from servotwin.errors import InvalidInput

CONTENT = b"measured" * 100


def zipped(name="FOLDER/data.mat", content=CONTENT):
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("readme.txt", "hello")
        archive.writestr(name, content)
    return file.getvalue()


@pytest.fixture
def server():
    """A file server; `answers` by path, `asked` what was asked for."""
    answers, asked = {}, []

    class Handler(http.server.BaseHTTPRequestHandler):
        def do_GET(self):
            asked.append(self.path)
            body = answers.get(self.path)
            self.send_response(404 if body is None else 200)
            self.send_header("Content-Length", str(len(body or b"")))
            self.end_headers()
            self.wfile.write(body or b"")

        def log_message(self, *_):
            pass

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler) as running:
        thread = threading.Thread(target=running.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        yield f"http://127.0.0.1:{running.server_port}", answers, asked
        running.shutdown()
        thread.join()


@pytest.fixture
def known(server, monkeypatch):
    dataset = datasets.PublicDataset(
        f"{server[0]}/data", "data.mat", hashlib.sha256(CONTENT).hexdigest(), 5000, "somebody 2019", "cite it"
    )
    monkeypatch.setattr(datasets, "DATASETS", {"some": dataset})
    return dataset


@pytest.mark.parametrize("body", [CONTENT, zipped()])
def test_a_set_is_fetched_once(server, known, tmp_path, body):
    _, answers, asked = server
    answers["/data"] = body
    path = datasets.fetch("some", tmp_path / "new")
    assert path.read_bytes() == CONTENT
    assert datasets.fetch("some", tmp_path / "new") == path
    assert asked == ["/data"]
    path.write_bytes(b"damaged")
    assert datasets.fetch("some", tmp_path / "new").read_bytes() == CONTENT
    assert len(asked) == 2


@pytest.mark.parametrize(
    ("body", "says"),
    [
        (None, "cannot be fetched"),
        (CONTENT + b"!", "is not the published file"),
        (bytes(6000), "sent more than 5000 bytes"),
        (zipped(content=CONTENT[1:]), "is not the published file"),
        (zipped(name="other.mat"), "has no data.mat"),
        (zipped(content=bytes(100_000)), "has no data.mat of at most 5000 bytes"),
        (zipped().replace(b"measured", b"M")[:-30] + zipped()[-22:], "data.mat|cannot be read|published"),
    ],
)
def test_nothing_else_is_kept(server, known, tmp_path, body, says):
    if body is not None:
        server[1]["/data"] = body
    with pytest.raises(InvalidInput, match=says):
        datasets.fetch("some", tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_names_and_places_are_checked(server, known, tmp_path, monkeypatch):
    with pytest.raises(InvalidInput, match="give one of some"):
        datasets.fetch("sone", tmp_path)
    monkeypatch.setattr(datasets, "DATASETS", {"some": replace(known, url="file:///etc/hostname")})
    with pytest.raises(InvalidInput, match="must begin with https://"):
        datasets.fetch("some", tmp_path)
    monkeypatch.setenv("SERVOTWIN_CACHE_DIR", "")
    with pytest.raises(InvalidInput, match="there is no cache folder"):
        datasets.fetch("some")


def test_a_broken_answer_and_an_unreadable_cache_are_one_sentence(known, tmp_path, monkeypatch):
    def broken(*_, **__):
        raise http.client.BadStatusLine("gibberish")

    monkeypatch.setattr(datasets.urllib.request, "urlopen", broken)
    with pytest.raises(InvalidInput, match=r"cannot be fetched from .*gibberish"):
        datasets.fetch("some", tmp_path)

    def unreadable(_):
        raise PermissionError(13, "Permission denied")

    (tmp_path / "data.mat").touch()
    monkeypatch.setattr(datasets.Path, "read_bytes", unreadable)
    with pytest.raises(InvalidInput, match=r"data.mat: cannot be read \(Permission denied\)"):
        datasets.fetch("some", tmp_path)


def test_the_command_says_whose_data_it_is(server, known, tmp_path, monkeypatch):
    monkeypatch.setenv("SERVOTWIN_CACHE_DIR", str(tmp_path))
    server[1]["/data"] = CONTENT
    result = CliRunner().invoke(app, ["dataset", "some"])
    assert result.exit_code == 0, result.output
    assert result.stdout.strip() == str(tmp_path / "datasets" / "data.mat")
    assert "somebody 2019" in result.stderr
    assert "cite it" in result.stderr
    wrong = CliRunner().invoke(app, ["dataset", "other"])
    assert wrong.exit_code == 2
    assert len(wrong.stderr.splitlines()) == 1


def test_every_set_has_a_digest_and_a_notice():
    for name, known in datasets.DATASETS.items():
        assert len(bytes.fromhex(known.sha256)) == 32, name
        assert known.url.startswith("https://")
        assert known.source
        assert known.notice


@pytest.mark.parametrize("name", datasets.DATASETS)
def test_every_set_has_an_address_a_checksum_a_source_and_a_notice(name):
    known = datasets.DATASETS[name]
    assert known.url.startswith("https://")
    assert len(bytes.fromhex(known.sha256)) == 32
    assert known.source
    assert "not to be passed on" in known.notice
    assert "never tried here" in known.notice


def test_no_two_sets_share_a_file():
    assert len({each.file for each in datasets.DATASETS.values()}) == len(datasets.DATASETS)
