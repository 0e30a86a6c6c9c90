import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference_filter

from jaxslam.core.types import JUNCTION, WALL
from jaxslam.filtering.compatibility import match_nearest
from jaxslam.filtering.map_management import claim_slots
from jaxslam.frontend.features import features_from_range_bearing
from jaxslam.smoothing.numbering import number_landmarks

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


def test_what_is_ambiguous_stays_unmatched():
    assert all_possible([[1.0, 1.0 + MARGIN - 1e-6]]) == 2
    assert all_possible([[1.0, 1.0 + MARGIN + 1e-6]]) == 0
    assert all_possible([[1.0, 1.0]]) == 2


def test_nan_is_never_matched_nor_in_the_way():
    np.testing.assert_array_equal(all_possible([[np.nan, 1.0], [np.nan, np.nan]]), [1, 2])
    np.testing.assert_array_equal(all_possible([[-np.inf, 1.0]]), [1])


def test_an_impossible_pair_is_neither_matched_nor_in_the_way():
    distance, possible = jnp.array([[0.1, 1.0]]), jnp.array([[False, True]])
    np.testing.assert_array_equal(matched(distance, possible), [1])


def test_claimed_slots_are_those_of_least_worth_in_order():
    worth = jnp.array([np.inf, 0.0, 3.0, 0.0, 2.0])
    wanted = jnp.array([True, False, True, True, False, True, True])
    np.testing.assert_array_equal(claim_slots(worth, wanted), [1, 5, 3, 4, 5, 2, 5])


def test_a_full_map_drops_new_landmarks():
    slots = claim_slots(jnp.array([np.inf, 0.0, np.inf]), jnp.array([True, True]))
    np.testing.assert_array_equal(slots, [1, 3])
    np.testing.assert_array_equal(jnp.zeros(3).at[slots].set(1.0, mode="drop"), [0, 1, 0])
    np.testing.assert_array_equal(claim_slots(jnp.full(3, jnp.inf), jnp.ones(2, bool)), [3, 3])


ID = np.array([[7, 3, -1], [9, 7, 3], [-1, 3, 5], [7, -1, 12]], np.int32)
POSES = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.5], [1.0, 1.0, 3.0], [2.0, 0.5, -3.0]])
PLACE = np.array([3.0, 2.0])  # of landmark 7; landmark 3 is a wall along y


def sightings():
    """What four poses see of the landmarks ID, with errors that cancel; NaN where nothing is."""
    kind = np.where(ID == 3, WALL, JUNCTION).astype(np.int32)
    offset = PLACE - POSES[:, :2]
    polar = np.stack([np.hypot(*offset.T), np.arctan2(*offset.T[::-1]) - POSES[:, 2]], axis=-1)
    polar = np.where((ID >= 0)[..., None], polar[:, None], np.nan)
    seen = jax.vmap(features_from_range_bearing)(jnp.array(polar), jnp.ones(ID.shape, bool))
    wobble = np.array([0.1, -0.3, 0.2, 0.0])  # about pi / 2, where a line's direction wraps
    line = reference_filter.wrap_line(np.pi / 2 + wobble - POSES[:, 2])[:, None]
    return seen._replace(kind=jnp.array(kind), direction=jnp.array(np.where(ID == 3, line, np.nan)))


def test_landmarks_are_numbered_and_placed_by_all_their_sightings():
    marks = number_landmarks(
        jnp.array(ID), jnp.array(POSES), sightings(), min_observations=3, capacity=4
    )
    np.testing.assert_array_equal(
        marks.landmark_index, [[1, 0, 4], [4, 1, 0], [4, 0, 4], [1, 4, 4]]
    )
    np.testing.assert_array_equal(marks.id, [3, 7, -1, -1])
    assert marks.landmark_index.dtype == marks.id.dtype == jnp.int32
    np.testing.assert_allclose(marks.positions[1], PLACE, atol=1e-12)
    np.testing.assert_allclose(np.abs(marks.positions[0]), [np.pi / 2, 0.0], atol=1e-2)
    np.testing.assert_array_equal(marks.positions[2:], 0.0)
    every = number_landmarks(jnp.array(ID), jnp.array(POSES), sightings(), min_observations=1)
    assert every.id.tolist() == [3, 5, 7, 9, 12]
    none = number_landmarks(jnp.full(ID.shape, -1, jnp.int32), jnp.array(POSES), sightings())
    assert none.id.tolist() == [-1] and np.all(none.landmark_index == 1)


def test_landmarks_that_do_not_fit_are_told():
    with pytest.raises(ValueError, match="2 landmarks are more than size = 1"):
        number_landmarks(
            jnp.array(ID), jnp.array(POSES), sightings(), min_observations=3, capacity=1
        )
    with pytest.raises(ValueError, match=r"id is int32 \(4, 2\), not"):
        number_landmarks(jnp.array(ID[:, :2]), jnp.array(POSES), sightings())
    with pytest.raises(ValueError, match=r"poses is .*\(3, 3\), not"):
        number_landmarks(jnp.array(ID), jnp.array(POSES[:3]), sightings())
