"""Variants of a study, made of its settings."""

from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxslam.cli.life_options import (
    MATCHED,
    LivingWorld,
    check_moved_at,
    leaving,
    leaving_note,
    life_of,
)
from jaxslam.cli.log_options import read_params
from jaxslam.cli.options import name_errors
from jaxslam.cli.world_options import Building, read_building
from jaxslam.core.scan import Lidar
from jaxslam.core.types import JUNCTION
from jaxslam.filtering.noise import NoiseParams
from jaxslam.frontend.config import FrontendConfig
from jaxslam.io import life_file, robot_file
from jaxslam.io.errors import InputError
from jaxslam.pipeline.config import Config
from jaxslam.simulation import drives, kinematics, scanner_presets
from jaxslam.simulation.arguments import as_robot
from jaxslam.simulation.ray_casting import Leaving
from jaxslam.simulation.robot import Robot
from jaxslam.simulation.wheel_faults import can_fail
from jaxslam.simulation.worlds import World
from jaxslam.study.runner import Variant, fingerprint
from jaxslam.study.settings import LIFE, Settings, files_of, with_life
from jaxslam.study.study_file import StudyFile, same_variants

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
        InputError: A file, a name or a number of a variant is not possible, or contradicts another
            one; or two variants are the same; the message names them.
    """
    notes: dict[str, None] = {}
    found: dict[str, Variant] = {}
    alike: dict[str, str] = {}
    given = [with_life(one.settings, study.path.parent) for one in study.variants]
    _check_used(study.path, given)
    slots = 0
    for (name, *_), own in zip(study.variants, given, strict=True):
        with name_errors(f"{study.path}: {name}"):
            files = files_of(own, study.path.parent)
            place = _place(files, _robot(files, {})[0])
            slots = max(slots, life_file.number_of_people(_life_in(own), _building(*place).path))
    # All of them draw the same random numbers then, and run the same program.
    lives = any(key in LIFE for own in given for key in own)
    fails = any(can_fail(life_file.parts(_life_in(own))["wheels"]) for own in given)
    if fails and not all("odometry" in own for own in given):
        notes[f"scans are matched: {MATCHED}"] = None
    for (name, settings, cost), all_of_it in zip(study.variants, given, strict=True):
        with name_errors(f"{study.path}: {name}"):
            own = {key: settings[key] for key in study.varied if key in settings}
            files = files_of(
                {"odometry": "scan" if fails else "wheels"} | all_of_it, study.path.parent
            )
            variant = _variant(
                name, own, files, slots if lives else None, study.seed, notes
            )._replace(cost=cost)
        mark = fingerprint(variant, study.seed)
        if mark in found:  # though their settings differ, as of a value that is the default
            raise same_variants(study.path, found[mark].name, name)
        found[mark] = variant
        without = {f"life.{key}" for key in life_file.silent(_life_in(all_of_it))}
        text = repr(sorted((k, x) for k, x in all_of_it.items() if k not in without))
        other = alike.setdefault(text, name)
        if other != name:
            note = f"{other!r} and {name!r} have the same trials: what they differ in says nothing"
            notes[note] = None
    return Prepared(tuple(found.values()), tuple(notes))


def _variant(
    name: str,
    shown: Settings,
    given: Settings,
    slots: int | None,
    seed: int,
    notes: dict[str, None],
) -> Variant:
    """The variant with some settings; adds to the notes. Without slots nothing goes wrong."""
    robot, config = _robot(given, notes)
    place = _place(given, robot)
    building = _building(*place)
    notes |= dict.fromkeys(building.notes)
    if given.get("landmarks") == "junctions":
        config = config._replace(filter=config.filter._replace(landmark_kinds=(JUNCTION,)))
    if "max_landmarks" in given:
        config = config._replace(
            filter=config.filter._replace(max_landmarks=given["max_landmarks"])
        )
    world, life = building.world, None
    wrong = _life_in(given)
    if slots is not None:
        living = _living(place, tuple(wrong.items()), slots, seed)
        world, life = living.world, living.life
        notes |= dict.fromkeys([f"{name}: life: {living.note}"] if wrong else [])
    match_scans = given["odometry"] == "scan"
    lidar, path = config.frontend.lidar, np.asarray(building.path)
    driven = path.tobytes(), str(path.dtype)
    num_scans = _num_scans(robot, np.asarray(building.world.walls, float).tobytes(), *driven)
    check_moved_at(life, robot, num_scans)
    found = _leaving(lidar, np.asarray(world.walls, float).tobytes(), robot, *driven)
    if found.beyond_range:
        about = robot.scanner.name if robot.scanner else "the default scanner"
        said = leaving_note(found, lidar.range_max)
        notes |= dict.fromkeys([f"{building.name}, {about}: {said}"])
    return Variant(
        name,
        shown,
        config,
        _params(given, robot, building.world, match_scans=match_scans),
        robot,
        world,
        path,
        num_scans,
        life,
        match_scans=match_scans,
    )


def _place(given: Settings, robot: Robot) -> tuple:
    """What names a building and a drive in it: settings, and the radius of the robot."""
    names = ("world", "path", "drive", "resolution", "unit", "layers")
    return *(given.get(key) for key in names), robot.radius


def _life_in(given: Settings) -> dict[str, float]:
    """What goes wrong, by the keys of `life_file`."""
    return {LIFE[key]: x for key, x in given.items() if key in LIFE}


@lru_cache(maxsize=16)
def _building(
    world: str | None,
    path: str | None,
    drive: str | None,
    resolution: float | None,
    unit: str | None,
    layers: str | None,
    robot_radius: float,
) -> Building:
    file = None if path is None else Path(path)
    options: dict[str, Any] = {"drive": drive, "resolution": resolution, "unit": unit}
    options["layers"] = tuple(x.strip() for x in (layers or "").split(",") if x.strip())
    return read_building(world or "office", file, **options, robot_radius=robot_radius)


@lru_cache(maxsize=256)
def _num_scans(robot: Robot, walls: bytes, path: bytes, dtype: str) -> int:
    world = World(np.frombuffer(walls).reshape(-1, 4))
    return drives.num_scans_of_drive(robot, np.frombuffer(path, dtype).reshape(-1, 2), world)


@lru_cache(maxsize=64)
def _living(
    place: tuple, wrong: tuple[tuple[str, float], ...], slots: int, seed: int
) -> LivingWorld:
    return life_of(_building(*place), dict(wrong), slots=slots, seed=seed)


@lru_cache(maxsize=256)
def _leaving(lidar: Lidar, walls: bytes, robot: Robot, path: bytes, dtype: str) -> Leaving:
    world = World(jnp.asarray(np.frombuffer(walls).reshape(-1, 4), float))
    return leaving(lidar, world, robot, np.frombuffer(path, dtype).reshape(-1, 2))


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
    if robot.kinematics == "holonomic" and "encoder_noise" in given:
        raise InputError("encoder_noise says nothing of a robot that is holonomic")
    robot = as_robot(robot._replace(**{k: given[k] for k in OF_ROBOT if k in given}))
    if robot.scanner is not None and robot.scan_period * robot.scanner.scan_rate < 1.0 - 1e-6:
        raise InputError(
            f"scan_period is {robot.scan_period:g} s, and {robot.scanner.name} scans every "
            f"{1.0 / robot.scanner.scan_rate:g} s; give at least that"
        )
    if robot.scanner is not None:
        lidar = robot.scanner.lidar()
    return robot, Config.for_lidar(lidar, frontend=config.frontend, filter=config.filter)


def _params(given: Settings, robot: Robot, world: World, *, match_scans: bool) -> NoiseParams:
    """Q and R that the filter assumes."""
    file = given.get("noise")
    default = kinematics.noise_params(robot, world, match_scans=match_scans)
    params = read_params(None if file is None else Path(file), default)
    q, r = (given.get(key, 1.0) for key in ("odometry_factor", "sensor_factor"))
    changed: dict[str, Any] = {"odometry_coefficients": params.odometry_coefficients * q}
    if params.odometry_cov_rate is not None:
        changed["odometry_cov_rate"] = params.odometry_cov_rate * q**2
    for key in ("range_std", "bearing_std", "feature_std_scale", "wall_angle_std"):
        changed[key] = getattr(params, key) * r
    changed = {key: jnp.asarray(x) for key, x in changed.items()}
    return params._replace(**changed)


def _check_used(path: Path, given: list[Settings]) -> None:
    """Raise InputError if a setting of what goes wrong says nothing in any variant."""
    wrong = life_file.unused(map(_life_in, given), "life.")
    if wrong is not None:
        key, problem, advice = wrong
        raise InputError(problem, path=path, field=f"life.{key}", advice=advice)
