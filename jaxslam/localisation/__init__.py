"""Where a robot is in a map that was made before; see README.md."""

from jaxslam.localisation.config import LocaliseInfo as LocaliseInfo
from jaxslam.localisation.config import LocaliseSpec as LocaliseSpec
from jaxslam.localisation.config import LocaliseState as LocaliseState
from jaxslam.localisation.config import PlaceMap as PlaceMap
from jaxslam.localisation.localise import init as init
from jaxslam.localisation.localise import make_map as make_map
from jaxslam.localisation.localise import map_of_scans as map_of_scans
from jaxslam.localisation.localise import run_steps as run_steps
from jaxslam.localisation.localise import step as step
