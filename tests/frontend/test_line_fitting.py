import math
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam.core.scan import Lidar, Scan
from jaxslam.frontend import line_fitting, segmentation
from jaxslam.frontend.line_fitting import NO_BEAM, BeamIntervals
from jaxslam.frontend.segments import SegmentSpec
from jaxslam.simulation import ray_casting, worlds
from jaxslam.simulation.worlds import World

SPEC = SegmentSpec()
SMALL = Lidar(num_beams=61, angle_min=-math.pi / 3, angle_increment=math.pi / 90, range_std=0.01)
SCANS, COST, MAX_INCIDENCE = 24, SPEC.segment_cost, 10.0
find_segments = jax.jit(segmentation.find_segments, static_argnums=(0, 1))
longest_intervals = jax.jit(line_fitting.longest_intervals, static_argnames="capacity")
cast = jax.jit(ray_casting.cast, static_argnums=0)


def angles(scanner):
    return scanner.angle_min + scanner.angle_increment * np.arange(scanner.num_beams)


@partial(jax.jit, static_argnums=4)
@partial(jax.vmap, in_axes=(0, 0, 0, None, None))
def partitions(ranges, hit, breaks, costs, num_candidates):
    segment_cost, outlier_cost, max_incidence = costs
    return line_fitting.partition_beams(
        SMALL,
        Scan(ranges, hit),
        breaks,
        hit,
        0.01,
        segment_cost=segment_cost,
        outlier_cost=outlier_cost,
        num_candidates=num_candidates,
        roughness_std=0.0,
        roughness_length=1.0,
        max_incidence=max_incidence,
    )


def partition(
    ranges,
    hit,
    breaks,
    *,
    num_candidates=16,
    segment_cost=COST,
    outlier_cost=SPEC.outlier_cost,
    max_incidence=MAX_INCIDENCE,
):
    """Where segments begin (N, R), of scans of even walls; the last is repeated for the program."""
    count, costs = len(ranges), jnp.array([segment_cost, outlier_cost, max_incidence])
    given = [
        jnp.asarray(np.concatenate([x, np.repeat(x[-1:], SCANS - count, axis=0)]))
        for x in (ranges, hit, breaks)
    ]
    found = partitions(*given, costs, num_candidates)
    return jax.tree.map(lambda x: np.asarray(x)[:count], found)


@pytest.fixture(scope="module")
def scans():
    """Ranges, hits and breaks (N, R) of polylines with noise; some beams did not return."""
    random = np.random.default_rng(0)
    turn, ranges = angles(SMALL), np.empty((SCANS, SMALL.num_beams))
    for r in ranges:
        knots = np.sort(random.uniform(-1.2, 1.2, 4))
        at = random.uniform(1.0, 4.0, 6)[:, None] * np.stack(
            [np.cos([-1.5, *knots, 1.5]), np.sin([-1.5, *knots, 1.5])], axis=1
        )
        # On a line the inverse range is a sinusoid of the bearing.
        part = np.searchsorted(knots, turn)
        ends = np.stack([at[part], at[part + 1]], axis=1)
        across = np.linalg.solve(ends, np.ones((SMALL.num_beams, 2, 1)))[..., 0]
        r[:] = 1 / np.sum(across * np.stack([np.cos(turn), np.sin(turn)], axis=1), axis=1)
    hit = random.random(ranges.shape) > 0.05
    ranges = np.where(
        hit, ranges + SMALL.range_std * random.normal(size=ranges.shape), SMALL.range_max
    )
    breaks = ~hit | ~np.roll(hit, 1, axis=1) | (random.random(ranges.shape) < 0.03)
    breaks[:, 0] = True
    return ranges, hit, breaks


