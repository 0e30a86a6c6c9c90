"""A run as it goes on, for rerun's viewer: live, or kept in a file for it.

The only part of the library that imports rerun.
"""

from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxslam import lidar, slam
from jaxslam.belief import Belief
from jaxslam.covariance import blocks_of
from jaxslam.io.errors import InputError
from jaxslam.lidar import Scan
from jaxslam.online import Mapper, Part, Survey
from jaxslam.poses import placed
from jaxslam.slam import Config


class View:
    """What has been shown of a run; `watch` is for `online.survey`."""

    def __init__(self, config: Config, times: np.ndarray, scans: Scan, file: Path | None):
        """Open the viewer, or a file for it.

        Args:
            config: Of the filter.
            times: (T,) [s] of the scans.
            scans: [T].
            file: To write; None: the viewer is opened.

        Raises:
            InputError: rerun is not installed.
        """
        if find_spec("rerun") is None:
            advice = "pip install 'jaxslam[view]'"
            raise InputError("rerun is needed to show a run as it goes on", advice=advice)
        import rerun  # takes its time to load

        self._config, self._times, self._hit = config, times, np.asarray(scans.hit)
        self._ends = np.asarray(jax.vmap(lidar.points, in_axes=(0, None))(scans, config.lidar))
        self._poses = np.zeros((0, 3))
        self._stream = rerun.RecordingStream("jaxslam")
        if file is None:
            self._stream.spawn()
        else:
            self._stream.save(file)
        # The viewer draws y of flat pictures downwards.
        self._log("", rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)

    def watch(self, mapper: Mapper, part: Part) -> None:
        """Show the scans of a stretch where they were made, and the landmarks after them."""
        from rerun import Arrows3D, Points3D

        from jaxslam.plot.sheet import BLUE, ORANGE

        for pose in np.asarray(part.info.pose, np.float64):
            at = len(self._poses)
            self._poses = np.concatenate([self._poses, pose[None]])
            self._stream.set_time("scan", sequence=at)
            self._stream.set_time("time", duration=float(self._times[at] - self._times[0]))
            if not np.isfinite(pose).all():
                continue
            ahead = 0.8 * np.array([[np.cos(pose[2]), np.sin(pose[2])]])
            self._log(
                "robot",
                Arrows3D(vectors=_flat(ahead), origins=_flat(pose[None, :2]), colors=_rgb(BLUE)),
            )
            seen = _flat(placed(pose, self._ends[at][self._hit[at]]))
            self._log("scan", Points3D(seen, colors=_rgb(ORANGE), radii=0.03))
        self._lines("path", [self._poses[:, :2]], BLUE, 0.03)
        self._landmarks(mapper.belief)

    def end(self, survey: Survey) -> None:
        """Show all as it is known at the end, and the arcs of the topological map."""
        from jaxslam.plot.sheet import BLUE, GREEN

        self._lines("path", [survey.poses[:, :2]], BLUE, 0.03)
        self._landmarks(survey.belief)
        self._lines("map/arcs", survey.graph.lines, GREEN, 0.02)
        self._stream.disconnect()

    def _lines(self, name: str, lines: Sequence[np.ndarray], colour: str, radius: float) -> None:
        from rerun import LineStrips3D

        flat = [_flat(line) for line in lines]
        self._log(name, LineStrips3D(flat, colors=_rgb(colour), radii=radius))

    def _landmarks(self, belief: Belief) -> None:
        from rerun import LineStrips3D, Points3D

        from jaxslam.plot.places import MARKS
        from jaxslam.plot.sheet import SIGMAS

        counts = np.asarray(slam.confirmed(self._config, belief))
        place, own = np.asarray(belief.places, np.float64), np.asarray(blocks_of(belief.map_cov))
        angle = np.linspace(-np.pi, np.pi, 25)
        circle = SIGMAS * np.stack([np.cos(angle), np.sin(angle)])
        for kind, (_, colour, name) in MARKS.items():
            use = counts & (np.asarray(belief.kind) == kind)
            values, vectors = np.linalg.eigh(own[use].astype(np.float64))
            stretched = vectors * np.sqrt(np.maximum(values, 0.0))[:, None]
            rings = place[use][:, None] + np.swapaxes(stretched @ circle, 1, 2)
            labels = [f"{name} {id}" for id in np.asarray(belief.id)[use]]
            look = {"colors": _rgb(colour)}
            dots = Points3D(_flat(place[use]), labels=labels, show_labels=False, radii=0.1, **look)
            self._log(f"map/{name}s", dots)
            self._log(f"map/{name}s/ellipses", LineStrips3D(list(_flat(rings)), radii=0.01, **look))

    def _log(self, name: str, what: Any, **how: bool) -> None:
        self._stream.log(f"world/{name}".rstrip("/"), what, **how)


def _flat(xy: np.ndarray) -> np.ndarray:
    """Points (..., 3) of points (..., 2), on the floor."""
    return np.concatenate([xy, np.zeros_like(xy[..., :1])], axis=-1)


def _rgb(colour: str) -> list[int]:
    """Numbers of a colour `#RRGGBB`."""
    return [int(colour[k : k + 2], 16) for k in (1, 3, 5)]
