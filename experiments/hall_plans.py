"""Buildings with halls of 15 to 25 m, for graphs through open space."""

from collections.abc import Sequence

import numpy as np

from jaxslam.simulation.worlds import Box, outline, polyline

PILLAR = 0.4  # [m] half of a pillar's width


def _pillars(xs: Sequence[float], ys: Sequence[float]) -> list[Box]:
    """Square pillars in rows and columns."""
    return [(x - PILLAR, y - PILLAR, x + PILLAR, y + PILLAR) for x in xs for y in ys]


def _tilted(x: float, y: float, length: float, width: float, angle: float) -> np.ndarray:
    """Walls (4, 4) [m] of a box around (x, y) that is turned by an angle [rad]."""
    half = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]]) * [length / 2, width / 2]
    cosine, sine = np.cos(angle), np.sin(angle)
    return polyline(half @ np.array([[cosine, sine], [-sine, cosine]]) + [x, y])


def fair() -> np.ndarray:
    """A square hall of 20 m with four pillars and five stands, beside a corridor with rooms."""
    hall = (0.0, 0.0, 20.0, 20.0)
    corridor = (20.15, 8.8, 36.0, 11.2)
    rooms = [
        (22.0, 11.35, 28.0, 17.0),
        (28.15, 11.35, 36.0, 17.0),
        (22.0, 2.0, 29.0, 8.65),
        (29.15, 2.0, 36.0, 8.65),
    ]
    doors = [
        (20.0, 9.2, 20.15, 10.8),
        (24.0, 11.2, 25.2, 11.35),
        (31.0, 11.2, 32.2, 11.35),
        (25.0, 8.65, 26.2, 8.8),
        (33.0, 8.65, 34.2, 8.8),
    ]
    stands = [(3.5, 14.5, 6.5, 16.0), (13.0, 2.5, 14.5, 5.5), (9.0, 0.0, 11.0, 1.0)]
    solid = [*_pillars((6.5, 13.5), (6.5, 13.5)), *stands]
    turned = [_tilted(15.5, 15.8, 2.5, 1.2, 0.6), _tilted(3.4, 4.0, 2.0, 1.0, -0.5)]
    return np.vstack([outline([hall, corridor, *rooms, *doors], solid), *turned])


def foyer() -> np.ndarray:
    """An empty hall of 24 m by 16 m with two pillars, and rooms on two sides of it."""
    hall = (0.0, 0.0, 24.0, 16.0)
    rooms = [(-7.0, 0.0, -0.15, 7.5), (-7.0, 7.65, -0.15, 16.0)]
    rooms += [(x, 18.15, x + 5.85, 23.0) for x in (0.0, 6.0, 12.0, 18.0)]
    corridor = (-7.0, 16.15, 24.0, 18.0)
    doors = [(-0.15, 3.0, 0.0, 4.2), (-0.15, 11.0, 0.0, 12.2), (-4.0, 16.0, -2.8, 16.15)]
    doors += [(x, 18.0, x + 1.1, 18.15) for x in (2.0, 8.5, 14.0, 21.0)]
    doors += [(4.0, 16.0, 5.6, 16.15), (19.0, 16.0, 20.6, 16.15)]
    return outline([hall, corridor, *rooms, *doors], _pillars((8.0, 16.0), (8.0,)))


def depot() -> np.ndarray:
    """A hall of 25 m by 18 m with three rows of shelves in one half, beside offices."""
    hall = (0.0, 0.0, 25.0, 18.0)
    offices = [(2.0, -5.0, 8.0, -0.15), (8.15, -5.0, 14.0, -0.15), (14.15, -5.0, 23.0, -0.15)]
    doors = [(4.0, -0.15, 5.2, 0.0), (10.5, -0.15, 11.7, 0.0), (18.0, -0.15, 19.4, 0.0)]
    shelves = [(13.5, y, 22.0, y + 0.9) for y in (4.0, 8.5, 13.0)]
    stacks = [_tilted(4.5, 12.5, 1.6, 1.6, 0.4), _tilted(7.0, 5.5, 2.2, 1.0, 1.1)]
    return np.vstack([outline([hall, *offices, *doors], shelves), *stacks])


BUILDINGS = {"fair": fair, "foyer": foyer, "depot": depot}
"""Functions that make the walls (S, 4) [m] of each building."""
