"""How numba compiles functions that only other compiled functions call: without machine code.

numba optimises each function and makes machine code of it, with all that it calls, before the one
that calls it: what is ten calls deep is compiled ten times. A part is kept as LLVM has it, and
compiled once with the function that is called from Python.
"""

from __future__ import annotations

from typing import Any

from numba.core.codegen import CPUCodeLibrary
from numba.core.compiler import Compiler


class _NoEnvironments:
    """A code generator; functions without machine code have no environment to be written."""

    def __init__(self, codegen: Any) -> None:
        self._codegen = codegen

    def __getattr__(self, name: str) -> Any:
        return getattr(self._codegen, name)

    def set_env(self, *_: Any) -> None:
        """Write nothing."""


class PartLibrary(CPUCodeLibrary):
    """The code of a part, and which others it calls."""

    def __init__(self, codegen: Any, name: str) -> None:
        super().__init__(codegen, name)
        self._whole: Any = None

    @property
    def codegen(self) -> Any:
        """What makes code of it."""
        return _NoEnvironments(self._codegen)

    def finalize(self) -> None:
        """Take no more code; optimise none."""
        self._raise_if_finalized()
        self._finalized = True

    def add_linking_library(self, library: Any) -> None:
        """Note that a function of another library is called."""
        super().add_linking_library(library)
        self._reload_init.update(library._reload_init)

    def get_pointer_to_function(self, name: str) -> int:
        """Return 0: there is no machine code."""
        self._ensure_finalized()
        return 0

    def _called(self, found: dict[Any, None]) -> None:
        for library in self._linking_libraries:
            if library not in found:
                found[library] = None
                if isinstance(library, PartLibrary):
                    library._called(found)

    def _own_module(self) -> Any:
        """Return the code without that of what it calls."""
        return super()._get_module_for_linking()

    def _get_module_for_linking(self) -> Any:
        """Return the code with that of all parts it calls, each once."""
        if self._whole is None:
            found: dict[Any, None] = {self: None}
            self._called(found)
            self._whole = self._own_module().clone()
            for library in list(found)[1:]:
                part = isinstance(library, PartLibrary)
                module = library._own_module() if part else library._get_module_for_linking()
                self._whole.link_in(module, preserve=True)
        return self._whole


class PartCompiler(Compiler):
    """The pipeline of a part."""

    def __init__(self, typingctx: Any, targetctx: Any, library: Any, *rest: Any) -> None:
        super().__init__(typingctx, targetctx, library, *rest)
        if library is None:
            self.state.library = PartLibrary(self.state.targetctx.codegen(), "part")