def line_costs(ranges, max_incidence=MAX_INCIDENCE):
    """Cost (R, R) of the segment from one beam to another: of the line that fits it best.

    The inverse ranges are those of the line a cos(turn) + b sin(turn), turned to the first beam,
    with standard deviations that follow from those of the ranges, and b is about 0 beforehand.
    """
    q, turn = 1 / ranges, angles(SMALL)
    cost = np.full((q.size, q.size), np.nan)
    for i in range(q.size):
        c, s = np.cos(turn[i:] - turn[i]), np.sin(turn[i:] - turn[i])
        rows = np.stack([c, s], axis=1) / (0.01 * q[i:] ** 2)[:, None]
        right = q[i:] / (0.01 * q[i:] ** 2)
        rows = np.concatenate([[[0.0, 1 / (max_incidence * q[i])]], rows])
        right = np.append(0.0, right)
        for j in range(i, q.size):
            most = j - i + 2
            line = np.linalg.lstsq(rows[:most], right[:most], rcond=None)[0]
            cost[i, j] = np.sum((rows[:most] @ line - right[:most]) ** 2)
    return cost


def total_cost(begins, line_cost, segment_cost=COST):
    """Cost of a partition (R,) bool."""
    first = np.flatnonzero(begins)
    last = np.append(first[1:], begins.size) - 1
    return np.sum(line_cost[first, last] + segment_cost)


def slow_partition(line_cost, must_begin, segment_cost):
    """The partition of least cost: the best of all first beams of the last segment, and so on."""
    best, first = [0.0], []
    for j in range(len(must_begin)):
        since = max(i for i in range(j + 1) if must_begin[i] or i == 0)
        starts = np.arange(since, j + 1)
        cost = np.array(best)[starts] + segment_cost + line_cost[starts, j]
        best.append(cost.min())
        first.append(starts[np.argmin(cost)])
    begins, last = np.zeros(len(must_begin), bool), len(must_begin) - 1
    while last >= 0:
        begins[first[last]] = True
        last = first[last] - 1
    return begins


@pytest.mark.parametrize("segment_cost", [COST, 6.0])  # the second splits noise
def test_no_partition_costs_less_and_a_few_candidates_nearly_suffice(scans, segment_cost):
    ranges, hit, breaks = scans
    every, few = (
        partition(*scans, num_candidates=n, segment_cost=segment_cost, outlier_cost=np.inf).begins
        for n in (SMALL.num_beams, SPEC.num_candidates)
    )
    cheap = 0
    for r, must_begin, optimal, lean in zip(ranges, breaks | ~hit, every, few, strict=True):
        line_cost = line_costs(r)
        best = slow_partition(line_cost, must_begin, segment_cost)
        np.testing.assert_array_equal(optimal, best)
        assert 5 <= best.sum() < 30
        least = total_cost(best, line_cost, segment_cost)
        excess = total_cost(lean, line_cost, segment_cost) - least
        assert excess > -1e-6
        cheap += excess < 1e-6
    assert cheap >= 0.9 * SCANS


def test_segments_begin_at_breaks_and_hold_no_beam_without_return(scans):
    _, hit, breaks = scans
    begins = partition(*scans).begins
    assert begins[breaks].all() and begins[~hit].all()
    assert not begins[hit & ~breaks].all() and begins[hit & ~breaks].any()
    for k in range(SCANS):
        intervals = longest_intervals(jnp.asarray(begins[k]), jnp.asarray(hit[k]), capacity=40)
        member = np.asarray(intervals.interval_of_beam(SMALL.num_beams)) < 40
        np.testing.assert_array_equal(member, hit[k])


def test_the_mirrored_scan_is_split_at_the_mirrored_beams(scans):
    """Up to ties: of a few beams those in the middle may go with either side, at equal cost."""
    ranges, hit, breaks = scans
    turned = breaks.copy()
    turned[:, 1:] = breaks[:, :0:-1]  # before a beam is after it
    back_to_front = ranges[:, ::-1], hit[:, ::-1], turned
    here, there = (
        partition(
            *scan, num_candidates=SMALL.num_beams, outlier_cost=np.inf, max_incidence=1e3
        ).begins
        for scan in (scans, back_to_front)
    )
    back = np.ones_like(there)
    back[:, 1:] = there[:, :0:-1]
    assert np.mean(np.all(here == back, axis=1)) >= 0.7
    for k in range(SCANS):
        line_cost = line_costs(ranges[k], max_incidence=1e3)
        costs = [total_cost(begins[k], line_cost) for begins in (here, back)]
        np.testing.assert_allclose(*costs, atol=1e-3)


