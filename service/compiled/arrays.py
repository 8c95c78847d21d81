"""Array functions for compiled code: copies, and views without an owner, never to be returned."""

from typing import Any

from numba import types
from numba.core.typing.templates import signature
from numba.extending import intrinsic
from numba.np.arrayobj import populate_array

from service.compiled.jit import njit_no_refcount


def _borrowed_view(_: Any, held: Any) -> Any:
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

    # numba's `signature` has no type annotations.
    return signature(held, held), generate  # type: ignore[no-untyped-call]


borrowed_view: Any = intrinsic(_borrowed_view)
"""Array, or a named tuple of arrays, as a view without an owner, which needs no reference counting.

For arguments of a compiled function that it passes on while it runs: its caller holds the arrays
meanwhile. The view must not be returned.
"""


def _view_into(_: Any, block: Any, first_byte: Any, shape: Any, dtype: Any) -> Any:
    kind = types.Array(dtype.dtype, len(shape), "C", readonly=not block.mutable)

    def generate(context: Any, builder: Any, _: Any, arguments: Any) -> Any:
        held, at, sizes, _ = arguments
        base = context.make_array(block)(context, builder, held).data
        at = context.cast(builder, at, first_byte, types.intp)
        extents = [
            context.cast(builder, builder.extract_value(sizes, axis), size, types.intp)
            for axis, size in enumerate(shape)
        ]
        item = context.get_constant(
            types.intp, context.get_abi_sizeof(context.get_data_type(kind.dtype))
        )
        strides = [item]
        for extent in reversed(extents[1:]):
            strides.insert(0, builder.mul(strides[0], extent))
        byte = builder.bitcast(base, context.get_data_type(types.uint8).as_pointer())
        array = context.make_array(kind)(context, builder)
        populate_array(  # type: ignore[no-untyped-call]
            array,
            data=builder.bitcast(builder.gep(byte, [at]), array.data.type),
            shape=extents,
            strides=strides,
            itemsize=item,
            meminfo=None,
        )
        return array._getvalue()

    return signature(kind, block, first_byte, shape, dtype), generate  # type: ignore[no-untyped-call]


view_into: Any = intrinsic(_view_into)
"""`view_into(block, first_byte, shape, dtype)`: an array within a block, a view without an owner.

The caller holds the block while it uses the view. This costs nothing, while slicing, viewing and
reshaping are three calls.
"""


@njit_no_refcount
def copy_rows(source, target):  # type: ignore[no-untyped-def]
    """Copy an array of one or more dimensions into another of the same shape.

    `target[:] = source` takes three seconds to compile, most of them for the error message about
    shapes.
    """
    for at in range(source.size):
        target.flat[at] = source.flat[at]
