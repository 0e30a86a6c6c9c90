import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rooms import CENTRE, IN_TRIANGLE, LEG, RADIUS, TRIANGLE
from scipy.optimize import least_squares

from jaxslam.core.scan import Lidar
from jaxslam.core.se2 import inverse_transform
from jaxslam.frontend import circle_fitting, segmentation, tangent_circles
from jaxslam.frontend.circle_fitting import FOOT_VARIANCE_FLOOR
from jaxslam.frontend.tangent_circles import WallSegments
from jaxslam.pipeline.config import Config
from jaxslam.simulation import ray_casting, worlds
from jaxslam.simulation.worlds import World

CONFIG = Config()
LIDAR, SPEC = CONFIG.frontend.lidar, CONFIG.frontend.features
HERE = inverse_transform(jnp.array(IN_TRIANGLE), jnp.array(CENTRE))
ALL_AROUND = Lidar(num_beams=721, angle_min=-np.pi)
SQUARE = worlds.outline([(0.0, 0.0, 2.0, 2.0)])
ROOM = worlds.outline([(0.0, 0.0, 2.3, 2.0)])  # its junctions are 0.3 m apart

solve = jax.jit(tangent_circles.tangent_circles, static_argnames="swaps")
cast = jax.jit(ray_casting.cast, static_argnums=0)


def walls_of(segments):
    """Segments (S, 4) as walls of the robot frame."""
    segments = np.asarray(segments, float)
    along = segments[:, 2:] - segments[:, :2]
    size = np.hypot(*along.T)[:, None]
    valid = jnp.ones(size.shape, bool)
    return WallSegments(_columns(segments[:, :2]), _columns(along / size), jnp.asarray(size), valid)


def _columns(x):
    """The two columns (S, 1) of an array (S, 2)."""
    return jnp.asarray(x[:, :1]), jnp.asarray(x[:, 1:])


def tangent(starts, three, walls, swaps=3):
    """Circles from starts (C, 2) that are tangent to three walls (C, 3) each."""
    x, y = jnp.asarray(np.atleast_2d(starts), float).T
    three = jnp.asarray(np.atleast_2d(three).T, jnp.int32)
    return solve(x, y, jnp.broadcast_to(three, (3, len(x))), walls, swaps=swaps)


def wall_distances(point, walls):
    """Distances (S,) of walls (S, 4) from a point, in NumPy."""
    start, along = walls[:, :2], walls[:, 2:] - walls[:, :2]
    part = np.sum((point - start) * along, axis=1) / np.sum(along**2, axis=1)
    return np.hypot(*(start + np.clip(part, 0, 1)[:, None] * along - point).T)


def slow_circle(start, walls):
    """Centre and radius of the circle near a point that touches three walls (3, 4)."""

    def residuals(circle):
        return wall_distances(circle[:2], walls) - circle[2]

    begin = [*start, wall_distances(np.asarray(start), walls).mean()]
    return least_squares(residuals, begin, xtol=1e-14, ftol=1e-14, gtol=1e-14).x


def three_around(random):
    """Three walls around the origin, whose middles are nearest to it, or one of them a point."""
    turn = np.array([0.0, 2.1, 4.2]) + random.uniform(-0.4, 0.4, 3)
    away = random.uniform(0.8, 1.4, 3)[:, None]
    out = np.stack([np.cos(turn), np.sin(turn)], axis=1)
    side = np.stack([-out[:, 1], out[:, 0]], axis=1) * np.array([1.5, 1.5, 0.01])[:, None]
    return np.concatenate([away * out - side, away * out + side], axis=1)


def test_a_circle_touches_three_walls_as_a_slow_solver_finds():
    random = np.random.default_rng(0)
    for _ in range(12):
        segments = three_around(random)
        start = random.uniform(-0.2, 0.2, 2)
        circle = tangent(start, [0, 1, 2], walls_of(segments), swaps=0)
        x, y, radius = slow_circle(start, segments)
        found = [circle.x[0], circle.y[0], circle.radius[0]]
        np.testing.assert_allclose(found, [x, y, radius], atol=1e-6)
        np.testing.assert_allclose(wall_distances(np.array([x, y]), segments), radius, atol=1e-6)


def test_padding_touches_nothing():
    segments = np.vstack([three_around(np.random.default_rng(1)), [[0.0, -0.1, 0.0, 0.1]]])
    walls = walls_of(segments)
    walls = walls._replace(valid=walls.valid.at[3].set(False))
    found, _ = tangent_circles.nearest_three_walls(jnp.zeros(1), jnp.zeros(1), walls, 0.9)
    assert sorted(found[:, 0].tolist()) == [0, 1, 2]
    circle = tangent([0.1, 0.0], [0, 1, 2], walls)
    assert sorted(circle.walls[:, 0].tolist()) == [0, 1, 2] and circle.penetration[0] < 0


