"""Variants of a study, made of its settings."""

from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxslam.cli.log_options import read_params
from jaxslam.cli.options import name_errors
from jaxslam.cli.world_options import Building, read_building
from jaxslam.core.types import JUNCTION
from jaxslam.filtering.noise import NoiseParams
from jaxslam.frontend.config import FrontendConfig
from jaxslam.io import robot_file
from jaxslam.io.errors import InputError
from jaxslam.pipeline.config import Config
from jaxslam.simulation import buildings, drives, kinematics, scanner_presets
from jaxslam.simulation.arguments import as_robot
from jaxslam.simulation.life import Life, life_in
from jaxslam.simulation.robot import Robot
from jaxslam.study.runner import Variant
from jaxslam.study.study_file import LIFE, PARTS, Settings, StudyFile, files_of

OF_ROBOT = (
    *("max_speed", "max_turn_rate", "encoder_noise", "scan_period"),
    *("time_offset", "wheel_base_scale"),
)
"""Settings that are fields of `Robot`."""


class Prepared(NamedTuple):
    """Variants of a study, and what was assumed for them.

    Attributes:
        variants: In the order of the study.
        notes: One line each.
    """

    variants: tuple[Variant, ...]
    notes: tuple[str, ...]


def prepare(study: StudyFile) -> Prepared:
    """The variants of a study; all that they name is read and checked.

    Raises:
        InputError: A file, a name or a number of a variant is not possible; the message names it.
    """
    notes: dict[str, None] = {}
    found = []
    slots = max(int(np.ceil(own.get("life.people", 0))) for _, own in study.variants)
    for name, settings in study.variants:
        with name_errors(f"{study.path}: {name}"):
            own = {key: settings[key] for key in study.varied if key in settings}
            given = files_of(settings, study.path.parent)
            found.append(_variant(name, own, given, slots, notes))
    return Prepared(tuple(found), tuple(notes))


def _variant(
    name: str, shown: Settings, given: Settings, slots: int, notes: dict[str, None]
) -> Variant:
    """The variant with some settings; adds to the notes."""
    place = tuple(given.get(key) for key in ("world", "path", "drive", "resolution", "unit"))
    building = _building(*place)
    robot, config = _robot(given, notes)
    notes |= dict.fromkeys(building.notes)
    if given.get("landmarks") == "junctions":
        config = config._replace(filter=config.filter._replace(landmark_kinds=(JUNCTION,)))
    if "max_landmarks" in given:
        config = config._replace(
            filter=config.filter._replace(max_landmarks=given["max_landmarks"])
        )
    path = np.asarray(building.path)
    return Variant(
        name,
        shown,
        config,
        _params(given, robot),
        robot,
        building.world,
        path,
        _num_scans(robot, path.tobytes(), str(path.dtype)),
        _life(given, building, slots),
    )


@lru_cache(maxsize=16)
def _building(
    world: str | None,
    path: str | None,
    drive: str | None,
    resolution: float | None,
    unit: str | None,
) -> Building:
    file = None if path is None else Path(path)
    return read_building(world or "office", file, drive=drive, resolution=resolution, unit=unit)


@lru_cache(maxsize=256)
def _num_scans(robot: Robot, path: bytes, dtype: str) -> int:
    return drives.num_scans_of_drive(robot, np.frombuffer(path, dtype).reshape(-1, 2))


def _robot(given: Settings, notes: dict[str, None]) -> tuple[Robot, Config]:
    """The robot of some settings, and the configuration for its scanner."""
    config = Config(frontend=FrontendConfig(labels=given.get("labels", "segments")))
    robot, lidar = Robot(), config.frontend.lidar
    if "robot" in given:
        read = robot_file.read(given["robot"])
        robot = read.robot
        notes |= dict.fromkeys(read.notes)
    if "scanner" in given:
        scanner = scanner_presets.preset(given["scanner"])
        robot = robot._replace(scanner=scanner, scan_period=1.0 / scanner.scan_rate)
        notes |= dict.fromkeys(f"{scanner.name}: {note}" for note in scanner.assumptions())
    robot = as_robot(robot._replace(**{k: given[k] for k in OF_ROBOT if k in given}))
    if robot.scanner is not None:
        lidar = robot.scanner.lidar()
    return robot, Config.for_lidar(lidar, frontend=config.frontend, filter=config.filter)


def _params(given: Settings, robot: Robot) -> NoiseParams:
    """Q and R that the filter assumes."""
    file = given.get("noise")
    params = read_params(None if file is None else Path(file), kinematics.noise_params(robot))
    q, r = (given.get(key, 1.0) for key in ("odometry_factor", "sensor_factor"))
    if not (q > 0.0 and r > 0.0):
        raise InputError("odometry_factor and sensor_factor are above 0")
    changed: dict[str, Any] = {"odometry_coefficients": params.odometry_coefficients * q}
    if params.odometry_cov_rate is not None:
        changed["odometry_cov_rate"] = params.odometry_cov_rate * q**2
    for key in ("range_std", "bearing_std", "feature_std_scale", "wall_angle_std"):
        changed[key] = getattr(params, key) * r
    changed = {key: jnp.asarray(x) for key, x in changed.items()}
    return params._replace(**changed)


def _life(given: Settings, building: Building, slots: int) -> Life | None:
    """What goes wrong; None where no setting of it is there, so that nothing of it is computed."""
    if not any(key in given for key in LIFE) and not slots:
        return None
    parts = {
        part: record(**{f: given[f"life.{f}"] for f in record._fields if f"life.{f}" in given})
        for part, record in PARTS.items()
    }
    if "life.moved_at" in given:
        raise InputError("life.moved_at needs furniture, which a study does not name yet")
    world = str(given.get("world", "office"))
    doors = doors_of(world) if parts["traffic"].closed else None
    return life_in(building.world, building.path, max_people=slots, doors=doors, **parts)


def doors_of(world: str) -> np.ndarray:
    """Closed doors (D, 4) [m] of a random building: lines in the middle of its walls.

    Raises:
        InputError: The doors of this world are not known.
    """
    if not world.startswith(buildings.PREFIX):
        raise InputError(f"life.closed needs doors, and those of {world} are not known")
    boxes = np.asarray(buildings.named_building(world).doors, float)
    middle = (boxes[:, :2] + boxes[:, 2:]) / 2
    half = (boxes[:, 2:] - boxes[:, :2]) / 2
    along = np.where((half[:, 0] >= half[:, 1])[:, None], half * [1, 0], half * [0, 1])
    return np.hstack([middle - along, middle + along])
