"""Mutual nearest neighbours, against their definition, and the assignment of slots."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference_filter

from jaxslam.filtering.compatibility import match_nearest
from jaxslam.filtering.map_management import claim_slots

GATE, MARGIN = 9.0, 1.0


@jax.jit
def matched(distance, possible):
    return match_nearest(distance, possible, gate=GATE, margin=MARGIN)


def all_possible(distance):
    distance = jnp.array(distance)
    return np.asarray(matched(distance, jnp.ones(distance.shape, bool)))


@pytest.mark.parametrize("seed", range(20))
def test_match_agrees_with_the_definition(seed):
    rng = np.random.default_rng(seed)
    distance = rng.exponential(15.0, (6, 9))
    distance[rng.random(distance.shape) < 0.05] = np.nan
    possible = rng.random(distance.shape) < 0.8
    result = np.asarray(matched(jnp.array(distance), jnp.array(possible)))
    np.testing.assert_array_equal(result, reference_filter.match(distance, possible, GATE, MARGIN))
    taken = result[result < 9]
    assert len(set(taken)) == len(taken)


def test_the_random_matrices_exercise_every_rule():
    rng = np.random.default_rng(0)
    found = all_possible(rng.exponential(15.0, (6, 9)))
    assert 0 < np.sum(found < 9) < 6


def test_a_landmark_goes_to_the_nearer_of_two_features():
    np.testing.assert_array_equal(all_possible([[2.0, 50.0], [1.0, 50.0]]), [2, 0])


def test_the_gate_is_a_bound():
    np.testing.assert_array_equal(all_possible([[GATE - 1e-6, 50.0], [50.0, GATE + 1e-6]]), [0, 2])


def test_an_ambiguous_feature_stays_unmatched():
    assert all_possible([[1.0, 1.0 + MARGIN - 1e-6]]) == 2
    assert all_possible([[1.0, 1.0 + MARGIN + 1e-6]]) == 0
    assert all_possible([[1.0, 1.0]]) == 2


def test_nan_is_never_matched_and_hides_no_other_landmark():
    np.testing.assert_array_equal(all_possible([[np.nan, 1.0], [np.nan, np.nan]]), [1, 2])
    np.testing.assert_array_equal(all_possible([[-np.inf, 1.0]]), [1])


def test_an_impossible_pair_is_not_matched_and_hides_no_other_landmark():
    distance, possible = jnp.array([[0.1, 1.0]]), jnp.array([[False, True]])
    np.testing.assert_array_equal(matched(distance, possible), [1])


def test_claimed_slots_are_those_of_least_cost_in_order():
    cost = jnp.array([np.inf, 0.0, 3.0, 0.0, 2.0])
    wanted = jnp.array([True, False, True, True, False, True, True])
    np.testing.assert_array_equal(claim_slots(cost, wanted), [1, 5, 3, 4, 5, 2, 5])


def test_a_full_map_drops_new_landmarks():
    slots = claim_slots(jnp.array([np.inf, 0.0, np.inf]), jnp.array([True, True]))
    np.testing.assert_array_equal(slots, [1, 3])
    np.testing.assert_array_equal(jnp.zeros(3).at[slots].set(1.0, mode="drop"), [0, 1, 0])
    np.testing.assert_array_equal(claim_slots(jnp.full(3, jnp.inf), jnp.ones(2, bool)), [3, 3])
