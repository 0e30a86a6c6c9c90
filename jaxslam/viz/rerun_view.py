"""Live view of a run in the rerun viewer, or a rerun file (.rrd) of it.

The only module of the library that imports rerun.
"""

from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxslam.core.scan import Scan
from jaxslam.core.se2_np import transform
from jaxslam.filtering import config as config_module
from jaxslam.filtering.belief import Belief
from jaxslam.filtering.covariance import slot_blocks
from jaxslam.frontend import lidar
from jaxslam.io.errors import InputError
from jaxslam.pipeline.config import Config
from jaxslam.pipeline.online import ChunkResult, SlamState
from jaxslam.pipeline.results import SlamResult


class RerunView:
    """A rerun recording of a run; `watch` is a callback for `offline.run_slam`."""

    def __init__(self, config: Config, times: np.ndarray, scans: Scan, file: Path | None):
        """Open the viewer, or a file.

        Args:
            config: Configuration of the filter.
            times: (T,) [s] of the scans.
            scans: [T] laser scans.
            file: File to write; None: open the viewer.

        Raises:
            InputError: rerun is not installed.
        """
        if find_spec("rerun") is None:
            advice = "pip install 'jaxslam[view]'"
            raise InputError("rerun is needed for the live view of a run", advice=advice)
        import rerun  # imported here, because it is slow to import

        self._config, self._times, self._hit = config, times, np.asarray(scans.hit)
        self._points = np.asarray(
            jax.vmap(lidar.beam_ends, in_axes=(None, 0))(config.frontend.lidar, scans)
        )
        self._poses = np.zeros((0, 3))
        self._stream = rerun.RecordingStream("jaxslam")
        if file is None:
            self._stream.spawn()
        else:
            self._stream.save(file)
        # The viewer draws y downwards in 2-D views, hence the 3-D coordinates.
        self._log("", rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)

    def watch(self, state: SlamState, chunk: ChunkResult) -> None:
        """Show the keyframes of a chunk at their estimated poses, and the landmarks after it.

        Args:
            state: State of SLAM after the chunk.
            chunk: Results of the chunk, with the numbers of its keyframes.
        """
        from rerun import Arrows3D, Points3D

        from jaxslam.viz.canvas import BLUE, ORANGE

        poses = np.asarray(chunk.info.pose, np.float64)
        for scan, pose in zip(np.asarray(chunk.keyframes).tolist(), poses, strict=True):
            self._poses = np.concatenate([self._poses, pose[None]])
            self._stream.set_time("scan", sequence=scan)
            self._stream.set_time("time", duration=float(self._times[scan] - self._times[0]))
            if not np.isfinite(pose).all():
                continue
            direction = 0.8 * np.array([[np.cos(pose[2]), np.sin(pose[2])]])
            arrow = Arrows3D(
                vectors=_to_3d(direction), origins=_to_3d(pose[None, :2]), colors=_rgb(BLUE)
            )
            self._log("robot", arrow)
            points = _to_3d(transform(pose, self._points[scan][self._hit[scan]]))
            self._log("scan", Points3D(points, colors=_rgb(ORANGE), radii=0.03))
        self._log_polylines("path", [self._poses[:, :2]], BLUE, 0.03)
        self._log_landmarks(state.belief)

    def end(self, result: SlamResult) -> None:
        """Show the final trajectory, landmarks and arcs of the topological map.

        Args:
            result: Result of SLAM.
        """
        from jaxslam.viz.canvas import BLUE, GREEN

        self._log_polylines("path", [result.poses[:, :2]], BLUE, 0.03)
        self._log_landmarks(result.belief)
        self._log_polylines("map/arcs", result.topological_map.arc_lines, GREEN, 0.02)
        self._stream.disconnect()

    def _log_polylines(
        self, name: str, lines: Sequence[np.ndarray], colour: str, radius: float
    ) -> None:
        """Log lines (N, 2) [m], `radius` [m] thick."""
        from rerun import LineStrips3D

        strips = [_to_3d(line) for line in lines]
        self._log(name, LineStrips3D(strips, colors=_rgb(colour), radii=radius))

    def _log_landmarks(self, belief: Belief) -> None:
        """Log the confirmed junctions and corners with their 3-sigma ellipses."""
        from rerun import LineStrips3D, Points3D

        from jaxslam.viz.canvas import NUM_SIGMAS
        from jaxslam.viz.landmarks import LANDMARK_STYLES

        confirmed = np.asarray(config_module.confirmed(self._config.filter, belief))
        position = np.asarray(belief.landmark_positions, np.float64)
        cov = np.asarray(slot_blocks(belief.map_cov))
        angle = np.linspace(-np.pi, np.pi, 25)
        circle = NUM_SIGMAS * np.stack([np.cos(angle), np.sin(angle)])
        for kind, (_, colour, name) in LANDMARK_STYLES.items():
            use = confirmed & (np.asarray(belief.kind) == kind)
            values, vectors = np.linalg.eigh(cov[use].astype(np.float64))
            root = vectors * np.sqrt(np.maximum(values, 0.0))[:, None]
            rings = position[use][:, None] + np.swapaxes(root @ circle, 1, 2)
            labels = [f"{name} {number}" for number in np.asarray(belief.id)[use]]
            rgb = _rgb(colour)
            points = Points3D(
                _to_3d(position[use]), labels=labels, show_labels=False, radii=0.1, colors=rgb
            )
            self._log(f"map/{name}s", points)
            strips = LineStrips3D(list(_to_3d(rings)), radii=0.01, colors=rgb)
            self._log(f"map/{name}s/ellipses", strips)

    def _log(self, name: str, entity: Any, *, static: bool = False) -> None:
        """Log an entity of rerun under `world`, at the current time or for all times."""
        self._stream.log(f"world/{name}".rstrip("/"), entity, static=static)


def _to_3d(xy: np.ndarray) -> np.ndarray:
    """Points (..., 3) with z = 0 of points (..., 2)."""
    return np.concatenate([xy, np.zeros_like(xy[..., :1])], axis=-1)


def _rgb(colour: str) -> list[int]:
    """Red, green, blue 0..255 of a colour `#RRGGBB`."""
    return [int(colour[start : start + 2], 16) for start in (1, 3, 5)]
