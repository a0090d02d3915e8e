"""Errors that tell that an SQLite file is damaged, for all who read one."""

from __future__ import annotations

import sqlite3

_CODES = (sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB)
_NO_TEXT = "Could not decode to UTF-8 column "
"""Python's own error, without a code; the words after the column are the bytes."""


def is_damage(error: BaseException | None) -> bool:
    """True where an error of SQLite names damage of its file: CORRUPT, NOTADB, or a text that is none."""
    return getattr(error, "sqlite_errorcode", 0) & 0xFF in _CODES or (
        isinstance(error, sqlite3.OperationalError) and str(error).startswith(_NO_TEXT)
    )


def damage_words(error: BaseException | None) -> str:
    """Words of an error; of a text that cannot be decoded without its bytes."""
    words = str(error)
    if words.startswith(_NO_TEXT):
        column = words.removeprefix(_NO_TEXT).partition("'")[2].partition("'")[0]
        return f"a text in column {column!r} is not UTF-8"
    return words
