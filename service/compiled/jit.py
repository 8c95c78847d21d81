"""How kernels are compiled: without counting references to what their callers hold.

numba counts, by an atomic increment and decrement, every array that a function
is given or that is taken from a tuple or cut out of another.  It leaves out what
it can prove to be in vain, but proves nothing in large functions.  In kernels
that work for a microsecond that was the largest single cost.
"""

from collections.abc import Callable
from typing import Any

from service.compiled.inner import Kernel


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
