"""Enrolling servos and operators, reading the evidence chain, backup and restore: the commands."""

import json
import re
import sqlite3
import stat
import threading
from contextlib import closing
from dataclasses import replace
from datetime import UTC, datetime, timedelta

import httpx
import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.x509.oid import NameOID
from selfsigned import self_made
from service_system import OPERATOR, bearer, place, process, twin_file, window
from typer.testing import CliRunner

from servotwin.cli import app as cli
from servotwin.edge.settings import AgentSettings
from servotwin.edge_process.config import token_of
from servotwin.edge_process.config_file import load
from servotwin.link.seal import verifier_of
from servotwin.messages import encode
from servotwin.store.integrity import message_digest
from servotwin.store.records import Incoming, MessageKind
from servotwin.store.store import open_store
from servotwin.twin_service.auth import read_tokens
from servotwin.up import enrolment

PATIENCE = 60.0


def run(*arguments):
    return CliRunner().invoke(cli.app, [str(argument) for argument in arguments])


def fresh(folder, service=""):
    return twin_file(folder, f'port = 8765\ntokens = "tokens.toml"\n{service}'.replace("port = 8765", ""), tokens=False)


def test_a_servo_is_enrolled_and_its_edge_can_begin(tmp_path):
    twin, edge = fresh(tmp_path), tmp_path / "edge"
    done = run("enroll", "ax-7", "--twin", twin, "--edge", edge, "--url", "https://twin:1", "--role", "control")
    assert done.exit_code == 0, done.output
    config = load(edge / "edge.toml")
    token = token_of(config)
    assert token not in done.output
    assert (config.agent.servo, config.role, config.twin.url) == ("ax-7", "control", "https://twin:1")
    assert isinstance(config.agent, AgentSettings)
    assert read_tokens(tmp_path / "tokens.toml").servos == {"ax-7": verifier_of(token)}
    for secret in (edge / "token", tmp_path / "tokens.toml"):
        assert stat.S_IMODE(secret.stat().st_mode) == 0o600
    assert token not in (edge / "edge.toml").read_text()


def test_a_second_token_replaces_the_first_only_on_request_and_leaves_the_edge_s_file(tmp_path):
    twin, edge = fresh(tmp_path), tmp_path / "edge"
    options = ("enroll", "ax-7", "--twin", twin, "--edge", edge, "--url", "http://127.0.0.1:1")
    first = run(*options)
    assert (first.exit_code, "kept" in first.stdout) == (0, False)
    (edge / "edge.toml").write_text((edge / "edge.toml").read_text() + "# mine\n")
    before = read_tokens(tmp_path / "tokens.toml"), (edge / "token").read_text()
    refused = run(*options)
    assert refused.exit_code == 2
    assert "--again" in refused.stderr
    assert (read_tokens(tmp_path / "tokens.toml"), (edge / "token").read_text()) == before
    again = run(*options, "--again")
    assert again.exit_code == 0
    [said] = [line for line in again.stdout.splitlines() if line.startswith("kept: ")]
    assert said.startswith(f"kept: {edge / 'edge.toml'}, with the limits and options of its enrolment; ")
    token = (edge / "token").read_text().strip()
    assert token != before[1].strip()
    assert read_tokens(tmp_path / "tokens.toml").servos == {"ax-7": verifier_of(token)}
    assert (edge / "edge.toml").read_text().endswith("# mine\n")


def test_another_servo_s_folder_is_left_alone(tmp_path):
    twin, edge = fresh(tmp_path), tmp_path / "edge"
    options = ("--twin", twin, "--edge", edge, "--url", "http://127.0.0.1:1")
    assert run("enroll", "ax-7", *options).exit_code == 0
    token = (edge / "token").read_text()
    for more in ((), ("--again",)):
        result = run("enroll", "ax-8", *options, *more)
        assert result.exit_code == 2
        assert "'ax-7'" in result.stderr
    assert (edge / "token").read_text() == token


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("stranger", "--url", "https://h"), "twin.toml: servo 'stranger' has no model"),
        (("ax-1",), "--url"),
        (("ax-1", "--url", "ftp://h"), "url"),
        (("ax-1", "--url", "https://h", "--role", "guess"), "control, supervise"),
        (("ax-1", "--url", "https://h", "--drive", "no.toml"), "no.toml"),
        (("ax 1", "--url", "https://h"), "name 'ax 1'"),
    ],
)
def test_a_refused_enrolment_leaves_nothing_behind(tmp_path, monkeypatch, arguments, message):
    monkeypatch.chdir(tmp_path)
    twin = fresh(tmp_path)
    result = run("enroll", *arguments, "--twin", twin, "--edge", tmp_path / "edge")
    assert result.exit_code == 2
    assert message in result.stderr
    assert result.stderr.count("\n") == 1
    tokens = tmp_path / "tokens.toml"
    assert not tokens.exists()
    assert not (tmp_path / "edge" / "edge.toml").exists()
    assert not (tmp_path / "edge" / "token").exists()


