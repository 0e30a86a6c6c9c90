"""Topological SLAM for a robot with a 2-D laser scanner, as differentiable, batched JAX."""

from importlib import metadata as _metadata

from jaxslam import ekf, lidar, metrics, monte_carlo, plan, slam, smoother, topomap, world
from jaxslam.belief import Belief
from jaxslam.grid import GridSpec
from jaxslam.lidar import Lidar, Scan
from jaxslam.motion import Robot
from jaxslam.nodes import Nodes
from jaxslam.slam import Config, Info, Inputs, Noise
from jaxslam.world import World

try:
    __version__ = _metadata.version("jaxslam")
except _metadata.PackageNotFoundError:  # the source tree, not installed
    __version__ = "0+unknown"

__all__ = [
    "Belief",
    "Config",
    "GridSpec",
    "Info",
    "Inputs",
    "Lidar",
    "Nodes",
    "Noise",
    "Robot",
    "Scan",
    "World",
    "ekf",
    "lidar",
    "metrics",
    "monte_carlo",
    "plan",
    "slam",
    "smoother",
    "topomap",
    "world",
]
