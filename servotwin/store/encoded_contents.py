"""Contents that are MessagePack or JSON and can be read as such: the store keeps them as bytes and texts."""

from __future__ import annotations

from collections.abc import Callable

import msgspec
import sqlalchemy as sa

from servotwin.store.engine import StoreDamaged, transaction
from servotwin.store.schema import contexts, evidence, outgoing, states
from servotwin.store.store import FLEET, Store
from servotwin.store.stored_value import row_name

_ROWS = 256
_COLUMNS: tuple[tuple[sa.Column[bytes] | sa.Column[str], str, Callable[..., object]], ...] = (
    (states.c.state, "MessagePack", msgspec.msgpack.decode),
    (contexts.c.text, "JSON", msgspec.json.decode),
    (outgoing.c.body, "MessagePack", msgspec.msgpack.decode),
    (evidence.c.body, "MessagePack", msgspec.msgpack.decode),
)


def encoding_faults(store: Store) -> tuple[str, ...]:
    """First row of each column whose content cannot be decoded, in a clause.

    Such a row harms one servo alone, and that is evidence of its own: the twin of that servo begins anew, or the body
    is shown as unknown.

    Raises
    ------
    StoreUnavailable
    """
    try:
        with transaction(store.engines.reader) as connection:
            faults = [_fault(connection, *each) for each in _COLUMNS]
    except StoreDamaged as error:
        return (str(error),)
    return tuple(filter(None, faults))


def _fault(
    connection: sa.Connection, column: sa.Column[bytes] | sa.Column[str], name: str, decode: Callable[..., object]
) -> str:
    table, keys = column.table, tuple(column.table.primary_key)
    query = sa.select(column, *keys)
    if table is contexts:
        query = query.where(contexts.c.key != FLEET)  # a name
    with connection.execution_options(yield_per=_ROWS).execute(query) as rows:
        for content, *key in rows:
            try:
                decode(content)
            except (msgspec.MsgspecError, ValueError, RecursionError):
                return f"column {table.name}.{column.name} holds what is no {name}, in {row_name(keys, key)}"
    return ""