def test_without_a_file_of_tokens_nobody_is_enrolled(tmp_path):
    result = run("enroll", "ax-1", "--twin", twin_file(tmp_path, tokens=False), "--edge", tmp_path / "edge")
    assert result.exit_code == 2
    assert "tokens" in result.stderr


@pytest.mark.slow
def test_an_operator_reads_what_the_service_and_its_store_know(tmp_path, monkeypatch):
    twin, token = twin_file(tmp_path), tmp_path / "operator"
    assert run("enroll", "boss", "--operator", token, "--twin", twin).exit_code == 0
    with process(twin) as (_running, url):
        sent = window()
        with httpx.Client(base_url=url, timeout=PATIENCE) as client:
            assert client.put(place(sent), content=encode(sent), headers=bearer()).status_code == 201
            while client.get("/v1/servos/ax-1", headers=bearer(OPERATOR)).json()["waiting"]:
                pass
        fetched = run("audit", "ax-1", "--url", url, "--token", token, "--json")
        assert fetched.exit_code == 0, fetched.output
        printed = run("audit", "ax-1", "--url", url, "--token", token)
        everybody = run("servos", "--url", url, "--token", token)
        refused = run("audit", "ax-1", "--url", url)
        assert refused.exit_code == 2
        assert "token" in refused.stderr
        clear = run("audit", "ax-1", "--url", "http://twin.example", "--token", token)
        assert (clear.exit_code, clear.stderr.count("in clear")) == (2, 1)
        monkeypatch.setenv("http_proxy", "http://127.0.0.1:9")
        assert run("servos", "--url", url, "--token", token).stdout == everybody.stdout
        none = run("audit", "ax-1", "--url", "http://[::1", "--token", token)
        assert (none.exit_code, none.stderr.count("give the URL of a twin")) == (2, 1)
    read = run("audit", "ax-1", "--config", twin, "--json")
    assert json.loads(read.stdout) == json.loads(fetched.stdout)
    [link] = json.loads(read.stdout)
    assert (link["window"]["boot"], link["window"]["sequence"]) == ("b", 0)
    table = run("audit", "ax-1", "--config", twin)
    assert printed.stdout == table.stdout
    assert run("servos", "--config", twin).stdout == everybody.stdout
    head, line = everybody.stdout.splitlines()
    assert line.split()[:2] == ["ax-1", "-"]
    assert line.index("2") == head.index("last message")
    assert [each["servo"] for each in json.loads(run("servos", "--config", twin, "--json").stdout)] == ["ax-1"]
    assert "boot b\n" in table.stdout
    line = r"^\d{4}-\d\d-\d\d \d\d:\d\d:\d\d +0 .*(unidentifiable|mismatch|bound): .*\S$"
    assert re.search(line, table.stdout, re.MULTILINE), table.stdout
    gone = run("audit", "ax-1", "--url", url, "--token", token)
    assert gone.exit_code == 2
    assert gone.stderr.count("\n") == 1


def test_a_servo_that_nobody_knows_is_told_from_one_without_windows_and_a_store_is_checked(tmp_path):
    twin = twin_file(tmp_path)
    store = open_store(f"sqlite:///{tmp_path / 'twin.db'}")
    store.put([Incoming("ax-1", MessageKind.LETTER, "k", b"body", "", message_digest(b"body"), 1.0)])
    store.close()
    for command in ("audit", "replay"):
        unknown = run(command, "ax-l", "--config", twin)
        assert unknown.exit_code == 2
        said = "servo 'ax-l': has never sent a message to this twin (did you mean 'ax-1'?)"
        assert said in " ".join(unknown.stderr.split())
    silent = run("audit", "ax-1", "--config", twin)
    assert (silent.exit_code, "has sent messages, but no window yet" in silent.stderr) == (2, True)
    checked = run("twin", "check", "--config", twin)
    assert (checked.exit_code, "is sound (1 messages agree" in checked.stdout) == (0, True), checked.output
    (tmp_path / "twin.db-newest").write_text("2\n")  # as a twin noted it
    short = run("twin", "check", "--config", twin)
    assert short.exit_code == 2
    assert "number 1, and it once had number 2" in " ".join(short.stderr.split())
    (tmp_path / "twin.db-newest").unlink()
    database = sqlite3.connect(tmp_path / "twin.db")
    with closing(database), database:
        database.execute("UPDATE bodies SET body = x'00'")
    damaged = run("twin", "check", "--config", twin)
    assert damaged.exit_code == 2
    assert "is damaged" in damaged.stderr
    assert "restore a backup" in " ".join(damaged.stderr.split())


