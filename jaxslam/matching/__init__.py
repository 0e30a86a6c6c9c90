"""Scan matching (odometry from scans), loop closures, place recognition; see README.md."""

from typing import TYPE_CHECKING

from jaxslam.core.lazy import lazy_names

if TYPE_CHECKING:
    from jaxslam.core.measurement import ScanMatch as ScanMatch
    from jaxslam.matching.icp import ScanMatchSpec as ScanMatchSpec
    from jaxslam.matching.icp import Submap as Submap
    from jaxslam.matching.joining import Join as Join
    from jaxslam.matching.joining import find_join as find_join
    from jaxslam.matching.loop_closure import LoopClosures as LoopClosures
    from jaxslam.matching.loop_closure import find_loop_closures as find_loop_closures
    from jaxslam.matching.map_places import JoinSpec as JoinSpec
    from jaxslam.matching.map_places import ScanMap as ScanMap
    from jaxslam.matching.odometry_fusion import fuse_odometry as fuse_odometry
    from jaxslam.matching.place_fit import PlaceQuery as PlaceQuery
    from jaxslam.matching.place_index import PlaceIndex as PlaceIndex
    from jaxslam.matching.place_index import PlaceSpec as PlaceSpec
    from jaxslam.matching.place_index import build_index as build_index
    from jaxslam.matching.place_recognition import Places as Places
    from jaxslam.matching.place_recognition import find_places as find_places
    from jaxslam.matching.place_recognition import make_query as make_query
    from jaxslam.matching.registration import LoopClosureSpec as LoopClosureSpec
    from jaxslam.matching.registration import Registration as Registration
    from jaxslam.matching.registration import register_scan as register_scan
    from jaxslam.matching.scan_matching import empty_submap as empty_submap
    from jaxslam.matching.scan_matching import match_scan as match_scan
    from jaxslam.matching.scan_matching import match_scans as match_scans

__getattr__, __all__ = lazy_names(  # noqa: PLE0604
    __name__,
    {
        "jaxslam.core.measurement": "ScanMatch",
        "jaxslam.matching.icp": "ScanMatchSpec Submap",
        "jaxslam.matching.joining": "Join find_join",
        "jaxslam.matching.loop_closure": "LoopClosures find_loop_closures",
        "jaxslam.matching.map_places": "JoinSpec ScanMap",
        "jaxslam.matching.odometry_fusion": "fuse_odometry",
        "jaxslam.matching.place_fit": "PlaceQuery",
        "jaxslam.matching.place_index": "PlaceIndex PlaceSpec build_index",
        "jaxslam.matching.place_recognition": "Places find_places make_query",
        "jaxslam.matching.registration": "LoopClosureSpec Registration register_scan",
        "jaxslam.matching.scan_matching": "empty_submap match_scan match_scans",
    },
)
