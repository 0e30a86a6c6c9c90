"""How repeatable the landmarks of single scans are, against noise, viewpoint and label mode.

Two viewpoints at most 1.5 m apart, of any heading, each give the landmarks of one noisy scan. A
landmark of the first *ought* to be seen from the second if it is visible there: a node if its
whole circle lies in view, a corner if the corner is in sight and five beams at least fall on
either of its walls. It *repeats* if a landmark of its kind lies within 0.2 m. It is *spurious* if
the world has no junction (no corner) within 0.15 m.
"""

from functools import partial
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from experiments import common, truth
from jaxslam import lidar, slam, world
from jaxslam.nodes import Nodes
from jaxslam.slam import map_batches
from jaxslam.types import CORNER, NODE
from jaxslam.world import PLAN_WALLS, World

NOISES = (0.0, 0.01, 0.03)  # [m] of a range
APART = 1.5  # [m] between the viewpoints of a pair at most
MATCH = 0.2  # [m] within which a landmark repeats
SPURIOUS = 0.15  # [m] from the nearest true one
BEAMS = 5  # on each wall of a visible corner
RIM = np.linspace(-np.pi, np.pi, 36, endpoint=False)


class Scene(NamedTuple):
    """A world and viewpoints in it."""

    walls: np.ndarray  # (S, 4), none without length
    free: truth.Free
    junctions: truth.Junctions
    corners: truth.Corners
    poses: np.ndarray  # (2 N, 3): the first N and the second N are pairs


def scene(walls: np.ndarray, rng: np.random.Generator, pairs: int, apart: float) -> Scene:
    """A world with pairs of viewpoints at most `apart` [m] from each other."""
    walls = truth.solid(walls)
    free = truth.Free(walls)
    low, high = walls.reshape(-1, 2).min(axis=0), walls.reshape(-1, 2).max(axis=0)

    def good(places):
        return free.holds(places) & (truth.clearance(places, walls) > 0.35)

    def draw(propose, count):
        kept = np.zeros((0, 4))
        while len(kept) < count:
            two = propose(8 * count)
            seen = good(two[:, :2]) & good(two[:, 2:])
            seen &= truth.in_sight(two[:, :2], two[:, None, 2:], walls)[:, 0]
            kept = np.vstack([kept, two[seen]])
        return kept[:count]

    def propose(count):
        first = rng.uniform(low, high, (count, 2))
        turn, away = rng.uniform(-np.pi, np.pi, count), apart * np.sqrt(rng.uniform(0, 1, count))
        step = away[:, None] * np.column_stack([np.cos(turn), np.sin(turn)])
        return np.hstack([first, first + step])

    places = draw(propose, pairs).reshape(pairs, 2, 2).transpose(1, 0, 2).reshape(-1, 2)
    heading = rng.uniform(-np.pi, np.pi, 2 * pairs)
    return Scene(
        walls,
        free,
        truth.junctions(walls, free),
        truth.corners(walls),
        np.column_stack([places, heading]),
    )


@partial(jax.jit, static_argnames=("config",))
def features(key, config: slam.Config, walls, poses) -> Nodes:
    """Landmarks of noisy scans from poses (N, 3)."""

    def one(item):
        key, pose = item
        scan = lidar.disturb(key, lidar.cast(World(walls), pose, config.lidar), config.lidar)
        return slam.front_end(config, scan)

    return map_batches(one, (jax.random.split(key, len(poses)), poses), size=slam.BATCH)


def seen_from(key, config: slam.Config, at: Scene) -> Nodes:
    """Landmarks of a noisy scan from each viewpoint of a scene, as NumPy."""
    walls = jnp.asarray(np.pad(at.walls, ((0, PLAN_WALLS - len(at.walls)), (0, 0))), float)
    return jax.tree.map(np.asarray, features(key, config, walls, jnp.asarray(at.poses, float)))


