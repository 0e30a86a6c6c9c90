"""Static configuration of the whole pipeline, by stage, with presets."""

from typing import NamedTuple

from jaxslam.core.scan import Lidar, check_lidar
from jaxslam.core.types import JUNCTION
from jaxslam.filtering import config as filter_config
from jaxslam.filtering.config import FilterConfig
from jaxslam.frontend import config as frontend_config
from jaxslam.frontend.config import FrontendConfig
from jaxslam.frontend.lidar import field_of_view
from jaxslam.mapping.config import MappingSpec, check_mapping_spec
from jaxslam.matching.checks import check_scan_match_spec
from jaxslam.matching.icp import ScanMatchSpec
from jaxslam.matching.map_places import JoinSpec, check_join_spec
from jaxslam.matching.registration import LoopClosureSpec, check_loop_closure_spec
from jaxslam.pipeline import keyframes

MAX_LANDMARKS = 2048  # default capacity for landmarks: a building with some kilometres of corridors
LOG_CONFIRM_COUNT = 3  # real buildings have clutter that looks like a landmark once or twice
LOG_KEYFRAME_DISTANCE = (0.3, 0.3)  # [m], [rad] little of a scanner's view changes over it
FRONTEND, FILTER = FrontendConfig(), FilterConfig()  # the defaults
SCAN_MATCHING, LOOP_CLOSURE, JOINING = ScanMatchSpec(), LoopClosureSpec(), JoinSpec()
MAPPING = MappingSpec()


class Config(NamedTuple):
    """Static configuration, by stage; hashable, static under jit.

    Each stage is compiled for its own part: another `loop_closure` compiles no filter again.

    Attributes:
        frontend: From a scan to features and the local topological map.
        filter: The EKF-SLAM filter.
        scan_matching: Scan matching, where odometry is fused with it.
        loop_closure: Loop closures, for batch smoothing.
        keyframe_distance: [m], [rad] matched motion since the last keyframe that makes a scan of a
            log a keyframe, if it exceeds one of both; other scans are only matched. None: every
            scan is a keyframe, as where more than half of them would be.
        joining: How pieces of a broken drive are joined.
        mapping: How the topological map is made at the end of a log.
    """

    frontend: FrontendConfig = FRONTEND
    filter: FilterConfig = FILTER
    scan_matching: ScanMatchSpec = SCAN_MATCHING
    loop_closure: LoopClosureSpec = LOOP_CLOSURE
    keyframe_distance: tuple[float, float] | None = None
    joining: JoinSpec = JOINING
    mapping: MappingSpec = MAPPING

    @classmethod
    def for_lidar(
        cls,
        lidar: Lidar,
        *,
        frontend: FrontendConfig = FRONTEND,
        filter: FilterConfig = FILTER,  # noqa: A002, as the field is called
        scan_matching: ScanMatchSpec = SCAN_MATCHING,
        loop_closure: LoopClosureSpec = LOOP_CLOSURE,
        keyframe_distance: tuple[float, float] | None = None,
    ) -> "Config":
        """Configuration for a scanner: front end and filter know it alike.

        Args:
            lidar: The scanner; takes the place of that in `frontend`.
            frontend: The rest of the front end.
            filter: The rest of the filter.
            scan_matching: Of the configuration.
            loop_closure: Of the configuration.
            keyframe_distance: Of the configuration.

        Raises:
            ValueError: The scanner is impossible.
        """
        check_lidar(lidar)
        return cls(
            frontend._replace(lidar=lidar),
            filter._replace(field_of_view=field_of_view(lidar)),
            scan_matching,
            loop_closure,
            keyframe_distance,
        )

    @classmethod
    def for_laser_log(cls, lidar: Lidar, *, max_landmarks: int = MAX_LANDMARKS) -> "Config":
        """The preset of `jaxslam run`: recorded logs of a scanner in real buildings.

        Args:
            lidar: The scanner of the log.
            max_landmarks: L, capacity of the map; `run_slam` takes slots as they are needed.
        """
        own = FilterConfig(max_landmarks=max_landmarks, confirm_count=LOG_CONFIRM_COUNT)
        return cls.for_lidar(lidar, filter=own, keyframe_distance=LOG_KEYFRAME_DISTANCE)

    @classmethod
    def for_landmark_sensor(cls, num_landmarks: int, max_measurements: int) -> "Config":
        """A sensor that measures range and bearing of landmarks that it identifies.

        Updates use the invariant linearisation: with few, distant landmarks corrections of the
        heading are large.

        Args:
            num_landmarks: L, number of landmarks; their ids are 0 to L - 1.
            max_measurements: M, largest number of them that is measured at a time.
        """
        return cls(
            filter=FilterConfig(
                landmark_kinds=(JUNCTION,),
                linearisation="invariant",
                max_landmarks=num_landmarks,
                max_updates=max_measurements,
                max_new=max_measurements,
            ),
        )

    def check(self) -> None:
        """Raise unless each stage is possible, and they fit each other.

        Raises:
            ValueError: A number or an option of a stage is out of range; or the field of view of
                the filter is not that of the scanner.
        """
        frontend_config.check_config(self.frontend)
        filter_config.check_config(self.filter)
        check_scan_match_spec(self.scan_matching, "config.scan_matching")
        check_loop_closure_spec(self.loop_closure)
        check_join_spec(self.joining)
        keyframes.check_distance(self.keyframe_distance)
        check_mapping_spec(self.mapping)
        own, scanner = self.filter.field_of_view, field_of_view(self.frontend.lidar)
        if own != scanner:
            raise ValueError(
                f"config.filter.field_of_view is {own} and config.frontend.lidar sees {scanner}; "
                "make the configuration with Config.for_lidar"
            )
