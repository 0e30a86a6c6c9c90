"""The main programs of the library, with their arguments, as users run them by default.

Each is built when it is asked for, and nothing of it is compiled: arguments that a program would
have to compute are shapes alone.
"""

from collections.abc import Callable
from functools import cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam.core.episode import Episode, measurements_of
from jaxslam.core.features import Features
from jaxslam.core.measurement import Measurement
from jaxslam.core.scan import Scan
from jaxslam.filtering import slam_filter
from jaxslam.filtering.belief import Belief
from jaxslam.filtering.config import init
from jaxslam.filtering.noise import NoiseParams
from jaxslam.frontend import automaton, extract
from jaxslam.frontend.config import FrontendConfig
from jaxslam.localisation import LocaliseSpec, localise
from jaxslam.localisation.config import PlaceMap
from jaxslam.matching import scan_matching
from jaxslam.matching.icp import ScanMatchSpec
from jaxslam.matching.place_index import PlaceIndex
from jaxslam.matching.place_views import views_of_map
from jaxslam.pipeline.config import Config
from jaxslam.simulation import kinematics, trial_episodes, trials
from jaxslam.simulation.life_defaults import typical_life
from jaxslam.smoothing.dense import smooth_trial
from jaxslam.smoothing.problem import LandmarkPrior, SmoothingProblem
from jaxslam.tuning import fitting, losses, parameters, transforms
from jaxslam.tuning.slam_model import slam_model

STEPS = 32  # scans of a drive; programs are loops over them
TRIALS = 4  # that are filtered together
CELLS, POSITIONS = (256, 256), 512  # of the map in which a robot is localised
LANDMARKS = 32  # of the trial that is smoothed


class Program(NamedTuple):
    """A program.

    Attributes:
        function: Of arrays, or records of them; not jitted.
        arguments: Arrays, or their shapes.
    """

    function: Callable[..., Any]
    arguments: tuple[Any, ...]


def shapes(function: Callable[..., Any], *arguments: Any, leading: tuple[int, ...] = ()) -> Any:
    """Shapes of the result of a function, after further leading axes."""
    return jax.tree.map(
        lambda x: jax.ShapeDtypeStruct((*leading, *x.shape), x.dtype),
        jax.eval_shape(function, *arguments),
    )


def real(*shape: int) -> jax.ShapeDtypeStruct:
    """Real numbers of a shape, in JAX's default precision."""
    return shapes(lambda: jnp.zeros(shape))


def scan_shapes(config: FrontendConfig) -> Scan:
    """Shapes of a scan."""
    beams = config.lidar.num_beams
    return Scan(real(beams), jax.ShapeDtypeStruct((beams,), bool))


def features_of(config: FrontendConfig, *leading: int) -> Features:
    """Shapes of the features of scans."""
    extracted = partial(extract.extract_features, config)
    return shapes(extracted, scan_shapes(config), leading=leading)


def trials_program(
    *, life: bool = False, num_trials: int = TRIALS, num_scans: int = STEPS
) -> Program:
    """Ray casting, front end and filter of trials in the office, as `jaxslam simulate` runs them.

    Args:
        life: Whether what recorded drives show on average goes wrong, as by `--life typical`; scans
            are then matched.
        num_trials: B, number of trials.
        num_scans: T, scans of a trial.
    """
    config, key = Config(), jax.random.key(0)
    robot = trial_episodes.ROBOT
    given = trial_episodes.drive_of(
        key, config, robot, "office", None, num_scans, None, match_scans=life
    )
    if life:
        given = given._replace(life=typical_life(given.world, np.asarray(given.path)))
    params = kinematics.noise_params(robot, given.world, match_scans=life)
    common = trials.TrialsCommon(
        jax.random.key_data(key), params, given.world, given.path, given.life
    )
    static = config.frontend, config.filter, robot, num_scans, jax.random.key_impl(key)
    function = partial(trials.filter_group, *static, given.matching, not life)
    return Program(function, (common, jax.ShapeDtypeStruct((num_trials,), jnp.int32)))


def frontend(labels: str) -> Program:
    """Features of a scan, with `segments` or `codes` as labels."""
    config = Config(frontend=FrontendConfig(labels=labels)).frontend
    return Program(partial(extract.extract_features, config), (scan_shapes(config),))


def automaton_of_scan() -> Program:
    """The automaton on the grid of a scan, as the front end runs it."""
    config = FrontendConfig()
    expand = partial(automaton.expand_encoded, steps=config.automaton_steps, octagon=True)
    return Program(expand, (jax.ShapeDtypeStruct(config.grid.shape, jnp.int8),))


