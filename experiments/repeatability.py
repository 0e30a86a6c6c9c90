"""Repeatability of the landmarks of single scans, against noise, viewpoint and label mode.

Two viewpoints at most 1.5 m apart, of any heading, each give the landmarks of one noisy scan. A
landmark of the first is *checked* if it is visible from the second: a node if its whole circle is
in view, a corner if it is in sight and five beams, half a degree apart, hit both of its walls. It
*repeats* if a landmark of its kind lies within 0.2 m. It is *spurious* if the world has no junction
(no corner) within 0.15 m. Thinning is the result of scikit-image and sknw on the same scans, where
they are installed. A map of Willow Garage is used if it lies beside the repository.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial import cKDTree
from tqdm import tqdm

from experiments import common, thinning
from experiments.viewpoints import (
    AnyWorld,
    CellWorld,
    Viewpoints,
    WallWorld,
    rotate_cov,
    sample_viewpoints,
    transform_points,
    visible_circles,
    wrap_angle,
)
from jaxslam.core.batching import map_batches
from jaxslam.core.features import Features
from jaxslam.core.scan import Lidar, Scan
from jaxslam.core.types import JUNCTION, Key
from jaxslam.frontend import extract, lidar
from jaxslam.frontend.config import FrontendConfig
from jaxslam.io import ros_map
from jaxslam.io.errors import InputError
from jaxslam.simulation import floor_plans, ray_casting
from jaxslam.simulation.worlds import named

SHARED = Path(__file__).resolve().parents[1] / ".." / "shared" / "data"
WILLOW = SHARED / "maps" / "willow-full.yaml"  # not part of the project
RANGE_STDS = (0.0, 0.01, 0.03)  # [m]
MAX_DISTANCE = 1.5  # [m] between the viewpoints of a pair
MATCH_DISTANCE = 0.2  # [m] within which a landmark repeats
SPURIOUS_DISTANCE = 0.15  # [m] from the nearest true one
DISTANCES = (0.0, 0.5, 1.0, MAX_DISTANCE)  # [m] edges of bins
HEADINGS = (0.0, 60.0, 120.0, 180.0)  # [deg] edges of bins
LABEL_KEYS = common.LABEL_KEYS | {"thinning": "thinning"}

Worlds = dict[str, list[Viewpoints]]
Found = dict[str, list[tuple[Viewpoints, Features]]]


class Case(NamedTuple):
    """One front end and scanner for all viewpoints.

    Attributes:
        labels: `"segments"`, `"codes"` or `"thinning"`.
        range_std: [m] noise of a range.
        skip: 1 for every beam of the lidar, 2 for every second.
    """

    labels: str
    range_std: float
    skip: int = 1

    @property
    def config(self) -> FrontendConfig:
        """Configuration of the front end."""
        lidar = Lidar()
        lidar = lidar._replace(
            range_std=self.range_std,
            num_beams=(lidar.num_beams - 1) // self.skip + 1,
            angle_increment=lidar.angle_increment * self.skip,
        )
        default = FrontendConfig(lidar=lidar)
        return default if self.labels == "thinning" else default._replace(labels=self.labels)


DEFAULT, COARSE = Case("segments", 0.01), Case("segments", 0.01, skip=2)


@partial(jax.jit, static_argnames="config")
def _features(config: FrontendConfig, scans: Scan) -> Features:
    find = partial(extract.extract_features, config)
    return map_batches(find, scans, batch_size=extract.SCAN_BATCH)


def find_landmarks(key: Key, worlds: Worlds, case: Case) -> Found:
    """Landmarks of a noisy scan from each viewpoint; the same key gives the same noise."""
    views = [view for views in worlds.values() for view in views]
    scanner = case.config.lidar
    ranges = jnp.asarray(np.concatenate([view.ranges[:, :: case.skip] for view in views]), float)
    scans = ray_casting.add_range_noise(key, scanner, lidar.to_scan(scanner, ranges))
    find = thinning.landmarks if case.labels == "thinning" else _features
    found = jax.tree.map(np.asarray, find(case.config, scans))
    ends = np.cumsum([len(view.poses) for view in views])[:-1]
    parts = zip(*(np.split(field, ends) for field in found), strict=True)
    return {
        name: [(view, Features(*next(parts))) for view in views] for name, views in worlds.items()
    }


def check(config: FrontendConfig, view: Viewpoints, found: Features, kinds: dict[str, int]) -> dict:
    """Checks of the viewpoints of one world, by kind of landmark: lists and counts to be pooled."""
    world, poses, half = view.world, view.poses, len(view.poses) // 2
    xy, cov = transform_points(poses, found.xy), rotate_cov(poses, found.cov)
    has_cov = np.isfinite(cov).all(axis=(2, 3))
    inverse = np.linalg.pinv(np.where(has_cov[..., None, None], cov, 0.0))
    out = {}
    for name, kind in kinds.items():
        true = world.junctions if kind == JUNCTION else world.corners.xy
        valid = found.valid & (found.kind == kind)
        trusted = valid & found.trusted
        off, nearest = cKDTree(true).query(xy)
        error = xy - true[nearest]
        nees = np.einsum("nmi,nmij,nmj->nm", error, inverse, error) / 2
        checks, distances = 0, []
        halves = slice(0, half), slice(half, None)
        for a, b in (halves, halves[::-1]):
            checked = trusted[a].copy()
            if kind == JUNCTION:
                n, m = np.nonzero(checked)
                circles = xy[a][n, m], found.descriptor[a][n, m]
                visible = [visible_circles(config, world, poses[v][n], *circles) for v in (a, b)]
                checked[n, m] = visible[0] & visible[1]
            else:
                visible = view.corners[a] & view.corners[b]
                checked &= np.take_along_axis(visible, nearest[a], axis=1)
                checked &= off[a] < SPURIOUS_DISTANCE
            distance = np.hypot(*np.moveaxis(xy[a][:, :, None] - xy[b][:, None], -1, 0))
            distance = np.where(valid[b][:, None], distance, np.inf).min(axis=-1)
            checks += checked.sum()
            distances.append(distance[checked & (distance < MATCH_DISTANCE)])
        out[name] = {
            "checks": checks,
            "distances": np.concatenate(distances),
            "trusted": trusted.sum(),
            "scans": len(poses),
            "spurious": (trusted & (off >= SPURIOUS_DISTANCE)).sum(),
            "nees": nees[trusted & has_cov & (off < SPURIOUS_DISTANCE)],
            "error": off[trusted],
        }
    return out


def row(parts: list[dict]) -> common.Numbers:
    """Row of the table: checks of one kind of landmark, pooled over viewpoints."""
    checks, trusted, scans, spurious = (
        sum(part[field] for part in parts) for field in ("checks", "trusted", "scans", "spurious")
    )
    distances, nees, error = (
        np.concatenate([part[field] for part in parts]) for field in ("distances", "nees", "error")
    )
    return {
        "checks": int(checks),
        "repeatability": len(distances) / checks if checks else np.nan,
        "spurious": spurious / trusted if trusted else np.nan,
        "spread_m": float(np.median(distances)) if len(distances) else np.nan,
        "nees": float(np.mean(nees)) if len(nees) else np.nan,
        "error_m": float(np.median(error)) if len(error) else np.nan,
        "per_scan": trusted / scans if scans else np.nan,
    }


def all_pairs(view: Viewpoints) -> np.ndarray:
    """All pairs (N,) of viewpoints."""
    return np.ones(len(view.poses) // 2, bool)


def rows(
    found: Found, case: Case, pick: Callable[[Viewpoints], np.ndarray] = all_pairs
) -> list[common.Numbers]:
    """A row for each world and kind of landmark, of the pairs (N,) bool that `pick` returns."""
    result = []
    for name, views in found.items():
        world = views[0][0].world
        kinds = {"node": JUNCTION} if case.labels == "thinning" else world.kinds
        parts = []
        for view, features in views:
            use = pick(view)
            some = jax.tree.map(lambda field, use=use: field[np.tile(use, 2)], features)
            parts.append(check(case.config, view.take(use), some, kinds))
        for kind in kinds:
            head = {"world": name, "labels": LABEL_KEYS[case.labels], "noise_m": case.range_std}
            own = row([part[kind] for part in parts]) | {"truth": world.known_from}
            result.append(head | {"kind": kind} | own)
    return result


def distance(view: Viewpoints) -> np.ndarray:
    """Distance (N,) [m] between the viewpoints of pairs."""
    return np.hypot(*np.subtract(*np.split(view.poses[:, :2], 2)).T)


def heading_difference(view: Viewpoints) -> np.ndarray:
    """Difference of heading (N,) [deg] between the viewpoints of pairs."""
    return np.degrees(np.abs(wrap_angle(np.subtract(*np.split(view.poses[:, 2], 2)))))


def binned(
    found: Found, size: Callable[[Viewpoints], np.ndarray], edges: tuple[float, ...]
) -> list[common.Numbers]:
    """Rows of the default case for the pairs whose `size` (N,) lies in each bin."""

    def in_bin(view: Viewpoints, low: float, high: float) -> np.ndarray:
        return (low <= size(view)) & (size(view) < high)

    return [
        own | {"bin": [low, high]}
        for low, high in pairwise(edges)
        for own in rows(found, DEFAULT, partial(in_bin, low=low, high=high))
    ]


def sample_worlds(seed: int, plans: int, pairs: int) -> tuple[Worlds, dict[str, str]]:
    """Viewpoints in each world, and why a world is left out."""
    rng, config = np.random.default_rng(seed), DEFAULT.config

    def sample(world: AnyWorld, count: int) -> Viewpoints:
        return sample_viewpoints(config, world, rng, count, MAX_DISTANCE)

    keys = tqdm(jax.random.split(jax.random.key(seed), plans), unit="plan", leave=False)
    worlds = {
        "office": [sample(WallWorld(named("office").walls), 3 * pairs)],
        "floor plans": [sample(WallWorld(floor_plans.floor_plan(k).walls), pairs) for k in keys],
    }
    try:
        own = ros_map.read(WILLOW)
    except InputError as error:
        return worlds, {"willow": str(error)}
    willow = CellWorld(own.occupied, own.free, own.resolution)
    return worlds | {"willow": [sample(willow, 6 * pairs)]}, {}


def compute(seed: int, plans: int, pairs: int) -> common.Numbers:
    """Rows for all worlds, label modes and noises, and of the default case by pair and beams."""
    absent = thinning.missing()
    modes = ("segments", "codes") if absent else ("segments", "codes", "thinning")
    cases = [Case(labels, std) for labels in modes for std in RANGE_STDS] + [COARSE]
    worlds, left_out = sample_worlds(seed, plans, pairs)
    task = partial(find_landmarks, jax.random.key(seed), worlds)
    numbers = {
        "seed": seed,
        "plans": plans,
        "pairs": pairs,
        "apart_m": MAX_DISTANCE,
        "match_m": MATCH_DISTANCE,
        "spurious_beyond_m": SPURIOUS_DISTANCE,
        "not_installed": absent,
        "left_out": left_out,
        "rows": [],
        "by_step": [],
    }
    with ThreadPoolExecutor(2) as pool:  # XLA compiles one case on one core
        every = tqdm(pool.map(task, cases), total=len(cases), unit="case", leave=False)
        for case, found in zip(cases, every, strict=True):
            own = rows(found, case)
            numbers["rows"] += own if case.skip == 1 else []
            if case in (DEFAULT, COARSE):
                step = round(np.degrees(case.config.lidar.angle_increment), 3)
                numbers["by_step"] += [r | {"beam_step_deg": step} for r in own]
            if case == DEFAULT:
                numbers["by_distance"] = binned(found, distance, DISTANCES)
                numbers["by_heading"] = binned(found, heading_difference, HEADINGS)
    return numbers


STYLES = {  # of labels and kind of landmark
    ("segments", "node"): ("nodes, segments", "o-", common.BLUE),
    ("codes", "node"): ("nodes, edge codes", "s--", common.ORANGE),
    ("thinning", "node"): ("nodes, thinning", "^:", common.PINK),
    ("segments", "corner"): ("corners", "D-.", common.GREEN),
}


def draw(numbers: common.Numbers, path: Path) -> None:
    """Repeatability over noise in each world, then over distance, heading and beams."""
    figure, axes = common.canvas(9, 5.6, 2, 3)
    names = list(dict.fromkeys(r["world"] for r in numbers["rows"]))
    for axis, name in zip(axes[0], names, strict=False):
        table = [r for r in numbers["rows"] if r["world"] == name]
        _draw_lines(axis, table, lambda r: f"{100 * r['noise_m']:g}")
        axis.set(title=name, xlabel="range noise [cm]")
    for axis in axes[0, len(names) :]:
        axis.axis("off")
    for axis, key, label, column in (
        (axes[1, 0], "by_distance", "between viewpoints [m]", lambda r: _span(r["bin"])),
        (axes[1, 1], "by_heading", "between headings [deg]", lambda r: _span(r["bin"])),
        (axes[1, 2], "by_step", "between beams [deg]", lambda r: f"{r['beam_step_deg']:g}"),
    ):
        table = [r for r in numbers[key] if r["world"] == "floor plans"]
        _draw_lines(axis, table, column)
        axis.set(title="floor plans, 1 cm", xlabel=label)
    for axis in axes[:, 0]:
        axis.set_ylabel("repeat [%]")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=4)
    figure.savefig(path)


def _span(edges: list[float]) -> str:
    return f"{edges[0]:g} to {edges[1]:g}"


def _draw_lines(
    axis: Any, table: list[common.Numbers], column: Callable[[common.Numbers], str]
) -> None:
    """Repeatability of each mode and kind in a table, over what `column` returns of a row."""
    for (labels, kind), (name, style, colour) in STYLES.items():
        own = [r for r in table if (r["labels"], r["kind"]) == (LABEL_KEYS[labels], kind)]
        if not own:
            continue
        repeat = [np.nan if r["repeatability"] is None else r["repeatability"] for r in own]
        percent = 100 * np.array(repeat)
        axis.plot([column(r) for r in own], percent, style, color=colour, label=name, markersize=5)
    axis.set(ylim=(0, 103))
    axis.margins(x=0.1)
    axis.grid(alpha=0.3)


def main(argv: list[str] | None = None) -> None:
    """Run the experiment."""
    args = common.parse(__doc__, argv, plans=20, pairs=100)
    numbers = compute(args.seed, args.plans, args.pairs)
    common.save(args.out, "repeatability", numbers, draw)
    modes = {key: labels for labels, key in LABEL_KEYS.items()}
    for r in numbers["rows"]:
        print(
            f"{modes[r['labels']]:8} {r['world']:11} {r['kind']:6} {100 * r['noise_m']:.0f} cm: "
            f"repeat {100 * r['repeatability']:5.1f} % of {r['checks']:4}, "
            f"spurious {100 * r['spurious']:4.1f} %, distance {100 * r['spread_m']:4.1f} cm, "
            f"NEES per dof {r['nees']:5.2f}, {r['per_scan']:.2f} per scan"
        )
    for name in numbers["not_installed"]:
        print(f"{name} is not installed: without thinning")
    for name, why in numbers["left_out"].items():
        print(f"without {name}: {why}")


if __name__ == "__main__":
    main()
