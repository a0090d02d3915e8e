"""Files are written whole or not at all, and a path that cannot be written is refused before anything is computed."""

import errno
import stat

import pytest

from servotwin.errors import InvalidInput
from servotwin.runtime import files


def names(folder):
    return [path.name for path in folder.iterdir()]


def write_half(path, error):
    with files.atomic_output(path) as temporary:
        temporary.write_text("half")
        raise error


def test_a_file_appears_whole(tmp_path):
    files.write_text(tmp_path / "a.txt", "gap")
    assert (tmp_path / "a.txt").read_text() == "gap"
    assert names(tmp_path) == ["a.txt"]


def test_a_failure_leaves_the_old_file_and_nothing_else(tmp_path):
    target = files.write_text(tmp_path / "a.txt", "old")
    with pytest.raises(RuntimeError):
        write_half(target, RuntimeError)
    assert target.read_text() == "old"
    assert names(tmp_path) == ["a.txt"]


def test_an_interrupt_leaves_nothing(tmp_path):
    with pytest.raises(KeyboardInterrupt):
        write_half(tmp_path / "a.txt", KeyboardInterrupt)
    assert names(tmp_path) == []


def test_the_file_has_the_permissions_of_an_ordinary_one(tmp_path):
    ordinary = tmp_path / "b.txt"
    ordinary.write_text("")
    written = files.write_text(tmp_path / "a.txt", "")
    assert stat.S_IMODE(written.stat().st_mode) == stat.S_IMODE(ordinary.stat().st_mode)


@pytest.mark.parametrize(
    ("name", "message"),
    [("run.xlsx", "'.xlsx'"), ("run", "''"), ("missing/run.csv", "no directory"), ("folder.csv", "is a directory")],
)
def test_a_path_that_cannot_be_written_is_refused(tmp_path, name, message):
    (tmp_path / "folder.csv").mkdir()
    with pytest.raises(InvalidInput, match=message) as error:
        files.check_file(tmp_path / name, (".csv", ".npz"))
    assert name in str(error.value)


def test_a_directory_under_a_file_is_refused(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(InvalidInput, match="cannot be made"):
        files.make_directory(tmp_path / "file" / "out")


def test_a_directory_is_made_with_its_parents(tmp_path):
    assert files.make_directory(tmp_path / "a" / "b").is_dir()


def test_a_refusal_by_the_system_is_one_sentence(tmp_path):
    with pytest.raises(InvalidInput, match=r"a\.txt: cannot be written \(No space left on device\)"):
        write_half(tmp_path / "a.txt", OSError(errno.ENOSPC, "No space left on device"))
    assert names(tmp_path) == []
    with pytest.raises(InvalidInput, match="cannot be written"):
        files.write_text(tmp_path / "missing" / "a.txt", "gap")


def test_a_directory_that_takes_no_file_is_refused_before_anything_is_computed(tmp_path, monkeypatch):
    def refuse(**_where):
        raise FileNotFoundError(errno.ENOENT, "No such file or directory")

    monkeypatch.setattr(files.tempfile, "TemporaryFile", refuse)
    with pytest.raises(InvalidInput, match="may not be written to"):
        files.check_file(tmp_path / "run.csv", (".csv",))


def test_a_replaced_file_is_private_from_the_first_byte(tmp_path):
    path = tmp_path / "token"
    (tmp_path / "token.new").write_text("")  # left behind, and readable
    files.replace_file(path, b"secret", durable=True, mode=0o600)
    assert (path.read_bytes(), stat.S_IMODE(path.stat().st_mode)) == (b"secret", 0o600)


def test_a_replacement_that_fails_leaves_the_old_file_and_nothing_else(tmp_path, monkeypatch):
    path = tmp_path / "state.json"
    files.replace_file(path, b"old")

    def crash(_descriptor):
        raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr(files.os, "fsync", crash)
    with pytest.raises(OSError, match="Input/output"):
        files.replace_file(path, b"new", durable=True)
    assert path.read_bytes() == b"old"
    assert names(tmp_path) == ["state.json"]