def test_an_outlier_does_not_split_a_wall():
    """Nor does it move it."""
    turn, beams = angles(SMALL), np.arange(3, 58, 3)
    wall = 2.0 / np.cos(turn - 0.2)
    ranges = np.tile(wall, (len(beams), 1))
    ranges += 0.005 * np.random.default_rng(0).normal(size=ranges.shape)
    clean, hit, breaks = ranges.copy(), ranges > 0, np.tile(np.arange(61) == 0, (len(beams), 1))
    ranges[np.arange(len(beams)), beams] += 0.15
    disturbed, straight = partition(ranges, hit, breaks), partition(clean, hit, breaks)
    np.testing.assert_array_equal(disturbed.begins, breaks)
    np.testing.assert_array_equal(straight.begins, breaks)
    np.testing.assert_allclose(disturbed.normal[:, -1], straight.normal[:, -1], atol=0.01)
    np.testing.assert_allclose(straight.normal[:, -1, 0], math.cos(0.2), atol=0.01)
    without_outliers = partition(ranges, hit, breaks, outlier_cost=np.inf)
    assert (without_outliers.begins.sum(axis=1) >= 3).all()


@pytest.mark.parametrize("ranges", [0.0, SMALL.range_max])
def test_a_scan_without_returns_has_no_segments_and_finite_numbers(ranges):
    nothing = Scan(jnp.full(61, ranges), jnp.zeros(61, bool))
    parts = partition(nothing.ranges[None], nothing.hit[None], nothing.hit[None])
    assert parts.begins.all() and np.isfinite(parts.normal).all()
    begins = jnp.asarray(parts.begins[0])
    intervals = longest_intervals(begins, nothing.hit, capacity=5)
    assert intervals.first.tolist() == [NO_BEAM] * 5 and intervals.last.tolist() == [-1] * 5
    found = find_segments(SMALL, SPEC, nothing)
    assert not found.valid.any() and not found.meets_next.any()
    assert all(np.isfinite(np.asarray(field, float)).all() for field in found)


@pytest.mark.parametrize("noise, step", [(0.01, 1.0), (0.03, 0.5)])
def test_a_straight_noisy_wall_is_one_segment(noise, step):
    beams = int(100 / step) + 1
    scanner = Lidar(
        num_beams=beams,
        angle_min=-math.radians(50),
        angle_increment=math.radians(step),
        range_std=noise,
    )
    walls = World(jnp.array([[2.0, -9.0, 2.0, 9.0]]))
    clean = cast(scanner, walls, jnp.zeros(3))
    keys = jax.random.split(jax.random.key(0), 200)

    def number(key):
        noisy = ray_casting.add_range_noise(key, scanner, clean)
        return segmentation.find_segments(scanner, SPEC, noisy).valid.sum()

    count = np.asarray(jax.jit(jax.vmap(number))(keys))
    assert np.mean(count == 1) >= 0.98, np.bincount(count)


def test_a_wall_that_steps_by_a_few_centimetres_is_one_segment():
    """Seen from near and at a grazing angle, whatever the noise; but not without the roughness."""
    walls = World(jnp.asarray(worlds.named("fig06d").walls))
    random, poses = np.random.default_rng(0), np.zeros((60, 3))
    poses[:, 0], poses[:, 1] = random.uniform(0.0, 2.5, 60), random.uniform(-0.6, 0.6, 60)
    poses[:, 2] = random.uniform(-0.2, 0.2, 60)

    def one(spec, scanner, key, pose):
        scan = ray_casting.add_range_noise(key, scanner, ray_casting.cast(scanner, walls, pose))
        return segmentation.find_segments(scanner, spec, scan).valid.sum()

    keys = jax.random.split(jax.random.key(0), 60)

    def counts(spec, noise):
        many = jax.jit(jax.vmap(partial(one, spec, Lidar(range_std=noise))))
        return np.asarray(many(keys, jnp.asarray(poses)))

    for noise in (0.0, 0.03):
        found = counts(SPEC, noise)
        assert np.mean(found == 2) >= 0.7 and found.max() <= 4, np.bincount(found)
    split = counts(SPEC._replace(roughness_std=1e-4), 0.0)
    assert np.mean(split > 4) >= 0.9, np.bincount(split)


