"""Series as Parquet files: what CSV holds, with types, and one sentence where pyarrow is missing."""

import io
import sys

import pytest
from pyarrow import parquet

from servotwin.dashboard.parquet_file import table_parquet
from servotwin.errors import InvalidInput

COLUMNS = {"gap": [1.0, None, 2], "boot": ["a", "b", "c"], "reasons": [[], ["x", "y"], []], "low": [None, None, None]}


def test_a_file_holds_every_column_and_what_is_unknown_is_null():
    table = parquet.read_table(io.BytesIO(table_parquet(COLUMNS)))
    assert table.to_pydict() == COLUMNS


def test_without_pyarrow_the_answer_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(InvalidInput, match=r"needs pyarrow, which is not installed; give: pip install 'servotwin\[par"):
        table_parquet(COLUMNS)
