"""One process compiles a function for all: the others wait for it and load what it cached.

numba caches on disk what it compiles, but processes that start together, as a service's workers do, all find the cache
empty and all compile the same. Here a process holds the lock of a function's cache while it compiles. It needs the
locks of the functions that it calls meanwhile; calls have no cycles, so no two processes wait for each other. A
process that dies releases its locks.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from numba.core.compiler_lock import global_compiler_lock
from numba.core.sigutils import normalize_signature

from servotwin.runtime.locks import locked

LONGEST = 120.0
"""s, after which a process compiles itself: another one may have been stopped by a debugger or a signal."""
_POLL = 0.05  # s


def compile_once(dispatcher: Any) -> None:
    """Let a function of numba's compile what is not in its cache under the lock of that cache."""
    compile_any: Callable[[Any], Any] = dispatcher.compile
    path = Path(f"{dispatcher._cache._cache_file._index_path}-lock")
    compiling = False

    def compile_alone(signature: Any) -> Any:
        nonlocal compiling
        # First numba's own lock, which is among threads: a thread that has the file's may need it to go on.
        with global_compiler_lock:
            # A function that calls itself has the lock already.
            if compiling or is_cached(dispatcher, signature):
                return compile_any(signature)
            with waited_for(path):
                compiling = True
                try:
                    return compile_any(signature)
                finally:
                    compiling = False

    dispatcher.compile = compile_alone


def is_cached(dispatcher: Any, signature: Any) -> bool:
    """True where the process has compiled or loaded a signature, or the index on disk has it."""
    normalised: Any = normalize_signature  # untyped
    if tuple(normalised(signature)[0]) in dispatcher.overloads:
        return True
    cached = dispatcher._cache
    return cached._index_key(signature, dispatcher.targetctx.codegen()) in cached._cache_file._load_index()


@contextmanager
def waited_for(path: Path, longest: float = LONGEST) -> Iterator[bool]:
    """Hold the lock on a file; yield False without it, after `longest` (s) or where no lock can be made."""
    end = time.monotonic() + longest
    with ExitStack() as scope:
        yield _wait(scope, path, end)


def _wait(scope: ExitStack, path: Path, end: float) -> bool:
    while True:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            scope.enter_context(locked(path))
        except BlockingIOError:
            if time.monotonic() > end:
                return False
            time.sleep(_POLL)
        except OSError:
            # A folder that is read-only, or a file system without locks: nothing is shared, and nothing is waited for.
            return False
        else:
            return True
