"""The arrays of a map file: names, dtypes, shapes, what must hold of their values.

The name of an array is that of the field in `SavedMap`: `times`, `belief.mean`. Four fields are
stored otherwise, so that the file is small and holds nothing that could contradict itself:

| field | arrays |
|---|---|
| `scans` | `scans.ranges` (K, R) float32 [m], 0 where nothing was hit |
| `belief.map_cov` | the upper triangle, row by row |
| `topological_map.arc_lines`, `.frontiers` | points of all polylines, and how many each has |

Letters are those of `SavedMap`; U numbers are in the upper triangle of (2 L, 2 L). The topological
map has N nodes, E arcs of P points in all, and F frontiers of Q points in all; G is F and B is E,
or they are 0.
"""

from collections.abc import Callable, Iterator, Mapping
from os import PathLike
from typing import Any, NamedTuple

import numpy as np

from jaxslam.core.maps import TopologicalMap
from jaxslam.core.scan import Lidar, Scan, check_lidar
from jaxslam.core.types import CORNER, JUNCTION, WALL, check_array
from jaxslam.filtering.belief import Belief
from jaxslam.filtering.heteroscedastic import WEIGHTS
from jaxslam.filtering.noise import NoiseParams
from jaxslam.frontend.arc_tracing import POLYLINE_POINTS
from jaxslam.io import noise_file
from jaxslam.io.errors import InputError
from jaxslam.mapping.arc_table import ArcTable
from jaxslam.mapping.saved_map import SavedMap

Arrays = Mapping[str, np.ndarray]

# "float" is float32 or float64, the same in all of a record.
LAYOUT: Mapping[str, tuple[str, tuple[int | str, ...]]] = {
    "lidar.num_beams": ("int64", ()),
    "lidar.angle_min": ("float64", ()),
    "lidar.angle_increment": ("float64", ()),
    "lidar.range_max": ("float64", ()),
    "lidar.range_std": ("float64", ()),
    "params.odometry_coefficients": ("float", (4,)),
    "params.range_std": ("float", ()),
    "params.bearing_std": ("float", ()),
    "params.feature_std_scale": ("float", ()),
    "params.wall_angle_std": ("float", ()),
    "params.scan_match_std_scale": ("float", ()),
    **{f"params.{key}": ("float", shape) for key, shape in noise_file.OPTIONAL.items()},
    "times": ("float64", ("K",)),
    "poses": ("float64", ("K", 3)),
    "pose_cov": ("float32", ("K", 3, 3)),
    "scans.ranges": ("float32", ("K", "R")),
    "belief.id": ("int32", ("L",)),
    "belief.kind": ("int32", ("L",)),
    "belief.mean": ("float", ("3 + 2 L",)),
    "belief.first_estimate": ("float", ("3 + 2 L",)),
    "belief.pose_cov": ("float", (3, 3)),
    "belief.cross_cov": ("float", (3, "2 L")),
    "belief.map_cov": ("float", ("U",)),
    "belief.num_seen": ("int32", ("L",)),
    "belief.last_seen": ("int32", ("L",)),
    "belief.num_missed": ("int32", ("L",)),
    "belief.num_pending": ("int32", ("L",)),
    "belief.direction": ("float", ("L",)),
    "belief.descriptor": ("float", ("L",)),
    "belief.step": ("int32", ()),
    "belief.next_id": ("int32", ()),
    "arcs.ends": ("int32", ("A", 2)),
    "arcs.polyline": ("float", ("A", POLYLINE_POINTS, 2)),
    "arcs.length": ("float", ("A",)),
    "arcs.clearance": ("float", ("A",)),
    "arcs.num_seen": ("int32", ("A",)),
    "topological_map.id": ("int64", ("N",)),
    "topological_map.xy": ("float64", ("N", 2)),
    "topological_map.kind": ("int64", ("N",)),
    "topological_map.clearance": ("float64", ("N",)),
    "topological_map.arc_ends": ("int64", ("E", 2)),
    "topological_map.arc_length": ("float64", ("E",)),
    "topological_map.arc_clearance": ("float64", ("E",)),
    "topological_map.arc_lines.size": ("int64", ("E",)),
    "topological_map.arc_lines.points": ("float64", ("P", 2)),
    "topological_map.arc_filled": ("bool", ("B",)),
    "topological_map.frontiers.size": ("int64", ("F",)),
    "topological_map.frontiers.points": ("float64", ("Q", 2)),
    "topological_map.frontier_node": ("int64", ("F",)),
    "topological_map.frontier_id": ("int64", ("G",)),
}
OPTIONAL = (
    "params.scan_match_std_scale",
    *(f"params.{key}" for key in noise_file.OPTIONAL),
    "topological_map.arc_filled",
    "topological_map.frontier_id",
)
_UNMEASURED = ("topological_map.arc_clearance",)  # NaN where an arc was driven, not observed

_DERIVED: Mapping[str, Callable[[int], int]] = {
    "3 + 2 L": lambda count: 3 + 2 * count,
    "2 L": lambda count: 2 * count,
    "U": lambda count: count * (2 * count + 1),
}