def beginning(config: Config) -> Belief:
    """Shapes of the belief at the start of a drive."""
    return shapes(partial(init, config.filter), real(3))


def filter_step() -> Program:
    """A step of the filter of simulated trials."""
    config, params = Config(), NoiseParams.for_simulated_robot()
    measurement = Measurement(real(3), features_of(config.frontend))
    step = partial(slam_filter.step, config.filter)
    return Program(step, (params, beginning(config), measurement))


def drive_shapes(config: Config, num_scans: int = STEPS) -> Episode:
    """Shapes of a drive."""
    features = features_of(config.frontend, num_scans)
    return Episode(truth=real(num_scans, 3), odometry=real(num_scans, 3), features=features)


def run_filter() -> Program:
    """The filter over a drive."""
    config, params = Config(), NoiseParams.for_simulated_robot()
    run = partial(slam_filter.run_filter, config.filter)
    return Program(run, (params, beginning(config), measurements_of(drive_shapes(config))))


def gradient() -> Program:
    """The default loss of a drive, and its gradient in the noise of the filter, as `tune` runs."""
    config, params = Config(), NoiseParams.for_simulated_robot()
    given = transforms.of_leaves(params)
    theta = parameters.unconstrain(parameters.as_params(params), given)
    function = partial(fitting.value_and_gradient, slam_model(config), losses.pose_nll, given)
    return Program(function, (theta, drive_shapes(config)))


def match_scan() -> Program:
    """Scan matching of a scan."""
    spec, config = ScanMatchSpec(), FrontendConfig()
    submap = shapes(lambda: scan_matching.empty_submap(spec, config.lidar))
    match = partial(scan_matching.match_scan, spec, config.lidar)
    return Program(match, (submap, scan_shapes(config), real(3)))


def smoother_step() -> Program:
    """A step of the smoother of a trial."""
    capacity = FrontendConfig().features.max_features
    index = jax.ShapeDtypeStruct((STEPS, capacity), jnp.int32)
    prior = LandmarkPrior(real(LANDMARKS, 2), real(LANDMARKS, 2, 2))
    problem = SmoothingProblem(
        start=real(3),
        odometry=real(STEPS, 3),
        odometry_cov=real(STEPS, 3, 3),
        measurement=real(STEPS, capacity, 2),
        measurement_cov=real(STEPS, capacity, 2, 2),
        kind=index,
        landmark_index=index,
        prior=prior,
    )
    smooth = partial(smooth_trial, iterations=1)
    return Program(smooth, (problem, real(STEPS, 3), real(LANDMARKS, 2)))


def localise_step() -> Program:
    """A step of localisation in a saved map."""
    spec, config = LocaliseSpec(), FrontendConfig()
    places = PlaceIndex(
        origin=real(2),
        distance=real(*CELLS),
        normal=real(*CELLS, 2),
        offset=real(*CELLS),
        positions=real(POSITIONS, 2),
        views=shapes(partial(views_of_map, spec.place.cell), real(*CELLS), real(POSITIONS, 2)),
        valid=jax.ShapeDtypeStruct((POSITIONS,), bool),
    )
    place_map = PlaceMap(places, jax.ShapeDtypeStruct(CELLS, bool), real())
    state = shapes(lambda: localise.init(spec, config.lidar))
    step = partial(localise.step, spec, config.lidar)
    return Program(step, (place_map, state, scan_shapes(config), real(3)))


PROGRAMS: dict[str, Callable[[], Program]] = {
    "trials": trials_program,
    "trials, typical life": partial(trials_program, life=True),
    "front end, segments": partial(frontend, "segments"),
    "front end, codes": partial(frontend, "codes"),
    "automaton": automaton_of_scan,
    "filter step": filter_step,
    "run_filter": run_filter,
    "gradient of the loss": gradient,
    "scan matching": match_scan,
    "smoother step": smoother_step,
    "localisation step": localise_step,
}
"""What makes each program, by its name."""


def traced(name: str) -> jax.stages.Traced:
    """A main program, traced for a CPU in JAX's default precision; once for all who ask."""
    return _traced(name, jax.dtypes.canonicalize_dtype(float))


@cache
def _traced(name: str, precision: Any) -> jax.stages.Traced:
    del precision  # of the arguments that are made
    program = PROGRAMS[name]()
    with jax.default_device("cpu"):
        return jax.jit(program.function).trace(*program.arguments)
