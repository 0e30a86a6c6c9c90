"""Errors that drives are given beside those of the model."""

import numpy as np
import pytest

from experiments import identifiability
from jaxslam import episode_from_arrays
from jaxslam.pipeline.stacking import stack_episodes

STEPS, LANDMARKS = 200, 6


@pytest.fixture(scope="module")
def drives():
    """Drives on which all landmarks are seen at 2 m and at a bearing of 0, at every step."""
    polar = np.tile([2.0, 0.0], (STEPS, LANDMARKS, 1))
    odometry = np.tile([0.1, 0.0, 0.0], (STEPS, 1)) * (np.arange(STEPS) > 0)[:, None]
    one = episode_from_arrays(odometry, polar, np.tile(range(LANDMARKS), (STEPS, 1)))
    return stack_episodes([one] * 20)


def test_the_odometry_counts_too_much_and_turns_as_before(drives):
    hurt = identifiability.with_scale(drives, 0)
    expected = np.asarray(drives.odometry) * [identifiability.SCALE, identifiability.SCALE, 1.0]
    np.testing.assert_allclose(hurt.odometry, expected)


def test_a_share_of_the_measurements_is_far_off(drives):
    moved = np.asarray(identifiability.with_far_measurements(drives, 0).features.xy)
    off = moved - np.asarray(drives.features.xy)
    far = off[(off != 0.0).any(axis=-1)]
    count = off[..., 0].size
    share = identifiability.FAR_SHARE
    assert abs(len(far) / count - share) < 4 * np.sqrt(share / count)
    spread = identifiability.FAR_STD / np.sqrt(2 * far.size)
    assert abs(far.std() - identifiability.FAR_STD) < 4 * spread


def test_an_error_that_lasts_is_a_markov_process_of_each_landmark(drives):
    hurt = identifiability.with_lasting_errors(drives, 0)
    error = np.asarray(hurt.features.xy)[..., 0] - 2.0  # (B, T, M)
    np.testing.assert_allclose(hurt.features.xy[..., 1], 0.0)
    independent = 20 * LANDMARKS * STEPS / (2 * identifiability.LASTING_STEPS)
    np.testing.assert_allclose(
        error.std(), identifiability.LASTING_STD, rtol=4 / np.sqrt(2 * independent)
    )
    later = np.mean(error[:, 10:] * error[:, :-10]) / np.mean(error**2)
    assert abs(later - np.exp(-10 / identifiability.LASTING_STEPS)) < 4 / np.sqrt(independent)
    others = np.corrcoef(error[..., 0].ravel(), error[..., 1].ravel())[0, 1]
    assert abs(others) < 4 / np.sqrt(independent / LANDMARKS)
