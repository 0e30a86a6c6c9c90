"""Rooms of the plans of Bormann et al. (2016): recall, precision and correlation with a person's.

    python -m experiments.rooms_benchmark --rooms FOLDER --out DIR

FOLDER holds NAME.png (empty), NAME.furnished.png and NAME.rooms.png, the true rooms: white areas
that lines divide. Each room is compared with the region that covers most of it:

    recall      share of the room that this region covers             mean over rooms
    precision   share of this region, inside any room, in this room   mean over rooms
    mcc         Matthews correlation of the two                       mean weighted by the area

Writes rooms_benchmark.json and rooms_benchmark.png.

References:
    Bormann, Jordan, Li, Hampp, Haegele (2016), on room segmentation, ICRA: the plans, and the
    method by Voronoi diagrams. Mielle, Magnusson, Lilienthal (2018): MAORIS. Liu et al. (2015):
    dual-space decomposition.
"""

import sys
from pathlib import Path

import numpy as np
from PIL import Image
from scipy import ndimage

from experiments import common
from jaxslam.io import ros_map
from jaxslam.io.errors import InputError
from jaxslam.mapping.rooms import find_regions

RESOLUTION = 0.05  # [m] of a pixel
MIN_ROOM = 100  # pixels of a true room
KINDS = {"empty": ".png", "furnished": ".furnished.png"}
SCORES = ("recall", "precision", "mcc")
# Scores of the published pictures of others for ten of the empty plans, by the same measures.
PUBLISHED = {
    "MAORIS": (0.947, 0.865, 0.885),
    "Voronoi diagram": (0.954, 0.922, 0.846),
    "dual-space": (0.876, 0.792, 0.743),
}


def plans(folder: Path) -> list[str]:
    """Names of the plans in a folder."""
    return sorted(path.name.removesuffix(".rooms.png") for path in folder.glob("*.rooms.png"))


def true_rooms(path: Path) -> np.ndarray:
    """Label (H, W) of the rooms of a picture, 0 for none; cells [x, y] as in `OccupancyMap`."""
    with Image.open(path) as image:
        white = np.asarray(image.convert("RGB")).min(axis=2) >= 250
    label, _ = ndimage.label(white)
    label[(np.bincount(label.ravel()) < MIN_ROOM)[label]] = 0
    border = np.concatenate([label[0], label[-1], label[:, 0], label[:, -1]])
    label[np.isin(label, border)] = 0
    return np.ascontiguousarray(label[::-1].T)


def compare(truth: np.ndarray, label: np.ndarray) -> tuple[float, float, float]:
    """Recall, precision and correlation of a division.

    Args:
        truth: (H, W) int, rooms from 1 on.
        label: (H, W) int, regions from 1 on.
    """
    inside = truth > 0
    room = np.unique(truth[inside], return_inverse=True)[1]
    counts = np.zeros((room.max() + 1, label.max() + 1), np.int64)
    np.add.at(counts, (room, label[inside]), 1)
    size, total = counts.sum(axis=1).astype(float), float(counts.sum())
    counts[:, 0] = 0
    best = counts.argmax(axis=1)
    both = counts.max(axis=1).astype(float)
    region = np.where(both > 0, counts.sum(axis=0)[best], 0).astype(float)
    spread = np.sqrt(size * (total - size) * region * (total - region))
    product = both * (total - size - region + both) - (region - both) * (size - both)
    mcc = np.where(spread > 0, product / np.where(spread > 0, spread, 1.0), 0.0)
    recall, precision = both / size, both / np.maximum(region, 1.0)
    return float(recall.mean()), float(precision.mean()), float(np.average(mcc, weights=size))


def score_plan(plan: Path, rooms: Path) -> tuple[float, float, float]:
    """Recall, precision and correlation of the regions found in a plan."""
    grid = ros_map.read_picture(plan, RESOLUTION)
    found = find_regions(grid.occupied, grid.free, resolution=RESOLUTION, origin=np.zeros(3))
    return compare(true_rooms(rooms), found.label)


def measure(folder: Path) -> common.Numbers:
    """Scores of all plans in a folder, their means, and the published ones."""
    numbers: common.Numbers = {"plans": {}, "mean": {}}
    for name in plans(folder):
        rooms = folder / f"{name}.rooms.png"
        numbers["plans"][name] = {
            kind: dict(zip(SCORES, score_plan(folder / f"{name}{end}", rooms), strict=True))
            for kind, end in KINDS.items()
        }
    for kind in KINDS:
        rows = [[plan[kind][score] for score in SCORES] for plan in numbers["plans"].values()]
        numbers["mean"][kind] = dict(zip(SCORES, np.mean(rows, axis=0), strict=True))
    numbers["published"] = {
        method: dict(zip(SCORES, scores, strict=True)) for method, scores in PUBLISHED.items()
    }
    return numbers


def print_table(numbers: common.Numbers) -> None:
    """Print the scores of all plans, empty and furnished."""
    print(f"{'':28}{'empty':>24}{'furnished':>24}")
    print(f"{'':28}" + 2 * "".join(f"{score[:6]:>8}" for score in SCORES))
    for name, row in (numbers["plans"] | {"mean": numbers["mean"]}).items():
        print(f"{name:28}" + "".join(f"{x:8.3f}" for kind in KINDS for x in row[kind].values()))
    for method, row in numbers["published"].items():
        print(f"{method + ', published':28}" + "".join(f"{x:8.3f}" for x in row.values()))


def draw(numbers: common.Numbers, path: Path) -> None:
    """Draw the correlation of each plan beside the published means."""
    names = [*numbers["plans"], "mean"]
    rows = [*numbers["plans"].values(), numbers["mean"]]
    figure, axes = common.canvas(9.0, 4.2, 1, 1)
    axis = axes[0, 0]
    for k, (kind, colour) in enumerate(zip(KINDS, (common.BLUE, common.SKY), strict=True)):
        values = [row[kind]["mcc"] for row in rows]
        axis.bar(np.arange(len(names)) + 0.4 * k - 0.2, values, 0.38, color=colour, label=kind)
    styles = zip(
        numbers["published"].items(), (common.RED, common.ORANGE, common.PINK), strict=True
    )
    for k, ((method, row), colour) in enumerate(styles):
        style = {"color": colour, "linestyle": ("-", "--", ":")[k]}
        axis.axhline(row["mcc"], label=f"{method}, mean of empty plans", **style)
    axis.set_xticks(range(len(names)), names, rotation=30, ha="right")
    axis.set(ylabel="Matthews correlation", ylim=(0.5, 1.0))
    figure.legend(loc="outside upper center", ncols=3, frameon=False)
    figure.savefig(path)


@common.report_errors("rooms_benchmark")
def main(argv: list[str] | None = None) -> int:
    """Score the plans of a folder."""
    args = common.parse(__doc__, argv, rooms=Path("rooms"))
    if not plans(args.rooms):
        raise InputError("holds no NAME.rooms.png", path=args.rooms, advice="name another folder")
    numbers = measure(args.rooms)
    print_table(numbers)
    common.save(args.out, "rooms_benchmark", numbers, draw)
    return 0


if __name__ == "__main__":
    sys.exit(main())
