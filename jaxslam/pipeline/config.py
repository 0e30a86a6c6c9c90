"""Static configuration of the whole pipeline, by stage, with presets."""

from typing import NamedTuple

from jaxslam.core.scan import Lidar
from jaxslam.filtering.config import FilterConfig
from jaxslam.frontend.config import FrontendConfig
from jaxslam.frontend.lidar import field_of_view
from jaxslam.matching.icp import ScanMatchSpec
from jaxslam.matching.loop_closure import LoopClosureSpec

MAX_LANDMARKS = 2048  # default capacity for landmarks: a building with some kilometres of corridors
LOG_CONFIRM_COUNT = 3  # real buildings have clutter that looks like a landmark once or twice


class Config(NamedTuple):
    """Static configuration, by stage; hashable, static under jit.

    Each stage is compiled for its own part: another `loop_closure` compiles no filter again.

    Attributes:
        frontend: From a scan to features and the local topological map.
        filter: The EKF-SLAM filter.
        scan_matching: Scan matching, where odometry is fused with it.
        loop_closure: Loop closures, for batch smoothing.
    """

    frontend: FrontendConfig = FrontendConfig()
    filter: FilterConfig = FilterConfig()
    scan_matching: ScanMatchSpec = ScanMatchSpec()
    loop_closure: LoopClosureSpec = LoopClosureSpec()

    @classmethod
    def for_lidar(
        cls,
        lidar: Lidar,
        *,
        frontend: FrontendConfig = FrontendConfig(),
        filter: FilterConfig = FilterConfig(),  # noqa: A002
        scan_matching: ScanMatchSpec = ScanMatchSpec(),
        loop_closure: LoopClosureSpec = LoopClosureSpec(),
    ) -> "Config":
        """Configuration for a scanner: front end and filter know it alike.

        Args:
            lidar: The scanner; takes the place of that in `frontend`.
            frontend: The rest of the front end.
            filter: The rest of the filter.
            scan_matching: Of the configuration.
            loop_closure: Of the configuration.
        """
        return cls(
            frontend._replace(lidar=lidar),
            filter._replace(field_of_view=field_of_view(lidar)),
            scan_matching,
            loop_closure,
        )

    @classmethod
    def for_laser_log(cls, lidar: Lidar, *, max_landmarks: int = MAX_LANDMARKS) -> "Config":
        """The preset of `jaxslam run`: recorded logs of a scanner in real buildings.

        Args:
            lidar: The scanner of the log.
            max_landmarks: L, capacity of the map; slots are taken as they are needed.
        """
        own = FilterConfig(max_landmarks=max_landmarks, confirm_count=LOG_CONFIRM_COUNT)
        return cls.for_lidar(lidar, filter=own)

    def check(self) -> None:
        """Raise unless the stages fit each other.

        Raises:
            ValueError: The field of view of the filter is not that of the scanner.
        """
        own, scanner = self.filter.field_of_view, field_of_view(self.frontend.lidar)
        if own != scanner:
            raise ValueError(
                f"config.filter.field_of_view is {own} and config.frontend.lidar sees {scanner}; "
                "make the configuration with Config.for_lidar"
            )
