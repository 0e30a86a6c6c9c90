"""Front end: from one laser scan to features, and to the local topological map.

A README of this folder lists the modules. The codes of `edge_codes` and `global_edge_codes` are
imported from these modules.
"""

from jaxslam.frontend.automaton import Diagram as Diagram
from jaxslam.frontend.automaton import expand as expand
from jaxslam.frontend.config import LABELS as LABELS
from jaxslam.frontend.config import FrontendConfig as FrontendConfig
from jaxslam.frontend.extract import extract_diagram as extract_diagram
from jaxslam.frontend.extract import extract_features as extract_features
from jaxslam.frontend.extract import extract_local_graph as extract_local_graph
from jaxslam.frontend.extract import extract_local_graphs as extract_local_graphs
from jaxslam.frontend.features import FeatureSpec as FeatureSpec
from jaxslam.frontend.features import features_from_range_bearing as features_from_range_bearing
from jaxslam.frontend.grid import Grid as Grid
from jaxslam.frontend.grid import GridSpec as GridSpec
from jaxslam.frontend.grid import rasterise as rasterise
from jaxslam.frontend.lidar import beam_angles as beam_angles
from jaxslam.frontend.lidar import beam_ends as beam_ends
from jaxslam.frontend.lidar import to_scan as to_scan
from jaxslam.frontend.local_graph import LocalArcs as LocalArcs
from jaxslam.frontend.segmentation import find_segments as find_segments
from jaxslam.frontend.segments import Segments as Segments
from jaxslam.frontend.segments import SegmentSpec as SegmentSpec
from jaxslam.frontend.tiled_automaton import expand_tiled as expand_tiled
from jaxslam.frontend.voronoi import branch_cells as branch_cells
from jaxslam.frontend.voronoi import junction_cells as junction_cells
