import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam.core.scan import Lidar
from jaxslam.matching import place_views
from jaxslam.matching.place_index import PlaceSpec, build_index
from jaxslam.simulation import ray_casting, worlds
from jaxslam.simulation.worlds import World

B = place_views.NUM_BEARINGS
ROUND = Lidar(B, 0.0, 2 * np.pi / B, 30.0, 0.0)


def distances(walls, size, cell):
    """Distances (G, H) of the cells of a grid from walls (S, 4) [m]."""
    start, end = np.asarray(walls)[:, :2], np.asarray(walls)[:, 2:]
    centres = cell * np.stack(np.indices(size), axis=-1)[..., None, :]
    along = end - start
    t = np.sum((centres - start) * along, axis=-1) / np.sum(along**2, axis=-1)
    nearest = start + np.clip(t, 0.0, 1.0)[..., None] * along
    return np.linalg.norm(centres - nearest, axis=-1).min(axis=-1)


def test_rays_end_at_the_first_wall():
    walls = np.array([[1.0, 1, 9, 1], [9, 1, 9, 6], [9, 6, 1, 6], [1, 6, 1, 1], [4, 1, 4, 3]])
    cell, start = 0.1, np.array([2.3, 2.1])
    table = jnp.asarray(distances(walls, (110, 80), cell))
    exact = ray_casting.cast(ROUND, World(jnp.asarray(walls)), jnp.array([*start, 0.0])).ranges
    bearing = 2 * np.pi * np.arange(B) / B
    beams = jnp.asarray(np.stack([np.cos(bearing), np.sin(bearing)], axis=-1))
    found = place_views.cast_rays(cell, table, jnp.tile(start[None], (B, 1)), beams)
    # A ray ends near a wall; by how much before depends on how it slants.
    before = np.asarray(exact - found)
    assert np.quantile(np.abs(before), 0.9) < 2 * cell and (before > -cell).all()
    outside = place_views.cast_rays(cell, table + 50.0, jnp.tile(start[None], (B, 1)), beams)
    assert (np.asarray(outside) == place_views.NOTHING).all()


def test_agreement_is_that_of_the_slow_comparison():
    rng = np.random.default_rng(3)
    views, query = rng.random((place_views.NUM_RANGES, 5, B)), rng.random((12, B))
    spectra = place_views._spectrum(jnp.asarray(views)), place_views._spectrum(jnp.asarray(query))
    fast = place_views.agreement(*spectra)
    kept = np.fft.rfft(query)
    kept[:, place_views.NUM_FREQUENCIES :] = 0.0
    smooth = np.fft.irfft(kept, B)
    slow = [
        [
            sum(view[k, (np.arange(B) + turn) % B] @ smooth[k] for k in range(12))
            for turn in range(B)
        ]
        for view in np.moveaxis(views, 1, 0)
    ]
    np.testing.assert_allclose(fast, slow, rtol=1e-6)


@pytest.mark.parametrize("turn", [0, 7, 50])
def test_a_scan_agrees_best_with_its_place_and_heading(turn):
    world, poses = worlds.named("fig07"), np.asarray(worlds.scan_poses("fig07"))
    spec = PlaceSpec()
    scans = [ray_casting.cast(ROUND, world, jnp.asarray(pose)) for pose in poses]
    scans = type(scans[0])(*(jnp.stack(x) for x in zip(*scans, strict=True)))
    index = build_index(spec, ROUND, poses, scans)
    here = np.asarray(index.positions)[np.asarray(index.valid)][3]
    pose = jnp.array([*here, 2 * np.pi * turn / B])
    ranges = np.asarray(ray_casting.cast(ROUND, world, pose).ranges)
    bearing = 2 * np.pi * np.arange(B) / B
    points = ranges[:, None] * np.stack([np.cos(bearing), np.sin(bearing)], axis=-1)
    query = place_views.view_of_points(jnp.asarray(points), jnp.ones(B, bool))
    found = np.asarray(place_views.agreement(index.views, query))[np.asarray(index.valid)]
    position, heading = np.unravel_index(found.argmax(), found.shape)
    near = np.asarray(index.positions)[position] - here
    assert np.hypot(*near) < 2 * spec.position_spacing
    assert min((heading - turn) % B, (turn - heading) % B) <= 1


def test_points_that_are_not_valid_are_not_in_the_view():
    points = jnp.asarray(np.random.default_rng(0).uniform(-5, 5, (20, 2)))
    valid = jnp.arange(20) < 12
    some = place_views.view_of_points(points[:12], valid[:12])
    np.testing.assert_allclose(place_views.view_of_points(points, valid), some, atol=1e-12)
    nothing = place_views.view_of_points(points, jnp.zeros(20, bool))
    assert (np.asarray(nothing) == 0.0).all()