def test_the_nearest_three_walls_lie_in_directions_that_differ():
    """A second wall behind the first, in the same direction, does not count."""
    box = worlds.outline([(-1.0, -2.0, 1.5, 2.5)])
    ahead = np.array([[1.6, -2.0, 1.6, 2.0]])
    walls = walls_of(np.vstack([box, ahead]))
    centres = jnp.array([0.9, 0.2]), jnp.array([-0.5, 0.3])
    three, nearest = tangent_circles.nearest_three_walls(*centres, walls, np.cos(0.5))
    segments = np.vstack([box, ahead])
    for k, centre in enumerate(([0.9, -0.5], [0.2, 0.3])):
        distances = wall_distances(np.array(centre), segments)
        np.testing.assert_allclose(nearest[k], distances.min(), atol=1e-12)
        order = np.argsort(distances)
        want = [n for n in order if n != 4][:3]
        assert three[:, k].tolist() == want


def test_a_wall_that_cuts_in_takes_the_place_of_the_one_most_like_it():
    """A plate stands before one side of the triangle: the circle touches the plate instead."""
    plate = np.array([[LEG - 0.7, -1.0, LEG - 0.7, 1.0]])
    segments = np.vstack([TRIANGLE, plate])
    behind = int(np.argmax(np.abs(TRIANGLE[:, 0] + TRIANGLE[:, 2] - 2 * LEG) < 1e-9))
    walls = walls_of(segments)
    kept, swapped = (tangent(CENTRE, [0, 1, 2], walls, swaps=n) for n in (0, 3))
    np.testing.assert_allclose([kept.x[0], kept.y[0]], CENTRE, atol=1e-9)
    np.testing.assert_allclose(kept.penetration[0], 0.7, atol=1e-9)
    others = [k for k in range(3) if k != behind]
    assert sorted(swapped.walls[:, 0].tolist()) == [*others, 3]
    want = slow_circle(CENTRE - [0.5, 0.0], segments[[*others, 3]])
    np.testing.assert_allclose([swapped.x[0], swapped.y[0], swapped.radius[0]], want, atol=1e-6)
    assert swapped.penetration[0] < 0.0


def test_the_fourth_wall_leads_to_the_other_of_two_junctions_that_are_near():
    """In a room that is nearly square two circles touch three walls, 0.3 m from each other."""
    walls = walls_of(ROOM)
    three, _ = tangent_circles.nearest_three_walls(jnp.array([0.95]), jnp.array([1.0]), walls, 0.9)
    first = tangent([0.95, 1.0], three[:, 0], walls)
    np.testing.assert_allclose([first.x[0], first.y[0], first.radius[0]], 1.0, atol=1e-9)
    (fourth,) = set(range(4)) - set(first.walls[:, 0].tolist())
    assert first.fourth_wall[0] == fourth
    three = np.tile(first.walls[:, 0], (3, 1))
    three[np.arange(3), np.arange(3)] = fourth
    more = tangent(np.ones((3, 2)), three, walls, swaps=1)
    other = np.hypot(more.x - 1.3, more.y - 1.0) < 1e-6
    assert other.any() and np.all(more.penetration[other] < 0.0)
    np.testing.assert_allclose(more.radius[other], 1.0, atol=1e-9)
    # Whatever else the three find cuts a wall, or is the first again.
    again = np.hypot(more.x - 1.0, more.y - 1.0) < 1e-6
    assert np.all(other | again | (np.asarray(more.penetration) > 0.05))


def fitted(segments, start, within=SPEC.tangency_gate):
    """Circle near a point that is fitted to the segments of a scan."""
    walls = tangent_circles.wall_segments(segments)
    x, y = start[:1], start[1:]
    three, _ = tangent_circles.nearest_three_walls(x, y, walls, 0.9)
    circle = tangent_circles.tangent_circles(x, y, three, walls, swaps=3)
    circle = circle_fitting.fit_circles(circle, segments, within=within, thick=SPEC.wall_thickness)
    circle = circle._replace(centre=circle.centre.T, cov=circle.cov.T)
    return jax.tree.map(lambda x: x[..., 0], circle)


@jax.jit
def circle_near(scan, start):
    return fitted(segmentation.find_segments(LIDAR, CONFIG.frontend.segments, scan), start)


def scan_of(walls, pose, scanner=LIDAR):
    return cast(scanner, World(jnp.asarray(walls, float)), jnp.asarray(pose))


