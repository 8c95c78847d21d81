"""Compiled code that does not count references to what its caller holds.

numba counts, by an atomic increment and decrement, every array that a function
is given or that is taken from a tuple or cut out of another.  It leaves out what
it can prove to be in vain, but proves nothing in large functions.  In kernels
that work for a microsecond that was the largest single cost.
"""

from collections.abc import Callable
from typing import Any

from numba import njit, types
from numba.core.typing.templates import signature
from numba.extending import intrinsic


def borrowing(kernel: Callable[..., Any]) -> Any:
    """Compile a kernel that counts nothing, since its caller holds all that it is given.

    Without numba's runtime it cannot make an array either: one that tries to
    does not compile.  Only for what returns no array, and calls nothing that
    returns one: nobody would ever let go of it.
    """
    return _compiled(kernel, error_model="numpy", _nrt=False)


def owning(kernel: Callable[..., Any]) -> Any:
    """Compile what makes arrays for itself although a kernel that borrows calls it.

    It would be compiled as its caller is, had it not said so itself.  It
    returns numbers alone, as that does.
    """
    return _compiled(kernel, _nrt=True)


def _compiled(kernel: Callable[..., Any], **options: Any) -> Any:
    compile_it: Any = njit  # whose stubs do not have `_nrt`, by which numba says it
    return compile_it(kernel, cache=True, nogil=True, **options)


def _uncounted(_: Any, held: Any) -> Any:
    def without_owner(context: Any, builder: Any, kind: Any, value: Any) -> Any:
        array = context.make_array(kind)(context, builder, value)
        array.meminfo = array.meminfo.type(None)
        return array._getvalue()

    def generate(context: Any, builder: Any, _: Any, arguments: Any) -> Any:
        (value,) = arguments
        if isinstance(held, types.Array):
            return without_owner(context, builder, held, value)
        for at, kind in enumerate(held.types):
            if isinstance(kind, types.Array):
                part = builder.extract_value(value, at)
                freed = without_owner(context, builder, kind, part)
                value = builder.insert_value(value, freed, at)
        return value

    # numba gives `signature` no types.
    return signature(held, held), generate  # type: ignore[no-untyped-call]


uncounted: Any = intrinsic(_uncounted)
"""The same array, or named tuple of arrays, without an owner: nobody counts who looks at it.

For what a compiled function was given as an argument and hands on, for as long
as it runs: its caller holds the arrays meanwhile.  Never to be returned.
"""
