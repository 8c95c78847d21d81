"""How kernels are compiled: as parts of one another, without counting references.

numba optimises every kernel and makes machine code of it, with all that it calls, before it
links it into its callers, where the same is done again: once for each level of calls.  That was
half of the time of compiling.  Here a kernel that another one calls is only typed and translated;
the one that Python calls is optimised as a whole, and it alone is kept in the cache on disk.
The same is done with the functions of numba's own that a kernel calls, such as sorts.

numba also counts, by an atomic increment and decrement, every array that a function
is given or that is taken from a tuple or cut out of another.  It leaves out what
it can prove to be in vain, but proves nothing in large functions.  In kernels
that work for a microsecond that was the largest single cost: `njit_no_refcount`.
"""

import errno
import fcntl
import importlib
import os
import sys
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import IO, Any

from llvmlite.binding import parse_assembly  # type: ignore[import-untyped]
from numba.core.caching import FunctionCache
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import CompilerBase, DefaultPassBuilder
from numba.core.compiler_lock import global_compiler_lock
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


def njit(*function: Callable[..., Any], **options: Any) -> Any:
    """Compile a kernel, with the options of `numba.njit`; the cache on disk keeps it."""
    if function:
        return Kernel(*function, **options)
    return lambda kernel: Kernel(kernel, **options)


def njit_no_refcount(kernel: Callable[..., Any]) -> Any:
    """Compile a kernel that counts no references: its caller holds all that it is given.

    Without numba's runtime it cannot make an array either: one that tries to
    does not compile.  Only for kernels that return no array, and call none that
    returns one: that array would never be freed.
    """
    return _compiled(kernel, error_model="numpy", _nrt=False)


def njit_inlined(kernel: Callable[..., Any]) -> Any:
    """`njit_no_refcount` for a part of a kernel that is copied into each of its callers.

    A named tuple of arrays is passed as tens of numbers, and the compiler does not see
    which of them the part uses: called for every pair of stars, that took as long as its work.
    What the part calls is not copied by that.
    """
    return _compiled(kernel, error_model="numpy", _nrt=False, forceinline=True)


def njit_allocating(kernel: Callable[..., Any]) -> Any:
    """Compile a kernel that makes arrays for itself although its caller counts no references.

    Without this it would be compiled as its caller is.  It returns numbers alone,
    as that does.
    """
    return _compiled(kernel, _nrt=True)


def _compiled(kernel: Callable[..., Any], **options: Any) -> Any:
    return Kernel(kernel, nogil=True, **options)


class Kernel(CPUDispatcher):
    """A compiled function: for Python with machine code, from the cache; for kernels without.

    Options are those of `numba.njit`.
    """

    def __init__(self, function: Callable[..., Any], **options: Any) -> None:
        options["nopython"] = True
        # numba would hand this on from a kernel to all that it calls, and those call.
        options.setdefault("forceinline", False)
        super().__init__(function, targetoptions=options, pipeline_class=_ForPython)
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
        self._inner = CPUDispatcher(function, targetoptions=options | without)

    def compile(self, sig: Any) -> Any:
        """Load or compile the kernel for a signature, one thread at a time."""
        with global_compiler_lock:
            try:
                return super().compile(sig)
            finally:
                self._cache.unlock()

    @property
    def _numba_type_(self) -> Any:
        """What kernels call where they name this one."""
        return self._inner._numba_type_


class _LockedCache(FunctionCache):
    """numba's cache on disk; of several processes that need a kernel one compiles it.

    The others wait, and load what it saved.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)  # type: ignore[no-untyped-call]
        self._cache_file = CheckedFile(  # type: ignore[no-untyped-call]
            self._cache_path, self._impl.filename_base, self._impl.locator.get_source_stamp()
        )
        self._lock: IO[str] | None = None

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Load a kernel; if there is none, lock it for saving, until `unlock` is called."""
        load: Callable[..., Any] = super().load_overload
        kernel = load(sig, target_context)
        if kernel is None and self._lock is None:
            with suppress(OSError):  # a folder that cannot be written: saving says so
                self._impl.locator.ensure_cache_path()
                place = Path(self.cache_path) / f"{self._impl.filename_base}.lock"
                self._lock = place.open("w")
                fcntl.flock(self._lock, fcntl.LOCK_EX)
                kernel = load(sig, target_context)
        return kernel

    def unlock(self) -> None:
        """Let other processes load the kernel, or compile it."""
        if self._lock is not None:
            self._lock.close()
            self._lock = None


class _ForPython(CompilerBase):
    """numba's compiler, into a library with machine code; what it calls has none."""

    def compile_extra(self, func: Any) -> Any:
        """Compile a function."""
        backend = self.state.targetctx.codegen()
        self.state.library = _MachineCodeLibrary(backend, func.__qualname__)  # type: ignore[no-untyped-call]
        self.state.library.enable_object_caching()
        backend.create_library = partial(_BitcodeLibrary, backend)
        try:
            return super().compile_extra(func)  # type: ignore[no-untyped-call]
        finally:
            del backend.create_library

    def define_pipelines(self) -> list[Any]:
        build: Any = DefaultPassBuilder.define_nopython_pipeline
        return [build(self.state)]


class _MachineCodeLibrary(JITCodeLibrary):
    """A kernel that Python calls; no kernel is linked with it.

    The cache would keep its bitcode as well, for linking, which every process would load.
    """

    def _get_module_for_linking(self) -> Any:
        """Functions of the same names, without code: numba finds the machine code by these."""
        names = [each.name for each in self._final_module.functions if not each.is_declaration]
        return parse_assembly(
            "".join(f'define void @"{name}"() {{ ret void }}\n' for name in names)
        )


class _BitcodeLibrary(JITCodeLibrary):
    """A function and what it calls, ready for linking and nothing else."""

    @property
    def codegen(self) -> Any:
        return _WithoutEnvironment(self._codegen)

    def _optimize_final_module(self) -> None:
        """Left to the kernel that this function is linked into."""

    def _finalize_final_module(self) -> None:
        self._finalize_dynamic_globals()  # type: ignore[no-untyped-call]
        self._verify_declare_only_symbols()  # type: ignore[no-untyped-call]
        self._finalized = True

    def get_pointer_to_function(self, name: str) -> int:
        """There is no machine code."""
        return 0


class _WithoutEnvironment:
    """A code generator for code that is not made into machine code: no environment is set."""

    def __init__(self, codegen: Any) -> None:
        self._own = codegen

    def __getattr__(self, name: str) -> Any:
        return getattr(self._own, name)

    def set_env(self, name: str, environment: Any) -> None:
        """Only machine code has a place for it."""
