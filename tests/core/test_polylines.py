import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam.core import polylines


def test_points_are_projected_onto_a_polyline():
    line = np.array([[0.0, 0.0], [2.0, 0.0], [2.0, 2.0]])
    points = np.array([[-1.0, 0.0], [1.0, 0.5], [3.0, 1.0], [2.5, -0.0]])
    distance, along = polylines.project(points, line)
    np.testing.assert_allclose(distance, [1.0, 0.5, 1.0, 0.5])
    np.testing.assert_allclose(along, [0.0, 1.0, 3.0, 2.0])


LINE = np.array([[0.0, 0.0], [3.0, 0.0], [3.0, 1.0]])


def test_lengths_add_up_along_a_polyline():
    np.testing.assert_allclose(polylines.length(LINE), 4.0)
    np.testing.assert_allclose(polylines.length(np.stack([LINE, 2 * LINE])), [4.0, 8.0])
    np.testing.assert_allclose(polylines.cumulative_lengths(LINE), [0.0, 3.0, 4.0])


@pytest.mark.parametrize("kind", [np.asarray, jnp.asarray])
def test_resampled_points_are_evenly_spaced_and_keep_the_ends(kind):
    found = polylines.resample(kind(LINE), 5)
    np.testing.assert_allclose(found, [[0, 0], [1, 0], [2, 0], [3, 0], [3, 1]], atol=1e-12)
    assert isinstance(found, jax.Array if kind is jnp.asarray else np.ndarray)
    assert polylines.resample(kind(LINE)).shape == (polylines.DEFAULT_POINTS, 2)


@pytest.mark.parametrize("kind", [np.asarray, jnp.asarray])
def test_points_along_a_polyline_stop_at_its_ends(kind):
    found = polylines.points_along(kind(LINE), kind([-1.0, 0.5, 3.5, 9.0]))
    np.testing.assert_allclose(found, [[0, 0], [0.5, 0], [3, 0.5], [3, 1]], atol=1e-12)


def test_numpy_and_jax_resample_alike_and_jax_traces():
    random = np.random.default_rng(0)
    lines = random.normal(size=(6, 20, 2)).cumsum(axis=1)
    found = jax.jit(jax.vmap(polylines.resample))(jnp.asarray(lines))
    for line, points in zip(lines, found, strict=True):
        np.testing.assert_allclose(points, polylines.resample(line), atol=1e-12)
        distance, _ = polylines.project(np.asarray(points), line)
        np.testing.assert_allclose(distance, 0.0, atol=1e-9)


def test_a_refined_polyline_keeps_its_points_and_has_no_long_steps():
    line = np.array([[0.0, 0.0], [0.35, 0.0], [0.35, 0.05], [0.35, 0.05]])
    fine = polylines.refine(line, 0.1)
    step = np.hypot(*np.diff(fine, axis=0).T)
    assert step.max() <= 0.1 and step.sum() == pytest.approx(0.4)
    assert len(fine) == 1 + 4 + 1 + 1
    for point in line:
        assert (np.abs(fine - point).max(axis=1) < 1e-12).any()
    assert len(polylines.refine(line, 9.0, 3)) == 10
