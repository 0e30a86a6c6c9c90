import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam.core.scan import Lidar, Scan
from jaxslam.frontend import dropouts, segmentation
from jaxslam.frontend.extract import extract_features
from jaxslam.frontend.lidar import to_scan
from jaxslam.frontend.segments import SegmentSpec
from jaxslam.pipeline import Config
from jaxslam.simulation import ray_casting
from jaxslam.simulation.worlds import World

SCANNER, SPEC = Lidar(), SegmentSpec()
fill = jax.jit(dropouts.fill_dropouts, static_argnums=(0, 1))
find_segments = jax.jit(segmentation.find_segments, static_argnums=(0, 1))

BOX = [[-2, -3, 5, -3], [5, -3, 5, 4], [5, 4, -2, 4], [-2, 4, -2, -3]]
BLOCK = [[2, 1, 3, 1], [3, 1, 3, 2], [3, 2, 2, 2], [2, 2, 2, 1]]


def scan_of(walls, pose=(0.0, 0.0, 0.0), scanner=SCANNER):
    return ray_casting.cast(scanner, World(jnp.asarray(walls, float)), jnp.asarray(pose))


def without(scan, missing, scanner=SCANNER):
    """The scan whose beams (R,) bool do not return."""
    return to_scan(scanner, jnp.where(jnp.asarray(missing) | ~scan.hit, jnp.inf, scan.ranges))


def slowly_filled(lidar, spec, ranges, hit):
    """Ranges, hits and jumps of a filled scan, by vectors, return by return."""
    angles = lidar.angle_min + lidar.angle_increment * np.arange(lidar.num_beams)
    rays = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    found = np.flatnonzero(hit)
    out, filled, jump = ranges.copy(), hit.copy(), np.ones(len(hit), bool)

    def predicts(p, q, third):
        """Whether the line through two returns meets the beam of a third near enough."""
        a, b = ranges[p] * rays[p], ranges[q] * rays[q]
        normal = np.array([b[1] - a[1], a[0] - b[0]])
        slope = normal @ rays[third]
        at = normal @ a / slope if slope != 0.0 else np.inf
        ahead, base = abs(third - q), abs(q - p)
        k = ahead / base
        width = ranges[q] * base * lidar.angle_increment
        slant = math.hypot(ranges[q] - ranges[p], width) / width
        allowed = 2.04 * lidar.range_std * math.sqrt(1 + k**2 + (1 + k) ** 2)
        allowed += 0.05 * abs(ranges[third] - ranges[q]) + (1 + k) * spec.roughness_std * slant
        return at > 0.0 and abs(at - ranges[third]) < allowed and k <= dropouts.MAX_EXTRAPOLATION

    for n, (p, q) in enumerate(zip(found[:-1], found[1:], strict=True)):
        opening = min(ranges[p], ranges[q]) * (q - p) * lidar.angle_increment
        if q - p > 1 and opening >= spec.max_gap:
            continue
        a, b = ranges[p] * rays[p], ranges[q] * rays[q]
        one = math.dist(a, b) <= spec.jump_distance
        one |= n > 0 and predicts(found[n - 1], p, q)
        one |= n + 2 < len(found) and predicts(found[n + 2], q, p)
        jump[q] = not one
        for j in range(p + 1, q):
            out[j] = min(ranges[p], ranges[q])
            if one:
                normal = np.array([b[1] - a[1], a[0] - b[0]])
                out[j], filled[j], jump[j] = normal @ a / (normal @ rays[j]), True, False
    return out, filled, jump


@pytest.mark.parametrize("share", [0.0, 0.1, 0.3, 0.7])
def test_scans_are_filled_as_a_slow_version_fills_them(share):
    rng = np.random.default_rng(0)
    for x in (0.0, 0.5, 1.0):
        scan = scan_of([*BOX, *BLOCK], (x, 0.3, 0.2))
        noisy = to_scan(SCANNER, scan.ranges + 0.01 * rng.normal(size=361))
        scan = without(noisy, rng.uniform(size=361) < share)
        found = fill(SCANNER, SPEC, scan)
        ranges, hit, jump = slowly_filled(SCANNER, SPEC, *map(np.asarray, scan))
        np.testing.assert_array_equal(found.scan.hit, hit)
        np.testing.assert_array_equal(found.jump, jump)
        np.testing.assert_allclose(found.scan.ranges, ranges, rtol=1e-9)
        np.testing.assert_array_equal(found.measured, scan.hit)


