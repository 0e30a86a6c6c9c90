"""Pictures of maps: their pixels, and which shades of a plan are free, walls or unknown.

Pillow, which matplotlib installs, decodes them.
"""

import struct
import warnings
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy import ndimage

from jaxslam.core.maps import MAX_CELLS
from jaxslam.io.errors import InputError

FORMATS = ("PPM", "PNG", "BMP", "JPEG", "GIF", "TIFF")  # PPM stands for all of PBM, PGM and PPM
SUFFIXES = tuple(".png .pgm .pbm .ppm .pnm .bmp .jpg .jpeg .gif .tif .tiff".split())
NAMES = "a PNG, PGM, BMP, JPEG, GIF or TIFF image"
_WITH_ALPHA = ("1", "L", "LA", "P", "PA", "RGB", "RGBA")  # modes that Pillow converts to RGBA

ORIENTATION = 0x0112  # EXIF field
_TURNS = {2: 0, 3: 3, 4: 1, 5: 5, 6: 4, 7: 6, 8: 2}  # its values: `Image.Transpose`

# Shades are levels from 0 (black) to 255 (white).
UNKNOWN = 205  # that map_saver writes
BLACK_BELOW, WHITE_ABOVE = 89.5, 205.5  # of map_saver's thresholds
PAPER_STEP = 30.0  # between the paper and the walls nearest to it
MIN_PAPER = 128.0
MIN_PALE_STEP = 20.0  # between the mean shades of paper and of walls lighter than `WHITE_ABOVE`
MAX_PALE_SHARE = 0.25  # of such walls
MAX_VALLEY = 0.25  # of the darker group: pixels between it and the lighter one
MIN_BLACK = 0.25  # of map_saver's walls, for each pixel of a grey that is not its unknown
MIN_SURROUND = 0.01  # of all pixels: what is unknown around a plan
MIN_OUTLINE = 0.25  # darker neighbours of what is unknown, for each lighter one
SAME_SHADE, OTHER_SHADE = 1, 8  # levels apart
MIN_PAPER_SHARE = 0.1  # of pixels lighter than a grey surround, for each pixel of it
MAX_WALL_WIDTH = 1.0  # [m] of walls that are drawn as outlines filled with a light grey
MIN_FILL = 100  # pixels of such a fill
DARK_BORDER, MAX_LINES = 0.9, 0.25  # of an inverted plan: border that is dark, pixels that are free


class Plan(NamedTuple):
    """How to read a picture.

    Attributes:
        unknown: (H, W) bool, unknown although opaque.
        walls: (H, W) bool, walls whatever their shade.
        limit: Shade from 0 to 1 that parts walls from free space; None: map_saver's thresholds.
        notes: What was guessed.
    """

    unknown: np.ndarray
    walls: np.ndarray
    limit: float | None
    notes: tuple[str, ...]


def is_picture(path: str | PathLike) -> bool:
    """Whether a path has the name of a picture."""
    return Path(path).suffix.lower() in SUFFIXES


