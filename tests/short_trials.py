"""Short trials in a small room: one configuration for several tests, as its program is large."""

from functools import cache

import numpy as np

from jaxslam.core.scan import Lidar
from jaxslam.filtering.config import FilterConfig
from jaxslam.filtering.noise import NoiseParams
from jaxslam.frontend.config import FrontendConfig
from jaxslam.frontend.grid import GridSpec
from jaxslam.pipeline.config import Config
from jaxslam.simulation import worlds
from jaxslam.simulation.path_following import densify
from jaxslam.simulation.robot import Robot
from jaxslam.study.runner import Variant

STEPS = 6
CONFIG = Config.for_lidar(
    Lidar(num_beams=181, angle_increment=np.pi / 180),
    frontend=FrontendConfig(grid=GridSpec(x_max=5.0, y_half=4.0)),
    filter=FilterConfig(max_landmarks=16, max_updates=4),
)
ROBOT = Robot()
PATH = densify(np.array([(0.7, 0.8), (2.0, 1.0), (2.2, 2.3), (1.6, 3.6)]))


@cache
def variant() -> Variant:
    """What is driven; not made at import, where processes that start may not use JAX yet."""
    params = NoiseParams.for_simulated_robot(*ROBOT[:2])
    return Variant("room", {}, CONFIG, params, ROBOT, worlds.named("fig07"), PATH, STEPS)
