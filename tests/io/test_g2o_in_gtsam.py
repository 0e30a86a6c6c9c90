"""graph.g2o in GTSAM: every factor but those of landmarks is read, and its optimum is ours."""

import numpy as np
import pytest

from jaxslam.core.se2_np import compose, dead_reckoning, relative
from jaxslam.io import g2o_writer
from jaxslam.mapping.pose_graph import PoseGraph
from jaxslam.matching.loop_closure import LoopClosures
from jaxslam.smoothing import SmoothingProblem, smooth_log
from jaxslam.smoothing.problem import LandmarkPrior

gtsam = pytest.importorskip("gtsam", reason="gtsam is not installed: pip install 'jaxslam[test]'")

NUM_POSES, NUM_CLOSURES = 40, 12


@pytest.fixture(scope="module")
def graph():
    """Two rounds of a square with turns of 90 degrees, and closures, some of them singular."""
    rng = np.random.default_rng(3)
    steps = np.tile([[1.0, 0.0, 0.0]] * 4 + [[1.0, 0.0, np.pi / 2]], (8, 1))[: NUM_POSES - 1]
    truth = dead_reckoning(np.zeros(3), np.concatenate([np.zeros((1, 3)), steps]))
    odometry = compose(steps, rng.normal(size=steps.shape) * [0.02, 0.01, 0.004])
    first = 1 + rng.choice(15, NUM_CLOSURES, replace=False)
    second = first + 20 + rng.integers(0, 4, NUM_CLOSURES)
    measured = relative(truth[first], truth[second])
    measured = measured + rng.normal(size=measured.shape) * [0.01, 0.01, 0.003]
    axes = np.linalg.qr(rng.normal(size=(NUM_CLOSURES, 3, 3)))[0]
    values = rng.uniform(1e3, 5e4, (NUM_CLOSURES, 3))
    values[::3, 0] = 0.0
    return PoseGraph(
        poses=dead_reckoning(np.zeros(3), np.concatenate([np.zeros((1, 3)), odometry])),
        landmark_positions=rng.normal(size=(3, 2)),
        odometry=odometry,
        odometry_information=np.tile(np.diag([2500.0, 1e4, 6e4]), (NUM_POSES - 1, 1, 1)),
        pose_index=np.array([0, 5, 9]),
        landmark_index=np.array([0, 1, 2]),
        landmark_xy=rng.normal(size=(3, 2)),
        landmark_information=np.tile(100.0 * np.eye(2), (3, 1, 1)),
        closure_ends=np.stack([first, second], axis=1),
        closure_pose=measured,
        closure_information=(axes * values[:, None]) @ axes.swapaxes(1, 2),
    )


@pytest.fixture(scope="module")
def read(graph, tmp_path_factory):
    path = tmp_path_factory.mktemp("gtsam") / "graph.g2o"
    g2o_writer.write(path, graph)
    return gtsam.readG2o(str(path), False)


def test_all_factors_between_poses_are_read_and_those_of_landmarks_are_not(graph, read):
    factors, _ = read
    found = [factors.at(k) for k in range(factors.size())]
    assert {type(factor).__name__ for factor in found} == {"BetweenFactorPose2"}
    pairs = [(k, k + 1) for k in range(NUM_POSES - 1)] + graph.closure_ends.tolist()
    assert [tuple(factor.keys()) for factor in found] == [tuple(pair) for pair in pairs]
    measured = np.concatenate([graph.odometry, graph.closure_pose])
    for factor, pose in zip(found, measured, strict=True):
        offset = gtsam.Pose2(*pose).between(factor.measured())
        np.testing.assert_allclose([offset.x(), offset.y(), offset.theta()], 0.0, atol=1e-12)


def test_singular_closures_stay_as_weak_as_they_are(graph, read):
    factors, _ = read
    for k, given in enumerate(graph.closure_information):
        largest = np.linalg.eigvalsh(given)[-1]
        least = np.linalg.svd(factors.at(NUM_POSES - 1 + k).noiseModel().R())[1][-1] ** 2
        expected = max(np.linalg.eigvalsh(given)[0], g2o_writer.LEAST_EIGENVALUE * largest)
        np.testing.assert_allclose(least, expected, rtol=1e-5)


def test_the_optimum_is_that_of_the_smoother(graph, read):
    factors, guess = read
    factors, values = gtsam.NonlinearFactorGraph(factors), gtsam.Values()
    for k in range(NUM_POSES):
        values.insert(k, guess.atPose2(k))
    tight = gtsam.noiseModel.Isotropic.Sigma(3, 1e-6)
    factors.add(gtsam.PriorFactorPose2(0, gtsam.Pose2(*graph.poses[0]), tight))
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(1e-12)
    best = gtsam.LevenbergMarquardtOptimizer(factors, values, parameters).optimize()
    found = np.array([[p.x(), p.y(), p.theta()] for p in map(best.atPose2, range(NUM_POSES))])

    count = NUM_POSES - 1
    unseen = np.zeros((1, 2))  # a landmark that is never measured, as there must be one
    problem = SmoothingProblem(
        start=graph.poses[0],
        odometry=graph.odometry,
        odometry_cov=np.linalg.inv(graph.odometry_information),
        measurement=np.ones((count, 1, 2)),
        measurement_cov=np.tile(np.eye(2), (count, 1, 1, 1)),
        kind=np.zeros((count, 1), np.int32),
        landmark_index=np.full((count, 1), -1, np.int32),
        prior=LandmarkPrior(unseen, np.eye(2)[None]),
    )
    closures = LoopClosures(
        graph.closure_ends[:, 0] - 1,
        graph.closure_ends[:, 1] - 1,
        graph.closure_pose,
        graph.closure_information,
    )
    assert closures.first.min() >= 0  # pose 0 is the start of the problem, not one of its poses
    ours = smooth_log(
        problem, graph.poses[1:], unseen, loop_closures=closures, robust_scale=np.inf
    ).poses
    moved = np.abs(ours - graph.poses[1:])[:, :2].max()
    difference = found[1:] - ours
    difference[:, 2] -= 2 * np.pi * np.round(difference[:, 2] / (2 * np.pi))
    assert moved > 0.05
    assert np.abs(difference[:, :2]).max() < 2e-4 and np.abs(difference[:, 2]).max() < 2e-4
