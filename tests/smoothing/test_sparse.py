"""The sparse smoother, beside the dense one, and beside SciPy's least squares where it doubts."""

import jax
import numpy as np
import pytest
from scipy.optimize import least_squares
from test_smoother import KINDS, L, T, drive, residuals, unpack

from jaxslam.core.types import WALL
from jaxslam.smoothing import dense, sparse
from jaxslam.smoothing.problem import LandmarkPrior, SmoothingResult


def guess_of(poses, places):
    lines = KINDS == WALL
    return np.concatenate([np.ravel(poses), np.ravel(places[~lines]), places[lines, 0]])


def same(found, track, atol):
    turn = lambda x: np.exp(1j * x)
    np.testing.assert_allclose(found.poses[:, :2], track.poses[:, :2], atol=atol)
    np.testing.assert_allclose(turn(found.poses[:, 2]), turn(track.poses[:, 2]), atol=atol)
    lines = KINDS == WALL
    np.testing.assert_allclose(found.places[~lines], track.places[~lines], atol=atol)
    two = turn(2 * found.places[lines, 0]), turn(2 * track.places[lines, 0])
    np.testing.assert_allclose(*two, atol=atol)


@pytest.mark.parametrize("seed", range(2))
def test_without_doubt_it_finds_what_the_dense_one_finds(seed):
    given = drive(seed)
    track = jax.tree.map(np.asarray, dense.smooth_trial(*given, iterations=10))
    found = sparse.smooth_log(*given, robust_scale=np.inf)
    same(found, track, 1e-5)
    np.testing.assert_allclose(found.cost[[0, -1]], track.cost[[0, -1]], rtol=1e-6)
    assert np.all(np.diff(found.cost) <= 0.0)


def test_what_is_doubted_weighs_as_cauchy_says():
    records, poses, places = drive(1)
    seen = np.array(records.measurement)
    seen[3, :2] += 0.4  # two that are not what they were taken for
    records = jax.tree.map(np.asarray, records._replace(measurement=seen))
    found = sparse.smooth_log(records, poses, places, robust_scale=2.0)
    # Of each feature the whole norm is doubted: a row that is as long as the root of rho.
    sizes = [1 if KINDS[i] == WALL else 2 for row in records.landmark_index for i in row if i >= 0]
    counts = [np.count_nonzero(row >= 0) for row in records.landmark_index]

    def doubted(x):
        told, out, size = residuals(records, *unpack(x)), [], iter(sizes)
        at = 0
        for count in counts:
            out.append(told[at : at + 3])
            at += 3
            for n in (next(size) for _ in range(count)):
                norm = np.linalg.norm(told[at : at + n])
                out.append([2.0 * np.sqrt(np.log1p(norm**2 / 4.0))])
                at += n
        return np.concatenate([*out, told[at:]])

    start = guess_of(found.poses, found.landmark_positions)
    best = least_squares(doubted, start, "3-point", xtol=1e-14, ftol=1e-14, max_nfev=20)
    same(found, SmoothingResult(*unpack(best.x), None), 2e-3)
    np.testing.assert_allclose(found.cost[-1], 2 * best.cost, rtol=1e-5)
    believed = sparse.smooth_log(records, poses, places, robust_scale=np.inf)
    right = sparse.smooth_log(drive(1)[0], poses, places, robust_scale=2.0)
    off = lambda track: np.abs(track.poses[:, :2] - right.poses[:, :2]).max()
    assert off(found) < 0.5 * off(believed)


def test_records_in_single_precision_are_smoothed_in_double():
    given = drive(0)
    single = jax.tree.map(lambda x: np.asarray(x, np.float32 if x.dtype == float else None), given)
    with jax.enable_x64(False):
        found = sparse.smooth_log(*single)
    assert found.poses.dtype == found.landmark_positions.dtype == np.float64
    same(found, sparse.smooth_log(*given), 1e-3)


def test_padding_is_invisible():
    records, poses, places = jax.tree.map(np.asarray, drive(0))
    alone = sparse.smooth_log(records, poses, places)
    more = lambda x, n, fill: np.concatenate([x, np.full((n, *x.shape[1:]), fill, x.dtype)])
    q = np.concatenate([records.odometry_cov, np.tile(np.eye(3), (3, 1, 1))])
    longer = records._replace(
        odometry=more(records.odometry, 3, 0.0),
        odometry_cov=q,
        measurement=more(records.measurement, 3, 0.0),
        measurement_cov=more(records.measurement_cov, 3, 0.0),
        kind=more(records.kind, 3, 0),
        landmark_index=more(records.landmark_index, 3, -1),
        prior=LandmarkPrior(*(more(x, 4, 0.0) for x in records.prior)),
    )
    padded = sparse.smooth_log(
        longer, np.append(poses, poses[[-1] * 3], axis=0), more(places, 4, 0.0)
    )
    np.testing.assert_allclose(padded.cost, alone.cost, rtol=1e-9)
    cut = padded._replace(poses=padded.poses[:T], landmark_positions=padded.landmark_positions[:L])
    same(cut, alone, 1e-9)


def test_a_guess_without_a_cost_is_given_back():
    records, poses, places = jax.tree.map(np.asarray, drive(0))
    found = sparse.smooth_log(records._replace(odometry=np.full((T, 3), np.nan)), poses, places)
    np.testing.assert_allclose(found.poses[:, :2], poses[:, :2])
    assert found.cost.shape == (1,)


def test_bad_arguments_are_told():
    records, poses, places = drive(0)
    with pytest.raises(ValueError, match="doubt is 0"):
        sparse.smooth_log(records, poses, places, robust_scale=0)
    with pytest.raises(ValueError, match="poses is"):
        sparse.smooth_log(records, poses[:, :2], places)
