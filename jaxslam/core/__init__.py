"""What all packages share: records of data, SE(2), small algebra, devices and caches.

A README of this folder lists the modules. Modules are `jaxslam.core.se2`, `se2_np`, `polylines`,
`linalg` and `time_series` for functions on arrays; the names below are records and entry points.
"""

from typing import TYPE_CHECKING

from jaxslam.core.lazy import lazy_names

if TYPE_CHECKING:
    from jaxslam.core.batching import map_batches as map_batches
    from jaxslam.core.batching import sequential_vmap_on_cpu as sequential_vmap_on_cpu
    from jaxslam.core.caches import enable_caches as enable_caches
    from jaxslam.core.devices import DeviceMap as DeviceMap
    from jaxslam.core.devices import use_cpu_devices as use_cpu_devices
    from jaxslam.core.episode import Episode as Episode
    from jaxslam.core.episode import measurements_of as measurements_of
    from jaxslam.core.features import Features as Features
    from jaxslam.core.features import concatenate_features as concatenate_features
    from jaxslam.core.features import restrict_features as restrict_features
    from jaxslam.core.logs import LandmarkLog as LandmarkLog
    from jaxslam.core.logs import LaserLog as LaserLog
    from jaxslam.core.logs import Relations as Relations
    from jaxslam.core.maps import OccupancyMap as OccupancyMap
    from jaxslam.core.maps import TopologicalMap as TopologicalMap
    from jaxslam.core.measurement import Measurement as Measurement
    from jaxslam.core.measurement import ScanMatch as ScanMatch
    from jaxslam.core.scan import Lidar as Lidar
    from jaxslam.core.scan import Scan as Scan
    from jaxslam.core.types import CORNER as CORNER
    from jaxslam.core.types import JUNCTION as JUNCTION
    from jaxslam.core.types import WALL as WALL

__getattr__, __all__ = lazy_names(  # noqa: PLE0604
    __name__,
    {
        "jaxslam.core.batching": "map_batches sequential_vmap_on_cpu",
        "jaxslam.core.caches": "enable_caches",
        "jaxslam.core.devices": "DeviceMap use_cpu_devices",
        "jaxslam.core.episode": "Episode measurements_of",
        "jaxslam.core.features": "Features concatenate_features restrict_features",
        "jaxslam.core.logs": "LandmarkLog LaserLog Relations",
        "jaxslam.core.maps": "OccupancyMap TopologicalMap",
        "jaxslam.core.measurement": "Measurement ScanMatch",
        "jaxslam.core.scan": "Lidar Scan",
        "jaxslam.core.types": "CORNER JUNCTION WALL",
    },
)
