"""Compiled functions loaded from numba's cache without what only a compilation needs.

Before it loads a function, numba imports and registers all that it could compile, and parses the function's
intermediate code, which only a caller that is compiled links in. Both took most of the time between a process's imports
and its first result. Here both wait until something is compiled.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import llvmlite.binding
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import CompileResult
from numba.core.runtime import nrt


class CachedLibrary(JITCodeLibrary):
    """Machine code from the cache, with the intermediate code as bytes."""

    _intermediate_code: bytes

    @classmethod
    def _unserialize(cls, codegen: Any, state: Any) -> CachedLibrary:
        name, _, (machine_code, intermediate_code) = state
        library = cls(codegen, name)
        library._intermediate_code = intermediate_code
        library.enable_object_caching()
        library._set_compiled_object(machine_code)
        library._finalize_final_module()
        return library

    def _get_module_for_linking(self) -> Any:
        if self._shared_module is None:
            self._shared_module = llvmlite.binding.parse_bitcode(self._intermediate_code)
        return self._shared_module

    def get_pointer_to_function(self, name: str) -> int:
        """Return the address of a function that the machine code has."""
        return self._codegen._engine.get_function_address(name)


def load_fast(dispatcher: Any, counts_references: bool) -> None:
    """Let a function of numba's load its machine code as this module does.

    Parameters
    ----------
    dispatcher : a function of numba's
        Python calls it: it has a wrapper for that.
    counts_references : bool
        False: compiled without reference counting.
    """
    cached = dispatcher._cache
    cached.load_overload = partial(_load, cached, counts_references)
    cached._impl.rebuild = _rebuild


def _load(cached: Any, counts_references: bool, signature: Any, context: Any) -> Any:
    if counts_references:
        nrt.rtsys.initialize(context)
    else:
        _name_helpers()
    with cached._guard_against_spurious_io_errors():
        return cached._load_overload(signature, context)


def _name_helpers() -> None:
    """Let machine code find numba's helpers, by which even a wrapper without reference counting reads arrays."""
    for name, address in nrt._nrt.c_helpers.items():
        llvmlite.binding.add_symbol(name if name.startswith("_") else f"NRT_{name}", address)


def _rebuild(context: Any, payload: Any) -> Any:
    # numba holds its lock for compilers meanwhile: no other thread loads or compiles.
    codegen = context.codegen()
    codegen._library_class = CachedLibrary
    try:
        return CompileResult._rebuild(context, *payload)
    finally:
        del codegen._library_class