def pack(saved: SavedMap) -> dict[str, np.ndarray]:
    """The arrays of a map, not checked; ValueError if the covariance is no square matrix.

    Parameters of a noise model of one's own are left out: a file does not have the model.
    """
    hit, graph = np.asarray(saved.scans.hit), saved.topological_map
    cov = np.asarray(saved.belief.map_cov)
    check_array("belief.map_cov", cov, (len(cov), len(cov)))
    lidar = Lidar(int(saved.lidar.num_beams), *map(float, saved.lidar[1:]))
    ranges = np.where(hit, saved.scans.ranges, np.float32(0.0))
    arrays = {name: np.asarray(getattr(saved, name)) for name in ("times", "poses", "pose_cov")}
    arrays |= (
        {"scans.ranges": ranges}
        | _fields("lidar", lidar)
        | _fields("params", saved.params._replace(custom=None))
    )
    arrays |= _fields("belief", saved.belief._replace(map_cov=cov[_upper(len(cov))]))
    arrays |= _fields("arcs", saved.arcs)
    rest = {k: v for k, v in graph._asdict().items() if k not in ("arc_lines", "frontiers")}
    arrays |= {f"topological_map.{name}": np.asarray(value) for name, value in rest.items()}
    for name, lines in (("arc_lines", graph.arc_lines), ("frontiers", graph.frontiers)):
        points = np.concatenate([np.zeros((0, 2)), *lines])
        arrays[f"topological_map.{name}.size"] = np.array([len(line) for line in lines], np.int64)
        arrays[f"topological_map.{name}.points"] = points
    return arrays


def unpack(arrays: Arrays) -> SavedMap:
    """The map of arrays that `check` accepts."""
    ranges, hit = arrays["scans.ranges"], arrays["scans.ranges"] > 0.0
    lidar = Lidar(*(arrays[f"lidar.{name}"].item() for name in Lidar._fields))
    triangle, size = arrays["belief.map_cov"], 2 * len(arrays["belief.id"])
    cov = np.zeros((size, size), triangle.dtype)
    cov[_upper(size)] = triangle
    cov += np.triu(cov, 1).T
    graph = {
        name: arrays[f"topological_map.{name}"]
        for name in TopologicalMap._fields
        if f"topological_map.{name}" in arrays
    }
    return SavedMap(
        lidar=lidar,
        params=_params(arrays),
        times=arrays["times"],
        poses=arrays["poses"],
        pose_cov=arrays["pose_cov"],
        scans=Scan._make((np.where(hit, ranges, np.float32(lidar.range_max)), hit)),
        belief=_record("belief", Belief, {**arrays, "belief.map_cov": cov}),
        arcs=_record("arcs", ArcTable, arrays),
        topological_map=TopologicalMap(
            arc_lines=_polylines("arc_lines", arrays),
            frontiers=_polylines("frontiers", arrays),
            **graph,
        ),
    )


def check(path: str | PathLike, arrays: Arrays, advice: str) -> None:
    """Raise InputError unless the arrays, of which none is missing, are those of a map.

    Args:
        path: Their file, for the message.
        arrays: By name.
        advice: Ends the message.
    """
    dtypes: dict[str, str] = {}
    sizes = {"R": _num_beams(path, arrays, advice)}
    for name, (kind, shape) in LAYOUT.items():
        if name not in arrays:
            continue
        array, wanted_dtype = arrays[name], kind
        if kind == "float":
            wanted_dtype = dtypes.setdefault(name.partition(".")[0], _precision(array))
        # Where the array has too few axes, a letter stands for itself: it differs anyhow.
        actual = (*array.shape, *shape[array.ndim :])
        wanted = tuple(_size(*pair, sizes) for pair in zip(shape, actual, strict=False))
        if str(array.dtype) != wanted_dtype or array.shape != wanted:
            problem = f"is {array.dtype} {array.shape}, not {wanted_dtype} {wanted}"
            raise InputError(problem, path=path, field=name, advice=advice)
        if name not in _UNMEASURED and not np.isfinite(array).all():
            raise InputError("holds NaN or infinity", path=path, field=name, advice=advice)
    for name, holds, problem in _rules(arrays):
        if not holds:
            raise InputError(problem, path=path, field=name, advice=advice)


def _num_beams(path: str | PathLike, arrays: Arrays, advice: str) -> int:
    """R; raise InputError unless the scanner is possible."""
    numbers = [arrays[f"lidar.{name}"] for name in Lidar._fields]
    for name, number in zip(Lidar._fields, numbers, strict=True):
        if number.shape or number.dtype.kind not in "fi":
            problem = f"is {number.dtype} {number.shape}, not a number"
            raise InputError(problem, path=path, field=f"lidar.{name}", advice=advice)
    lidar = Lidar(*(number.item() for number in numbers))
    try:
        check_lidar(lidar)
    except ValueError as error:
        raise InputError(str(error), path=path, advice=advice) from None
    return lidar.num_beams


