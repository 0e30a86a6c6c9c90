"""Simulated worlds, robots, scans and drives, and Monte-Carlo trials of them."""

from jaxslam.simulation.buildings import building as building
from jaxslam.simulation.drives import drive as drive
from jaxslam.simulation.drives import num_scans_of_drive as num_scans_of_drive
from jaxslam.simulation.drives import simulate_scans as simulate_scans
from jaxslam.simulation.floor_plans import floor_plan as floor_plan
from jaxslam.simulation.path_following import densify as densify
from jaxslam.simulation.path_following import pure_pursuit as pure_pursuit
from jaxslam.simulation.patrols import patrol as patrol
from jaxslam.simulation.patrols import route as route
from jaxslam.simulation.ray_casting import add_range_noise as add_range_noise
from jaxslam.simulation.ray_casting import cast as cast
from jaxslam.simulation.robot import Robot as Robot
from jaxslam.simulation.trials import replay_trial as replay_trial
from jaxslam.simulation.trials import run_trials as run_trials
from jaxslam.simulation.trials import simulate_episodes as simulate_episodes
from jaxslam.simulation.trials import simulate_keys as simulate_keys
from jaxslam.simulation.trials import trial_keys as trial_keys
from jaxslam.simulation.worlds import World as World
from jaxslam.simulation.worlds import named as named
from jaxslam.simulation.worlds import scan_poses as scan_poses
from jaxslam.simulation.worlds import waypoints as waypoints