def read(path: Path, *, upright: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """Read a picture, the first of a file that holds several.

    Args:
        path: Image of one of the `FORMATS`.
        upright: Turn it as its EXIF orientation says, as viewers do; map_server does not.

    Returns:
        Shade (H, W) float32 from 0 (black) to 1 (white), and whether opaque (H, W) bool.

    Raises:
        InputError: It cannot be read, or has no cells or more than `MAX_CELLS`.
    """
    from PIL import Image, UnidentifiedImageError

    advice = f"give {NAMES}"
    try:
        with warnings.catch_warnings():
            # Pillow warns of its own limit, ours is checked below; and of broken metadata.
            warnings.simplefilter("ignore")
            with Image.open(path, formats=FORMATS) as image:
                width, height = image.size
                if not 0 < width * height <= MAX_CELLS:
                    problem = f"{width} x {height} cells are not between 1 and {MAX_CELLS}"
                    raise InputError(problem, path=path, advice="cut the map into parts")
                return _pixels(_turned(image) if upright else image)
    except InputError:
        raise
    except FileNotFoundError:
        raise InputError("does not exist", path=path, advice="check its name") from None
    except Image.DecompressionBombError:
        raise InputError(f"has more than {MAX_CELLS} cells", path=path) from None
    except UnidentifiedImageError:
        raise InputError("is no image that can be read", path=path, advice=advice) from None
    except (OSError, ValueError, TypeError, SyntaxError, EOFError, struct.error) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise InputError(f"cannot be read ({reason})", path=path, advice=advice) from None


def plan_shades(shade: np.ndarray, known: np.ndarray, resolution: float) -> Plan:
    """Find which shades of a plan are free, walls or unknown, which a picture alone does not say.

    The histogram as a whole decides, not single dark pixels: the paper is the lighter of two groups
    of shades; a grey around the plan, parted from the paper by darker lines, is unknown.

    Args:
        shade: (H, W) from 0 (black) to 1 (white).
        known: (H, W) bool, opaque.
        resolution: [m] side of a pixel.
    """
    level = np.round(255.0 * shade).astype(np.int16)
    level[~known] = -1
    guesses = []
    unknown = np.zeros(level.shape, bool)
    surround = _surround(level)
    walls = np.zeros(level.shape, bool)
    if surround is not None:
        unknown = (np.abs(level - surround) <= SAME_SHADE) & (level < WHITE_ABOVE)
    count = np.bincount(level[known & ~unknown], minlength=256)
    if surround is not None and abs(surround - UNKNOWN) <= SAME_SHADE:
        black, grey = _black_and_grey(count)
        if black > MIN_BLACK * grey:  # of map_saver
            return Plan(walls, walls, None, ())  # its thresholds leave the shade unknown
    if surround is not None:
        guesses.append(f"the shade {surround} of 255 around the plan is taken as unknown")
    limit, paper = _limit(count)
    if limit is not None:
        guesses.append(f"shades below {np.ceil(limit):.0f} of 255 are taken as walls")
        if paper <= WHITE_ABOVE:
            guesses.append(f"paper of the shade {paper:.0f} is taken as free")
    if paper > WHITE_ABOVE:
        pale = (level > (limit or WHITE_ABOVE)) & (level <= paper - PAPER_STEP)
        walls = _outlined(level, pale & ~unknown, resolution)
        if walls.any():
            guesses.append("narrow light grey areas within darker lines are taken as walls")
    notes = (", ".join(guesses),) if guesses else ()
    return Plan(unknown, walls, None if limit is None else limit / 255.0, notes)


def two_groups(count: np.ndarray) -> float | None:
    """The level that best parts dark from light: of the largest variance between the two.

    Args:
        count: (256,) pixels of each level.

    Returns:
        The middle of the levels that do equally well, in 0.5 to 254.5; None where there is one
        level alone.

    References:
        Otsu, A Threshold Selection Method from Gray-Level Histograms, 1979.
    """
    darker = np.cumsum(count)[:-1].astype(float)  # up to each level
    lighter = count.sum() - darker
    sums = np.cumsum(count * np.arange(256.0))
    means = sums[:-1] / np.maximum(darker, 1), (sums[-1] - sums[:-1]) / np.maximum(lighter, 1)
    between = darker * lighter * (means[1] - means[0]) ** 2
    if not between.max(initial=0.0) > 0.0:
        return None
    best = np.flatnonzero(between >= between.max() * (1.0 - 1e-9))
    return 0.5 * float(best[0] + best[-1]) + 0.5


def looks_inverted(occupied: np.ndarray, free: np.ndarray) -> bool:
    """Whether a map (H, W) bool could be a plan with white walls: little is free, none around."""
    border = np.concatenate([occupied[0], occupied[-1], occupied[:, 0], occupied[:, -1]])
    return bool(border.mean() >= DARK_BORDER and free.mean() <= MAX_LINES)


def half_width(area: np.ndarray) -> float:
    """Half of the width [pixels] of an area (H, W) bool where it is widest."""
    return float(ndimage.distance_transform_edt(np.pad(area, 1)).max()) - 0.5


def _turned(image: Any) -> Any:
    """An open Pillow image as its EXIF orientation says; as it is where that cannot be read.

    Not by `ImageOps.exif_transpose`, which fails where other EXIF fields cannot be written again.
    """
    image.load()  # turns a TIFF image
    try:
        method = _TURNS.get(image.getexif().get(ORIENTATION))
    except (OSError, ValueError, TypeError, SyntaxError, struct.error):
        return image
    return image if method is None else image.transpose(method)


def _pixels(image: Any) -> tuple[np.ndarray, np.ndarray]:
    """Shade and opacity of an open Pillow image."""
    if image.mode == "I" or image.mode.startswith("I;16"):  # 16 bits a pixel
        shade = np.asarray(image).astype(np.float32) / np.float32(65535)
        return shade, np.ones(shade.shape, bool)
    colours = image if image.mode in _WITH_ALPHA else image.convert("RGB")
    values = np.asarray(colours.convert("RGBA"))
    shade = values[..., :3].mean(axis=2, dtype=np.float32) / np.float32(255)
    return shade, values[..., 3] > 127


def _limit(count: np.ndarray) -> tuple[float | None, float]:
    """Level that parts walls from free space, None for map_saver's, and level of the paper.

    Args:
        count: (256,) pixels of each level.
    """
    parted = two_groups(count)
    if parted is None:
        return None, 255.0
    levels = np.arange(256)
    lighter, total = count * (levels > parted), count.sum()
    paper = float(np.searchsorted(np.cumsum(lighter), 0.5 * lighter.sum()))
    if parted > WHITE_ABOVE and not _is_pale(count, parted):
        parted = 0.0
    is_paper = lighter.sum() >= 0.5 * total and paper >= MIN_PAPER
    limit = max(parted, min(WHITE_ABOVE, paper - PAPER_STEP if is_paper else WHITE_ABOVE))
    black, grey = _black_and_grey(count)
    if limit == WHITE_ABOVE and black >= grey:
        return None, paper
    return limit, paper


def _black_and_grey(count: np.ndarray) -> tuple[int, int]:
    """Pixels that map_saver's thresholds make occupied, and those between them."""
    levels = np.arange(256)
    grey = count[(levels > BLACK_BELOW) & (levels < WHITE_ABOVE)].sum()
    return int(count[levels < BLACK_BELOW].sum()), int(grey)


def _is_pale(count: np.ndarray, parted: float) -> bool:
    """Whether two groups of light levels are paper and pale walls, not one group with noise."""
    levels = np.arange(256)
    pale = count * ((levels < parted) & (levels > BLACK_BELOW))
    paper = count * (levels > parted)
    if not MAX_PALE_SHARE * count.sum() >= pale.sum() > count[levels < BLACK_BELOW].sum():
        return False
    low, high = (float(part @ levels) / part.sum() for part in (pale, paper))
    quarter = 0.25 * (high - low)
    valley = count[(levels > low + quarter) & (levels < high - quarter)].sum()
    return high - low >= MIN_PALE_STEP and bool(valley <= MAX_VALLEY * pale.sum())


def _surround(level: np.ndarray) -> int | None:
    """Level of what is unknown around a plan, if any: a grey that darker lines part from the paper.

    It is the level of most of the border if that is grey, else map_saver's.
    """
    border = np.concatenate([level[0], level[-1], level[:, 0], level[:, -1]])
    count = np.bincount(border[border >= 0], minlength=256)
    usual = int(count.argmax())
    grey = BLACK_BELOW < usual < WHITE_ABOVE and 2 * count[usual] >= border.size
    candidate = usual if grey else UNKNOWN
    is_it = np.abs(level - candidate) <= SAME_SHADE
    lighter = (level > candidate + PAPER_STEP).sum()
    if (
        is_it.mean() < MIN_SURROUND
        or candidate != UNKNOWN
        and lighter < MIN_PAPER_SHARE * is_it.sum()
    ):
        return None
    around = np.zeros(2)  # darker, lighter neighbours
    for here, beside in _neighbours(level):
        at = (np.abs(here - candidate) <= SAME_SHADE) & (beside >= 0)
        around += (
            (at & (beside < candidate - OTHER_SHADE)).sum(),
            (at & (beside > candidate + OTHER_SHADE)).sum(),
        )
    return candidate if around[0] > 0 and around[0] >= MIN_OUTLINE * around[1] else None


def _outlined(level: np.ndarray, pale: np.ndarray, resolution: float) -> np.ndarray:
    """Parts (H, W) bool of `pale` that are insides of walls: narrow, most around them is darker."""
    parts, number = ndimage.label(pale)
    around = np.zeros((2, number + 1))  # darker, lighter neighbours
    for (here, beside), (at, other) in zip(_neighbours(level), _neighbours(parts), strict=True):
        edge = (at > 0) & (other == 0) & (beside >= 0)
        darker = beside[edge] < here[edge]
        around[0] += np.bincount(at[edge][darker], minlength=number + 1)
        around[1] += np.bincount(at[edge][~darker], minlength=number + 1)
    enough = np.bincount(parts.ravel(), minlength=number + 1) >= MIN_FILL
    chosen = enough & (around[0] >= 2.0 * around[1])
    chosen[0] = False
    for border in (parts[0], parts[-1], parts[:, 0], parts[:, -1]):
        chosen[border] = False
    if not chosen.any():
        return np.zeros(pale.shape, bool)
    depth = ndimage.distance_transform_edt(chosen[parts])
    widest = ndimage.maximum(depth, parts, np.arange(number + 1))
    chosen &= (2.0 * np.asarray(widest) - 1.0) * resolution <= MAX_WALL_WIDTH
    return chosen[parts]


def _neighbours(values: np.ndarray) -> tuple[tuple[np.ndarray, np.ndarray], ...]:
    """Pairs of arrays: pixels, and their neighbours on each of the four sides."""
    across, along = (values[:, 1:], values[:, :-1]), (values[1:], values[:-1])
    return across, across[::-1], along, along[::-1]
