"""One edge at a time on its files: two would give one machine two voltages."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

from servotwin.edge_process.config import EdgeConfig
from servotwin.edge_process.log import say
from servotwin.errors import InvalidInput
from servotwin.runtime.locks import locked


@contextmanager
def alone(config: EdgeConfig) -> Iterator[None]:
    """Hold an edge's files for this process, however it ends; where the disk takes no lock the machine runs anyway.

    Raises
    ------
    InvalidInput
        Another process holds them.
    """
    with ExitStack() as locks:
        for name in dict.fromkeys((config.keeping.parameters, config.keeping.outbox)):
            try:
                locks.enter_context(locked(config.path(f"{name}-lock")))
            except BlockingIOError:
                raise InvalidInput(f"{config.source}: another edge runs on its files; end that one first") from None
            except OSError as error:
                say("not locked", error=str(error))
        yield
