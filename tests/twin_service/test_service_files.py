"""Files of a service: its tokens, its password and its configuration."""

import stat

import pytest
from hypothesis import given
from hypothesis import strategies as st
from service_system import SERVO, twin_file

from servotwin.config.table import Table
from servotwin.errors import InvalidInput
from servotwin.link.seal import verifier_of
from servotwin.twin_service.auth import Verifiers, read_tokens, write_private, write_tokens
from servotwin.twin_service.config import PASSWORD, ServiceConfig, read_service
from servotwin.twin_service.twin_file import read_twin


@pytest.mark.slow
@given(
    servos=st.dictionaries(st.from_regex(r"\A[A-Za-z0-9][A-Za-z0-9._-]{0,20}\Z"), st.binary(min_size=32, max_size=32)),
    operators=st.dictionaries(st.sampled_from(["me", "you"]), st.binary(min_size=32, max_size=32)),
)
def test_a_file_of_tokens_reads_as_it_was_written(tmp_path_factory, servos, operators):
    path = tmp_path_factory.mktemp("tokens") / "tokens.toml"
    every = [*servos.values(), *operators.values()]
    write_tokens(path, Verifiers(servos, operators))
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    if len(set(every)) < len(every):
        with pytest.raises(InvalidInput, match="same token"):
            read_tokens(path)
    else:
        assert read_tokens(path) == Verifiers(servos, operators)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ('[servos]\n"ax-1" = "secret"', "no verifier"),
        ('[servos]\n"a b" = "00"', "a name has"),
        (f'[servos]\na = "{"0" * 64}"\nb = "{"0" * 64}"', "same token"),
        ('[servo]\na = "00"', "did you mean 'servos'"),
        ('[operators]\n"x" = 3', "no verifier"),
    ],
)
def test_a_file_of_tokens_that_is_wrong_is_one_sentence_without_what_it_holds(tmp_path, text, expected):
    path = tmp_path / "tokens.toml"
    write_private(path, text)
    with pytest.raises(InvalidInput) as error:
        read_tokens(path)
    assert expected in str(error.value)
    assert "secret" not in str(error.value)
    path.chmod(0o640)
    with pytest.raises(InvalidInput, match="chmod 600"):
        read_tokens(path)


def config(folder, values, environment=None):
    return read_service(Table("twin.toml", values, "service"), folder, environment or {})


def test_the_password_of_a_store_comes_from_a_file_or_the_environment_and_is_not_shown(tmp_path):
    url = "postgresql://me@host/twin"
    write_private(tmp_path / "password", "hunter2\n")
    for result in (
        config(tmp_path, {"store": url, "store_password_file": "password"}),
        config(tmp_path, {"store": url}, {PASSWORD: "hunter2"}),
    ):
        assert result.store_password == "hunter2"
        assert "hunter2" not in repr(result)
    assert config(tmp_path, {}).store == f"sqlite:///{tmp_path / 'twin.db'}"
    for holding in ("postgresql://me:hunter2@host/twin", "postgresql://me@host/twin?password=hunter2"):
        with pytest.raises(InvalidInput, match="holds a password") as error:
            config(tmp_path, {"store": holding})
        assert "hunter2" not in str(error.value)
    (tmp_path / "password").chmod(0o604)
    with pytest.raises(InvalidInput, match=r"store_password_file = 'password': .* others"):
        config(tmp_path, {"store": url, "store_password_file": "password"})


def test_another_address_needs_tokens_and_tls_or_a_proxy(tmp_path):
    for values in ({}, {"tokens": "tokens.toml"}, {"behind_proxy": True}):
        with pytest.raises(InvalidInput, match="requires tokens"):
            config(tmp_path, {"bind": "0.0.0.0", **values})
    assert not config(tmp_path, {"bind": "::", "tokens": "tokens.toml", "behind_proxy": True}).local
    with pytest.raises(InvalidInput, match="requires tokens"):
        config(tmp_path, {"bind": "127.0.0.1", "behind_proxy": True})
    for address in ("localhost", "127.0.0.2", "::1"):
        assert config(tmp_path, {"bind": address}).local
    assert ServiceConfig().local


def test_a_whole_file_knows_its_service_and_its_fleet(tmp_path):
    result = read_twin(twin_file(tmp_path, "speed = 5.0"))
    assert result.service.speed == 5.0
    assert result.fleet.model_of("ax-9").name == "axis"
    assert verifier_of("token-of-ax-1") in read_tokens(result.service.tokens).servos.values()
    with pytest.raises(InvalidInput, match="unknown key 'servo'"):
        read_twin(twin_file(tmp_path, servos="[servo]\nx = 1\n" + SERVO))
