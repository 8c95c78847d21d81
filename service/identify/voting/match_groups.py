"""Van Bezooijen's match groups: the largest sets of stars with mutually consistent candidates.

The pairs that survive the tests form a graph: a node is an observed star identified with a zone
star, an edge a pair that supports both of its identities. A match group is a clique of the graph;
only the largest ones count. A star's candidates are those of any largest group, each with the votes
of the group's other stars; stars in no group have no votes.
"""

from typing import Any

import numpy as np
import numpy.typing as npt

from service.compiled.jit import njit

Integers = npt.NDArray[Any]

MAX_EDGES = 1 << 18
"""Largest number of surviving pairs for which groups are searched; beyond, all votes count."""
MAX_WORK = 50_000_000
"""Work limit of a search for match groups in nodes visited, about a quarter of a second."""
MAX_HELD = 1 << 22
"""Largest number of nodes in memory at one time, in a search for match groups."""


def keep_largest_groups(
    votes: Integers, edges: Integers, max_work: int = MAX_WORK
) -> tuple[bool, int]:
    """Remove votes outside of the largest match groups; returns if cut short, and the work.

    Returns true if the search was cut short, and the work in nodes visited. `edges` (E, 4):
    observed star, its zone row, the other observed star, its zone row. After a search cut short,
    every node that might still belong to a group of the size found is kept.
    """
    if not len(edges):
        return False, 0
    rows = votes.shape[1]
    ends = np.concatenate([edges[:, 0:2], edges[:, 2:4]]).astype(np.int64)
    key, node = np.unique(ends[:, 0] * rows + ends[:, 1], return_inverse=True)
    left, right = node[: len(edges)], node[len(edges) :]
    source, target = np.concatenate([left, right]), np.concatenate([right, left])
    order = np.lexsort((target, source))
    start = np.searchsorted(source[order], np.arange(len(key) + 1))
    star = key // rows
    member = np.zeros(len(key), np.bool_)
    allowed = min(MAX_WORK, max_work)
    size, left = _largest(star, start, target[order], member, allowed)
    votes[:] = 0
    votes[star[member], key[member] % rows] = size - 1
    return left <= 0, allowed - max(left, 0)


@njit(nogil=True)
def _largest(star, start, neighbour, member, work):  # type: ignore[no-untyped-def]
    """The number of stars in the largest match groups, and the work that remains allowed.

    `member` is set to mark the nodes in one of the groups.

    Nodes are in order of `star`; the neighbours of node v are
    neighbour[start[v]:start[v + 1]], ascending.
    """
    nodes = len(star)
    group = np.empty(star[-1] + 1, np.int64)
    size = 0
    for v in range(nodes):
        # Every group is found from its first star.
        later = neighbour[start[v] : start[v + 1]]
        later = later[np.searchsorted(later, v) :]
        while True:
            found, work = _group_of(v, later, size + 1, star, start, neighbour, group, work)
            if found == 0:
                break
            size = found
    for v in range(nodes):
        if not member[v]:
            near = neighbour[start[v] : start[v + 1]]
            found, work = _group_of(v, near, size, star, start, neighbour, group, work)
            for k in range(found):
                member[group[k]] = True
            if work <= 0 and 1 + _stars(star, near) >= size:
                member[v] = True
    return size, work


@njit(nogil=True)
def _stars(star, nodes):  # type: ignore[no-untyped-def]
    """The number of observed stars that a sorted list of nodes belongs to."""
    count, last = 0, -1
    for node in nodes:
        if star[node] != last:
            count += 1
            last = star[node]
    return count


@njit(nogil=True)
def _group_of(v, near, least, star, start, neighbour, group, work):  # type: ignore[no-untyped-def]
    """Find a match group of at least `least` nodes with node `v` among `near`; size 0 if none.

    Depth first, with one level per node of the group; held[at[d]:end[d]] are the nodes of level d
    that are consistent with all levels above and still to be tried. Returns the size and the
    remaining work.
    """
    group[0] = v
    reach = _stars(star, near)
    if work <= 0 or 1 + reach < least:
        return 0, work
    if reach == 0:
        return 1, work
    held = np.empty(4 * len(near), np.int64)
    at, end = np.zeros(reach, np.int64), np.zeros(reach, np.int64)
    for i in range(len(near)):
        held[i] = near[i]
    end[0] = len(near)
    depth = 0
    while depth >= 0:
        # The stars still open at this level, with the nodes above, must be enough.
        open_nodes = held[at[depth] : end[depth]]
        work -= len(open_nodes)
        if work <= 0:
            return 0, work
        if 1 + depth + _stars(star, open_nodes) < least:
            depth -= 1
            continue
        node = open_nodes[0]
        at[depth] += 1
        group[depth + 1] = node
        count = 0
        if depth + 1 < reach:
            if end[depth] + len(open_nodes) > len(held):
                if 2 * len(held) > MAX_HELD:
                    return 0, 0
                held = np.concatenate((held, np.empty_like(held)))
                open_nodes = held[at[depth] - 1 : end[depth]]
            joined = neighbour[start[node] : start[node + 1]]
            count = _common(open_nodes[1:], joined, held[end[depth] :])
            work -= len(joined)
        if count == 0:
            if depth + 2 >= least:
                return depth + 2, work
            continue
        at[depth + 1], end[depth + 1] = end[depth], end[depth] + count
        depth += 1
    return 0, work


@njit(nogil=True, inline="always")
def _common(ones, others, out):  # type: ignore[no-untyped-def]
    """Write the common elements of two sorted lists; returns their number."""
    count = i = j = 0
    while i < len(ones) and j < len(others):
        if ones[i] < others[j]:
            i += 1
        elif ones[i] > others[j]:
            j += 1
        else:
            out[count] = ones[i]
            count += 1
            i += 1
            j += 1
    return count
