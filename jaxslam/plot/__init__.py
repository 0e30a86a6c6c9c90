"""Plots of worlds, trajectories, maps, errors and local Voronoi diagrams, on given axes.

The only package of the library that imports matplotlib.
"""

from jaxslam.plot.charts import errors as errors
from jaxslam.plot.charts import losses as losses
from jaxslam.plot.charts import parameters as parameters
from jaxslam.plot.films import film as film
from jaxslam.plot.places import LINES as LINES
from jaxslam.plot.places import arcs as arcs
from jaxslam.plot.places import echoes as echoes
from jaxslam.plot.places import ellipses as ellipses
from jaxslam.plot.places import ends as ends
from jaxslam.plot.places import landmarks as landmarks
from jaxslam.plot.places import local as local
from jaxslam.plot.places import occupancy as occupancy
from jaxslam.plot.places import outline as outline
from jaxslam.plot.places import roads as roads
from jaxslam.plot.places import robot as robot
from jaxslam.plot.places import trajectory as trajectory
from jaxslam.plot.places import walls as walls
from jaxslam.plot.sheet import BLACK as BLACK
from jaxslam.plot.sheet import canvas as canvas
from jaxslam.plot.sheet import extent as extent
from jaxslam.plot.sheet import legend as legend
from jaxslam.plot.sheet import plan as plan
