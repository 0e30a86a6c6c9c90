"""Pictures of maps: their pixels, and which shades of a plan are walls.

Pillow, which matplotlib installs, decodes them.
"""

import warnings
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from jaxslam.core.maps import MAX_CELLS
from jaxslam.io.errors import InputError

FORMATS = ("PPM", "PNG", "BMP", "JPEG", "GIF", "TIFF")  # PPM stands for all of PBM, PGM and PPM
SUFFIXES = tuple(".png .pgm .pbm .ppm .pnm .bmp .jpg .jpeg .gif .tif .tiff".split())
NAMES = "a PNG, PGM, BMP, JPEG, GIF or TIFF image"
_WITH_ALPHA = ("1", "L", "LA", "P", "PA", "RGB", "RGBA")  # modes that Pillow converts to RGBA


def is_picture(path: str | PathLike) -> bool:
    """Whether a path has the name of a picture."""
    return Path(path).suffix.lower() in SUFFIXES


def read(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Read a picture, the first of a file that holds several.

    Args:
        path: Image of one of the `FORMATS`.

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
                return _pixels(image)
    except InputError:
        raise
    except FileNotFoundError:
        raise InputError("does not exist", path=path, advice="check its name") from None
    except Image.DecompressionBombError:
        raise InputError(f"has more than {MAX_CELLS} cells", path=path) from None
    except UnidentifiedImageError:
        raise InputError("is no image that can be read", path=path, advice=advice) from None
    except (OSError, ValueError, SyntaxError, EOFError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise InputError(f"cannot be read ({reason})", path=path, advice=advice) from None


def wall_shade(shade: np.ndarray) -> float | None:
    """The shade that best parts dark from light ones: of the largest variance between the two.

    Args:
        shade: (n,) from 0 to 1.

    Returns:
        The middle of the shades that do equally well; None where there is one level alone.

    References:
        Otsu, A Threshold Selection Method from Gray-Level Histograms, 1979.
    """
    count = np.bincount(np.round(255.0 * shade).astype(int), minlength=256)
    darker = np.cumsum(count)[:-1]  # up to each level
    lighter = count.sum() - darker
    sums = np.cumsum(count * np.arange(256.0))
    means = sums[:-1] / np.maximum(darker, 1), (sums[-1] - sums[:-1]) / np.maximum(lighter, 1)
    between = darker * lighter * (means[1] - means[0]) ** 2
    if not between.max(initial=0.0) > 0.0:
        return None
    best = np.flatnonzero(between >= between.max() * (1.0 - 1e-9))
    return (0.5 * float(best[0] + best[-1]) + 0.5) / 255.0


def _pixels(image: Any) -> tuple[np.ndarray, np.ndarray]:
    """Shade and opacity of an open Pillow image."""
    if image.mode == "I" or image.mode.startswith("I;16"):  # 16 bits a pixel
        shade = np.asarray(image).astype(np.float32) / np.float32(65535)
        return shade, np.ones(shade.shape, bool)
    colours = image if image.mode in _WITH_ALPHA else image.convert("RGB")
    values = np.asarray(colours.convert("RGBA"))
    shade = values[..., :3].mean(axis=2, dtype=np.float32) / np.float32(255)
    return shade, values[..., 3] > 127
