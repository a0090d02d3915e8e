"""Pool of connections that leaves none open once it is disposed."""

from __future__ import annotations

import logging

from sqlalchemy.pool import ConnectionPoolEntry, QueuePool

# SQLAlchemy names a pool's logger after its class, and this one is ours: the log would hold the pool's every step.
logging.getLogger(f"{__name__}.ClosingPool").setLevel(logging.WARNING)


class ClosingPool(QueuePool):
    """A pool that closes also those connections that were in use when it was disposed, as they are given back.

    SQLAlchemy's own keeps them until it is garbage itself: open, with their sockets.
    """

    _disposed = False

    def dispose(self) -> None:
        """Close every connection: one that is in use when it is given back."""
        self._disposed = True
        super().dispose()

    def _do_return_conn(self, record: ConnectionPoolEntry) -> None:
        super()._do_return_conn(record)
        if self._disposed:
            super().dispose()
