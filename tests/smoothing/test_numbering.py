"""Landmarks of a filtered log, numbered without gaps."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference_filter

from jaxslam.core.types import JUNCTION, WALL
from jaxslam.frontend.features import features_from_range_bearing
from jaxslam.smoothing.numbering import number_landmarks

ID = np.array([[7, 3, -1], [9, 7, 3], [-1, 3, 5], [7, -1, 12]], np.int32)
POSES = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.5], [1.0, 1.0, 3.0], [2.0, 0.5, -3.0]])
POSITION = np.array([3.0, 2.0])  # of landmark 7; landmark 3 is a wall along y


def features_of_landmarks():
    """Features of the landmarks ID from four poses, with errors that cancel; NaN in the padding."""
    kind = np.where(ID == 3, WALL, JUNCTION).astype(np.int32)
    offset = POSITION - POSES[:, :2]
    polar = np.stack([np.hypot(*offset.T), np.arctan2(*offset.T[::-1]) - POSES[:, 2]], axis=-1)
    polar = np.where((ID >= 0)[..., None], polar[:, None], np.nan)
    features = jax.vmap(features_from_range_bearing)(jnp.array(polar), jnp.ones(ID.shape, bool))
    wobble = np.array([0.1, -0.3, 0.2, 0.0])  # about pi / 2, where a line's direction wraps
    line = reference_filter.wrap_line(np.pi / 2 + wobble - POSES[:, 2])[:, None]
    return features._replace(
        kind=jnp.array(kind), direction=jnp.array(np.where(ID == 3, line, np.nan))
    )


def test_landmarks_are_numbered_and_their_positions_are_means_of_all_observations():
    landmarks = number_landmarks(
        jnp.array(ID), jnp.array(POSES), features_of_landmarks(), min_observations=3, capacity=4
    )
    np.testing.assert_array_equal(
        landmarks.landmark_index, [[1, 0, 4], [4, 1, 0], [4, 0, 4], [1, 4, 4]]
    )
    np.testing.assert_array_equal(landmarks.id, [3, 7, -1, -1])
    assert landmarks.landmark_index.dtype == landmarks.id.dtype == jnp.int32
    np.testing.assert_allclose(landmarks.positions[1], POSITION, atol=1e-12)
    np.testing.assert_allclose(np.abs(landmarks.positions[0]), [np.pi / 2, 0.0], atol=1e-2)
    np.testing.assert_array_equal(landmarks.positions[2:], 0.0)
    every = number_landmarks(
        jnp.array(ID), jnp.array(POSES), features_of_landmarks(), min_observations=1
    )
    assert every.id.tolist() == [3, 5, 7, 9, 12]
    none = number_landmarks(
        jnp.full(ID.shape, -1, jnp.int32), jnp.array(POSES), features_of_landmarks()
    )
    assert none.id.tolist() == [-1] and np.all(none.landmark_index == 1)


def test_landmarks_that_do_not_fit_are_refused_by_name():
    with pytest.raises(ValueError, match="2 landmarks are more than capacity = 1"):
        number_landmarks(
            jnp.array(ID), jnp.array(POSES), features_of_landmarks(), min_observations=3, capacity=1
        )
    with pytest.raises(ValueError, match=r"features.kind is int32 \(4, 3\), not .*\(4, 2\)"):
        number_landmarks(jnp.array(ID[:, :2]), jnp.array(POSES), features_of_landmarks())
    with pytest.raises(ValueError, match=r"poses is .*\(3, 3\), not"):
        number_landmarks(jnp.array(ID), jnp.array(POSES[:3]), features_of_landmarks())
    with pytest.raises(ValueError, match=r"feature_ids is float64 \(4, 3\), not integer"):
        number_landmarks(ID.astype(float), POSES, features_of_landmarks())
    with pytest.raises(ValueError, match="features is a ndarray, not Features"):
        number_landmarks(ID, POSES, POSES)
    with pytest.raises(ValueError, match="min_observations is 0, not 1 or more"):
        number_landmarks(ID, POSES, features_of_landmarks(), min_observations=0)


def test_lists_numpy_and_jax_of_either_precision_give_the_same():
    features = features_of_landmarks()
    expected = number_landmarks(jnp.array(ID), jnp.array(POSES), features)
    lists = jax.tree.map(lambda x: np.asarray(x).tolist(), features)
    jax.tree.map(
        np.testing.assert_array_equal,
        number_landmarks(ID.tolist(), POSES.tolist(), lists),
        expected,
    )
    single = jax.tree.map(
        lambda x: np.asarray(x, np.float32 if x.dtype == float else None), features
    )
    found = number_landmarks(ID.astype(np.int64), POSES.astype(np.float32), single)
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, atol=1e-6), found, expected)
