"""Iso-lines of a section by marching squares. Numpy alone, no bpy."""

from __future__ import annotations

from collections.abc import Generator

import numpy as np

from ...core.steps import part_of_work, run_through

# Cells, edges or points that are looked at between two steps: some hundredths of a second.
_AT_ONCE = 1 << 12
# Shares of the work that are done when the cells on a line are known, then where the line crosses their edges.
_FOUND, _CROSSED = 0.5, 0.7
# Edges of a cell: 0 top, 1 right, 2 bottom, 3 left. Bits of a case: top-left, top-right, bottom-right, bottom-left.
_SEGMENTS: dict[int, tuple[tuple[int, int], ...]] = {
    1: ((3, 0),),
    2: ((0, 1),),
    3: ((3, 1),),
    4: ((1, 2),),
    6: ((0, 2),),
    7: ((3, 2),),
    8: ((2, 3),),
    9: ((2, 0),),
    11: ((2, 1),),
    12: ((1, 3),),
    13: ((1, 0),),
    14: ((0, 3),),
}
# The two saddles: joined through the middle when the cell's mean is inside, apart when it is not.
_SADDLES = {
    5: (((3, 2), (1, 0)), ((3, 0), (1, 2))),
    10: (((0, 3), (2, 1)), ((0, 1), (2, 3))),
}


def contour_lines(values: np.ndarray, level: float) -> list[np.ndarray]:
    """Lines along which an image has the value `level`, by linear interpolation.

    Args:
        values: (height, width).

    Returns:
        Lines (n, 2) of (x, y) in pixels, where the middle of the top-left pixel is (0.5, 0.5); a closed line
        repeats its first point. Longest first.
    """
    return run_through(lines_in_steps(values, level))


def lines_in_steps(values: np.ndarray, level: float) -> Generator[float, None, list[np.ndarray]]:
    """As `contour_lines`, with breaks that tell the share that is done, 0 to 1."""
    height, width = values.shape
    if height < 2 or width < 2:
        return []
    field = np.nan_to_num(values.astype(np.float64)) - level
    field[field == 0] = np.finfo(np.float64).tiny
    segments = yield from part_of_work(_segments(field), 0.0, _FOUND)
    points = {}
    for index, pair in enumerate(segments):
        if index % _AT_ONCE == 0:
            yield _FOUND + index / len(segments) * (_CROSSED - _FOUND)
        points.update((edge, _crossing(field, edge)) for edge in pair)
    chains = yield from part_of_work(_chains(segments), _CROSSED, 1.0)
    lines = [np.array([points[edge] for edge in chain]) for chain in chains]
    return sorted(lines, key=len, reverse=True)


def polygon_area(line: np.ndarray) -> float:
    """The area that a closed line (n, 2) encloses, 0 for an open one; the square of its units."""
    if len(line) < 4 or not np.allclose(line[0], line[-1]):
        return 0.0
    x, y = line.T
    return 0.5 * abs(float(np.sum(x[:-1] * y[1:] - x[1:] * y[:-1])))


def line_length(line: np.ndarray) -> float:
    """Length along a line (n, 2)."""
    return float(np.linalg.norm(np.diff(line, axis=0), axis=1).sum())


def automatic_level(values: np.ndarray) -> float:
    """Half of the material's median density: where the edge of a blurred step lies.

    Material is what reaches a tenth of the section's highest value; 0 when the section is empty.
    """
    top = float(values.max(initial=0.0))
    return 0.5 * float(np.median(values[values > 0.1 * top])) if top > 0 else 0.0


Edge = tuple[int, int, int]  # row and column of its first corner, then 0 along the row or 1 down the column


def _segments(field: np.ndarray) -> Generator[float, None, list[tuple[Edge, Edge]]]:
    inside = field > 0
    case = inside[:-1, :-1] + 2 * inside[:-1, 1:] + 4 * inside[1:, 1:] + 8 * inside[1:, :-1]
    segments = []
    cells = np.argwhere((case > 0) & (case < 15))
    for index, (row, column) in enumerate(cells):
        if index % _AT_ONCE == 0:
            yield index / len(cells)
        kind = int(case[row, column])
        if kind in _SADDLES:
            middle_inside = field[row : row + 2, column : column + 2].mean() > 0
            pairs = _SADDLES[kind][0 if middle_inside else 1]
        else:
            pairs = _SEGMENTS[kind]
        sides = ((row, column, 0), (row, column + 1, 1), (row + 1, column, 0), (row, column, 1))
        segments += [(_plain(sides[a]), _plain(sides[b])) for a, b in pairs]
    return segments


def _plain(edge: tuple) -> Edge:
    return int(edge[0]), int(edge[1]), edge[2]


def _crossing(field: np.ndarray, edge: Edge) -> tuple[float, float]:
    row, column, down = edge
    first = field[row, column]
    second = field[row + 1, column] if down else field[row, column + 1]
    part = first / (first - second)
    return (column + 0.5, row + 0.5 + part) if down else (column + 0.5 + part, row + 0.5)


def _chains(segments: list[tuple[Edge, Edge]]) -> Generator[float, None, list[list[Edge]]]:
    neighbours: dict[Edge, list[Edge]] = {}
    for a, b in segments:
        neighbours.setdefault(a, []).append(b)
        neighbours.setdefault(b, []).append(a)
    chains, seen = [], set()
    # Open lines start at the image's border, where an edge has one neighbour; what is left then is closed.
    for start in sorted(neighbours, key=lambda edge: len(neighbours[edge])):
        if start in seen:
            continue
        chain = [start]
        seen.add(start)
        while True:
            following = [edge for edge in neighbours[chain[-1]] if edge not in seen]
            if not following:
                break
            chain.append(following[0])
            seen.add(following[0])
            if len(seen) % _AT_ONCE == 0:
                yield len(seen) / len(neighbours)
        if len(chain) > 2 and start in neighbours[chain[-1]]:
            chain.append(start)
        chains.append(chain)
    return chains