def test_the_incircle_of_a_triangle_is_exact_from_any_start():
    for off in ([0.0, 0.0], [0.15, -0.1], [-0.1, 0.2]):
        found = circle_near(scan_of(TRIANGLE, IN_TRIANGLE), HERE + jnp.array(off))
        np.testing.assert_allclose(found.centre, HERE, atol=1e-6)
        np.testing.assert_allclose(found.radius, RADIUS, atol=1e-6)
        assert found.touched.sum() == 3 and found.feet_real and abs(found.penetration) < 1e-6


def test_a_wall_may_reach_into_a_circle_behind_its_end_by_its_thickness():
    """A plate ends 3 cm outside the circle; behind it, on the line of sight, lies the circle."""

    def tip(angle, distance):
        return IN_TRIANGLE[:2] + distance * np.array([np.cos(angle), np.sin(angle)])

    plate = worlds.polyline([tip(0.85, 0.5), tip(1.25, 0.5)])
    open_room, screened = (scan_of(walls, IN_TRIANGLE) for walls in (TRIANGLE, [*TRIANGLE, *plate]))
    assert circle_near(open_room, HERE).hidden_depth == 0.0
    behind = [
        np.hypot(*(tip(0.85, 0.5 + s) - CENTRE)) for s in np.linspace(0, SPEC.wall_thickness, 50)
    ]
    assert 0.02 < behind[0] - RADIUS < 0.05 and RADIUS - min(behind) > 0.02
    np.testing.assert_allclose(
        circle_near(screened, HERE).hidden_depth, RADIUS - min(behind), atol=0.01
    )


def shifted(found, draws):
    """Segments with errors of their covariance and roughness, by standard normals (2, K)."""
    tilt = draws[1] * jnp.sqrt(found.angle_variance)
    off = draws[0] * jnp.sqrt(found.offset_variance + FOOT_VARIANCE_FLOOR)
    normal = found.normal - tilt[:, None] * found.tangent
    normal = normal / jnp.linalg.norm(normal, axis=1, keepdims=True)
    at = jnp.sum((found.ends - found.centre[:, None]) * found.tangent[:, None], axis=2)
    ends = found.ends + (off[:, None] + tilt[:, None] * at)[..., None] * found.normal[:, None]
    centre = found.centre + off[:, None] * found.normal
    return found._replace(normal=normal, centre=centre, ends=ends)


@pytest.mark.parametrize(
    "walls, pose, centre, count",
    [(TRIANGLE, IN_TRIANGLE, CENTRE, 3), (SQUARE, (0.8, 0.8, np.pi / 4), (1, 1), 4)],
)
def test_covariance_of_a_circle_is_that_of_its_lines(walls, pose, centre, count):
    """Centres fitted to 2000 draws of the lines; each entry within 5 standard errors."""
    samples, scanner = 2000, ALL_AROUND
    start = inverse_transform(jnp.asarray(pose), jnp.asarray(centre, float))

    @jax.jit
    def centres(scan, draws):
        found = segmentation.find_segments(scanner, CONFIG.frontend.segments, scan)

        def of_draw(draw):
            return fitted(shifted(found, draw), start, 12.0).centre

        return fitted(found, start, 12.0), jax.lax.map(of_draw, draws, batch_size=100)

    scan = ray_casting.add_range_noise(jax.random.key(0), scanner, scan_of(walls, pose, scanner))
    draws = jax.random.normal(
        jax.random.key(1), (samples, 2, CONFIG.frontend.segments.max_segments)
    )
    one, many = centres(scan, draws)
    assert one.touched.sum() == count
    claimed, sampled = np.asarray(one.cov), np.cov(np.asarray(many).T)
    error = np.sqrt((np.outer(np.diag(claimed), np.diag(claimed)) + claimed**2) / samples)
    assert np.all(np.abs(sampled - claimed) < 5 * error)


def test_covariance_of_a_circle_is_that_of_noisy_scans():
    """But for the roughness of walls, which these are without."""
    samples = 400
    scan = scan_of(TRIANGLE, IN_TRIANGLE)

    def trial(key):
        return circle_near(ray_casting.add_range_noise(key, LIDAR, scan), HERE)

    found = jax.jit(jax.vmap(trial))(jax.random.split(jax.random.key(2), samples))
    error = np.asarray(found.centre - HERE[None])
    # Of feet in three even directions (A^T A)^-1 is 2/3.
    claimed = np.asarray(found.cov).mean(axis=0) - 2 / 3 * FOOT_VARIANCE_FLOOR * np.eye(2)
    ratio = np.linalg.eigvals(np.linalg.solve(claimed, error.T @ error / samples))
    np.testing.assert_allclose(ratio, 1.0, atol=5 * np.sqrt(2 / samples))
    assert np.all(np.abs(error.mean(axis=0)) < 5 * error.std(axis=0) / np.sqrt(samples))
