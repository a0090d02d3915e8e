"""The last proved parameters outlive a boot, whole or not at all."""

from pathlib import Path

import pytest

from servotwin.edge.parameters import Parameters
from servotwin.edge.store import FileStore, MemoryStore, Store
from servotwin.errors import InvalidInput
from servotwin.messages import Band, Gains

GOOD = Parameters(
    7, 1e-4, 20.0, ("b0", 3), 110_000, Gains(1377.7, 0.0, -135.1, 0.1), Band(1e-4, 2e-5, 0.1, 2.0), True, 160_000
)


@pytest.fixture(params=["memory", "file"])
def store(request: pytest.FixtureRequest, tmp_path: Path) -> Store:
    return MemoryStore() if request.param == "memory" else FileStore(tmp_path / "axis-1.json")


def test_nothing_is_kept_at_first(store: Store) -> None:
    assert store.load() is None


def test_what_outlives_a_boot(store: Store) -> None:
    store.save(Parameters(3, 2e-4))
    store.save(GOOD)
    assert store.load() == Parameters(7, 1e-4, gains=GOOD.gains, band=GOOD.band, fallback=True)


def test_a_crash_while_writing_leaves_the_old_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = FileStore(tmp_path / "kept.json")
    store.save(Parameters(3, 2e-4))

    def crash(_: int) -> None:
        raise OSError("power is gone")

    monkeypatch.setattr("servotwin.runtime.files.os.fsync", crash)
    with pytest.raises(OSError, match="power"):
        store.save(GOOD)
    assert store.load() == Parameters(3, 2e-4)


@pytest.mark.parametrize("text", ["", "{}", '{"type":"kept/1","version":-1,"tolerance":0}', '{"type":"kept/2"}'])
def test_a_file_that_holds_something_else_is_named(tmp_path: Path, text: str) -> None:
    path = tmp_path / "kept.json"
    path.write_text(text)
    with pytest.raises(InvalidInput, match=r"kept\.json"):
        FileStore(path).load()
