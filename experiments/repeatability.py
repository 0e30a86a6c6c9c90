"""How repeatable the landmarks of single scans are, against noise, viewpoint and label mode.

Two viewpoints at most 1.5 m apart, of any heading, each give the landmarks of one noisy scan. A
landmark of the first *ought* to be seen from the second if it is visible there: a node if its
whole circle lies in view, a corner if it is in sight and five beams, half a degree apart, fall on
either of its walls. It *repeats* if a landmark of its kind lies within 0.2 m. It is *spurious* if
the world has no junction (no corner) within 0.15 m. Thinning is what scikit-image and sknw make of
the same scans, where they are installed; a map of Willow Garage is looked at if it lies beside the
repository.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial import cKDTree
from tqdm import tqdm

from experiments import common, thinning
from experiments.viewpoints import (
    Cells,
    Drawn,
    Scene,
    scene,
    to_world,
    turned,
    visible_circles,
)
from jaxslam.core.batching import map_batches
from jaxslam.core.features import Features
from jaxslam.core.scan import Lidar, Scan
from jaxslam.core.types import JUNCTION
from jaxslam.frontend import extract, lidar
from jaxslam.frontend.config import FrontendConfig
from jaxslam.io import ros_map
from jaxslam.io.errors import InputError
from jaxslam.pipeline.config import Config
from jaxslam.simulation import floor_plans, ray_casting
from jaxslam.simulation.worlds import named

SHARED = Path(__file__).resolve().parents[1] / ".." / "shared" / "data"
WILLOW = SHARED / "maps" / "willow-full.yaml"  # no part of the project
NOISES = (0.0, 0.01, 0.03)  # [m] of a range
APART = 1.5  # [m] between the viewpoints of a pair at most
MATCH = 0.2  # [m] within which a landmark repeats
SPURIOUS = 0.15  # [m] from the nearest true one
DISTANCES = (0.0, 0.5, 1.0, APART)  # [m] edges of bins
HEADINGS = (0.0, 60.0, 120.0, 180.0)  # [degrees] likewise

Worlds = dict[str, list[Scene]]
Seen = dict[str, list[tuple[Scene, Features]]]


class Case(NamedTuple):
    """One way to look at all scenes."""

    labels: str  # "runs", "codes" or "thinning"
    noise: float  # [m] of a range
    skip: int = 1  # every beam of the lidar, or every second

    @property
    def config(self) -> Config:
        """What the front end is given."""
        usual = Lidar()
        beams, step = (usual.num_beams - 1) // self.skip + 1, usual.angle_increment * self.skip
        own = usual._replace(range_std=self.noise, num_beams=beams, angle_increment=step)
        labels = Config().frontend.labels if self.labels == "thinning" else self.labels
        return Config.for_lidar(
            own,
            frontend=FrontendConfig(
                labels=labels,
            ),
        )


USUAL, COARSE = Case("runs", 0.01), Case("runs", 0.01, skip=2)


@partial(jax.jit, static_argnames="config")
def _features(config: Config, scans: Scan) -> Features:
    return map_batches(
        partial(extract.extract_features, config.frontend), scans, batch_size=extract.SCAN_BATCH
    )


def look(key, worlds: Worlds, case: Case) -> Seen:
    """Landmarks of a noisy scan from each viewpoint; the same key means the same noise."""
    scenes, scanner = (
        [at for scenes in worlds.values() for at in scenes],
        case.config.frontend.lidar,
    )
    ranges = jnp.asarray(np.concatenate([at.ranges[:, :: case.skip] for at in scenes]), float)
    scans = ray_casting.add_range_noise(key, scanner, lidar.to_scan(scanner, ranges))
    find = thinning.landmarks if case.labels == "thinning" else _features
    found = jax.tree.map(np.asarray, find(case.config, scans))
    ends = np.cumsum([len(at.poses) for at in scenes])[:-1]
    parts = zip(*(np.split(field, ends) for field in found), strict=True)
    return {
        name: [(at, Features(*next(parts))) for at in scenes] for name, scenes in worlds.items()
    }


def judge(config: Config, at: Scene, found: Features, kinds: dict[str, int]) -> dict:
    """Checks of one scene, by kind of landmark: lists and counts to be pooled over scenes."""
    place, poses, half = at.place, at.poses, len(at.poses) // 2
    xy, cov = to_world(poses, found.xy), turned(poses, found.cov)
    known = np.isfinite(cov).all(axis=(2, 3))
    inverse = np.linalg.pinv(np.where(known[..., None, None], cov, 0.0))
    out = {}
    for name, kind in kinds.items():
        true = place.junctions if kind == JUNCTION else place.max_corners.xy
        valid = found.valid & (found.kind == kind)
        trusted = valid & found.trusted
        off, nearest = cKDTree(true).query(xy)
        error = xy - true[nearest]
        nees = np.einsum("nmi,nmij,nmj->nm", error, inverse, error) / 2
        checks, spreads = 0, []
        one = slice(0, half), slice(half, None)
        for a, b in (one, one[::-1]):
            ought = trusted[a].copy()
            if kind == JUNCTION:
                n, m = np.nonzero(ought)
                circles = xy[a][n, m], found.descriptor[a][n, m]
                both = [visible_circles(place, poses[v][n], *circles, config) for v in (a, b)]
                ought[n, m] = both[0] & both[1]
            else:
                ought &= np.take_along_axis(
                    at.max_corners[a] & at.max_corners[b], nearest[a], axis=1
                )
                ought &= off[a] < SPURIOUS
            away = np.hypot(*np.moveaxis(xy[a][:, :, None] - xy[b][:, None], -1, 0))
            away = np.where(valid[b][:, None], away, np.inf).min(axis=-1)
            checks += ought.sum()
            spreads.append(away[ought & (away < MATCH)])
        out[name] = {
            "checks": checks,
            "spread": np.concatenate(spreads),
            "trusted": trusted.sum(),
            "scans": len(poses),
            "spurious": (trusted & (off >= SPURIOUS)).sum(),
            "nees": nees[trusted & known & (off < SPURIOUS)],
            "error": off[trusted],
        }
    return out


def row(parts: list[dict]) -> common.Numbers:
    """Row of the table: checks of one kind of landmark, pooled over scenes."""
    total = lambda field: sum(part[field] for part in parts)
    every = lambda field: np.concatenate([part[field] for part in parts])
    part = lambda some, all: some / all if all else np.nan
    mean = lambda how, x: float(how(x)) if len(x) else np.nan
    return {
        "checks": int(total("checks")),
        "repeatability": part(len(every("spread")), total("checks")),
        "spurious": part(total("spurious"), total("trusted")),
        "spread_m": mean(np.median, every("spread")),
        "nees": mean(np.mean, every("nees")),
        "error_m": mean(np.median, every("error")),
        "per_scan": part(total("trusted"), total("scans")),
    }


def everyone(at: Scene) -> np.ndarray:
    """All pairs (N,) of a scene."""
    return np.ones(len(at.poses) // 2, bool)


def rows(seen: Seen, case: Case, pick: Callable = everyone, **more) -> list[common.Numbers]:
    """A row for each world and kind of landmark, of the pairs that `pick` (scene) -> (N,) takes."""
    result = []
    for name, scenes in seen.items():
        place = scenes[0][0].place
        kinds = {"node": JUNCTION} if case.labels == "thinning" else place.filter.landmark_kinds
        parts = []
        for at, nodes in scenes:
            use = pick(at)
            some = Features(*(field[np.tile(use, 2)] for field in nodes))
            parts.append(judge(case.config, at.take(use), some, kinds))
        for kind in kinds:
            head = {"world": name, "labels": case.labels, "noise_m": case.noise, "kind": kind}
            own = row([part[kind] for part in parts]) | {"truth": place.known_from}
            result.append(head | more | own)
    return result


def apart(at: Scene) -> np.ndarray:
    """Distance (N,) [m] between the viewpoints of pairs."""
    return np.hypot(*np.subtract(*np.split(at.poses[:, :2], 2)).T)


def turn(at: Scene) -> np.ndarray:
    """Difference of heading (N,) [degrees] between the viewpoints of pairs."""
    off = np.subtract(*np.split(at.poses[:, 2], 2))
    return np.degrees(np.abs((off + np.pi) % (2 * np.pi) - np.pi))


def binned(seen: Seen, size: Callable, edges: tuple[float, ...]) -> list[common.Numbers]:
    """Rows of the usual case for the pairs whose `size` (scene) -> (N,) lies in each bin."""
    result = []
    for low, high in pairwise(edges):
        pick = lambda at, low=low, high=high: (low <= size(at)) & (size(at) < high)
        result += rows(seen, USUAL, pick, bin=[low, high])
    return result


def worlds_of(seed: int, plans: int, pairs: int) -> tuple[Worlds, dict[str, str]]:
    """Scenes of each world, and why a world is left out."""
    rng = np.random.default_rng(seed)
    at = lambda place, count: scene(place, rng, count, APART, USUAL.config)
    keys = tqdm(jax.random.split(jax.random.key(seed), plans), unit="plan", leave=False)
    worlds = {
        "office": [at(Drawn(named("office").walls), 3 * pairs)],
        "floor plans": [at(Drawn(floor_plans.floor_plan(key).walls), pairs) for key in keys],
    }
    try:
        own = ros_map.read(WILLOW)
    except InputError as error:
        return worlds, {"willow": str(error)}
    return worlds | {"willow": [at(Cells(own.occupied, own.free, own.resolution), 6 * pairs)]}, {}


def compute(seed: int, plans: int, pairs: int) -> common.Numbers:
    """Rows for all worlds, label modes and noises, and how the usual case depends on the pair."""
    lacking = thinning.missing()
    modes = ("runs", "codes") if lacking else ("runs", "codes", "thinning")
    cases = [Case(labels, noise) for labels in modes for noise in NOISES] + [COARSE]
    worlds, left_out = worlds_of(seed, plans, pairs)
    task = partial(look, jax.random.key(seed), worlds)
    numbers = {"seed": seed, "plans": plans, "pairs": pairs, "apart_m": APART, "match_m": MATCH}
    numbers |= {"spurious_beyond_m": SPURIOUS}
    numbers |= {"not_installed": lacking, "left_out": left_out, "rows": [], "by_step": []}
    with ThreadPoolExecutor(2) as pool:  # XLA compiles one case on one core
        every = tqdm(pool.map(task, cases), total=len(cases), unit="case", leave=False)
        for case, seen in zip(cases, every, strict=True):
            own = rows(seen, case)
            numbers["rows"] += own if case.skip == 1 else []
            if case in (USUAL, COARSE):
                step = round(np.degrees(case.config.frontend.lidar.angle_increment), 3)
                numbers["by_step"] += [r | {"beam_step_deg": step} for r in own]
            if case == USUAL:
                numbers["by_distance"] = binned(seen, apart, DISTANCES)
                numbers["by_heading"] = binned(seen, turn, HEADINGS)
    return numbers


def draw(numbers: common.Numbers, path: Path) -> None:
    """Repeatability over noise in each world, then over distance, heading and beams."""
    figure, axes = common.canvas(9, 5.6, 2, 3)
    styles = {
        ("runs", "node"): ("nodes, runs", "o-", common.BLUE),
        ("codes", "node"): ("nodes, edge codes", "s--", common.ORANGE),
        ("thinning", "node"): ("nodes, thinning", "^:", common.PINK),
        ("runs", "corner"): ("corners", "D-.", common.GREEN),
    }

    def lines(axis, table, title, label, of):
        for (labels, kind), (name, style, colour) in styles.items():
            own = [r for r in table if (r["labels"], r["kind"]) == (labels, kind)]
            if not own:
                continue
            repeat = [
                100 * (np.nan if r["repeatability"] is None else r["repeatability"]) for r in own
            ]
            axis.plot([of(r) for r in own], repeat, style, color=colour, label=name, markersize=5)
        axis.set(title=title, xlabel=label, ylim=(0, 103))
        axis.margins(x=0.1)
        axis.grid(alpha=0.3)

    names = list(dict.fromkeys(r["world"] for r in numbers["rows"]))
    for axis, name in zip(axes[0], names, strict=False):
        table = [r for r in numbers["rows"] if r["world"] == name]
        lines(axis, table, name, "range noise [cm]", lambda r: f"{100 * r['noise_m']:g}")
    for axis in axes[0, len(names) :]:
        axis.axis("off")
    span = lambda r: "{:g} to {:g}".format(*r["bin"])
    for axis, key, label, of in (
        (axes[1, 0], "by_distance", "between viewpoints [m]", span),
        (axes[1, 1], "by_heading", "between headings [degrees]", span),
        (axes[1, 2], "by_step", "between beams [degrees]", lambda r: f"{r['beam_step_deg']:g}"),
    ):
        table = [r for r in numbers[key] if r["world"] == "floor plans"]
        lines(axis, table, "floor plans, 1 cm", label, of)
    for axis in axes[:, 0]:
        axis.set_ylabel("repeat [%]")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=4)
    figure.savefig(path)


def main(argv: list[str] | None = None) -> None:
    """Run the experiment."""
    given = common.parse(__doc__, argv, plans=20, pairs=100)
    numbers = compute(given.seed, given.plans, given.pairs)
    common.save(given.out, "repeatability", numbers, draw)
    for r in numbers["rows"]:
        print(
            f"{r['labels']:8} {r['world']:11} {r['kind']:6} {100 * r['noise_m']:.0f} cm: "
            f"repeat {100 * r['repeatability']:5.1f} % of {r['checks']:4}, "
            f"spurious {100 * r['spurious']:4.1f} %, spread {100 * r['spread_m']:4.1f} cm, "
            f"NEES {r['nees']:5.2f}, {r['per_scan']:.2f} a scan"
        )
    for name in numbers["not_installed"]:
        print(f"{name} is not installed: without thinning")
    for name, why in numbers["left_out"].items():
        print(f"without {name}: {why}")


if __name__ == "__main__":
    main()