def test_what_is_filled_on_a_wall_is_what_would_have_returned():
    full = scan_of(BOX, (0.3, 0.1, 0.4))
    missing = np.random.default_rng(1).uniform(size=361) < 0.3
    found = fill(SCANNER, SPEC, without(full, missing))
    beside_corner = np.abs(np.asarray(found.scan.ranges - full.ranges)) > 1e-9
    assert found.scan.hit.sum() > 350 and beside_corner.sum() < 8
    assert not (beside_corner & ~missing).any()


@pytest.mark.parametrize(("opening", "closed"), [(0.2, True), (0.9, False)])
def test_a_narrow_gap_without_returns_is_closed_and_a_door_is_not(opening, closed):
    half = opening / 2
    walls = [[3.0, -4.0, 3.0, -half], [3.0, half, 3.0, 4.0]]
    segments = find_segments(SCANNER, SPEC, scan_of(walls))
    assert segments.valid.sum() == (1 if closed else 2)
    if not closed:
        y = np.sort(np.abs(segments.ends[np.asarray(segments.end_occludes)][:, 1]))
        np.testing.assert_allclose(y, [half, half, 4.0, 4.0], atol=0.03)


def test_lines_are_those_of_the_beams_that_returned_alone():
    """Offsets have the variance that is stated: no beam that was filled counts as one."""
    full, rng = scan_of([[3.0, -4.0, 3.0, 4.0]]), np.random.default_rng(2)
    squared = []
    for _ in range(200):
        ranges = jnp.where(full.hit, full.ranges + 0.01 * rng.normal(size=361), jnp.inf)
        scan = without(to_scan(SCANNER, ranges), rng.uniform(size=361) < 0.5)
        segments = find_segments(SCANNER, SPEC, scan)
        k = int(np.argmax(segments.num_beams))
        assert int(segments.num_beams[k]) <= int(scan.hit.sum())
        squared.append(float((segments.centre[k, 0] - 3.0) ** 2 / segments.offset_variance[k]))
    # The mean of 200 squared normal numbers is 1, with a standard error of 0.1.
    assert 0.6 < np.mean(squared) < 1.3


def test_features_of_a_room_survive_missing_beams():
    """Of the features of whole scans nearly all are found with three beams of ten missing."""
    config, rng = Config().frontend, np.random.default_rng(3)
    extract = jax.jit(extract_features, static_argnums=0)
    kept = total = 0
    for x in np.linspace(-1.0, 1.5, 8):
        scan = scan_of([*BOX, *BLOCK], (x, -0.5, 0.3))
        scan = to_scan(SCANNER, scan.ranges + 0.01 * rng.normal(size=361))
        whole = extract(config, scan)
        hurt = extract(config, without(scan, rng.uniform(size=361) < 0.3))
        for kind, xy in zip(
            *(np.asarray(y)[np.asarray(whole.trusted)] for y in whole[:2]), strict=True
        ):
            same = np.asarray(hurt.valid & (hurt.kind == kind))
            near = np.linalg.norm(np.asarray(hurt.xy)[same] - xy, axis=1)
            kept += bool((near < 0.1).any())
            total += 1
    assert total > 30 and kept > 0.85 * total


def test_a_scan_with_one_return_or_none_is_finite():
    for hits in ([], [5], [5, 300]):
        ranges = np.full(361, np.inf)
        ranges[hits] = 2.0
        scan = to_scan(SCANNER, ranges)

        def total(r, scan=scan):
            return jnp.sum(fill(SCANNER, SPEC, Scan(r, scan.hit)).scan.ranges)

        assert np.isfinite(jax.grad(total)(scan.ranges)).all()
        assert fill(SCANNER, SPEC, scan).jump.all()
