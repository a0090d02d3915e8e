"""The link over MQTT: access control, TLS, and the files of the guide."""

import re
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from mosquitto import Login, Tls, broker
from mqttparts import edge, kept, parcel, twin
from selfsigned import self_made
from waiting import until

from servotwin.config.table import parse_toml
from servotwin.edge_process.config import password_of
from servotwin.edge_process.config_file import load as load_edge_config
from servotwin.errors import InvalidInput
from servotwin.link.broker import Broker
from servotwin.link.mqtt import MqttTransport
from servotwin.link.transport import Unreachable
from servotwin.store.store import Store, open_store
from servotwin.twin_service.auth import write_private
from servotwin.twin_service.config import read_service


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    store = open_store(f"sqlite:///{tmp_path}/twin.db")
    yield store
    store.close()


def shown(words: str) -> str:
    """The block of the guide that has these words in it."""
    text = (Path(__file__).parents[2] / "docs/howto/mqtt.md").read_text()
    (block,) = (each for each in re.findall(r"```\w+\n(.*?)```", text, re.DOTALL) if words in each)
    return block


def test_the_files_that_the_guide_shows_are_read(tmp_path: Path) -> None:
    for name in ("token", "broker-password"):
        write_private(tmp_path / name, "secret")
    self_made(tmp_path)[0].rename(tmp_path / "broker-ca.pem")
    text = 'servo = "axis-1"\nrole = "supervise"\nsample_rate_hz = 100.0\n[drive]\nkind = "simulated"\n'
    (tmp_path / "edge.toml").write_text(text + shown("[twin]"))
    config = load_edge_config(tmp_path / "edge.toml")
    assert config.twin is not None
    assert (config.twin.over_mqtt, password_of(config)) == (True, "secret")
    (tmp_path / "tokens").touch(0o600)
    twin_file = '[service]\ntokens = "tokens"\n' + shown("[service.mqtt]")
    result = read_service(parse_toml(twin_file, "twin.toml").table("service"), tmp_path, {})
    assert result.mqtt is not None
    assert (result.mqtt.broker.password, result.mqtt.group, result.mqtt.local) == ("secret", "twins", False)


@pytest.mark.slow
def test_the_rules_that_the_guide_shows_are_enough_and_keep_others_out(tmp_path: Path, store: Store) -> None:
    rules = shown("pattern write")
    logins = Login("twins", "twin's password"), Login("axis-1", "edge's password")
    with broker(tmp_path / "broker", logins, rules=rules) as server:
        twins, edges = (Broker(server.url, *login) for login in logins)
        with twin(twins, store), edge(edges, wait_s=0.1) as here, edge(edges, "axis-2", timeout_s=1.0) as other:
            here.deliver(parcel(0))
            assert here.listen(0) == []
            with pytest.raises(Unreachable, match=r"the broker refuses what this user sends \(Not authorized\)"):
                other.deliver(parcel(0, "axis-2"))
    assert (kept(store), kept(store, "axis-2")) == ([0], [])


@pytest.mark.slow
def test_a_twin_whose_user_may_not_answer_says_so(
    tmp_path: Path, store: Store, caplog: pytest.LogCaptureFixture
) -> None:
    rules = shown("pattern write").replace("topic write servotwin/+/down\n", "")
    assert rules != shown("pattern write")
    logins = Login("twins", "twin's password"), Login("axis-1", "edge's password")
    with broker(tmp_path / "broker", logins, rules=rules) as server:
        twins, edges = (Broker(server.url, *login) for login in logins)
        with twin(twins, store), edge(edges, timeout_s=1.0) as here:
            for _ in range(2):
                with pytest.raises(Unreachable, match="no answer of a twin"):
                    here.deliver(parcel(0))
            until(lambda: "broker refuses answers" in caplog.messages)
    assert kept(store) == [0]
    [line] = [each for each in caplog.records if each.message == "broker refuses answers"]
    assert vars(line)["why"] == "the broker refuses what this user sends (Not authorized)"


@pytest.mark.slow
def test_a_user_and_a_password_where_the_broker_asks_for_them(tmp_path: Path, store: Store) -> None:
    logins = Login("edge", "edge's password"), Login("twin", "twin's password")
    with broker(tmp_path / "broker", logins) as server:
        twins, edges = (Broker(server.url, *login) for login in reversed(logins))
        with twin(twins, store), edge(edges) as here, edge(Broker(server.url), timeout_s=1.0) as nobody:
            here.deliver(parcel(0))
            with pytest.raises(Unreachable, match="refuses the connection"):
                nobody.deliver(parcel(1))
    assert kept(store) == [0]
    assert "password" not in repr(edges)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_over_tls_the_brokers_certificate_is_checked(tmp_path: Path, store: Store) -> None:
    """The socket of a handshake that failed is left by paho to the garbage collector, which warns."""
    files = Tls(*self_made(tmp_path))
    with broker(tmp_path / "broker", tls=files) as server:
        trusted = Broker(server.url, ca_file=str(files.certificate))
        with twin(trusted, store), edge(trusted) as here, edge(Broker(server.url), timeout_s=1.0) as doubting:
            here.deliver(parcel(0))
            with pytest.raises(Unreachable, match="signed by none that this computer trusts"):
                doubting.deliver(parcel(1))
    assert kept(store) == [0]
    with pytest.raises(InvalidInput, match="holds no certificates"):
        MqttTransport(Broker("mqtts://127.0.0.1", ca_file=str(tmp_path / "absent.pem")), "axis-1", "token")


@pytest.mark.parametrize(
    "url", ["http://host", "mqtt://", "mqtt://host/path", "mqtt://me:secret@host", "mqtt://host:0", "mqtt://host:x"]
)
def test_an_invalid_address_is_named(url: str) -> None:
    with pytest.raises(InvalidInput, match=r"give mqtt\(s\)://host"):
        Broker(url)


def test_without_paho_one_sentence_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "paho.mqtt.client", None)
    with pytest.raises(InvalidInput, match=r"pip install 'servotwin\[mqtt\]'"):
        MqttTransport(Broker("mqtt://127.0.0.1"), "axis-1", "token")


def test_a_broker_on_another_machine_requires_tokens(tmp_path: Path) -> None:
    for text, what in (
        ('[service.mqtt]\nurl = "mqtts://elsewhere"', "requires tokens"),
        ('[service]\nlockstep = true\n[service.mqtt]\nurl = "mqtt://localhost"', "exclude each other"),
        ('[service.mqtt]\nurl = "mqtt://localhost"\ngroup = "a/b"', "a name without"),
    ):
        with pytest.raises(InvalidInput, match=what):
            read_service(parse_toml(text, "twin.toml").table("service"), tmp_path, {})
