"""Columns of a series as a Parquet file."""

from __future__ import annotations

import io
from typing import Any

from servotwin.runtime.extras import require


def table_parquet(columns: dict[str, list[Any]]) -> bytes:
    """Write columns of equal length as a Parquet file; null where a value is unknown.

    Raises
    ------
    InvalidInput
        pyarrow is not installed.
    """
    purpose = "a Parquet file of the dashboard"
    pyarrow, parquet = require("pyarrow", purpose), require("pyarrow.parquet", purpose)
    made = io.BytesIO()
    parquet.write_table(pyarrow.table({name: pyarrow.array(values) for name, values in columns.items()}), made)
    return made.getvalue()
