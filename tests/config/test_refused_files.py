"""A twin's or an edge's file that cannot work: one sentence, exit code 2, no traceback; one each by the process."""

import json
import os
import socket
import subprocess
import sys
from collections.abc import Callable
from contextlib import closing, nullcontext
from pathlib import Path

import pytest
from edge_files import edge_file
from selfsigned import self_made

from servotwin.edge_process.config_file import load
from servotwin.edge_process.run import run as run_edge
from servotwin.edge_process.startup import check
from servotwin.errors import InvalidInput
from servotwin.twin_service import command

MODELS = '[models.a]\nservo = "paper"\n[models.a.twin]\npolicy = "paper"\n[servos]\n"ax-*" = "a"\n'
EDGE = edge_file()


def ended(folder: Path, *arguments: str) -> str:
    """Sentence of a process that refuses its file."""
    environment = {key: value for key, value in os.environ.items() if key != "SERVOTWIN_STORE_PASSWORD"}
    done = subprocess.run(
        [sys.executable, "-m", *arguments], cwd=folder, env=environment, capture_output=True, text=True, timeout=120,
        stdin=subprocess.DEVNULL, check=False,
    )  # fmt: skip
    assert done.returncode == 2, done.stderr
    assert "Traceback" not in done.stderr
    *logged, sentence = done.stderr.splitlines()
    assert [json.loads(line)["message"] for line in logged] in ([], ["new store"])
    assert sentence.startswith("error: ")
    assert done.stdout == ""
    return sentence


def twin_file(folder: Path, service: str) -> Path:
    (folder / "twin.toml").write_text(f"[service]\n{service}\n{MODELS}")
    return folder / "twin.toml"


def nonsense(folder: Path) -> str:
    for name in ("c.pem", "k.pem"):
        (folder / name).write_text("nonsense\n")
    return 'tls_certificate = "c.pem"\ntls_key = "k.pem"'


def strangers(folder: Path) -> str:
    """A certificate and the key of another one."""
    for name in ("one", "other"):
        (folder / name).mkdir()
    certificate, _ = self_made(folder / "one")
    _, key = self_made(folder / "other")
    return f'tls_certificate = "{certificate}"\ntls_key = "{key}"'


def world_readable(folder: Path) -> str:
    (folder / "tokens.toml").write_text("")
    (folder / "tokens.toml").chmod(0o644)
    return 'tokens = "tokens.toml"'


def text_store(folder: Path) -> str:
    (folder / "twin.db").write_text("this is no database, but long enough to be looked at as one" * 20)
    return ""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("service", "expected"),
    [
        ("prot = 1", "unknown key 'service.prot' (did you mean 'port'?)"),
        ("retention_days = -3", "service.retention_days = -3 is not allowed; give a positive number"),
        ('tokens = "none.toml"', "none.toml: there is no such file of tokens; `servotwin enroll` makes it"),
        (world_readable, "has mode 0644, so that others may open it; make it 0600: chmod 600 "),
        (nonsense, "are no certificate with its own key, in PEM and without a password"),
        (strangers, "KEY_VALUES_MISMATCH"),
        ('store = "sqlite:///no/such/folder/twin.db"', "cannot be made (No such file or directory)"),
        (text_store, "file is not a database"),
        ('store = "postgresql://u:secret@h/d"', "holds a password"),
    ],
)
def test_a_twin_with_an_invalid_file_names_the_fault_and_does_not_start(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, service: str | Callable[[Path], str], expected: str
) -> None:
    """As the command does it; the process is tested below."""
    monkeypatch.delenv("SERVOTWIN_STORE_PASSWORD", raising=False)
    monkeypatch.chdir(tmp_path)
    for name in ("configure_logging", "raise_descriptor_limit"):
        monkeypatch.setattr(command, name, lambda *_: None)
    monkeypatch.setattr(command, "HttpServer", lambda *_: pytest.fail("it serves"))
    # None of these is a fault of a model, which a worker would find.
    monkeypatch.setattr(command.WorkerPool, "launched", lambda _: nullcontext())
    path = twin_file(tmp_path, "port = 0\n" + (service if isinstance(service, str) else service(tmp_path)))
    with pytest.raises(InvalidInput) as refused:
        command.run(path)
    assert expected in str(refused.value)
    assert "secret" not in str(refused.value)
    assert "\n" not in str(refused.value)


