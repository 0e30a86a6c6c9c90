import numpy as np
import pytest

from jaxslam.core.regions import Region, Regions
from jaxslam.io.room_colours import MIN_NEIGHBOURS, cielab, region_colours

CLEAR = 12.0  # in CIELAB; about 2.3 is just noticeable, on large areas side by side


def regions(numbers, beside=lambda n: ()):
    square = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]])
    place = {n: k for k, n in enumerate(numbers)}
    found = []
    for n in numbers:
        neighbours = tuple(sorted(place[m] for m in beside(n) if m in place))
        found.append(Region(f"room_{n}", "room", square, 1.0, (), neighbours))
    return Regions(np.zeros((0, 0), np.int32), tuple(found), (), 1.0, np.zeros(3))


def distances(colours):
    lab = cielab(colours)
    return np.linalg.norm(lab[:, None] - lab, axis=2) + np.where(np.eye(len(lab)), np.inf, 0.0)


def test_known_colours_in_cielab():
    """Of Lindbloom's tables for sRGB and the white D65."""
    known = {(255, 0, 0): (53.24, 80.09, 67.20), (0, 0, 255): (32.30, 79.20, -107.86)}
    known |= {(255, 255, 255): (100.0, 0.0, 0.0), (119, 119, 119): (50.03, 0.0, 0.0)}
    np.testing.assert_allclose(cielab(list(known)), list(known.values()), atol=0.05)


def test_any_two_of_the_first_100_are_clearly_different():
    assert distances(region_colours(regions(range(1, 101)))).min() > CLEAR
    assert distances(region_colours(regions(range(1, 31)))).min() > 2 * CLEAR


@pytest.mark.parametrize("seed", range(3))
def test_neighbours_are_clearly_different(seed):
    """A ring with chords: those of one place in the palette are neighbours, too."""
    rng = np.random.default_rng(seed)
    chords = {frozenset(pair) for pair in rng.integers(1, 601, (900, 2)).tolist()}
    chords |= {frozenset((n, n + 200)) for n in range(1, 401)}
    beside: dict[int, set[int]] = {n: {n % 600 + 1, (n - 2) % 600 + 1} for n in range(1, 601)}
    for pair in chords:
        for n in pair:
            beside[n] |= pair - {n}
    made = regions(range(1, 601), beside.get)
    between = distances(region_colours(made))
    nearest = min(between[k, n] for k, r in enumerate(made.regions) for n in r.neighbours)
    assert nearest > MIN_NEIGHBOURS - 3.0  # a colour that is there is changed a little


def test_each_region_has_its_own_colour_which_is_neither_black_nor_white():
    colours = region_colours(regions(range(1, 3001)))
    assert len({tuple(c) for c in colours.tolist()}) == 3000
    assert colours.min() > 0 and (colours.min(axis=1) < 255).all()
    assert region_colours(regions([])).shape == (0, 3)


def test_a_colour_stays_with_its_name():
    colours = region_colours(regions(range(1, 101)))
    np.testing.assert_array_equal(region_colours(regions([2, 7, 93])), colours[[1, 6, 92]])
    beside = {n: {n - 1, n + 1} for n in range(1, 51)}
    np.testing.assert_array_equal(region_colours(regions(range(1, 51), beside.get)), colours[:50])