def to_world(poses: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Places (N, M, 2) of the frames of poses (N, 3) in the world."""
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    turn = np.stack([np.stack([c, -s], -1), np.stack([s, c], -1)], axis=1)
    return np.einsum("nij,nmj->nmi", turn, places) + poses[:, None, :2]


def turned(poses: np.ndarray, cov: np.ndarray) -> np.ndarray:
    """Covariances (N, M, 2, 2) of the frames of poses (N, 3) in the world."""
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    turn = np.stack([np.stack([c, -s], -1), np.stack([s, c], -1)], axis=1)
    return np.einsum("nij,nmjk,nlk->nmil", turn, cov, turn)


def in_view(poses: np.ndarray, places: np.ndarray, config: slam.Config) -> np.ndarray:
    """Whether places (N, K, 2) [m, world] are in the view of poses (N, 3), and on their grid."""
    offset = places - poses[:, None, :2]
    bearing = np.arctan2(offset[..., 1], offset[..., 0]) - poses[:, None, 2]
    bearing = (bearing - config.lidar.first) % (2 * np.pi)
    away = np.hypot(offset[..., 0], offset[..., 1])
    reach = min(config.lidar.reach, config.grid.ahead, config.grid.side)
    return (bearing <= (config.lidar.beams - 1) * config.lidar.step) & (away < reach)


def visible_circles(at: Scene, poses, places, radii, config) -> np.ndarray:
    """Whether circles, centres (N, 2) and radii (N,), are wholly in view of poses (N, 3)."""
    rim = np.stack([np.cos(RIM), np.sin(RIM)], axis=-1)
    rim = places[:, None] + 0.95 * radii[:, None, None] * rim
    seen = in_view(poses, rim, config).all(axis=-1)
    seen[seen] = truth.in_sight(poses[seen, :2], rim[seen], at.walls).all(axis=-1)
    return seen


def visible_corners(at: Scene, config: slam.Config) -> np.ndarray:
    """Whether each pose sees each corner, and either wall of it with five beams: (2 N, C) bool."""
    turn = config.lidar.first + config.lidar.step * np.arange(config.lidar.beams)
    corner, along = at.corners
    result = np.zeros((len(at.poses), len(corner)), bool)
    for n, pose in enumerate(at.poses):
        near = corner + 1e-6 * (pose[:2] - corner)
        seen = truth.in_sight(pose[None, :2], near[None], at.walls)
        seen = np.flatnonzero((seen & in_view(pose[None], near[None], config))[0])
        ends = truth.hits(pose[:2], pose[2] + turn, at.walls)
        offset = (ends[:, None] - corner[seen])[:, :, None]  # (R, C, 1, 2)
        ahead = np.sum(offset * along[seen], axis=-1)
        across = np.sum(offset * along[seen][..., ::-1] * [1, -1], axis=-1)
        on = (ahead > 0) & (ahead < 1.0) & (np.abs(across) < 1e-4)
        result[n, seen] = np.all(on.sum(axis=0) >= BEAMS, axis=-1)
    return result


def judge(config: slam.Config, at: Scene, found: Nodes, kinds=(NODE, CORNER)) -> dict:
    """Checks of one scene: lists to be pooled over scenes."""
    half = len(at.poses) // 2
    xy, cov = to_world(at.poses, found.xy), turned(at.poses, found.cov)
    out = {}
    corner_seen = visible_corners(at, config) if CORNER in kinds else None
    for kind in kinds:
        name = {NODE: "node", CORNER: "corner"}[kind]
        true = at.junctions.xy if kind == NODE else at.corners.xy
        valid = found.valid & (found.kind == kind)
        trusted = valid & found.trusted
        gap = np.hypot(*np.moveaxis(xy[:, :, None] - true, -1, 0))
        nearest, off = gap.argmin(axis=-1), gap.min(axis=-1)
        error = xy - true[nearest]
        nees = np.einsum("nmi,nmij,nmj->nm", error, np.linalg.pinv(cov), error) / 2
        one = slice(0, half), slice(half, None)
        checks, repeats, spreads = 0, 0, []
        for a, b in (one, one[::-1]):
            if kind == NODE:
                n, m = np.nonzero(trusted[a])
                circles = xy[a][n, m], found.shape[a][n, m]
                both = [visible_circles(at, at.poses[v][n], *circles, config) for v in (a, b)]
                ought = np.zeros_like(trusted[a])
                ought[n, m] = both[0] & both[1]
            else:
                both = corner_seen[b] & corner_seen[a]
                ought = np.take_along_axis(both, nearest[a], axis=1) & (off[a] < SPURIOUS)
            ought &= trusted[a]
            away = np.hypot(*np.moveaxis(xy[a][:, :, None] - xy[b][:, None], -1, 0))
            away = np.where(valid[b][:, None], away, np.inf).min(axis=-1)
            checks += ought.sum()
            repeats += (ought & (away < MATCH)).sum()
            spreads.append(away[ought & (away < MATCH)])
        out[name] = {
            "checks": checks,
            "repeats": repeats,
            "spread": np.concatenate(spreads),
            "trusted": trusted.sum(),
            "scans": len(at.poses),
            "spurious": (trusted & (off >= SPURIOUS)).sum(),
            "nees": nees[trusted & (off < SPURIOUS)],
            "error": off[trusted],
        }
    return out


def row(parts: list[dict], kind: str) -> common.Numbers:
    """Row of the table: checks of one kind of landmark, pooled over scenes."""
    total = lambda field: sum(part[kind][field] for part in parts)
    every = lambda field: np.concatenate([part[kind][field] for part in parts])
    return {
        "checks": int(total("checks")),
        "repeatability": total("repeats") / max(total("checks"), 1),
        "spurious": total("spurious") / max(total("trusted"), 1),
        "spread_m": float(np.median(every("spread"))) if total("repeats") else np.nan,
        "nees": float(np.mean(every("nees"))) if len(every("nees")) else np.nan,
        "error_m": float(np.median(every("error"))) if total("trusted") else np.nan,
        "per_scan": total("trusted") / total("scans"),
    }


def compute(seed: int, plans: int, pairs: int) -> common.Numbers:
    """Rows for the office and for random floor plans, both label modes, three noises."""
    rng = np.random.default_rng(seed)
    keys = jax.random.split(jax.random.key(seed), plans)
    worlds = {
        "office": [scene(world.named("office").walls, rng, 3 * pairs, APART)],
        "floor plans": [scene(world.floor_plan(key).walls, rng, pairs, APART) for key in keys],
    }
    cases = [(labels, noise) for labels in ("runs", "codes") for noise in NOISES]
    rows = []
    for labels, noise in tqdm(cases, unit="case", leave=False):
        config = slam.Config(labels=labels)
        config = config._replace(lidar=config.lidar._replace(noise=noise))
        for name, scenes in worlds.items():
            draw_key = jax.random.fold_in(jax.random.key(seed), len(rows))
            found = [seen_from(draw_key, config, at) for at in scenes]
            parts = [judge(config, at, nodes) for at, nodes in zip(scenes, found, strict=True)]
            head = {"world": name, "labels": labels, "noise_m": noise}
            rows += [head | {"kind": kind} | row(parts, kind) for kind in ("node", "corner")]
    return {"seed": seed, "apart_m": APART, "plans": plans, "pairs": pairs, "rows": rows}


def draw(numbers: common.Numbers, path: Path) -> None:
    """Repeatability over noise, a panel for each kind of landmark."""
    figure, axes = common.canvas(8, 3.2, 1, 2)
    for axis, kind in zip(axes[0], ("node", "corner"), strict=True):
        for labels, colour in (("runs", common.BLUE), ("codes", common.ORANGE)):
            for name, style in (("office", "o-"), ("floor plans", "s--")):
                lines = [
                    (100 * r["noise_m"], 100 * r["repeatability"])
                    for r in numbers["rows"]
                    if (r["kind"], r["labels"], r["world"]) == (kind, labels, name)
                ]
                axis.plot(*zip(*lines, strict=True), style, color=colour, label=f"{labels}, {name}")
        axis.set(xlabel="range noise [cm]", ylabel="repeat [%]", title=f"{kind}s", ylim=(0, 102))
        axis.grid(alpha=0.3)
    axes[0, 0].legend(fontsize=8, loc="lower left")
    figure.savefig(path)


def main(argv: list[str] | None = None) -> None:
    """Run the experiment."""
    given = common.parse(__doc__, argv, plans=20, pairs=100)
    numbers = compute(given.seed, given.plans, given.pairs)
    common.save(given.out, "repeatability", numbers, draw)
    for r in numbers["rows"]:
        print(
            f"{r['labels']:5} {r['world']:11} {r['kind']:6} {100 * r['noise_m']:.0f} cm: "
            f"repeat {100 * r['repeatability']:5.1f} % of {r['checks']}, "
            f"spurious {100 * r['spurious']:.1f} %, spread {100 * r['spread_m']:.1f} cm, "
            f"NEES {r['nees']:.2f}, {r['per_scan']:.2f} a scan"
        )


if __name__ == "__main__":
    main()
