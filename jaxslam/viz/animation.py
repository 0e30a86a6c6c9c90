"""Animations as GIF: of any figure, and of a filter on a log with its scans and landmarks."""

from collections.abc import Callable
from os import PathLike

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.animation import PillowWriter
from matplotlib.figure import Figure
from tqdm import tqdm

from jaxslam.core.measurement import Measurement
from jaxslam.core.scan import Scan
from jaxslam.core.se2_np import transform
from jaxslam.core.types import AnyArray, as_float64
from jaxslam.filtering import slam_filter
from jaxslam.filtering.config import init
from jaxslam.filtering.noise import NoiseParams
from jaxslam.frontend import lidar
from jaxslam.pipeline.config import Config
from jaxslam.viz import canvas, landmarks, maps

NUM_FRAMES = 100
FRAMES_PER_SECOND = 12


def write_gif(
    path: str | PathLike, figure: Figure, draw: Callable[[int], None], num_frames: int
) -> None:
    """Write an animation of a figure as GIF.

    Args:
        path: File to write.
        figure: The figure.
        draw: Draws frame k on the figure; called for k = 0 .. `num_frames` - 1 in order.
        num_frames: Number of frames.

    Raises:
        ValueError: `num_frames` is below 1.
    """
    if num_frames < 1:
        raise ValueError(f"num_frames is {num_frames}, not at least 1")
    writer = PillowWriter(fps=FRAMES_PER_SECOND)
    with writer.saving(figure, str(path), dpi=int(figure.dpi)):
        for frame in range(num_frames):
            draw(frame)
            writer.grab_frame()


def animate_run(
    path: str | PathLike,
    config: Config,
    params: NoiseParams,
    measurements: Measurement,
    scans: Scan,
    estimate: AnyArray,
    odom_poses: AnyArray,
    *,
    num_frames: int = NUM_FRAMES,
) -> None:
    """Run the filter on a log again, and write an animation of it as GIF.

    Args:
        path: File to write.
        config: Configuration of the filter.
        params: Noise parameters of the filter.
        measurements: [T] inputs of the filter.
        scans: [T] laser scans.
        estimate: (T, 3) [m, m, rad] estimated trajectory of the whole log; it sets the limits of
            the axes.
        odom_poses: (T, 3) [m, m, rad] trajectory by odometry alone, map frame.
        num_frames: Largest number of frames.

    Raises:
        ValueError: The arguments do not have the same T >= 1, or `num_frames` is below 1.
    """
    odom_poses = as_float64("odom_poses", odom_poses, ("T", 3))
    num_scans = len(odom_poses)
    estimate = as_float64("estimate", estimate, (num_scans, 3))
    if not num_scans or num_frames < 1:
        raise ValueError(f"{num_scans} scans in {num_frames} frames: give at least 1 of each")
    for name, record in (("measurements", measurements), ("scans", scans)):
        lengths = {len(leaf) for leaf in jax.tree.leaves(record)}
        if lengths != {num_scans}:
            raise ValueError(f"{name} has {sorted(lengths)} steps, odom_poses has {num_scans}")
    scans_per_frame = -(-num_scans // num_frames)
    num_frames = -(-num_scans // scans_per_frame)

    def pad(values: jax.Array) -> jax.Array:
        """Fill the last frame by steps without features and motion: one program serves all."""
        num_padding = num_frames * scans_per_frame - num_scans
        return jnp.pad(values, [(0, num_padding)] + [(0, 0)] * (values.ndim - 1))

    measurements = jax.tree.map(pad, measurements)
    ends = jax.vmap(lidar.beam_ends, in_axes=(None, 0))(config.frontend.lidar, scans)
    points = np.asarray(ends, np.float64)
    hit = np.asarray(scans.hit)
    returns = [points[scan][hit[scan]] for scan in range(num_scans)]
    belief = init(config.filter, jnp.asarray(odom_poses[0], float))
    poses = np.zeros((0, 3))
    map_points = [
        transform(pose, seen) for pose, seen in zip(estimate, returns, strict=True) if len(seen)
    ]
    figure, axis = canvas.map_canvas(*canvas.extent(estimate, *map_points))
    limits = axis.get_xlim(), axis.get_ylim()

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
        landmarks.draw_landmarks(axis, belief, confirm_count=config.filter.confirm_count)
        maps.draw_robot(axis, poses[-1], returns[done - 1])
        axis.set(xlim=limits[0], ylim=limits[1], aspect="equal", xlabel="x [m]", ylabel="y [m]")
        axis.set_title(f"scan {done} of {num_scans}")
        if not figure.legends:
            canvas.legend(figure)
        bar.update()

    with tqdm(total=num_frames, unit="frame", desc="animation") as bar:
        write_gif(path, figure, draw, num_frames)
