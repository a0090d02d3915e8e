"""Backup of a store while a servo is set aside: it holds all others, says so, and is never taken for a whole one."""

import shutil
from contextlib import closing
from pathlib import Path

import pytest
from store_cases import claim, outcome, window
from typer.testing import CliRunner

from servotwin.cli.app import INVALID, app
from servotwin.errors import InvalidInput
from servotwin.messages import Resend, decode
from servotwin.store.backup import RowCounts, backup, restore
from servotwin.store.integrity import check_all, message_digest
from servotwin.store.records import EvidenceRecord
from servotwin.store.store import Store, open_store

WRONG = "column twins.serial holds -7 where a count up to 2**53 belongs, in the row of servo 'ax-1'"


def digested(servo: str, sequence: int) -> object:
    plain = window(servo, sequence, b"%d" % sequence)
    return plain._replace(digest=message_digest(plain.body))


def hit(url: str) -> Store:
    """A store of two servos, one of which is set aside."""
    store = open_store(url)
    store.put([digested(servo, n) for servo in ("ax-1", "ax-2") for n in range(3)])
    for lease in claim(store):
        seen = EvidenceRecord("estimate", lease.messages[0].id, b"e", gap=0.1)
        store.commit([outcome(lease, seen, outgoing=(b"u",))], 201.0)
    with store.writing() as connection:
        connection.exec_driver_sql("UPDATE twins SET serial = -7 WHERE servo = 'ax-1'")
    store.set_aside(check_all(store).rows)
    return store


def test_a_backup_holds_the_others_and_a_restore_says_whom_it_lacks(tmp_path: Path) -> None:
    saved, again = tmp_path / "backup.db", f"sqlite:///{tmp_path}/again.db"
    with closing(hit(f"sqlite:///{tmp_path}/store.db")) as store:
        before = store.audit("ax-2")
        assert backup(f"sqlite:///{tmp_path}/store.db", saved) == (RowCounts(1, 3, 3, 1, 1), {"ax-1": WRONG})
    assert restore(saved, again) == (RowCounts(1, 3, 3, 1, 1), {"ax-1": WRONG})
    with closing(open_store(again)) as restored:
        assert not restored.aside
        assert not check_all(restored).faults
        assert restored.audit("ax-2") == before
        assert restored.audit("ax-1") == []
        for servo, said in (("ax-1", f", which lacks all of this servo ({WRONG}). Versions"), ("ax-2", " UTC. Ver")):
            (alarm,) = restored.events(servo)
            assert said in alarm.status
            asked = restored.outgoing(servo, 1)
            assert [type(decode(each.body)) for each in asked] == [Resend]
        restored.put([digested("ax-1", 5)])
        assert [lease.servo for lease in claim(restored)] == ["ax-1"]


def test_a_file_that_was_copied_while_a_servo_was_set_aside_is_restored_without_it(tmp_path: Path) -> None:
    hit(f"sqlite:///{tmp_path}/store.db").close()
    shutil.copy(tmp_path / "store.db", tmp_path / "copy.db")
    rows, left_out = restore(tmp_path / "copy.db", f"sqlite:///{tmp_path}/again.db")
    assert (rows.twins, left_out) == (1, {"ax-1": WRONG})


def test_a_backup_without_a_servo_replaces_no_other_one(tmp_path: Path) -> None:
    saved = tmp_path / "backup.db"
    hit(f"sqlite:///{tmp_path}/store.db").close()
    saved.write_bytes(b"an earlier one")
    with pytest.raises(InvalidInput, match=r"is not replaced, because the new one would lack servos .*\(ax-1: column"):
        backup(f"sqlite:///{tmp_path}/store.db", saved, replace=True)
    assert saved.read_bytes() == b"an earlier one"
    assert not list(tmp_path.glob(".*"))


def test_another_fault_than_that_of_the_servo_is_damage(tmp_path: Path) -> None:
    with closing(hit(f"sqlite:///{tmp_path}/store.db")) as store, store.writing() as connection:
        connection.exec_driver_sql("UPDATE twins SET posted = -7 WHERE servo = 'ax-2'")
    with pytest.raises(InvalidInput, match=r"is damaged \(column twins.posted holds -7"):
        backup(f"sqlite:///{tmp_path}/store.db", tmp_path / "backup.db")


def test_the_commands_say_what_is_missing(tmp_path: Path) -> None:
    config, saved = tmp_path / "twin.toml", tmp_path / "backup.db"
    config.write_text('[models.axis]\nservo = "paper"\n[servos]\n"ax-*" = "axis"\n')
    hit(f"sqlite:///{tmp_path}/twin.db").close()
    made = CliRunner().invoke(app, ["backup", str(saved), "--config", str(config)])
    assert made.exit_code == INVALID
    assert "1 servos, 3 messages" in made.stdout
    assert f"is written, but holds nothing of servos that are set aside (ax-1: {WRONG}); keep" in made.stderr
    for file in tmp_path.glob("twin.db*"):
        file.unlink()
    put_back = CliRunner().invoke(app, ["restore", str(saved), "--config", str(config)])
    assert (put_back.exit_code, put_back.stderr) == (0, "")
    assert f"missing: the backup holds nothing of ax-1: {WRONG}: these servos begin anew" in put_back.stdout
