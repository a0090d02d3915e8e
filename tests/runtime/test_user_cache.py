"""The user's cache folder by the rules of the XDG specification, and the digest of source code."""

from pathlib import Path

import pytest

from servotwin.runtime.user_cache import cache_folder, digest_of


@pytest.mark.parametrize(
    ("given", "xdg", "expected"),
    [
        (None, None, "/home/me/.cache/servotwin"),
        (None, "/var/xdg", "/var/xdg/servotwin"),
        (None, "relative", "/home/me/.cache/servotwin"),
        (None, "", "/home/me/.cache/servotwin"),
        ("/var/cache/servotwin", "/var/xdg", "/var/cache/servotwin"),
        ("", "/var/xdg", None),
    ],
)
def test_the_folder(monkeypatch: pytest.MonkeyPatch, given: str | None, xdg: str | None, expected: str | None) -> None:
    monkeypatch.setenv("HOME", "/home/me")
    for name, value in (("SERVOTWIN_CACHE_DIR", given), ("XDG_CACHE_HOME", xdg)):
        if value is None:
            monkeypatch.delenv(name, raising=False)
        else:
            monkeypatch.setenv(name, value)
    assert cache_folder() == (None if expected is None else Path(expected))


def test_a_user_without_a_home_has_none(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse() -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.delenv("SERVOTWIN_CACHE_DIR", raising=False)
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr(Path, "home", refuse)
    assert cache_folder() is None


def test_the_digest_follows_names_and_contents_of_sources_only(tmp_path: Path) -> None:
    def digest() -> str:
        digest_of.cache_clear()
        return digest_of(tmp_path)

    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "one.py").write_text("x = 1\n")
    first = digest()
    (tmp_path / "a" / "__pycache__").mkdir()
    (tmp_path / "a" / "__pycache__" / "one.py").write_text("compiled")
    (tmp_path / "a" / "notes.txt").write_text("text")
    assert digest() == first
    (tmp_path / "a" / "one.py").write_text("x = 2\n")
    second = digest()
    (tmp_path / "a" / "one.py").rename(tmp_path / "a" / "two.py")
    assert len({first, second, digest()}) == 3
