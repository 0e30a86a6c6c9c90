"""A film of a run: what the filter believed, scan by scan."""

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
    """Filter a log again, and film it as GIF.

    Args:
        path: File to write.
        config: Of the filter.
        noise: What it assumes.
        inputs: [T] of the filter.
        scans: [T].
        way: (T, 3) estimated poses, of the whole run.
        odometry: (T, 3) the way by odometry alone, world frame.
        frames: At most.
    """
    from jaxslam import plot  # matplotlib takes its time to load

    count = len(odometry)
    each = -(-count // frames)  # scans of a frame
    frames = -(-count // each)
    # Blind steps without motion fill the last frame: one program serves all.
    fill = lambda x: jnp.pad(x, [(0, frames * each - count)] + [(0, 0)] * (x.ndim - 1))
    inputs = jax.tree.map(fill, inputs)
    beams = np.asarray(jax.vmap(lidar.points, in_axes=(0, None))(scans, config.lidar))
    hit = np.asarray(scans.hit)
    belief, poses = slam.init(config, jnp.asarray(odometry[0], float)), np.zeros((0, 3))
    far = [beams[k][hit[k]] for k in range(count)]
    shown = [placed(pose, ends) for pose, ends in zip(way, far, strict=True) if len(ends)]
    figure, axis = plot.plan(*plot.extent(way, *shown))
    look = {"xlim": axis.get_xlim(), "ylim": axis.get_ylim(), "aspect": "equal"}
    look |= {"xlabel": "x [m]", "ylabel": "y [m]"}

    def draw(k: int) -> None:
        nonlocal belief, poses
        some = jax.tree.map(lambda x: x[k * each : (k + 1) * each], inputs)
        belief, info = slam.run(config, noise, belief, some)
        poses = np.concatenate([poses, np.asarray(info.pose, np.float64)])[:count]
        now = len(poses)
        axis.clear()
        plot.echoes(axis, poses, beams[:now], hit[:now])
        plot.trajectory(axis, odometry[:now], "odometry")
        plot.trajectory(axis, poses, "estimate")
        plot.landmarks(axis, belief, confirm=config.confirm)
        plot.robot(axis, poses[-1], far[now - 1])
        axis.set(**look, title=f"scan {now} of {count}")
        if not figure.legends:
            plot.legend(figure)
        bar.update()

    with tqdm(total=frames, unit="frame", desc="film") as bar:
        plot.film(path, figure, draw, frames)
