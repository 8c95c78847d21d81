"""Match groups held against every assignment tried one by one."""

import itertools

import numpy as np
import pytest

from service.identify.voting import match_groups
from service.identify.voting.match_groups import keep_largest_groups


def largest_groups_tried_one_by_one(edges, stars):
    """The nodes (star, row) of the largest sets of which every two are joined, and their size."""
    joined = {frozenset(((i, a), (j, b))) for i, a, j, b in edges}
    nodes = sorted({node for pair in joined for node in pair})
    choices = [[None, *(node for node in nodes if node[0] == star)] for star in range(stars)]
    groups = []
    for chosen in itertools.product(*choices):
        group = [node for node in chosen if node is not None]
        if all(frozenset(pair) in joined for pair in itertools.combinations(group, 2)):
            groups.append(group)
    size = max(map(len, groups))
    return {node for group in groups if len(group) == size for node in group}, size


def votes_of(edges, stars, rows):
    votes = np.zeros((stars, rows), np.int32)
    for i, a, j, b in edges:
        votes[i, a] += 1
        votes[j, b] += 1
    return votes


def random_edges(rng, stars, rows, share):
    pairs = itertools.combinations(range(stars), 2)
    possible = [(i, a, j, b) for i, j in pairs for a in range(rows) for b in range(rows) if a != b]
    kept = [edge for edge in possible if rng.random() < share]
    return np.array(kept or possible[:1], np.int32)


@pytest.mark.parametrize("share", [0.02, 0.1, 0.3, 0.6])
def test_the_largest_groups_are_those_found_by_trying_all(rng, share):
    for _ in range(25):
        edges = random_edges(rng, 5, 4, share)
        votes = votes_of(edges, 5, 4)
        expected, size = largest_groups_tried_one_by_one(edges.tolist(), 5)
        assert keep_largest_groups(votes, edges)[0] is False
        assert {tuple(node) for node in np.argwhere(votes).tolist()} == expected
        assert set(votes[votes > 0].tolist()) == {size - 1}


def test_a_chance_pair_with_one_star_of_a_group_loses_its_votes():
    triangle = [(0, 7, 1, 8), (0, 7, 2, 9), (1, 8, 2, 9)]
    edges = np.array([*triangle, (0, 3, 3, 4), (2, 9, 3, 5)], np.int32)
    votes = votes_of(edges, 4, 10)
    keep_largest_groups(votes, edges)
    assert np.argwhere(votes).tolist() == [[0, 7], [1, 8], [2, 9]]
    assert votes.max() == 2


def test_a_field_full_of_stars_is_searched_to_the_end():
    stars = 250
    edges = np.array([(i, i, j, j) for i, j in itertools.combinations(range(stars), 2)], np.int32)
    votes = votes_of(edges, stars, stars)
    assert keep_largest_groups(votes, edges)[0] is False
    assert np.array_equal(votes, (stars - 1) * np.eye(stars))


def test_a_search_cut_short_says_so_and_names_no_star_that_may_have_a_rival(rng, monkeypatch):
    edges = random_edges(rng, 8, 12, 0.5)
    whole = votes_of(edges, 8, 12)
    keep_largest_groups(whole, edges)
    monkeypatch.setattr(match_groups, "MAX_WORK", 2000)
    votes = votes_of(edges, 8, 12)
    assert keep_largest_groups(votes, edges)[0] is True
    assert np.all((votes > 0) >= (whole > 0))


def test_no_pairs_leave_no_votes():
    votes = np.zeros((3, 5), np.int32)
    assert keep_largest_groups(votes, np.empty((0, 4), np.int32)) == (False, 0)
    assert not votes.any()
