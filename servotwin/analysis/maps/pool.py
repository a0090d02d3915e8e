"""Tasks shared among processes by joblib: a pool on this machine, or a Dask cluster."""

from __future__ import annotations

import logging
import os
import re
import warnings
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

from joblib import Parallel, delayed, parallel_config
from joblib.externals.loky import get_reusable_executor
from joblib.externals.loky.backend import resource_tracker as loky_tracker

from servotwin.errors import InvalidInput
from servotwin.runtime.extras import require
from servotwin.runtime.interrupts import ignore_interrupts, interrupts_blocked

CONNECT_TIMEOUT = 5.0
_ADDRESS = re.compile(r"((tcp|tls|ws|wss)://)?([^\s/:\[\]]+|\[[0-9a-fA-F:.]+\]):[0-9]{1,5}")

_T = TypeVar("_T")
_R = TypeVar("_R")


@contextmanager
def workplace(workers: int | None = None, scheduler: str | None = None) -> Iterator[None]:
    """Provide the worker processes for `shared` inside this block.

    Parameters
    ----------
    workers : int, optional
        Processes on this machine, one per core by default; 1: no other process.
    scheduler : str, optional
        Address of a Dask scheduler, such as tcp://host:8786: its workers do the work.

    Raises
    ------
    InvalidInput
        The scheduler cannot be reached, has no workers, or is lost.
    """
    with _processes(workers or os.cpu_count() or 1) if scheduler is None else _cluster(scheduler):
        yield


def shared(function: Callable[[_T], _R], tasks: Iterable[_T]) -> Generator[tuple[_T, _R], None, None]:
    """Apply `function` to every task; yield (task, result) in order of completion, until closed.

    Parameters
    ----------
    function : callable
        Picklable; its result depends on the task alone.
    tasks : iterable
        Picklable.
    """
    with interrupts_blocked(loky_tracker.ensure_running):
        outcomes = Parallel(batch_size=1, return_as="generator_unordered")(
            delayed(_performed)(function, task) for task in tasks
        )
    try:
        # Not `yield from`: it would close `outcomes` before `finally`, and joblib would warn of unfinished tasks.
        for outcome in outcomes:  # noqa: UP028
            yield outcome
    finally:
        with warnings.catch_warnings(action="ignore"):  # joblib's, of unfinished tasks
            outcomes.close()


def _performed(function: Callable[[_T], _R], task: _T) -> tuple[_T, _R]:
    return task, function(task)


@contextmanager
def _processes(workers: int) -> Iterator[None]:
    try:
        with (
            parallel_config(backend="loky", n_jobs=workers, initializer=ignore_interrupts),
            warnings.catch_warnings(),
        ):
            # loky replaces workers whose caches have grown; nothing is wrong then.
            warnings.filterwarnings("ignore", "A worker stopped while some jobs", UserWarning)
            yield
    finally:
        if workers > 1:
            get_reusable_executor(reuse=True).shutdown(wait=True, kill_workers=True)


@contextmanager
def _cluster(address: str) -> Iterator[None]:
    if not _ADDRESS.fullmatch(address):
        raise InvalidInput(f"--scheduler {address!r}: is no address; give one such as tcp://host:8786")
    client = _connected(address)
    try:
        with parallel_config(backend="dask", client=client):
            yield
    except ModuleNotFoundError as error:
        raise InvalidInput(
            f"--scheduler {address}: its workers cannot import {error.name}; install servotwin"
        ) from None
    except Exception as error:
        if not type(error).__module__.startswith("distributed."):
            raise
        raise InvalidInput(
            f"--scheduler {address}: the connection to it or to its workers was lost ({type(error).__name__}); finished"
            " pieces are stored, and the same command continues from them"
        ) from None
    finally:
        client.close()


def _connected(address: str) -> Any:
    distributed = require("distributed", f"--scheduler {address}:")
    for name in ("distributed", "distributed.client", "tornado.application"):
        logging.getLogger(name).setLevel(logging.CRITICAL)  # the InvalidInput below says it once
    connect: Any = distributed.Client
    try:
        client = connect(address, timeout=CONNECT_TIMEOUT, set_as_default=False)
    except (OSError, ValueError):
        raise InvalidInput(
            f"--scheduler {address}: no Dask scheduler answers there within {CONNECT_TIMEOUT:g} s; start one, or give"
            " the address that it shows"
        ) from None
    if not client.ncores():
        client.close()
        raise InvalidInput(f"--scheduler {address}: has no workers; start some with dask worker {address}")
    return client