def _precision(array: np.ndarray) -> str:
    """The dtype that the floats of a record must have, of which this array is the first."""
    return "float32" if array.dtype == np.float32 else "float64"


def _size(symbol: int | str, actual: Any, sizes: dict[str, int]) -> int:
    """A size of a shape; a letter stands for what it was when it first came up."""
    if isinstance(symbol, int):
        return symbol
    if symbol in _DERIVED:
        return _DERIVED[symbol](sizes["L"])
    return sizes.setdefault(symbol, actual)


def _rules(arrays: Arrays) -> Iterator[tuple[str, Any, str]]:
    """Name of an array, whether its values are possible, and what is wrong if they are not."""
    yield "times", arrays["times"].size > 0, "is empty: a map has at least one keyframe"
    ranges = arrays["scans.ranges"]
    reach = np.float32(arrays["lidar.range_max"])
    yield "scans.ranges", ((ranges >= 0.0) & (ranges <= reach)).all(), "is not in [0, range_max]"
    for name in noise_file.KEYS:
        value = arrays.get(f"params.{name}", np.zeros(()))
        yield f"params.{name}", (value >= 0.0).all(), "a standard deviation is below 0"
    ids = arrays["belief.id"]
    yield "belief.id", len(np.unique(ids)) == len(ids), "an id occurs twice"
    known = ((ids >= 0) & (ids < arrays["belief.next_id"])).all()
    yield "belief.id", known, "an id is negative, or not below belief.next_id"
    kinds = np.isin(arrays["belief.kind"], (JUNCTION, CORNER, WALL)).all()
    yield "belief.kind", kinds, "is none of the kinds of landmark"
    yield "belief.num_seen", (arrays["belief.num_seen"] > 0).all(), "a slot is free"
    yield "arcs.num_seen", (arrays["arcs.num_seen"] > 0).all(), "a slot is free"
    ends = arrays["arcs.ends"]
    yield "arcs.ends", (ends >= [0, -1]).all(), "is no pair of landmark ids"
    nodes = arrays["topological_map.id"]
    own = np.concatenate([nodes, arrays.get("topological_map.frontier_id", nodes[:0])])
    yield "topological_map.id", len(np.unique(own)) == len(own), "an id occurs twice"
    known = ((own >= 0) & (own < arrays["belief.next_id"])).all()
    yield "topological_map.id", known, "an id is negative, or not below belief.next_id"
    kinds = np.isin(arrays["topological_map.kind"], (JUNCTION, CORNER)).all()
    yield "topological_map.kind", kinds, "is none of the kinds of node"
    for name in ("topological_map.arc_ends", "topological_map.frontier_node"):
        index = arrays[name]
        yield name, ((index >= 0) & (index < len(nodes))).all(), "is no index of a node"
    for part, whole in (("arc_filled", "arc_length"), ("frontier_id", "frontier_node")):
        name, wanted = f"topological_map.{part}", len(arrays[f"topological_map.{whole}"])
        given = len(arrays.get(name, ()))
        yield name, given in (0, wanted), f"has {given} entries, not {wanted} or none"
    for name in ("topological_map.arc_lines", "topological_map.frontiers"):
        size, points = arrays[f"{name}.size"], arrays[f"{name}.points"]
        fits = ((size >= 2) & (size <= len(points))).all() and size.sum() == len(points)
        yield f"{name}.size", fits, f"does not share out {len(points)} points, 2 or more to each"


def _fields(prefix: str, record: NamedTuple) -> dict[str, np.ndarray]:
    """The fields of a record as arrays, without those that are None."""
    found: dict[str, np.ndarray] = {}
    for name, value in record._asdict().items():
        if hasattr(value, "_asdict"):
            found |= _fields(f"{prefix}.{name}", value)
        elif value is not None:
            found[f"{prefix}.{name}"] = np.asarray(value)
    return found


def _record(prefix: str, kind: Any, arrays: Arrays) -> Any:
    """A record made of its fields, None where there is none."""
    return kind._make(arrays.get(f"{prefix}.{name}") for name in kind._fields)


def _params(arrays: Arrays) -> NoiseParams:
    """Noise parameters; a record of weights where there are some of it."""
    params = _record("params", NoiseParams, arrays)
    for field, kind in WEIGHTS.items():
        if any(name.startswith(f"params.{field}.") for name in arrays):
            params = params._replace(**{field: _record(f"params.{field}", kind, arrays)})
    return params


def _polylines(name: str, arrays: Arrays) -> tuple[np.ndarray, ...]:
    """Polylines (n, 2) [m] from all their points."""
    size, points = (arrays[f"topological_map.{name}.{part}"] for part in ("size", "points"))
    return tuple(np.split(points, np.cumsum(size)[:-1])) if len(size) else ()


def _upper(size: int) -> np.ndarray:
    """The upper triangle (size, size) of a matrix, bool, with its diagonal."""
    return np.tri(size, dtype=bool).T