@pytest.mark.slow
def test_a_port_that_is_taken_is_named_by_the_process(tmp_path: Path) -> None:
    with closing(socket.create_server(("127.0.0.1", 0))) as taken:
        port = taken.getsockname()[1]
        twin_file(tmp_path, f"port = {port}")
        assert f"port = {port}: cannot listen there (Address already in use)" in ended(tmp_path, "servotwin", "twin")


def edge(folder: Path, more: str) -> str:
    (folder / "edge.toml").write_text(EDGE + more)
    return ended(folder, "servotwin.edge_process", "edge.toml")


def test_an_edge_with_an_invalid_file_names_the_fault_and_does_not_start(tmp_path: Path) -> None:
    """As a process; the other reasons below, without one each."""
    assert "edge.toml: unknown key 'keeep' (did you mean 'keep'?)" in edge(tmp_path, "[keeep]\n")
    assert list(tmp_path.iterdir()) == [tmp_path / "edge.toml"]


TOKEN = 'token_file = "token"\n'


@pytest.mark.parametrize(
    ("more", "expected"),
    [
        (f'[twin]\nurl = "https://h"\n{TOKEN}ca_file = "no.crt"', "no.crt: holds no certificates that can be read (No"),
        (
            f'[twin]\nurl = "https://h"\n{TOKEN}ca_file = "edge.toml"',
            "edge.toml: holds no certificates that can be read",
        ),
        (
            '[twin]\nurl = "https://h"\ntoken_file = "none"',
            "none: cannot be read (No such file or directory)",
        ),
        (
            '[twin]\nurl = "https://h"\ntoken_file = "open"',
            "open: has mode 0644, so that others may open it; make it 0600: chmod 600 ",
        ),
        (
            '[twin]\nurl = "https://h"\ntoken_file = "long"',
            "twin.token_file = 'long': ",
        ),
        (
            '[twin]\nurl = "https://h"\ntoken_file = "long"',
            "long: has 1025 characters; at most 1024 are allowed",
        ),
        (
            '[twin]\nurl = "https://h"\ntoken_env = "SERVOTWIN_NOT_SET"',
            "environment variable SERVOTWIN_NOT_SET: is empty",
        ),
        (f'[twin]\nurl = "mqtt://h"\n{TOKEN}user = "u"\npassword_file = "none"', "none: cannot be read"),
        ('[keep]\noutbox = "no/outbox.sqlite"', "[keep]: outbox = 'no/outbox.sqlite': there is no folder "),
        ('[keep]\nstatus = "/no/status.json"', "[keep]: status = '/no/status.json': there is no folder /no"),
        ("[own]\nkp_v_per_m = 1.0", "edge.toml: [own] has gains, which need update_gains = true; set that, or"),
        ("[start]\nkp_v_per_m = 1.0", "edge.toml: [start] has gains, which need update_gains = true; set that, or"),
        ('[keep]\noutbox = ""', "[keep]: outbox = '': is a folder; give the name of a file"),
        ('[keep]\nstatus = "boots"', "[keep]: boots = 'boots': is status; give another name"),
        ('[keep]\nstatus = "edge.toml"', "[keep]: status = 'edge.toml': is this file itself; give another name"),
        (
            f'[twin]\nurl = "https://h"\n{TOKEN}[keep]\nboots = "./token"',
            "boots = './token': is token_file; give another",
        ),
        ('[twin]\nurl = "https://h"\ntoken_file = ""', ": is a folder; give the name of a file"),
    ],
)
def test_files_that_an_edge_s_file_names_must_exist(tmp_path: Path, more: str, expected: str) -> None:
    (tmp_path / "edge.toml").write_text(EDGE + more)
    for name, mode in (("token", 0o600), ("open", 0o644)):
        (tmp_path / name).write_text("secret-token\n")
        (tmp_path / name).chmod(mode)
    (tmp_path / "long").write_text("secret-token" + "x" * 1013)
    (tmp_path / "long").chmod(0o600)
    with pytest.raises(InvalidInput) as refused:
        check(load(tmp_path / "edge.toml"))
    assert expected in str(refused.value)
    assert "secret-token" not in str(refused.value)


