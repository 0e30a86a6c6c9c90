"""Colours of regions, by the numbers in their names."""

from collections.abc import Sequence
from functools import cache

import numpy as np

from jaxslam.core.regions import Regions
from jaxslam.mapping.region_names import number_of

PALETTE_SIZE = 200
MIN_NEIGHBOURS = 20.0  # [CIELAB] between the colours of neighbours, at least
_LEVELS = np.arange(4, 253, 8)  # of red, green and blue in the palette
_LIGHTNESS = (42.0, 94.0)  # [CIELAB] least and most: walls are black, paper is white
_CHROMA = (12.0, 65.0)  # [CIELAB] least and most: unknown space is grey, marks are bright


def region_colours(regions: Regions) -> np.ndarray:
    """Colour (R, 3) uint8 of each region; no two are the same, and neighbours differ clearly.

    It is that of its number in the palette, so that it stays with the name, unless a neighbour of
    a lower number has one like it: then it is the next in the palette that differs from them.
    """
    colours, lab = _palette()
    chosen: list[int] = []
    found: dict[tuple[int, ...], None] = {}
    for k, region in enumerate(regions.regions):
        entry = (number_of(region.name) - 1) % PALETTE_SIZE
        beside = [chosen[n] for n in region.neighbours if n < k]
        for _ in range(PALETTE_SIZE):
            if not beside or _distance(lab[beside], lab[entry]).min() >= MIN_NEIGHBOURS:
                break
            entry = (entry + 1) % PALETTE_SIZE
        chosen.append(entry)
        colour = colours[entry].tolist()
        while tuple(colour) in found:  # entries are 8 levels apart, and all stay above 0
            colour[2] = colour[2] % 254 + 1
        found[tuple(colour)] = None
    return np.array(list(found), np.uint8).reshape(-1, 3)


@cache
def _palette() -> tuple[np.ndarray, np.ndarray]:
    """Colours (P, 3) uint8, each as far as can be from those before it, and the same in CIELAB."""
    rgb = np.stack(np.meshgrid(_LEVELS, _LEVELS, _LEVELS, indexing="ij"), axis=-1).reshape(-1, 3)
    lab = cielab(rgb)
    chroma = np.hypot(lab[:, 1], lab[:, 2])
    usable = (lab[:, 0] >= _LIGHTNESS[0]) & (lab[:, 0] <= _LIGHTNESS[1])
    usable &= (chroma >= _CHROMA[0]) & (chroma <= _CHROMA[1])
    rgb, lab = rgb[usable], lab[usable]
    chosen = [int(np.abs(rgb - [100, 180, 230]).sum(axis=1).argmin())]
    nearest = np.full(len(rgb), np.inf)
    while len(chosen) < PALETTE_SIZE:
        nearest = np.minimum(nearest, _distance(lab, lab[chosen[-1]]))
        chosen.append(int(nearest.argmax()))
    return rgb[chosen].astype(np.uint8), lab[chosen]


def _distance(lab: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Distance (N,) of colours (N, 3) in CIELAB from another (3,)."""
    return np.sqrt(((lab - other) ** 2).sum(axis=1))


def cielab(rgb: np.ndarray | Sequence[Sequence[int]]) -> np.ndarray:
    """Colours (N, 3) [0, 255] in sRGB as (N, 3) lightness, a and b of CIELAB 1976, white D65.

    Values are rounded to hundredths, so that they are the same on all machines.
    """
    level = np.asarray(rgb, float) / 255.0
    linear = np.where(level <= 0.04045, level / 12.92, ((level + 0.055) / 1.055) ** 2.4)
    to_xyz = np.array(
        [[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]]
    )
    xyz = linear @ to_xyz.T / to_xyz.sum(axis=1)
    cubic = np.where(xyz > 216 / 24389, np.cbrt(xyz), (24389 / 27 * xyz + 16.0) / 116.0)
    x, y, z = cubic.T
    return np.round(np.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)], axis=1), 2)
