"""Arrays in compiled code: copies, and views without an owner, which are never to be returned."""

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

    # numba gives `signature` no types.
    return signature(held, held), generate  # type: ignore[no-untyped-call]


borrowed_view: Any = intrinsic(_borrowed_view)
"""The same array, or named tuple of arrays, without an owner: no reference to it is counted.

For what a compiled function was given as an argument and passes on, for as long
as it runs: its caller holds the arrays meanwhile.  Never to be returned.
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
"""`view_into(block, first_byte, shape, dtype)`: an array within a block, without an owner.

The caller holds the block for as long as it runs.  Costs nothing, where a slice, a view
and a shape of it are three calls.
"""


@njit_no_refcount
def copy_rows(source, target):  # type: ignore[no-untyped-def]
    """Write an array of one or more dimensions over another of the same shape.

    `target[:] = source` takes three seconds to compile, most of them for the message of an
    error about their shapes.
    """
    for at in range(source.size):
        target.flat[at] = source.flat[at]
