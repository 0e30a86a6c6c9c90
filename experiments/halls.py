"""Junctions of halls 15 to 25 m wide, with and without the coarser levels of the pyramid.

Each hall is a rectangle with a wide bay on one side, whose junctions are known exactly: one at
either end, as far from three walls; one before the bay, as far from its two corners and the wall
opposite; and one in the bay, if it is deep enough. A scanner of 30 m range, with 1 cm noise, sees
it from a random pose. A junction is visible if the scan saw its circle, up to 95 % of the radius.
"""

from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from experiments import common
from jaxslam.core.batching import map_batches
from jaxslam.core.features import Features
from jaxslam.core.scan import Lidar, Scan
from jaxslam.core.se2 import inverse_transform, unit_vector
from jaxslam.core.types import FAR_JUNCTION, JUNCTION, Array
from jaxslam.frontend import extract
from jaxslam.frontend.config import PYRAMID, FrontendConfig
from jaxslam.frontend.lidar import in_free_view, to_scan
from jaxslam.simulation import worlds
from jaxslam.simulation.ray_casting import cast
from jaxslam.simulation.worlds import World

LIDAR = Lidar(range_max=30.0)
MATCH = 0.5  # [m] a junction found within this of the true one is that one
VIEWS = 8  # poses in each hall


def hall(random: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Walls (S, 4) [m] of a random hall, and its junctions (N, 3): position and clearance [m]."""
    width, length = random.uniform(15.0, 25.0), random.uniform(30.0, 40.0)
    bay, depth = random.uniform(8.0, 11.0), random.uniform(7.0, 10.0)
    middle = length / 2 + random.uniform(-3.0, 3.0)
    walls = worlds.outline(
        [
            (0.0, 0.0, length, width),
            (middle - bay / 2, width, middle + bay / 2, width + depth),
        ]
    )
    r = width / 2
    opening = width / 2 + bay**2 / (8 * width)
    junctions = [(r, r, r), (length - r, r, r), (middle, opening, opening)]
    junctions.append((middle, width + depth - bay / 2, bay / 2))
    true = np.array([j for j in junctions if _is_empty(walls, j)])
    return walls, true


def _is_empty(walls: np.ndarray, circle: tuple[float, float, float]) -> bool:
    """Whether no wall cuts a circle x, y, radius."""
    start, end = walls[:, :2], walls[:, 2:]
    step = end - start
    along = np.sum((np.array(circle[:2]) - start) * step, axis=1) / np.sum(step**2, axis=1)
    nearest = start + np.clip(along, 0.0, 1.0)[:, None] * step
    return np.linalg.norm(nearest - circle[:2], axis=1).min() > circle[2] - 1e-6


def _seen(circles: Array, pose: Array, scan: Scan) -> Array:
    """Whether circles (N, 3) of the map frame were seen from a pose (3,): (N,) bool."""
    centre = inverse_transform(pose, circles[:, :2])
    rim = unit_vector(jnp.linspace(-jnp.pi, jnp.pi, 90, endpoint=False))
    points = centre[:, None] + 0.95 * circles[:, 2:, None] * rim[None]
    return jnp.all(in_free_view(LIDAR, points, scan.ranges), axis=1)


def compute(seed: int, halls: int) -> common.Numbers:
    """Share of visible junctions found, errors, and false ones, with one level and with two."""
    random = np.random.default_rng(seed)
    one = {name: [] for name in ("true", "pose", "scan")}
    for _ in range(halls):
        walls, true = hall(random)
        width, length = walls[:, 1].max(), walls[:, 0].max()
        for _ in range(VIEWS):
            pose = random.uniform([2.0, 2.0, -np.pi], [length - 2.0, 13.0, np.pi])
            assert pose[1] < width
            exact = cast(LIDAR, World(jnp.asarray(walls)), jnp.asarray(pose))
            one["true"].append(np.pad(true, ((0, 4 - len(true)), (0, 0))))
            one["pose"].append(pose)
            one["scan"].append(np.asarray(exact.ranges))
    true, pose, ranges = (jnp.asarray(np.stack(x), float) for x in one.values())
    noisy = ranges + LIDAR.range_std * jnp.asarray(random.normal(size=ranges.shape), float)
    scans = to_scan(LIDAR, jnp.where(ranges < LIDAR.range_max, noisy, LIDAR.range_max))
    seen = jax.vmap(_seen)(true, pose, to_scan(LIDAR, ranges)) & (true[:, :, 2] > 0.0)
    config = FrontendConfig(lidar=LIDAR)
    return {
        "halls": halls,
        "views": len(pose),
        "one_level": measure(config, scans, pose, true, seen),
        "pyramid": measure(config._replace(levels=PYRAMID), scans, pose, true, seen),
    }


def measure(
    config: FrontendConfig, scans: Scan, pose: Array, true: Array, seen: Array
) -> common.Numbers:
    """Compare what the front end finds in scans [T] with true circles (T, N, 3), map frame."""
    run = partial(map_batches, partial(extract.extract_features, config), batch_size=16)
    found: Features = jax.tree.map(np.asarray, jax.jit(run)(scans))
    is_junction = found.valid & np.isin(found.kind, (JUNCTION, FAR_JUNCTION))
    local = np.asarray(jax.vmap(inverse_transform)(pose, true[:, :, :2]))
    gap = np.linalg.norm(found.xy[:, None] - local[:, :, None], axis=-1)  # (T, N, M)
    gap = np.where(is_junction[:, None] & (np.asarray(true)[:, :, 2:] > 0.0), gap, np.inf)
    error, index = gap.min(axis=2), gap.argmin(axis=2)
    own = np.asarray(seen) & (error < MATCH)
    rows, columns = np.nonzero(own)
    cov = found.cov[rows, index[own]]
    offset = found.xy[rows, index[own]] - local[rows, columns]
    nees = np.einsum("ni,nij,nj->n", offset, np.linalg.inv(cov), offset) / 2
    false = is_junction & (gap.min(axis=1) >= MATCH)
    return {
        "visible": int(seen.sum()),
        "found": float(own.sum() / seen.sum()),
        "trusted": float(found.trusted[rows, index[own]].sum() / seen.sum()),
        "error_median_m": float(np.median(error[own])) if own.any() else None,
        "error_90_percent_m": float(np.quantile(error[own], 0.9)) if own.any() else None,
        "nees_per_dof_median": float(np.median(nees)) if len(nees) else None,
        "others_per_scan": float(false.sum() / len(false)),
        "others_trusted_per_scan": float((false & found.trusted).sum() / len(false)),
    }


def draw(numbers: common.Numbers, path: Path) -> None:
    """Bars: share of the visible junctions found."""
    figure, axes = common.canvas(4, 3, 1, 1)
    names = ("one_level", "pyramid")
    shares = [100 * numbers[name]["found"] for name in names]
    bars = axes[0, 0].bar(["one level", "pyramid"], shares, color=common.SKY)
    axes[0, 0].bar_label(bars, fmt="%.0f %%")
    axes[0, 0].set(ylim=(0, 110), title="visible junctions of halls found")
    figure.savefig(path)


def main(argv: list[str] | None = None) -> None:
    """Run the experiment."""
    args = common.parse(__doc__, argv, halls=25)
    numbers = compute(args.seed, args.halls)
    common.save(args.out, "halls", numbers, draw)
    for name in ("one_level", "pyramid"):
        print(name, {key: value and round(value, 4) for key, value in numbers[name].items()})


if __name__ == "__main__":
    main()
