import itertools

import numpy as np
import pytest

from jaxslam.core.pairing import one_to_one


@pytest.mark.parametrize("seed", range(20))
def test_no_pair_that_was_left_out_is_better_than_what_its_items_have(seed):
    """The law of a stable matching, which greedy pairing by one common cost fulfils."""
    rng = np.random.default_rng(seed)
    pairs = rng.permutation(list(itertools.product(range(7), range(5, 12))))[:25]
    cost = rng.integers(0, 6, len(pairs)).astype(float)
    found = one_to_one(pairs, cost)
    assert len(set(found.values())) == len(found)
    price = {(a, b): (c, a, b) for (a, b), c in zip(pairs.tolist(), cost.tolist(), strict=True)}
    back = {b: a for a, b in found.items()}
    for a, b in price:
        own = [(a, found[a])] if a in found else []
        own += [(back[b], b)] if b in back else []
        assert any(price[pair] <= price[a, b] for pair in own)


def test_pairs_are_in_the_order_of_their_choice_and_may_be_none():
    assert list(one_to_one([(0, 1), (1, 0), (0, 0)], [2.0, 3.0, 1.0]).items()) == [(0, 0)]
    assert list(one_to_one([(4, 1), (2, 2), (2, 1)], [2.0, 1.0, 2.0])) == [2, 4]
    assert one_to_one([], []) == {}
