"""Animation of a run: scans, estimated trajectory and landmarks of the filter, as GIF."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from jaxslam.core.measurement import Measurement
from jaxslam.core.scan import Scan
from jaxslam.core.se2_np import transform
from jaxslam.filtering import slam_filter
from jaxslam.filtering.config import init
from jaxslam.filtering.noise import NoiseParams
from jaxslam.frontend import lidar
from jaxslam.pipeline.config import Config

FRAMES = 100


def animate_run(
    path: Path,
    config: Config,
    params: NoiseParams,
    measurements: Measurement,
    scans: Scan,
    estimate: np.ndarray,
    odom_poses: np.ndarray,
    *,
    frames: int = FRAMES,
) -> None:
    """Run the filter on a log again, and write an animation of it as GIF.

    Args:
        path: File to write.
        config: Configuration of the filter.
        params: Noise parameters of the filter.
        measurements: [T] inputs of the filter.
        scans: [T] laser scans.
        estimate: (T, 3) [m, m, rad] estimated trajectory of the whole run; it sets the limits of the
            axes.
        odom_poses: (T, 3) [m, m, rad] trajectory by odometry alone, world frame.
        frames: Largest number of frames.
    """
    from jaxslam.viz import (
        canvas,
        gif,  # imported here, because matplotlib is slow to import
        maps,
    )

    num_scans = len(odom_poses)
    scans_per_frame = -(-num_scans // frames)
    frames = -(-num_scans // scans_per_frame)

    def pad(values: jax.Array) -> jax.Array:
        """Fill the last frame by steps without features and motion: one program serves all."""
        num_padding = frames * scans_per_frame - num_scans
        return jnp.pad(values, [(0, num_padding)] + [(0, 0)] * (values.ndim - 1))

    measurements = jax.tree.map(pad, measurements)
    points = np.asarray(jax.vmap(lidar.beam_ends, in_axes=(0, None))(scans, config.frontend.lidar))
    hit = np.asarray(scans.hit)
    returns = [points[scan][hit[scan]] for scan in range(num_scans)]
    belief = init(config.filter, jnp.asarray(odom_poses[0], float))
    poses = np.zeros((0, 3))
    world_points = [
        transform(pose, ends) for pose, ends in zip(estimate, returns, strict=True) if len(ends)
    ]
    figure, axis = canvas.map_canvas(*canvas.extent(estimate, *world_points))
    axis_style = {"xlim": axis.get_xlim(), "ylim": axis.get_ylim(), "aspect": "equal"}
    axis_style |= {"xlabel": "x [m]", "ylabel": "y [m]"}

    def draw(frame: int) -> None:
        nonlocal belief, poses
        first = frame * scans_per_frame
        chunk = jax.tree.map(lambda values: values[first : first + scans_per_frame], measurements)
        belief, info = slam_filter.run_filter(config.filter, params, belief, chunk)
        poses = np.concatenate([poses, np.asarray(info.pose, np.float64)])[:num_scans]
        done = len(poses)
        axis.clear()
        maps.draw_hits(axis, poses, points[:done], hit[:done])
        maps.draw_trajectory(axis, odom_poses[:done], "odometry")
        maps.draw_trajectory(axis, poses, "estimate")
        maps.draw_landmarks(axis, belief, confirm_count=config.filter.confirm_count)
        maps.draw_robot(axis, poses[-1], returns[done - 1])
        axis.set(**axis_style, title=f"scan {done} of {num_scans}")
        if not figure.legends:
            canvas.legend(figure)
        bar.update()

    with tqdm(total=frames, unit="frame", desc="animation") as bar:
        gif.write_gif(path, figure, draw, frames)
