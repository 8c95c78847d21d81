"""The sharing-star validation of PTP (section 2.3): a star must be itself in two triangles.

A false match names three stars at random; two false matches seldom name the
same star for the same spot.  A star that two triangles name alike validates
itself and every triangle that holds it.  Counted are distinct triangles of the
image: one triangle seen from two of its corners says nothing twice.
"""

import numpy as np
import numpy.typing as npt

from service.compiled.jit import njit

Rows = npt.NDArray[np.int32]
Held = npt.NDArray[np.bool_]

LEAST_TRIANGLES = 2
"""In so many triangles a sharing star carries the same identity."""


def count_pairs(
    image: Rows, star: Rows, stars: int, pair_image: Rows, pair_star: Rows, votes: Rows, held: Held
) -> int:
    """Tally (observed star, catalog star) pairs over matches, the most votes first.

    `image` and `star` (m, 3) hold the three observed rows and the three catalog
    rows of each match in one order; `stars` is the number of catalog rows.
    Returns how many pairs were written to `pair_image`, `pair_star`, `votes` and
    `held`, each of length 3 m.  A vote is a distinct set of three observed
    stars; held is a pair of which some match has a sharing star.
    """
    low, middle, high = np.sort(image, axis=1).astype(np.int64).T
    triples, number = np.unique((low << 40) | (middle << 20) | high, return_inverse=True)
    distinct = max(len(triples), 1)
    of_corner = image.astype(np.int64) * stars + star
    counted = np.unique(of_corner * distinct + number[:, None]) // distinct
    pair, tally = np.unique(counted, return_counts=True)
    place = np.searchsorted(pair, of_corner)
    is_held = np.zeros(len(pair), np.bool_)
    is_held[place[(tally[place] >= LEAST_TRIANGLES).any(axis=1)]] = True
    ranked = np.argsort(-tally, kind="stable")
    count = len(pair)
    pair_image[:count], pair_star[:count] = np.divmod(pair[ranked], stars)
    votes[:count], held[:count] = tally[ranked], is_held[ranked]
    return count


@njit(nogil=True)
def validate(pair_image, pair_star, votes, held, match):  # type: ignore[no-untyped-def]
    """Into `match` (n,) the catalog row that sharing stars validate for each, -1 for none.

    Pairs come with the most votes first.  Of several held pairs of a star that
    with the most votes counts, and none of two with equally many; a catalog
    star goes likewise to the observed star with the most votes for it.
    """
    match[:] = -1
    n = len(match)
    best, tied = np.zeros(n, np.int64), np.zeros(n, np.bool_)
    for at in range(len(votes)):
        k = pair_image[at]
        if not held[at]:
            continue
        if best[k] == 0:
            best[k] = votes[at]
            match[k] = pair_star[at]
        elif votes[at] == best[k]:
            tied[k] = True
    for k in range(n):
        if tied[k]:
            match[k] = -1
    dropped = np.zeros(n, np.bool_)
    for k in range(n):
        for other in range(n):
            if other != k and match[k] >= 0 and match[other] == match[k] and best[other] >= best[k]:
                dropped[k] = True
    for k in range(n):
        if dropped[k]:
            match[k] = -1
