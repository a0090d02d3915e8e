"""Queries of the rows of all servos, from which those are left out that are set aside: rows of theirs are damaged."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

import sqlalchemy as sa


def without(query: sa.Select[Any], servo: sa.ColumnElement[str], aside: Collection[str]) -> sa.Select[Any]:
    """Leave out the rows of servos that are set aside; most often there are none, and the query stays as it is."""
    return query.where(servo.not_in(sorted(aside))) if aside else query
