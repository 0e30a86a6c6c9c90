"""Slow versions of the front end that are obviously right."""

import math

import numpy as np


def bits(labels):
    """Number of labels in a bit set."""
    return bin(int(labels)).count("1")


def neighbours(cell, shape):
    """The cells beside, above and below one cell, inside the grid."""
    i, j = cell
    beside = [(i + 1, j), (i - 1, j), (i, j + 1), (i, j - 1)]
    return [(a, b) for a, b in beside if 0 <= a < shape[0] and 0 <= b < shape[1]]


def block(cell, shape):
    """The cells of the 3 x 3 block around one cell, inside the grid."""
    i, j = cell
    rows, columns = range(max(i - 1, 0), i + 2), range(max(j - 1, 0), j + 2)
    return [(a, b) for a in rows for b in columns if a < shape[0] and b < shape[1]]


def expand(labels, free, steps):
    """Breadth-first search from all sources at once; a cell that several labels reach freezes."""
    cells = np.array(labels)
    arrival = np.where(cells != 0, 0, -1)
    front = [tuple(cell) for cell in np.argwhere(cells)]
    for step in range(1, steps + 1):
        reached = {}
        for cell in front:
            for beside in neighbours(cell, cells.shape):
                if bits(cells[cell]) == 1 and free[beside] and cells[beside] == 0:
                    reached.setdefault(beside, set()).add(int(cells[cell]))
        for cell, arrived in reached.items():
            cells[cell], arrival[cell] = sum(arrived), step
        front = list(reached)
    return cells, arrival


def expand_octagons(labels, free, steps):
    """Steps in turn to the four and the eight neighbours, the four first, from single labels."""
    cells = np.array(labels)
    arrival = np.where(cells != 0, 0, -1)
    for step in range(1, steps + 1):
        before = cells.copy()
        single = {c: int(x) for c, x in np.ndenumerate(before) if bits(x) == 1}
        for cell in map(tuple, np.argwhere(free & (before == 0))):
            near = {single[c] for c in neighbours(cell, cells.shape) if c in single}
            if not near and step % 2 == 0:
                near = {single[c] for c in block(cell, cells.shape) if c in single}
            if near:
                cells[cell], arrival[cell] = sum(near), step
    return cells, arrival


def junctions(cells, sources):
    """Cells whose block holds three labels or more, sources left out."""
    found = np.zeros(cells.shape, bool)
    for cell in np.argwhere((cells != 0) & ~sources):
        union = 0
        for near in block(cell, cells.shape):
            union |= 0 if sources[near] else int(cells[near])
        found[tuple(cell)] = bits(union) >= 3
    return found


def unseparated(cells, branch, sources):
    """Pairs of neighbours that belong to different regions with no branch between."""
    inner = (cells != 0) & ~branch & ~sources
    return [
        (tuple(a), b)
        for a in np.argwhere(inner)
        for b in neighbours(a, cells.shape)
        if inner[b] and cells[tuple(a)] != cells[b]
    ]


def seen_free(ranges, angle_min, angle_increment, spec):
    """Cells whose centre is nearer than the ends of the beams on either side of it."""
    free = np.zeros(spec.shape, bool)
    for i, j in np.ndindex(*spec.shape):
        x, y = (i + 0.5) * spec.cell_size + spec.x_min, (j + 0.5) * spec.cell_size - spec.y_half
        beam = (math.atan2(y, x) - angle_min) / angle_increment
        if 0 <= beam < len(ranges) - 1:
            free[i, j] = math.hypot(x, y) < min(ranges[int(beam)], ranges[int(beam) + 1])
    return free