@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_a_scan_is_split_at_the_beam_of_a_corner(noise):
    scanner = Lidar(
        num_beams=181, angle_min=-math.pi / 4, angle_increment=math.pi / 360, range_std=0.01
    )
    walls = World(jnp.asarray(worlds.polyline([(3.0, -9.0), (3.0, 1.0), (-2.0, 1.0)])))
    scan = cast(scanner, walls, jnp.zeros(3))
    if noise:
        scan = ray_casting.add_range_noise(jax.random.key(1), scanner, scan)
    of = np.asarray(find_segments(scanner, SPEC, scan).segment_of_beam)
    beam = (math.atan2(1.0, 3.0) - scanner.angle_min) / scanner.angle_increment  # 126.9
    np.testing.assert_allclose(np.flatnonzero(np.diff(of)) + 0.5, beam, atol=1.5 if noise else 0.5)
    assert of[0] == 0 and of[-1] == 1


def pairs_of(intervals):
    pairs = zip(intervals.first.tolist(), intervals.last.tolist(), strict=True)
    return [(a, b) for a, b in pairs if b >= 0]


def test_the_longest_are_kept_in_the_order_of_the_beams():
    begins = jnp.isin(jnp.arange(24), jnp.array([0, 5, 7, 10, 11, 21]))
    hit = jnp.arange(24) < 21
    kept = longest_intervals(begins, hit, capacity=3)
    assert pairs_of(kept) == [(0, 4), (7, 9), (11, 20)]
    of = [0] * 5 + [3] * 2 + [1] * 3 + [3] + [2] * 10 + [3] * 3
    np.testing.assert_array_equal(kept.interval_of_beam(24), of)
    np.testing.assert_array_equal(kept.size, [5, 3, 10])
    more = longest_intervals(begins, hit, capacity=7)
    assert pairs_of(more) == [(0, 4), (5, 6), (7, 9), (10, 10), (11, 20)]
    assert more.first.tolist()[5:] == [NO_BEAM] * 2 and more.last.tolist()[5:] == [-1] * 2


def test_padding_holds_no_beam():
    padded = BeamIntervals(jnp.array([0, NO_BEAM], jnp.int32), jnp.array([4, -1], jnp.int32))
    np.testing.assert_array_equal(padded.size, [5, 0])
    np.testing.assert_array_equal(padded.interval_of_beam(6), [0] * 5 + [2])


def test_moments_and_principal_axes_are_those_of_numpy():
    random = np.random.default_rng(0)
    xy, weight, of = random.normal(size=(40, 2)), random.uniform(0.5, 2, 40), np.arange(40) % 4
    xy = xy @ np.array([[2.0, 0.3], [0.0, 0.4]]) + 3.0
    sums = line_fitting.line_moments(*map(jnp.asarray, (xy, weight, of.astype(np.int32))), lines=3)
    normal, across, along = line_fitting.principal_axes(sums.scatter)
    for k in range(3):  # those of the fourth count nowhere
        own = of == k
        scatter = np.cov(xy[own].T, aweights=weight[own], ddof=0) * weight[own].sum()
        np.testing.assert_allclose(sums.weight[k], weight[own].sum())
        np.testing.assert_allclose(sums.mean[k], np.average(xy[own], axis=0, weights=weight[own]))
        value, vector = np.linalg.eigh(scatter)
        np.testing.assert_allclose([across[k], along[k]], value)
        np.testing.assert_allclose(np.abs(vector[:, 0] @ normal[k]), 1.0)
