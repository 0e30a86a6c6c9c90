import numpy as np
import pytest

from jaxslam.core.se2_np import compose
from jaxslam.evaluation import consistency, log_errors, trajectory


def drive(count=40):
    """Times (count,) and poses (count, 3) of a drive along an arc."""
    turn = np.linspace(0.0, 1.5, count)
    return np.arange(count) * 0.5, np.stack([np.cos(turn), np.sin(turn), turn + np.pi / 2], axis=1)


def test_path_length_is_the_sum_of_the_steps():
    assert log_errors.path_length(np.array([[0, 0, 0], [3, 4, 1], [3, 5, 2]], float)) == 6.0


def test_errors_against_a_moved_reference_are_zero_after_alignment():
    times, poses = drive()
    reference = times, compose(np.array([4.0, -1.0, 2.0]), poses)
    found = log_errors.against_reference(times, poses, reference)
    assert found["ate_rmse_m"] < 1e-9 and found["heading_rmse_deg"] < 1e-6
    assert found["matched"] == len(times)
    in_map = log_errors.reference_in_map(times, poses, reference)
    np.testing.assert_allclose(in_map, poses, atol=1e-9)


def test_errors_since_start_begin_at_zero_and_are_nan_without_reference():
    times, poses = drive()
    reference = times[5:], compose(np.array([4.0, -1.0, 2.0]), poses[5:])
    drift = np.zeros_like(poses)
    drift[6:] = 0.25, -0.5, 0.125
    error = log_errors.errors_since_start(times, poses + drift, reference)
    assert np.isnan(error[:5]).all()
    np.testing.assert_allclose(error[5:], drift[5:], atol=1e-9)


def test_mean_nees_per_dof_leaves_out_poses_that_are_certain_or_have_no_error():
    error = np.tile([0.1, 0.2, 0.0], (5, 1))
    cov = np.stack([np.zeros((3, 3)), *[np.eye(3) * 0.01] * 4])
    error[1] = np.nan
    found = log_errors.mean_nees_per_dof(error, cov)
    values = np.asarray(consistency.nees(error[2:], cov[2:]))
    assert found == float(values.mean()) / 3.0
    assert log_errors.mean_nees_per_dof(error[:2], cov[:2]) is None


def test_relations_and_reference_are_evaluated_where_they_are_given():
    times, poses = drive()
    assert log_errors.errors_against(None, poses, None, None) == {}
    by_hand = trajectory.ate(times, poses + 0.1, times, poses)
    found = log_errors.against_reference(times, poses + 0.1, (times, poses))
    assert by_hand.items() <= found.items()


def test_a_reference_without_headings_gives_no_errors_that_need_them():
    times = np.arange(20.0)
    poses = np.column_stack([np.cos(0.3 * times), np.sin(0.3 * times), 0.3 * times])
    reference = times, np.column_stack([poses[:, :2], np.full(20, np.nan)])
    numbers = log_errors.against_reference(times, poses, reference)
    assert numbers["ate_rmse_m"] == pytest.approx(0.0, abs=1e-6)
    assert all(numbers[name] is None for name in log_errors.NEED_HEADING)
    assert not log_errors.has_heading(reference) and log_errors.has_heading((times, poses))


def test_errors_of_poses_are_those_of_the_trials_evaluation():
    random = np.random.default_rng(0)
    poses, truth = random.normal(0.0, 4.0, (2, 3, 50, 3))
    found = log_errors.pose_errors(poses, truth)
    np.testing.assert_allclose(found, consistency.pose_error(poses, truth), atol=1e-12)
    assert np.abs(found[..., 2]).max() <= np.pi < np.abs((poses - truth)[..., 2]).max()
