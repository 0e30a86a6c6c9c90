"""Animation of a run: scans, estimated trajectory and landmarks of the filter, as GIF."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from jaxslam import lidar, slam
from jaxslam.lidar import Scan
from jaxslam.noise import Noise
from jaxslam.poses import placed
from jaxslam.slam import Config, Inputs

FRAMES = 100


def film(
    path: Path,
    config: Config,
    noise: Noise,
    inputs: Inputs,
    scans: Scan,
    way: np.ndarray,
    odometry: np.ndarray,
    *,
    frames: int = FRAMES,
) -> None:
    """Run the filter on a log again, and write an animation of it as GIF.

    Args:
        path: File to write.
        config: Configuration of the filter.
        noise: Noise parameters of the filter.
        inputs: [T] inputs of the filter.
        scans: [T] laser scans.
        way: (T, 3) [m, m, rad] estimated trajectory of the whole run; it sets the limits of the
            axes.
        odometry: (T, 3) [m, m, rad] trajectory by odometry alone, world frame.
        frames: Largest number of frames.
    """
    from jaxslam import plot  # imported here, because matplotlib is slow to import

    num_scans = len(odometry)
    scans_per_frame = -(-num_scans // frames)
    frames = -(-num_scans // scans_per_frame)

    def pad(values: jax.Array) -> jax.Array:
        """Fill the last frame by steps without features and motion: one program serves all."""
        num_padding = frames * scans_per_frame - num_scans
        return jnp.pad(values, [(0, num_padding)] + [(0, 0)] * (values.ndim - 1))

    inputs = jax.tree.map(pad, inputs)
    points = np.asarray(jax.vmap(lidar.points, in_axes=(0, None))(scans, config.lidar))
    hit = np.asarray(scans.hit)
    returns = [points[scan][hit[scan]] for scan in range(num_scans)]
    belief = slam.init(config, jnp.asarray(odometry[0], float))
    poses = np.zeros((0, 3))
    world_points = [
        placed(pose, ends) for pose, ends in zip(way, returns, strict=True) if len(ends)
    ]
    figure, axis = plot.plan(*plot.extent(way, *world_points))
    axis_style = {"xlim": axis.get_xlim(), "ylim": axis.get_ylim(), "aspect": "equal"}
    axis_style |= {"xlabel": "x [m]", "ylabel": "y [m]"}

    def draw(frame: int) -> None:
        nonlocal belief, poses
        first = frame * scans_per_frame
        chunk = jax.tree.map(lambda values: values[first : first + scans_per_frame], inputs)
        belief, info = slam.run(config, noise, belief, chunk)
        poses = np.concatenate([poses, np.asarray(info.pose, np.float64)])[:num_scans]
        done = len(poses)
        axis.clear()
        plot.echoes(axis, poses, points[:done], hit[:done])
        plot.trajectory(axis, odometry[:done], "odometry")
        plot.trajectory(axis, poses, "estimate")
        plot.landmarks(axis, belief, confirm=config.confirm)
        plot.robot(axis, poses[-1], returns[done - 1])
        axis.set(**axis_style, title=f"scan {done} of {num_scans}")
        if not figure.legends:
            plot.legend(figure)
        bar.update()

    with tqdm(total=frames, unit="frame", desc="animation") as bar:
        plot.film(path, figure, draw, frames)
