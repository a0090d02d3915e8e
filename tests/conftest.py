"""What holds for every test: nothing leaks, and a failing random test prints its input."""

import gc
import logging
import os
import platform
import signal
import sys
import threading
from collections.abc import Generator, Iterator
from functools import cache
from pathlib import Path
from shutil import rmtree
from tempfile import mkdtemp

import pytest
from hypothesis import HealthCheck, settings

# Small matrices only: threads of BLAS would but fight with the other test process for the cores.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# The same rounding with AVX-512 and without: by it alone, fits of a few windows end in another minimum. Outside of the
# tests each processor keeps its own.
if platform.machine().lower() in ("x86_64", "amd64"):
    os.environ.setdefault("OPENBLAS_CORETYPE", "Haswell")

# Started in the background, a shell's child ignores interrupts, and so would every process that a test interrupts.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# The suite is deterministic; `make fuzz` explores with fresh examples, more of them.
settings.register_profile(
    "suite",
    deadline=None,
    derandomize=True,
    print_blob=True,
    max_examples=50,
    suppress_health_check=[HealthCheck.too_slow],
)
settings.register_profile("fuzz", settings.get_profile("suite"), derandomize=False, max_examples=500)
settings.load_profile("suite")


FIRST = (
    "simulation/test_sampled_ensemble.py",  # compiles what most others wait for: in a fresh clone most of a minute
    *("config/", "link/", "messages/", "runtime/", "store/"),  # compile nothing: for the other processes, meanwhile
    *("analysis/", "control/", "cosim/", "estimation/", "hybrid/", "simulation/"),  # compile the rest
    *("up/", "edge_process/", "docs/test_operator_guide.py"),  # wait, and find all compiled: not at the end
)
"""Folders and files in the order of their tests; all others follow. Two processes hardly ever compile the same."""


FALLBACK_SETS = pytest.StashKey[str]()
"""Folder of the fallback sets that this run has verified: every process of the suite would verify them again."""


def pytest_configure(config: pytest.Config) -> None:
    """Give the run a cache of its own, not the user's; the processes that it starts inherit it."""
    if not hasattr(config, "workerinput"):
        config.stash[FALLBACK_SETS] = os.environ["SERVOTWIN_CACHE_DIR"] = mkdtemp(prefix="servotwin-tests-")


def pytest_unconfigure(config: pytest.Config) -> None:
    """Remove it."""
    if FALLBACK_SETS in config.stash:
        rmtree(config.stash[FALLBACK_SETS], ignore_errors=True)


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None]:
    """Collect without searching for garbage: the modules that are imported stay."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put the tests in an order in which two processes end together; within a file it stays."""

    @cache
    def place(file: Path) -> int:
        path = file.relative_to(Path(__file__).parent).as_posix()
        return next((k for k, name in enumerate(FIRST) if path.startswith(name)), len(FIRST))

    items.sort(key=lambda item: place(item.path))


def pytest_collection_finish() -> None:
    """Refuse test modules that simulate when they are imported: every process would, and would compile the kernel."""
    kernel = sys.modules.get("servotwin.hybrid.kernel")
    if kernel is not None and kernel.follow_schedule.signatures:
        raise pytest.UsageError("a test module simulates when it is imported; a fixture or a cached function should")


class Kept(logging.Handler):
    """Keeps what is logged: asyncio reports a task destroyed while pending, or an error nobody fetched, only there."""

    def __init__(self) -> None:
        super().__init__(logging.ERROR)
        self.messages: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.messages.append(record.getMessage())


@pytest.fixture(autouse=True)
def own_logging() -> Iterator[None]:
    """Undo the logging of a command that ran in this process: later lines would go to its closed stream."""
    loggers = [logging.getLogger(name) for name in ("servotwin", "uvicorn")]
    before = [(logger.handlers[:], logger.propagate, logger.level) for logger in loggers]
    yield
    for logger, (handlers, propagate, level) in zip(loggers, before, strict=True):
        logger.handlers[:], logger.propagate = handlers, propagate
        logger.setLevel(level)


@pytest.fixture(autouse=True)
def nothing_leaks() -> Iterator[None]:
    """Fail the test that leaves a thread running or an asyncio task pending."""
    before = set(threading.enumerate())
    kept, logger = Kept(), logging.getLogger("asyncio")
    logger.addHandler(kept)
    yield
    logger.removeHandler(kept)
    left = [thread for thread in threading.enumerate() if thread not in before]
    for thread in left:
        thread.join(timeout=1.0)
    assert not [thread.name for thread in left if thread.is_alive()], "threads were left running"
    assert not kept.messages
