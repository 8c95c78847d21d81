"""Compilation of kernels with numba: callers include their callees, and references are not counted.

numba optimises every kernel with its callees and generates machine code before linking it into its
callers, where this is repeated at each level of calls. That took half of the compile time. Here a
kernel called by another one is only typed and translated, once for each kind of its arguments; the
one called by Python is linked with all its callees, optimised as a whole, and only that one is
cached on disk. The same applies to numba's own functions that a kernel calls, such as sorts.

numba also counts references, with atomic operations, to every array argument, tuple element and
slice. It omits counts that it can prove redundant, but not in large functions. In kernels that take
a microsecond that was the largest single cost; `njit_no_refcount` avoids it.
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
from numba.core.errors import TypingError
from numba.core.registry import CPUDispatcher
from numba.core.types import unliteral

from service.compiled.checked_file import CheckedFile

_SCIPY = "scipy.linalg"


def _leave_scipy_out() -> None:
    """Make numba load its array functions as if scipy were not installed.

    numba needs scipy only for matrix products, which no kernel here uses; importing it takes a
    tenth of the start and 40 MB per process.
    """
    if _SCIPY not in sys.modules:
        # None makes an import fail, which the type stubs of the standard library do not allow for.
        sys.modules[_SCIPY] = None  # type: ignore[assignment]
        try:
            importlib.import_module("numba.np.arraymath")
        finally:
            del sys.modules[_SCIPY]


_leave_scipy_out()


def njit(*function: Callable[..., Any], **options: Any) -> Any:
    """A decorator that compiles a kernel with the options of `numba.njit`, cached on disk."""
    if function:
        return Kernel(*function, **options)
    return lambda kernel: Kernel(kernel, **options)


def njit_no_refcount(kernel: Callable[..., Any]) -> Any:
    """A decorator for kernels without reference counting: the caller holds all arguments.

    Such a kernel cannot create arrays, because numba's runtime is off: otherwise it does not
    compile. It must not return an array, nor call a kernel that does, since that array would never
    be freed.
    """
    return _compiled(kernel, error_model="numpy", _nrt=False)


def njit_inlined(kernel: Callable[..., Any]) -> Any:
    """A decorator like `njit_no_refcount` for a part of a kernel that is inlined into each caller.

    A named tuple of arrays is passed as tens of numbers, and the compiler does not see which of
    them are used: for a function called per star pair, that took as long as its work. Callees of
    the part are not inlined by this.
    """
    return _compiled(kernel, error_model="numpy", _nrt=False, forceinline=True)


def njit_allocating(kernel: Callable[..., Any]) -> Any:
    """A decorator that compiles kernels with numba's runtime, so that they can create arrays.

    Otherwise it would be compiled as its caller is. Like that caller it returns only numbers.
    """
    return _compiled(kernel, _nrt=True)


def _compiled(kernel: Callable[..., Any], **options: Any) -> Any:
    return Kernel(kernel, nogil=True, **options)


class Kernel(CPUDispatcher):
    """A compiled function, with cached machine code for Python, and without for other kernels.

    Options are those of `numba.njit`.
    """

    def __init__(self, function: Callable[..., Any], **options: Any) -> None:
        # Python calls it through another wrapper, and nothing calls it from C.
        options |= {"nopython": True, "no_cfunc_wrapper": True}
        # numba would pass this on from a kernel to its callees and theirs.
        options.setdefault("forceinline", False)
        options.setdefault("error_model", "numpy")
        super().__init__(function, targetoptions=options, pipeline_class=_ForPython)
        try:
            self._cache = _LockedCache(function)
        except RuntimeError:
            # numba found no writable folder, and its message names only the function.
            raise OSError(
                errno.EACCES,
                "compiled kernels cannot be stored there: name a folder that this user can write "
                "in NUMBA_CACHE_DIR",
                os.environ.get("NUMBA_CACHE_DIR"),
            ) from None
        inner = {"nogil": True, "no_cpython_wrapper": True}
        self._inner = _Inner(function, targetoptions=options | inner)

    def compile(self, sig: Any) -> Any:
        """Load the kernel for a signature from the cache, or compile it; one thread at a time."""
        with global_compiler_lock:
            try:
                return super().compile(sig)
            finally:
                self._cache.unlock()

    @property
    def _numba_type_(self) -> Any:
        """The numba type that represents this kernel when another kernel calls it."""
        return self._inner._numba_type_


class _Inner(CPUDispatcher):
    """A kernel for kernels, compiled once for all constants that it is called with."""

    def get_call_template(self, args: Any, kws: Any) -> Any:
        """Compile the kernel for the types of its arguments, unless it needs their values."""
        try:
            # numba gives `unliteral` no types.
            kinds = tuple(unliteral(each) for each in args)  # type: ignore[no-untyped-call]
            return super().get_call_template(kinds, kws)
        except TypingError:
            return super().get_call_template(args, kws)


class _LockedCache(FunctionCache):
    """numba's cache on disk with a lock, so that only one of several processes compiles a kernel.

    The other processes wait, and load the saved kernel.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)  # type: ignore[no-untyped-call]
        self._cache_file = CheckedFile(  # type: ignore[no-untyped-call]
            self._cache_path, self._impl.filename_base, self._impl.locator.get_source_stamp()
        )
        self._lock: IO[str] | None = None

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Load a kernel from the cache; if it is missing, lock it until `unlock` is called."""
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
        """Release the lock, so that other processes load or compile the kernel."""
        if self._lock is not None:
            self._lock.close()
            self._lock = None


class _ForPython(CompilerBase):
    """numba's compiler for kernels called by Python, into a library with machine code."""

    def compile_extra(self, func: Any) -> Any:
        """Compile a function into a library with machine code; its callees stay bitcode."""
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
    """The machine code of a kernel that Python calls, which is never linked into another kernel.

    Otherwise the cache would also store bitcode for linking, which every process would load.
    """

    def finalize(self) -> None:
        """Link the kernel with all that it calls, and those call; then make machine code."""
        callees: dict[Any, None] = {}

        def collect(library: Any) -> None:
            for each in library._linking_libraries:
                if each not in callees:
                    collect(each)
                    callees[each] = None

        collect(self)
        # Callers first: LLVM leaves out a function that nothing has called by then.
        self._linking_libraries = list(reversed(callees))
        # numba gives its own methods no types; so below.
        super().finalize()  # type: ignore[no-untyped-call]

    def _get_module_for_linking(self) -> Any:
        """Module of empty functions with the right names, by which numba finds the machine code."""
        names = [each.name for each in self._final_module.functions if not each.is_declaration]
        return parse_assembly(
            "".join(f'define void @"{name}"() {{ ret void }}\n' for name in names)
        )


class _BitcodeLibrary(JITCodeLibrary):
    """The bitcode of a function and its callees, for linking into a kernel only."""

    @property
    def codegen(self) -> Any:
        return _WithoutEnvironment(self._codegen)

    def add_ir_module(self, ir_module: Any) -> None:
        """Add a function, but not the wrapper for C that numba makes of each of its own."""
        if ir_module.name != "cfunc_wrapper":
            super().add_ir_module(ir_module)  # type: ignore[no-untyped-call]

    def finalize(self) -> None:
        """Leave linking and optimising to the kernel that this function is linked into."""
        for library in self._linking_libraries:
            self._reload_init.update(library._reload_init)
        self._finalize_dynamic_globals()  # type: ignore[no-untyped-call]
        self._finalized = True

    def get_pointer_to_function(self, name: str) -> int:
        """Zero in place of an address, since bitcode is no machine code."""
        return 0


class _WithoutEnvironment:
    """A code generator for code that stays bitcode: it sets no environment."""

    def __init__(self, codegen: Any) -> None:
        self._own = codegen

    def __getattr__(self, name: str) -> Any:
        return getattr(self._own, name)

    def set_env(self, name: str, environment: Any) -> None:
        """Do nothing: only machine code has room for an environment."""
