"""A store written by the version before the new layout: it opens, holds the same, and its twin continues."""

import gzip
import json
import shutil
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import msgspec
import pytest

from servotwin.messages import WindowMessage, decode, encode
from servotwin.store.backup import backup, restore
from servotwin.store.engine import transaction
from servotwin.store.migrate import VERSIONS
from servotwin.store.records import MessageKind, PutResult
from servotwin.store.schema import REVISION
from servotwin.store.store import Store, open_store
from servotwin.twin.work import work
from servotwin.twin_service.http_operator import trace_as_json
from servotwin.twin_service.ingest import Ingest
from servotwin.twin_service.limits import SampleTimeLimiter
from servotwin.twin_service.monitoring import Metrics
from servotwin.twin_service.twin_file import read_twin

DATA = Path(__file__).parents[1] / "data" / "version-0"
SERVO = "quick"


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """The file as it was left."""
    path = tmp_path / "twin.db"
    path.write_bytes(gzip.decompress((DATA / "twin.db.gz").read_bytes()))
    path.chmod(0o600)
    return path


@pytest.fixture
def store(path: Path) -> Iterator[Store]:
    store = open_store(str(path))
    yield store
    store.close()


def renamed(value: object) -> object:
    """A document with the keys of today."""
    if isinstance(value, list):
        return [renamed(each) for each in value]
    if isinstance(value, dict):
        today = {"made": "created", "found": "evidence"}
        return {today.get(key, key): renamed(each) for key, each in value.items()}
    return value


def newest_window(store: Store) -> WindowMessage:
    last = store.windows(SERVO, 1)[0]
    stored = store.window(SERVO, last.boot, last.sequence)
    assert stored is not None
    message = decode(incoming(store, stored.body, stored.encoding)[1])
    assert isinstance(message, WindowMessage)
    return message


def incoming(_store: Store, body: bytes, encoding: str) -> tuple[object, bytes]:
    """The message as the service would store it, and its bytes."""
    ingest = Ingest(put=None, has_servo=lambda _: True, sample_times=SampleTimeLimiter(1e9, 1e9), metrics=Metrics())
    item, message = ingest.read(SERVO, body, encoding)
    return item, encode(message)


def test_a_store_of_version_0_is_at_the_newest_revision_and_tells_the_same(store: Store) -> None:
    with transaction(store.engines.reader) as connection:
        assert connection.exec_driver_sql(f"SELECT version_num FROM {VERSIONS}").scalar() == REVISION
    expected = json.loads(gzip.decompress((DATA / "audit.json.gz").read_bytes()))
    traces = [trace_as_json(trace) for trace in store.audit(SERVO)]
    answers = [answer for trace in traces for step in trace["steps"] for answer in step["answers"]]
    assert all(answer.pop("received") <= answer["created"] for answer in answers)  # later versions tell it as well
    assert json.loads(msgspec.json.encode(traces)) == renamed(expected)
    assert sum(len(trace["steps"]) for trace in traces) == 1


def test_a_window_of_version_0_sent_again_is_known_and_another_one_under_its_key_is_a_conflict(store: Store) -> None:
    window = newest_window(store)
    again, _ = incoming(store, encode(window), "")
    other, _ = incoming(store, encode(msgspec.structs.replace(window, reason="another")), "")
    assert store.put([again, other]) == [PutResult.KNOWN, PutResult.CONFLICT]


def test_the_twin_of_version_0_continues_from_its_stored_state(store: Store, tmp_path: Path) -> None:
    shutil.copy(DATA / "twin.toml", tmp_path)
    (tmp_path / "tokens.toml").touch(0o600)
    fleet = read_twin(tmp_path / "twin.toml").fleet
    last, before = newest_window(store), store.servo(SERVO)
    assert before is not None
    following = msgspec.structs.replace(last, sequence=last.sequence + 1, start=last.start + 4.0)
    item, _ = incoming(store, encode(following), "")
    assert store.put([item]) == [PutResult.NEW]
    [lease] = store.lease("me", 1, 60.0, item.received, (MessageKind.WINDOW, MessageKind.LETTER), servo=SERVO)
    assert lease.state
    result = work(fleet, lease, item.received)
    assert {record.kind for record in result.evidence} & {"glance", "estimate"}
    assert not [record.status for record in result.evidence if record.status.startswith("failed")]
    assert store.commit([result], item.received) == [True]
    after = store.servo(SERVO)
    assert after is not None
    assert after.serial == before.serial + 1
    assert after.waiting == 0


def test_its_backup_is_restored(path: Path, tmp_path: Path) -> None:
    made, place = tmp_path / "backup.db", tmp_path / "new.db"
    assert backup(str(path), made).rows == restore(made, str(place)).rows
    with closing(open_store(str(path))) as old, closing(open_store(str(place))) as new:
        assert new.windows(SERVO, 5) == old.windows(SERVO, 5)
        assert new.audit(SERVO) == old.audit(SERVO)
    assert not place.with_name(f"{place.name}-wal").exists()
