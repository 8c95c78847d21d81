"""The sharing-star validation of PTP (section 2.3): a star must be itself in two triangles.

A false match names three stars at random; two false matches seldom name the
same star for the same spot.  A star that two triangles name alike validates
itself and every triangle that holds it.  Counted are distinct triangles of the
image: one triangle seen from two of its corners says nothing twice.
"""

import numpy as np

from service.compiled.jit import njit

LEAST_TRIANGLES = 2
"""In so many triangles a sharing star carries the same identity."""


@njit(nogil=True)
def count_pairs(image, star, stars, pair_image, pair_star, votes, held):  # type: ignore[no-untyped-def]
    """Tally (observed star, catalog star) pairs over matches, the most votes first.

    `image` and `star` (m, 3) hold the three observed rows and the three catalog
    rows of each match in one order; `stars` is the number of catalog rows.
    Returns how many pairs were written to `pair_image`, `pair_star`, `votes` and
    `held`, each of length 3 m.  A vote is a distinct set of three observed
    stars; held is a pair of which some match has a sharing star.
    """
    matches = len(image)
    number, distinct = _numbered(image)
    key = np.empty(3 * matches, np.int64)
    for m in range(matches):
        for corner in range(3):
            key[3 * m + corner] = _pair(image, star, stars, m, corner) * distinct + number[m]
    key.sort()
    pair = np.empty(3 * matches, np.int64)
    tally = np.zeros(3 * matches, np.int64)
    count = 0
    for at in range(len(key)):
        if at > 0 and key[at] == key[at - 1]:
            continue
        if count == 0 or pair[count - 1] != key[at] // distinct:
            pair[count] = key[at] // distinct
            count += 1
        tally[count - 1] += 1
    pair, tally = pair[:count], tally[:count]
    in_shared = np.zeros(count, np.bool_)
    for m in range(matches):
        place = np.empty(3, np.int64)
        shares = False
        for corner in range(3):
            place[corner] = np.searchsorted(pair, _pair(image, star, stars, m, corner))
            shares = shares or tally[place[corner]] >= LEAST_TRIANGLES
        if shares:
            in_shared[place] = True
    ranked = np.argsort(-tally, kind="mergesort")
    for at in range(count):
        one = ranked[at]
        pair_image[at], pair_star[at] = pair[one] // stars, pair[one] % stars
        votes[at], held[at] = tally[one], in_shared[one]
    return count


@njit(nogil=True)
def _numbered(image):  # type: ignore[no-untyped-def]
    """A number for each row of `image`, equal where it holds the same stars; how many there are."""
    triple = np.empty(len(image), np.int64)
    for m in range(len(image)):
        a, b, c = np.sort(image[m])
        triple[m] = (np.int64(a) << 40) | (np.int64(b) << 20) | np.int64(c)
    order = np.argsort(triple)
    number = np.empty(len(image), np.int64)
    distinct = 0
    for at in range(len(image)):
        if at > 0 and triple[order[at]] != triple[order[at - 1]]:
            distinct += 1
        number[order[at]] = distinct
    return number, distinct + 1


@njit(nogil=True)
def _pair(image, star, stars, m, corner):  # type: ignore[no-untyped-def]
    return np.int64(image[m, corner]) * stars + np.int64(star[m, corner])


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
