"""The angle of incidence that the front end states for noise that depends on it."""

import jax.numpy as jnp
import numpy as np

from jaxslam.core.features import concatenate_features, restrict_features
from jaxslam.filtering.heteroscedastic import incidence
from jaxslam.frontend.features import FeatureSpec, find_corners, find_wall_directions
from jaxslam.frontend.segments import Segments

SPEC = FeatureSpec(max_corners=2, max_walls=3, incidence=True)
ANGLES = np.arctan2([0.25, 0.5], [2.0, 1.5])  # of the beams to the middles of two walls


def two_walls():
    """Walls x = 2 and y = 1.5, which meet in a corner at (2, 1.5); then padding."""
    corner = [2.0, 1.5]
    ends = [[[2.0, -1.0], corner], [corner, [-1.0, 1.5]], [[0.0, 0.0], [0.0, 0.0]]]
    small = np.tile(1e-5 * np.eye(2), (3, 2, 1, 1))
    return Segments(
        normal=jnp.array([[-1.0, 0.0], [0.0, -1.0], [0.0, 0.0]]),
        centre=jnp.array([[2.0, 0.25], [0.5, 1.5], [0.0, 0.0]]),
        ends=jnp.array(ends),
        end_cov=jnp.array(small),
        end_is_real=jnp.ones((3, 2), bool),
        end_occludes=jnp.zeros((3, 2), bool),
        offset_variance=jnp.full(3, 1e-6),
        angle_variance=jnp.full(3, 1e-6),
        num_beams=jnp.array([40, 40, 0], jnp.int32),
        meets_next=jnp.array([True, False, False]),
        valid=jnp.array([True, True, False]),
        segment_of_beam=jnp.zeros(80, jnp.int32),
    )


def test_a_corner_has_the_larger_angle_of_its_walls_and_a_wall_its_own():
    corners, walls = (find(SPEC, two_walls()) for find in (find_corners, find_wall_directions))
    np.testing.assert_allclose(corners.incidence, [ANGLES.max(), 0.0], rtol=1e-6)
    np.testing.assert_allclose(walls.incidence, [ANGLES[1], ANGLES[0], 0.0], rtol=1e-6)
    both = concatenate_features(corners, walls)
    np.testing.assert_allclose(incidence(both), both.incidence)
    bad = both._replace(incidence=both.incidence.at[0].set(jnp.nan))
    assert not restrict_features(bad, jnp.ones(5, bool)).valid[0]


def test_it_is_no_field_where_it_is_not_wanted():
    features = find_corners(SPEC._replace(incidence=False), two_walls())
    assert features.incidence is None
