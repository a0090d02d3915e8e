"""Compilation of functions that only compiled functions call.

numba makes machine code and a wrapper for Python of every function, and those that are called from others are compiled
again as a part of each caller: in a chain of six, six times. What is called only by compiled functions needs neither.
Its optimised intermediate code is all that callers take, and what they compile is the same with and without this.
"""

from __future__ import annotations

from typing import Any

import llvmlite.binding
import llvmlite.ir
from numba import version_info
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import CompilerBase, DefaultPassBuilder

TRIED = version_info.short == (0, 68)
"""True with a version of numba whose insides this file has been tried on; others compile as numba does, more slowly."""

_ENVIRONMENT = "_ZN08NumbaEnv"


class SubroutineLibrary(JITCodeLibrary):
    """Optimised intermediate code for callers; of machine code nothing but the variables that numba looks up."""

    def _finalize_final_module(self) -> None:
        self._finalize_dynamic_globals()
        optimised, self._final_module = self._final_module, self._environments()
        super()._finalize_final_module()
        self._final_module = optimised

    def _environments(self) -> Any:
        module = self._codegen._create_empty_module(self.name)
        for variable in self._final_module.global_variables:
            if variable.name.startswith(_ENVIRONMENT):
                place = llvmlite.ir.GlobalVariable(module, llvmlite.ir.IntType(8).as_pointer(), variable.name)
                place.linkage = "common"
                place.initializer = llvmlite.ir.Constant(place.value_type, None)
        return llvmlite.binding.parse_assembly(str(module))


class UnoptimisedLibrary(SubroutineLibrary):
    """Intermediate code as it was translated."""

    def _optimize_final_module(self) -> None:
        """Leave it to the callers."""


class SubroutineCompiler(CompilerBase):
    """numba's passes, into a `SubroutineLibrary`."""

    library = SubroutineLibrary

    def define_pipelines(self) -> list[Any]:
        """The one pipeline there is."""
        state = self.state
        if state.library is None:
            state.library = self.library(state.targetctx.codegen(), state.func_id.func_qualname)
            state.library.enable_object_caching()
        return [DefaultPassBuilder.define_nopython_pipeline(state)]


class UnoptimisedCompiler(SubroutineCompiler):
    """numba's passes, into an `UnoptimisedLibrary`."""

    library = UnoptimisedLibrary
