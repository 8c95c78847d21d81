"""Arrays that numba does not count references to.

Compiled code counts, by an atomic increment and decrement, every array that it
takes from a tuple or cuts a row of.  In a search for hypotheses, which looks at
a few dozen stars in microseconds, that was the largest single cost.
"""

from typing import Any

from numba import types
from numba.core.typing.templates import signature
from numba.extending import intrinsic


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

    return signature(held, held), generate  # type: ignore[no-untyped-call]


uncounted: Any = intrinsic(_uncounted)
"""The same array, or named tuple of arrays, without an owner: nobody counts who looks at it.

For what a compiled function was given as an argument, for as long as it runs:
its caller holds the arrays meanwhile.  Never to be returned.
"""
