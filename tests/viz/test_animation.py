import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image
from small import CONFIG, LIDAR

from jaxslam.core.measurement import Measurement
from jaxslam.filtering.noise import NoiseParams
from jaxslam.frontend.extract import extract_features
from jaxslam.simulation import ray_casting, worlds
from jaxslam.viz import animation, canvas


def frames(path):
    with Image.open(path) as gif:
        return gif.n_frames


def test_each_frame_is_drawn_once_and_in_order(tmp_path):
    figure, axes = canvas.canvas(2.0, 1.0)
    drawn = []

    def draw(frame):
        drawn.append(frame)
        axes[0, 0].plot([0, frame], [0, 1])

    animation.write_gif(tmp_path / "a.gif", figure, draw, 3)
    assert drawn == [0, 1, 2] and frames(tmp_path / "a.gif") == 3
    with pytest.raises(ValueError, match="num_frames is 0"):
        animation.write_gif(tmp_path / "b.gif", figure, draw, 0)


@pytest.fixture(scope="module")
def drive():
    """Measurements [5] and scans [5] of a robot that turns in a room, and its poses (5, 3)."""
    poses = np.stack([np.full(5, 2.5), np.full(5, 2.0), 0.1 * np.arange(5)], axis=1)
    cast = jax.jit(jax.vmap(lambda pose: ray_casting.cast(LIDAR, worlds.named("fig07"), pose)))
    scans = cast(jnp.asarray(poses))
    extract = jax.jit(jax.vmap(lambda scan: extract_features(CONFIG.frontend, scan)))
    odometry = jnp.array([[0.0, 0.0, 0.0]] + [[0.0, 0.0, 0.1]] * 4)
    return Measurement(odometry, extract(scans)), scans, poses


@pytest.mark.slow
def test_a_run_is_drawn_a_few_scans_a_frame(drive, tmp_path):
    measurements, scans, poses = drive
    params = NoiseParams.for_laser_log()
    path = tmp_path / "run.gif"
    animation.animate_run(
        path, CONFIG, params, measurements, scans, poses, poses.tolist(), num_frames=3
    )
    assert frames(path) == 3


def test_a_bad_argument_is_named(drive, tmp_path):
    measurements, scans, poses = drive

    def animate(measurements=measurements, scans=scans, estimate=poses, odom=poses, num_frames=3):
        params = NoiseParams.for_laser_log()
        animation.animate_run(
            tmp_path / "run.gif",
            CONFIG,
            params,
            measurements,
            scans,
            estimate,
            odom,
            num_frames=num_frames,
        )

    shorter = jax.tree.map(lambda values: values[:4], (measurements, scans))
    with pytest.raises(ValueError, match=r"measurements has \[4\] steps, odom_poses has 5"):
        animate(measurements=shorter[0])
    with pytest.raises(ValueError, match=r"scans has \[4\] steps, odom_poses has 5"):
        animate(scans=shorter[1])
    with pytest.raises(ValueError, match="estimate is"):
        animate(estimate=poses[:4])
    with pytest.raises(ValueError, match="odom_poses is"):
        animate(odom=poses[:, :2])
    with pytest.raises(ValueError, match="5 scans in 0 frames"):
        animate(num_frames=0)
    assert not list(tmp_path.iterdir())