def faulty(path: Path, fault: str) -> None:
    if fault == "a folder":
        path.mkdir()
    elif fault == "a pipe":
        os.mkfifo(path, 0o600)
    elif fault != "missing":
        path.write_bytes(b"" if fault == "empty" else bytes(range(256)))
        path.chmod(0o600)


FAULTS = pytest.mark.parametrize("fault", ["missing", "empty", "a folder", "a pipe", "rubbish"])


@FAULTS
@pytest.mark.parametrize(
    ("table", "key", "more"),
    [
        ("service", "tokens", ""),
        ("service", "store_password_file", ""),
        ("service", "store_ca", 'store = "postgresql://u@h/d"\n'),
        ("service.mqtt", "password_file", 'url = "mqtt://127.0.0.1"\nuser = "u"\n'),
        ("service.mqtt", "ca_file", 'url = "mqtts://127.0.0.1"\n'),
        ("service.webhook", "secret_file", 'url = "https://127.0.0.1"\n'),
        ("service.webhook", "ca_file", 'url = "https://127.0.0.1"\n'),
    ],
)
def test_a_twin_names_the_key_of_a_file_that_cannot_be_used_and_makes_no_store(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, table: str, key: str, more: str, fault: str
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(command, "configure_logging", lambda *_: None)
    monkeypatch.setattr(command.WorkerPool, "launched", lambda _: pytest.fail("it starts"))
    faulty(tmp_path / "named", fault)
    file = twin_file(tmp_path, f'[{table}]\n{more}{key} = "named"\n'.removeprefix("[service]\n"))
    before = set(tmp_path.iterdir())
    with pytest.raises(InvalidInput) as refused:
        command.run(file.relative_to(tmp_path))
    assert str(refused.value).startswith(f"twin.toml: {table}.{key} = 'named': ")
    assert "\n" not in str(refused.value)
    assert set(tmp_path.iterdir()) == before


OPC_UA = 'kind = "opcua"\nurl = "opc.tcp://127.0.0.1:1"\n'


@FAULTS
@pytest.mark.parametrize(
    ("key", "more"),
    [
        ("twin.token_file", 'url = "http://127.0.0.1"\n'),
        ("twin.ca_file", f'url = "https://127.0.0.1"\n{TOKEN}'),
        ("twin.password_file", f'url = "mqtt://127.0.0.1"\n{TOKEN}user = "u"\n'),
        ("drive.password_file", 'user = "u"\n'),
        ("drive.log", 'kind = "replay"\n'),
        ("drive.certificate", 'private_key = "token"\nserver_certificate = "token"\n'),
    ],
)
def test_an_edge_names_the_key_of_a_file_that_cannot_be_used(tmp_path: Path, key: str, more: str, fault: str) -> None:
    (tmp_path / "token").write_text("t\n")
    (tmp_path / "token").chmod(0o600)
    faulty(tmp_path / "named", fault)
    table, _, name = key.partition(".")
    text = EDGE.replace('role = "control"', 'role = "supervise"')
    if table == "drive":
        simulated = text[text.index("[drive]") : text.index("[controller]")]
        kind = "" if more.startswith("kind") else OPC_UA
        text = text.replace(simulated, f'[drive]\n{kind}{more}{name} = "named"\n')
    else:
        text += f'[{table}]\n{more}{name} = "named"\n'
    (tmp_path / "edge.toml").write_text(text)
    with pytest.raises(InvalidInput) as refused:
        run_edge(tmp_path / "edge.toml")
    assert str(refused.value).startswith(f"{tmp_path / 'edge.toml'}: {key} = 'named': ")
    assert {each.name for each in tmp_path.iterdir()} <= {"edge.toml", "token", "named"}
    assert "\n" not in str(refused.value)


def test_a_broker_without_its_library_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "token").write_text("t\n")
    (tmp_path / "token").chmod(0o600)
    (tmp_path / "edge.toml").write_text(f'{EDGE}[twin]\nurl = "mqtt://h"\n{TOKEN}')
    check(load(tmp_path / "edge.toml"))
    monkeypatch.setattr("servotwin.runtime.extras.find_spec", lambda _name: None)
    with pytest.raises(InvalidInput, match=r"needs paho-mqtt, .*pip install 'servotwin\[mqtt\]'"):
        check(load(tmp_path / "edge.toml"))
