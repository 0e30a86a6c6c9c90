"""What is kept of a belief when its submap is closed."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam.core.types import CORNER, JUNCTION, WALL
from jaxslam.filtering.adaptation import AdaptationSpec
from jaxslam.filtering.config import FilterConfig
from jaxslam.filtering.covariance import defer, downdate
from jaxslam.filtering.submaps import begin_submap, close_submap

CONFIG = FilterConfig(max_landmarks=6)


def belief():
    """A wall, an unconfirmed corner, a free slot, and landmarks in slots 1, 4 and 5."""
    rng = np.random.default_rng(0)
    start = begin_submap(CONFIG)
    root = rng.normal(size=(15, 15))
    cov = root @ root.T
    return start._replace(
        mean=jnp.asarray(rng.normal(size=15)),
        pose_cov=jnp.asarray(cov[:3, :3]),
        cross_cov=jnp.asarray(cov[:3, 3:]),
        map_cov=jnp.asarray(cov[3:, 3:]),
        kind=jnp.array([WALL, CORNER, CORNER, CORNER, JUNCTION, CORNER], jnp.int32),
        num_seen=jnp.array([9, 2, 1, 0, 5, 3], jnp.int32),
        id=jnp.array([0, 7, 8, 3, 2, 4], jnp.int32),
        direction=jnp.asarray(rng.normal(size=6)),
        descriptor=jnp.asarray(rng.normal(size=6)),
    )


def test_a_submap_is_the_marginal_of_last_pose_and_confirmed_points():
    given = belief()
    found = close_submap(CONFIG, given)
    rows = np.array([0, 1, 2, 5, 6, 11, 12, 13, 14])
    np.testing.assert_allclose(found.cov, np.asarray(given.cov)[np.ix_(rows, rows)], rtol=1e-12)
    mean = np.asarray(given.mean)
    np.testing.assert_array_equal(found.last_pose, mean[:3])
    np.testing.assert_array_equal(found.positions.ravel(), mean[rows[3:]])
    np.testing.assert_array_equal(found.id, [7, 2, 4])
    np.testing.assert_array_equal(found.kind, [CORNER, JUNCTION, CORNER])
    np.testing.assert_array_equal(found.direction, np.asarray(given.direction)[[1, 4, 5]])
    np.testing.assert_array_equal(found.descriptor, np.asarray(given.descriptor)[[1, 4, 5]])


def test_deferred_downdates_are_applied():
    given = belief()
    rows = 0.1 * jnp.asarray(np.random.default_rng(1).normal(size=(2, 12)))
    deferred = downdate(defer(given.map_cov), rows, jnp.bool_(True))
    dense = given.map_cov - rows.T @ rows
    found = close_submap(CONFIG, given._replace(map_cov=deferred))
    wanted = close_submap(CONFIG, given._replace(map_cov=dense))
    np.testing.assert_allclose(found.cov, wanted.cov, rtol=1e-12)


def test_a_submap_begins_at_its_origin_without_uncertainty():
    start = begin_submap(CONFIG)
    assert not np.any(start.pose) and not np.any(start.cov) and not np.any(start.num_seen)


@pytest.mark.parametrize(
    ("field", "value"),
    [("odometry_bias_std", (0.1, 0.1, 0.1)), ("adaptation", AdaptationSpec())],
)
def test_what_is_estimated_over_the_whole_drive_is_refused(field, value):
    with pytest.raises(ValueError, match=f"config.{field} is given"):
        begin_submap(CONFIG._replace(**{field: value}))
