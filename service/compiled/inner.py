"""Kernels that other kernels call are not made into machine code of their own.

numba optimises every kernel and makes machine code of it, with all that it calls, before it
links it into its callers, where the same is done again: once for each level of calls.  That was
half of the time of compiling.  Here a kernel that another one calls is only typed and translated;
the one that Python calls is optimised as a whole, and it alone is kept in the cache on disk.
"""

import errno
import fcntl
import importlib
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from numba.core.caching import FunctionCache
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import CompilerBase, DefaultPassBuilder
from numba.core.registry import CPUDispatcher

from service.compiled.checked_file import CheckedFile

_SCIPY = "scipy.linalg"


def _leave_scipy_out() -> None:
    """Have numba load its functions of arrays as where scipy is not installed.

    It needs scipy for matrix products in kernels, of which there are none here; loading it is a
    tenth of the start and 40 MB of each process.
    """
    if _SCIPY not in sys.modules:
        # None makes an import fail, which the types of the standard library do not know.
        sys.modules[_SCIPY] = None  # type: ignore[assignment]
        try:
            importlib.import_module("numba.np.arraymath")
        finally:
            del sys.modules[_SCIPY]


_leave_scipy_out()


class Kernel(CPUDispatcher):
    """A compiled function: for Python with machine code, from the cache; for kernels without.

    Options are those of `numba.njit`.
    """

    def __init__(self, function: Callable[..., Any], **options: Any) -> None:
        options["nopython"] = True
        super().__init__(function, targetoptions=options)
        try:
            self._cache = _LockedCache(function)
        except RuntimeError:
            # numba found no place that can be written, and says so of the function.
            raise OSError(
                errno.EACCES,
                "compiled kernels cannot be stored there: name a folder that this user can write "
                "in NUMBA_CACHE_DIR",
                os.environ.get("NUMBA_CACHE_DIR"),
            ) from None
        without = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
        self._inner = CPUDispatcher(
            function, targetoptions=options | without, pipeline_class=_WithoutMachineCode
        )

    @property
    def _numba_type_(self) -> Any:
        """What kernels call where they name this one."""
        return self._inner._numba_type_


class _LockedCache(FunctionCache):
    """numba's cache on disk, which one process at a time writes to.

    numba reads the index, adds an entry and writes it again.  Two processes that save a kernel
    with different signatures at once choose the same file for both, and one entry is lost.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)  # type: ignore[no-untyped-call]
        self._cache_file = CheckedFile(  # type: ignore[no-untyped-call]
            self._cache_path, self._impl.filename_base, self._impl.locator.get_source_stamp()
        )

    def save_overload(self, sig: Any, data: Any) -> None:
        """Save a kernel while no other process saves one of the same folder."""
        self._impl.locator.ensure_cache_path()
        with (Path(self.cache_path) / "saving.lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)  # closing the file unlocks it
            super().save_overload(sig, data)  # type: ignore[no-untyped-call]


class _WithoutMachineCode(CompilerBase):
    """numba's compiler, into a library without machine code."""

    def define_pipelines(self) -> list[Any]:
        backend = self.state.targetctx.codegen()
        name = self.state.func_id.func_qualname
        self.state.library = _BitcodeLibrary(backend, name)  # type: ignore[no-untyped-call]
        build: Any = DefaultPassBuilder.define_nopython_pipeline
        passes = build(self.state)
        passes.finalize()
        return [passes]


class _BitcodeLibrary(JITCodeLibrary):
    """A kernel and what it calls, ready for linking and nothing else."""

    @property
    def codegen(self) -> Any:
        return _WithoutEnvironment(self._codegen)

    def _optimize_final_module(self) -> None:
        """Left to the kernel that this one is linked into."""

    def _finalize_final_module(self) -> None:
        self._finalize_dynamic_globals()  # type: ignore[no-untyped-call]
        self._verify_declare_only_symbols()  # type: ignore[no-untyped-call]
        self._finalized = True

    def get_pointer_to_function(self, name: str) -> int:
        """There is no machine code."""
        return 0


class _WithoutEnvironment:
    """Where machine code is made; none that an environment could be written to."""

    def __init__(self, codegen: Any) -> None:
        self._own = codegen

    def __getattr__(self, name: str) -> Any:
        return getattr(self._own, name)

    def set_env(self, name: str, environment: Any) -> None:
        """Only machine code has a place for it."""
