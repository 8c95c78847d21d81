"""Compiled kernel that reads the lengths of all codes of JPEG data; see `frames.jpeg`.

Source: ITU-T T.81, F.2.2 and G.1.2.
"""

import numpy as np

from service.compiled.jit import njit_no_refcount


@njit_no_refcount
def ends_whole(coded, ends, size, units, kind, tables, known, run):  # type: ignore[no-untyped-def]
    """True if the blocks of every JPEG restart interval (bytes up to `ends`) end in its last byte.

    `size`: units in a row, in all, in an interval. `units` (n, 6): for each component of the scan,
    blocks across and down, columns of the grid, first block, and rows of `tables`. `kind`: first
    and last coefficient, whether the scan refines, whether it is progressive. `known`: for each
    block, a bit for every nonzero coefficient; with one spare block at the end. `run` (1,): number
    of following blocks without further coefficients.
    """
    columns, total, step = size
    start = 0
    for interval in range(len(ends)):
        at, end = 8 * start, 8 * ends[interval]
        start = ends[interval]
        run[0] = 0
        for unit in range(interval * step, min(total, (interval + 1) * step)):
            for c in range(len(units)):
                across, down, grid, first = units[c, 0], units[c, 1], units[c, 2], units[c, 3]
                for k in range(across * down):
                    row = unit // columns * down + k // across
                    block = first + row * grid + unit % columns * across + k % across
                    at = _behind(coded, at, units[c], kind, tables, known, block, run)
                    if at < 0 or at > end:
                        return False
        if end - at > 7 or run[0] > 0:
            return False
        rest = _bits(coded, at) >> (16 - (end - at))
        if rest != (1 << (end - at)) - 1 and not (kind[0] == 0 and kind[2]):
            # Padding is all ones; any other bits begin another block.
            spare = len(known) - 1
            after = _behind(coded, at, units[0], kind, tables, known, spare, run)
            if 0 <= after <= end:
                return False
    return True


@njit_no_refcount
def _bits(coded, at):  # type: ignore[no-untyped-def]
    """The 16 bits of coded data at a bit offset, as a number."""
    k = at >> 3
    three = np.int64(coded[k]) << 16 | np.int64(coded[k + 1]) << 8 | np.int64(coded[k + 2])
    return three >> (8 - (at & 7)) & 0xFFFF


@njit_no_refcount
def _behind(coded, at, unit, kind, tables, known, block, run):  # type: ignore[no-untyped-def]
    """The bit offset after a coded JPEG block; -1 if its data hold an invalid code."""
    k, last, refines, progressive = kind
    if k == 0:
        if refines:
            return at + 1
        code = np.int64(tables[unit[4], _bits(coded, at)])
        if code == 0:
            return -1
        at += (code >> 8) + (code & 15)
        k = 1
        if last == 0:
            return at
    if run[0] > 0:
        run[0] -= 1
        return _corrected(coded, at, known, block, k, last) if refines else at
    codes = unit[5]
    while k <= last:
        code = np.int64(tables[codes, _bits(coded, at)])
        if code == 0:
            return -1
        at += code >> 8
        zeros, size = code >> 4 & 15, code & 15
        if size == 0 and zeros < 15:
            if zeros > 0:
                if not progressive:
                    return -1
                run[0] = (1 << zeros) - 1 + (_bits(coded, at) >> (16 - zeros))
                at += zeros
            return _corrected(coded, at, known, block, k, last) if refines else at
        if refines:
            if size > 1:
                return -1
            at += size
            while k <= last:
                if known[block] >> np.uint64(k) & np.uint64(1):
                    at += 1
                elif zeros == 0:
                    break
                else:
                    zeros -= 1
                k += 1
        else:
            k += zeros
            at += size
        if size > 0 and k > last:
            return -1
        if size > 0 and progressive:
            known[block] |= np.uint64(1) << np.uint64(k)
        k += 1
    return at if k == last + 1 else -1


@njit_no_refcount
def _corrected(coded, at, known, block, k, last):  # type: ignore[no-untyped-def]
    """The bit offset after the refinement bits of a block's coefficients from `k` on."""
    for j in range(k, last + 1):
        at += np.int64(known[block] >> np.uint64(j) & np.uint64(1))
    return at


def compile_kernels() -> None:
    """Compile or load the JPEG check's kernel with one block of codes of one bit."""
    size, units = np.ones(3, np.int64), np.array([[1, 1, 1, 0, 0, 4]], np.int64)
    # One table of two codes of one bit each, both without further bits.
    tables = np.full((8, 1 << 16), 1 << 8, np.uint16)
    # Six ones of padding follow the block's two codes.  `frombuffer` gives read-only arrays.
    coded = np.frombuffer(bytes([0x3F]) + bytes(16), np.uint8)
    kind, run = np.array([0, 63, 0, 0], np.int64), np.zeros(1, np.int64)
    known = np.zeros(1, np.uint64)
    assert ends_whole(coded, np.array([1]), size, units, kind, tables, known, run)
