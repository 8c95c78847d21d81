"""Copies between arrays of one shape, in compiled code."""

from service.compiled.jit import njit_no_refcount


@njit_no_refcount
def copy_rows(source, target):  # type: ignore[no-untyped-def]
    """Write an array of one or more dimensions over another of the same shape.

    `target[:] = source` takes three seconds to compile, most of them for the message of an
    error about their shapes.
    """
    for at in range(source.size):
        target.flat[at] = source.flat[at]
