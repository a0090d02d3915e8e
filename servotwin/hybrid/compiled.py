"""Compilation with numba, cached on disk, never stale.

numba keys its disk cache on the file that defines a function, so an edit to an *imported* compiled helper would go
unnoticed. Here the key is a digest of the function's own code and of every compiled function that it names, and theirs
in turn. Helpers must stand above what calls them: what is defined later has no digest yet.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from functools import cache, partial
from types import CodeType
from typing import Any, TypeVar, cast

from numba import njit
from numba.core.compiler import CompilerBase

from servotwin.errors import InvalidInput
from servotwin.hybrid.cached_code import load_fast
from servotwin.hybrid.compile_lock import compile_once
from servotwin.hybrid.compile_progress import show_compilation
from servotwin.hybrid.subroutine import TRIED, SubroutineCompiler, UnoptimisedCompiler

show_compilation()

_Function = TypeVar("_Function", bound=Callable[..., Any])


def compiled(function: _Function) -> _Function:
    """Compile with ``numba.njit``: no GIL, cached on disk, products fused into sums where the machine can."""
    return _compile(function, fastmath={"contract"})


def bare(function: _Function) -> _Function:
    """Compile without reference counting, which is half the time of a hot loop: the function allocates nothing and
    returns no array."""
    return _compile(function, fastmath={"contract"}, _nrt=False)


def subroutine(function: _Function) -> _Function:
    """Compile like `bare`, a function that compiled functions call, and Python only in tests: a part of its callers,
    optimised with them, without machine code of its own: in a chain of calls all of that would be done again and again.
    """
    return _compile_part(function, UnoptimisedCompiler, fastmath={"contract"}, _nrt=False)


def merged(function: _Function) -> _Function:
    """Compile a subroutine inline."""
    return _compile_part(function, UnoptimisedCompiler, fastmath={"contract"}, _nrt=False, forceinline=True)


def inlined(function: _Function) -> _Function:
    """Compile inline, for helpers of a hot loop: a call would copy the array header of every argument. Optimised alone
    first, which makes better loops of small functions."""
    return _compile_part(function, SubroutineCompiler, fastmath={"contract"}, _nrt=False, forceinline=True)


def summed(function: _Function) -> _Function:
    """Compile inline, additions in any order: a vector of partial sums and no chain of additions."""
    return _compile_part(function, SubroutineCompiler, fastmath={"contract", "reassoc"}, _nrt=False, forceinline=True)


def verbatim(function: _Function) -> _Function:
    """Compile inline, every operation rounded as written: the same bits as the interpreter's."""
    # Explicit, because numba compiles a callee with its caller's fastmath where the callee sets none.
    return _compile_part(function, SubroutineCompiler, fastmath=False, _nrt=False, forceinline=True)


def _compile_part(function: _Function, compiler: type[CompilerBase], **options: Any) -> _Function:
    """Compile a part of other functions; a test that calls it from Python compiles it once more."""
    if not TRIED:
        return _compile(function, **options)
    part: Any = _compile(function, **options, no_cpython_wrapper=True, pipeline_class=compiler)

    @cache
    def callable_from_python() -> Any:
        return _compile(function, **options)

    # What Python calls it with matches none of the versions that numba knows: it asks here, and calls what it is given.
    part.add_overload = lambda compiled: part.overloads.update({tuple(compiled.signature.args): compiled})
    part._compile_for_args = lambda *_arguments, **_keywords: callable_from_python()
    return cast(_Function, part)


def _compile(function: _Function, **options: Any) -> _Function:
    try:
        # The C wrapper would only be compiled and cached: nothing calls these functions through a C function pointer.
        given: dict[str, Any] = {"error_model": "numpy", "no_cfunc_wrapper": True, **options}
        dispatcher: Any = njit(cache=True, nogil=True, **given)(function)
    except RuntimeError:  # only the cache can fail here: compilation comes with the first call
        raise InvalidInput(
            "compiled code cannot be cached: neither the folder of servotwin nor the user's home is writable; set the "
            "environment variable NUMBA_CACHE_DIR to a folder that is"
        ) from None
    # Every process prints a set of strings in another order.
    sorted_options = {name: _text(value) for name, value in options.items()}
    dispatcher.options_key = repr(sorted(sorted_options.items()))
    dispatcher.stamp = stamp(function, dispatcher.options_key)
    # numba has no public way to set the stamp that its index file is compared with.
    index = dispatcher._cache._cache_file
    index._source_stamp = dispatcher.stamp
    index._load_index = partial(_load_index, index._load_index)
    if TRIED and "pipeline_class" not in options:
        load_fast(dispatcher, options.get("_nrt", True))
    compile_once(dispatcher)
    return cast(_Function, dispatcher)


def _text(option: Any) -> str:
    """The same text in every process."""
    return option.__name__ if isinstance(option, type) else repr(sorted(option) if isinstance(option, set) else option)


def _load_index(load: Callable[[], dict[Any, Any]]) -> dict[Any, Any]:
    """Load numba's index of compiled versions; empty where it names a type that this version of servotwin lacks.

    The index is a pickle of argument types, so that renaming a tuple of arguments made an old cache unreadable.
    """
    try:
        return load()
    except (AttributeError, ImportError):
        return {}


def stamp(function: Any, options: str) -> str:
    """Digest of a function, its compile options, and the compiled functions and constants that it names."""
    code = function.__code__
    parts = [options, _fingerprint(code)]
    for name in code.co_names:
        value: Any = function.__globals__.get(name)
        if hasattr(value, "stamp"):
            parts.append(value.stamp)
        elif isinstance(value, int | float | str | tuple):
            parts.append(repr(value))
        elif isinstance(value, type) and hasattr(value, "_fields"):
            parts.append(repr(value._fields))
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()


def _fingerprint(code: CodeType) -> str:
    constants = [_fingerprint(c) if isinstance(c, CodeType) else repr(c) for c in code.co_consts]
    return repr((code.co_code, code.co_names, code.co_varnames, constants))