def test_a_store_is_backed_up_and_restored(tmp_path):
    twin = twin_file(tmp_path)
    store = open_store(f"sqlite:///{tmp_path / 'twin.db'}")
    store.close()
    assert run("backup", tmp_path / "copy.db", "--config", twin).exit_code == 0
    for each in tmp_path.glob("twin.db*"):
        each.unlink()
    assert run("restore", tmp_path / "copy.db", "--config", twin).exit_code == 0
    assert (tmp_path / "twin.db").exists()
    assert run("restore", tmp_path / "nothing.db", "--config", twin).exit_code == 2


def test_servos_enrolled_at_the_same_time_all_get_their_tokens(tmp_path):
    twin = fresh(tmp_path)
    barrier, made = threading.Barrier(8), []

    def enroll(name):
        barrier.wait()
        made.extend(enrolment.enroll_operator(twin, name, tmp_path / name))

    threads = [threading.Thread(target=enroll, args=(f"boss-{i}",)) for i in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(made) == 16
    assert sorted(read_tokens(tmp_path / "tokens.toml").operators) == [f"boss-{i}" for i in range(8)]


def test_an_operator_s_token_replaces_no_file_that_is_there(tmp_path):
    twin = fresh(tmp_path)
    before = twin.read_text()
    refused = run("enroll", "boss", "--operator", twin, "--twin", twin)
    assert refused.exit_code == 2
    assert "exists already" in refused.stderr
    assert twin.read_text() == before


def test_a_revoked_token_is_refused(tmp_path):
    twin = twin_file(tmp_path)
    before = read_tokens(tmp_path / "tokens.toml")
    assert run("revoke", "ax-1", "--twin", twin).exit_code == 0
    assert run("revoke", "me", "--twin", twin).exit_code == 0
    assert read_tokens(tmp_path / "tokens.toml") == replace(
        before, servos={"ax-2": before.servos["ax-2"]}, operators={}
    )
    assert stat.S_IMODE((tmp_path / "tokens.toml").stat().st_mode) == 0o600
    again = run("revoke", "ax-1", "--twin", twin)
    assert again.exit_code == 2
    assert "'ax-1' has no token" in again.stderr


def test_an_edge_gets_the_certificates_to_verify_the_twin(tmp_path):
    """A certificate that has signed itself goes along; one of the system's does not; signers are named."""
    certificate, key = self_made(tmp_path)
    tls = f'tls_certificate = "{certificate}"\ntls_key = "{key}"\n'
    twin = fresh(tmp_path, tls)
    options = ("enroll", "ax-1", "--twin", twin, "--url", "https://h", "--edge")
    assert run(*options, tmp_path / "own").exit_code == 0
    assert (tmp_path / "own" / "ca.crt").read_bytes() == certificate.read_bytes()
    assert load(tmp_path / "own" / "edge.toml").twin.ca_file == "ca.crt"
    signed = signed_by_another(tmp_path, key)
    certificate.write_bytes(signed)
    assert run(*options, tmp_path / "known", "--again").exit_code == 0
    assert not (tmp_path / "known" / "ca.crt").exists()
    assert load(tmp_path / "known" / "edge.toml").twin.ca_file is None
    (tmp_path / "signers").mkdir()
    signers, _ = self_made(tmp_path / "signers")
    assert run(*options, tmp_path / "named", "--again", "--ca", signers).exit_code == 0
    assert (tmp_path / "named" / "ca.crt").read_bytes() == signers.read_bytes()
    # An enrolment that was interrupted leaves no edge.toml without its certificates: no later one writes those.
    (tmp_path / "cut" / "ca.crt").mkdir(parents=True)
    assert run(*options, tmp_path / "cut", "--again", "--ca", signers).exit_code != 0
    assert not (tmp_path / "cut" / "edge.toml").exists()
    refused = run(*options, tmp_path / "none", "--again", "--ca", twin)
    assert (refused.exit_code, "holds no certificates" in refused.stderr) == (2, True)
    assert not (tmp_path / "none").exists()


def signed_by_another(folder, key):
    """A certificate for a key that another one has signed."""
    (folder / "authority").mkdir()
    issuer, issuers_key = (path.read_bytes() for path in self_made(folder / "authority"))
    authority = x509.load_pem_x509_certificate(issuer)
    private = serialization.load_pem_private_key(key.read_bytes(), None)
    now, name = datetime.now(UTC), x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "twin")])
    builder = x509.CertificateBuilder(authority.subject, name, private.public_key(), x509.random_serial_number())
    builder = builder.not_valid_before(now).not_valid_after(now + timedelta(days=1))
    signed = builder.sign(serialization.load_pem_private_key(issuers_key, None), hashes.SHA256())
    return signed.public_bytes(serialization.Encoding.PEM)
