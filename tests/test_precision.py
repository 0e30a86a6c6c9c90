"""The chain from simulated scans to filtered poses, gradients, a smoothed log and its map.

It runs in float32, as users do; the other tests run in float64.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam import Config, NoiseParams, evaluate, filter_episodes, run_slam, simulate_episodes
from jaxslam.core.scan import Lidar
from jaxslam.filtering.config import FilterConfig
from jaxslam.frontend.config import FrontendConfig
from jaxslam.frontend.extract import extract_features
from jaxslam.frontend.grid import GridSpec
from jaxslam.frontend.lidar import to_scan
from jaxslam.simulation import drives, ray_casting, worlds
from jaxslam.simulation.path_following import densify
from jaxslam.simulation.robot import Robot
from jaxslam.tuning.fitting import gradients

CONFIG = Config.for_lidar(
    Lidar(num_beams=181, angle_min=-np.pi / 2, angle_increment=np.pi / 180),
    frontend=FrontendConfig(grid=GridSpec(x_max=5.0, y_half=4.0)),
    filter=FilterConfig(max_landmarks=32),
)
SCANS = 16

pytestmark = pytest.mark.usefixtures("single_precision")


def scans_of_a_drive():
    world = worlds.World(jnp.asarray(worlds.named("office").walls, float))
    path = jnp.asarray(densify(worlds.waypoints("office")), float)
    key = jax.random.key(1)
    return drives.simulate_scans(key, CONFIG.frontend.lidar, Robot(), world, path, num_scans=SCANS)


def test_features_are_the_same_in_both_precisions():
    world = worlds.World(jnp.asarray(worlds.named("office").walls, float))
    scan = ray_casting.cast(CONFIG.frontend.lidar, world, jnp.array([10.35, 5.0, 1.5]))
    extract = jax.jit(extract_features, static_argnums=0)
    found = extract(CONFIG.frontend, scan)
    assert found.xy.dtype == jnp.float32
    with jax.enable_x64(True):
        ranges = np.asarray(scan.ranges, np.float64)
        exact = extract(CONFIG.frontend, to_scan(CONFIG.frontend.lidar, ranges))
    assert np.array_equal(found.kind, exact.kind) and np.array_equal(found.valid, exact.valid)
    np.testing.assert_allclose(found.xy, exact.xy, atol=1e-4)


@pytest.mark.slow
def test_filter_and_its_gradients():
    episodes = simulate_episodes(jax.random.key(0), CONFIG, num_trials=2, num_scans=SCANS)
    params = NoiseParams.for_simulated_robot()
    results = filter_episodes(CONFIG, params, episodes)
    assert results.estimate.dtype == jnp.float32
    numbers = evaluate(results)
    assert numbers["diverged"] == numbers["nonfinite"] == 0 and numbers["position_rmse_m"] < 0.05
    values, slopes = gradients(CONFIG, params, episodes)
    assert np.isfinite(values).all() and np.isfinite(slopes).all()


@pytest.mark.slow
@pytest.mark.parametrize("match_scans", [False, True])
def test_a_log_is_mapped_and_smoothed(match_scans):
    truth, odometry, scans = scans_of_a_drive()
    config = Config.for_laser_log(CONFIG.frontend.lidar, max_landmarks=64)
    config = config._replace(frontend=CONFIG.frontend)
    params = NoiseParams.for_laser_log(match_scans=match_scans)
    result = run_slam(
        config, params, odometry, scans.ranges, start=truth[0], match_scans=match_scans
    )
    assert result.info.pose.dtype == jnp.float32
    assert np.abs(result.poses - np.asarray(truth))[:, :2].max() < 0.1
    assert len(result.topological_map.xy) > 3
