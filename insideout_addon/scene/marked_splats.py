"""Splats that an import marks, by which it is known later how points were moved by something else than this add-on.

Blender's own Apply moves the points of a model and keeps no trace of it; a scan or a mesh that is still in the frame of
the file would stand beside the model.
"""

from __future__ import annotations

import bpy
import numpy as np

from ...core.affine import Affine

# On points: which marked one they are, counted from 1; 0 of all others. On the object: (K, 3) where these were.
_MARK, _PLACES_KEY = "insideout_mark", "insideout_mark_places"
_MOST, _LOOKED_AT = 32, 2048
# Differences that count as rounding, in parts of how far the marked splats are from their middle.
_ROUNDING = 1e-3
# Of fewer one that was moved by itself would pass for a turn or a scale of all.
_FEWEST = 8
# Trials to leave out marked splats that were moved by themselves; a map that leaves less of a volume is none, in parts
# of what its largest stretch in all directions would leave: in metres a millimetre is small, but not flat.
_TRIALS, _FLAT = 8, 1e-9


def mark_splats(model: bpy.types.Object) -> None:
    """Marks some of a model's splats and keeps where they are, for `moved_since`."""
    data, count = model.data, len(model.data.points)
    some = np.unique(np.linspace(0, count - 1, min(count, _LOOKED_AT)).round().astype(int))
    position = data.attributes["position"].data
    places = np.array([position[i].vector for i in some.tolist()], np.float64).reshape(-1, 3)
    far = np.linalg.norm(places - np.nanmedian(places, axis=0), axis=1)
    # Single splats of a background may be so far away that a millimetre is nothing there.
    near = np.flatnonzero(far <= np.nanmedian(far))
    if not len(near):
        return
    chosen = near[np.unique(np.linspace(0, len(near) - 1, _MOST).round().astype(int))]
    marks = np.zeros(count, np.int8)
    marks[some[chosen]] = np.arange(1, len(chosen) + 1)
    layer = data.attributes.get(_MARK) or data.attributes.new(_MARK, "INT8", "POINT")
    layer.data.foreach_set("value", marks)
    model[_PLACES_KEY] = places[chosen].ravel().tolist()


def moved_since(model: bpy.types.Object, known: Affine) -> Affine:
    """How a model's points have been moved since they were marked.

    Args:
        known: what is known of it, which is the answer where nothing else is to be found: no splats are marked, or they
            were moved one by one.
    """
    marked, now = _found(model)
    if not len(marked):
        return known
    found = _map_of_most(known.apply(marked), now)
    return known if found is None else Affine(found.linear @ known.linear, found.apply(known.translation))


def points_are_turned_or_scaled(model: bpy.types.Object, known: Affine) -> bool:
    """Whether a model's points have been turned, mirrored or scaled since they were marked, beyond what is known: the
    splats on them have their directions and their size of before. A millisecond of a million, for panels."""
    marked, now = _found(model)
    if len(marked) < _FEWEST:
        return False
    expected = known.apply(marked)
    if _map_of_most(expected, now) is None:
        return False
    return not _agree(expected + np.median(now - expected, axis=0), now)


def _found(model: bpy.types.Object) -> tuple[np.ndarray, np.ndarray]:
    """(K, 3) where the splats were that are marked and still there, each once, and where they are."""
    layer, kept = model.data.attributes.get(_MARK), np.array(model.get(_PLACES_KEY, ()), np.float64).reshape(-1, 3)
    positions = model.data.attributes.get("position")
    if positions is None or layer is None or (layer.data_type, layer.domain) != ("INT8", "POINT"):
        return np.zeros((0, 3)), np.zeros((0, 3))
    marks = np.zeros(len(layer.data), np.int8)
    layer.data.foreach_get("value", marks)
    index = np.flatnonzero((marks > 0) & (marks <= len(kept)))
    # Of a copy, or of another model that was joined, nobody knows which is meant.
    _, first, count = np.unique(marks[index], return_index=True, return_counts=True)
    index = index[first[count == 1]]
    now = np.array([positions.data[i].vector for i in index.tolist()], np.float64).reshape(-1, 3)
    sane = np.isfinite(now).all(axis=1)
    return kept[marks[index] - 1][sane], now[sane]


def _map_of_most(expected: np.ndarray, now: np.ndarray) -> Affine | None:
    """What has moved most of the places (K, 3) away from where they are expected; None where nothing in common has."""
    if _agree(expected, now):
        return None
    found = _map_between(expected, now)
    flat = abs(np.linalg.det(found.linear)) <= _FLAT * np.linalg.norm(found.linear, 2) ** 3
    return None if flat or not _agree(found.apply(expected), now) else found


def _map_between(before: np.ndarray, now: np.ndarray) -> Affine:
    """The affine map of most of the places (K, 3); across a plane that they all lie in nothing is changed."""
    used = np.arange(len(before))
    for _ in range(_TRIALS):
        found = _nearest_map(before[used], now[used])
        wrong = np.linalg.norm(found.apply(before) - now, axis=1)
        used = np.argsort(wrong, kind="stable")[: max(len(before) // 2 + 1, min(len(before), 4))]
    return found


def _nearest_map(before: np.ndarray, now: np.ndarray) -> Affine:
    middle = before.mean(axis=0)
    size = max(float(np.abs(before - middle).max()), 1e-12)
    around = np.column_stack([(before - middle) / size, np.ones(len(before))])
    change = np.linalg.lstsq(around, now - before, rcond=1e-5)[0]
    linear = np.eye(3) + change[:3].T / size
    return Affine(linear, middle + change[3] - linear @ middle)


def _agree(expected: np.ndarray, now: np.ndarray) -> bool:
    """Whether more than half are where they are expected, for some may have been moved by themselves."""
    spread = float(np.median(np.linalg.norm(now - np.median(now, axis=0), axis=1)))
    return 2 * np.count_nonzero(np.linalg.norm(expected - now, axis=1) <= _ROUNDING * spread) > len(now)
