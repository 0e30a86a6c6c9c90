"""Scan matching (odometry from scans), loop closures, place recognition; see README.md."""

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
