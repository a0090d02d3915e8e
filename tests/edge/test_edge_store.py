"""The last parameters under which the loop kept its band outlive a boot, whole or not at all."""

from pathlib import Path

import pytest

from servotwin.edge.parameters import Parameters
from servotwin.edge.store import FileParameterStore
from servotwin.errors import InvalidInput
from servotwin.messages import Band, Gains, Setting

GOOD = Parameters(
    7,
    Setting(1e-4, Gains(1377.7, 0.0, -135.1, 0.1), Band(1e-4, 2e-5, 0.1, 2.0)),
    20.0,
    ("b0", 3),
    110_000,
    True,
    160_000,
)


@pytest.fixture
def store(tmp_path: Path) -> FileParameterStore:
    return FileParameterStore(tmp_path / "axis-1.json")


def test_a_new_store_is_empty(store: FileParameterStore) -> None:
    assert store.load() is None


def test_the_file_of_the_version_before_is_read(tmp_path: Path) -> None:
    path = tmp_path / "kept.json"
    path.write_text(
        '{"type":"kept/1","version":7,"tolerance":0.0001,"gains":{"Kp":1377.7,"Ki":0.0,"Kd":-135.1,"Tf":0.1,"enter":1.0,'
        '"leave":1.0,"feedforward":0.0},"band":{"error":0.0001,"error_rms":0.00002,"effort":0.1,"settling":2.0},'
        '"fallback":true}'
    )
    assert FileParameterStore(path).load() == Parameters(7, GOOD.setting, fallback=True)


def test_version_setting_and_fallback_outlive_a_boot(store: FileParameterStore) -> None:
    store.save(Parameters(3, Setting(2e-4)))
    store.save(GOOD)
    assert store.load() == Parameters(7, GOOD.setting, fallback=True)


def test_only_its_owner_may_read_it(tmp_path: Path) -> None:
    FileParameterStore(tmp_path / "kept.json").save(GOOD)
    assert (tmp_path / "kept.json").stat().st_mode & 0o777 == 0o600


def test_a_crash_while_writing_leaves_the_old_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = FileParameterStore(tmp_path / "kept.json")
    store.save(Parameters(3, Setting(2e-4)))

    def crash(_: int) -> None:
        raise OSError("power is gone")

    monkeypatch.setattr("servotwin.runtime.files.os.fsync", crash)
    with pytest.raises(OSError, match="power"):
        store.save(GOOD)
    assert store.load() == Parameters(3, Setting(2e-4))


@pytest.mark.parametrize("text", ["", "{}", '{"type":"kept/1","version":-1,"tolerance":0}', '{"type":"kept/2"}'])
def test_a_file_that_holds_something_else_is_named(tmp_path: Path, text: str) -> None:
    path = tmp_path / "kept.json"
    path.write_text(text)
    with pytest.raises(InvalidInput, match=r"kept\.json"):
        FileParameterStore(path).load()
