"""One small configuration: programs that one test compiles serve the others."""

import numpy as np

from jaxslam.core.scan import Lidar
from jaxslam.filtering.config import FilterConfig
from jaxslam.pipeline.config import Config

LIDAR = Lidar(num_beams=91, angle_min=-np.pi / 2, angle_increment=np.pi / 90, range_max=8.0)
CONFIG = Config.for_lidar(LIDAR, filter=FilterConfig(max_landmarks=24, confirm_count=2))
