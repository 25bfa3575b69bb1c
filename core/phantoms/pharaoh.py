"""An Egyptian coffin in the shape of a man, of wood under painted gesso, with a mummy in it.

It stands on its foot end and looks towards −y. Lid and trough meet in a joint all around, pegged with dowels. Crook
and flail, the upper and the lower arm, and a seal on one shoulder tell left from right.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from . import shapes, solids
from .materials import Material
from .model import Part, Phantom
from .pharaoh_mummy import mummy_parts
from .pharaoh_paint import paint
from .solid_table import SolidTable, curve, loft

JOINT_Y = 3.0
_WALL_MM, _FOOT_WALL_MM, _GESSO_MM = 4.5, 6.0, 0.5
_FOOT_Z = -60.0
_GESSO = Material("gesso", (("CaCO3", 0.85), ("C3H5NO", 0.15)), 1.20)
_LID = Material("cedar wood", "C6H10O5", 0.58)
_TROUGH = Material("sycamore fig wood", "C6H10O5", 0.50)
_DOWEL = Material("acacia wood", "C6H10O5", 0.95)
_ENERGY_KEV = 40.0

# z, half width, reach to the front and to the back of the plane of the joint, mm.
_BODY = np.array(
    [
        [-60, 13.4, 9.5, 12.0],
        [-50, 12.9, 9.5, 12.0],
        [-40, 13.6, 10.4, 12.6],
        [-25, 16.2, 12.4, 13.8],
        [-10, 18.8, 14.2, 14.8],
        [5, 21.0, 15.2, 15.4],
        [15, 22.0, 15.4, 15.6],
        [21, 21.8, 14.8, 15.5],
        [26, 20.0, 13.2, 15.0],
        [30, 16.5, 11.5, 14.0],
        [34, 11.0, 8.5, 11.5],
    ],
    float,
)
_HEADDRESS = np.array(
    [
        [20, 16.5, 12.5, 14.0],
        [28, 17.6, 12.0, 14.2],
        [34, 17.4, 11.2, 14.0],
        [40, 16.6, 10.9, 13.7],
        [47, 15.2, 10.8, 13.2],
    ],
    float,
)


@lru_cache(maxsize=1)
def hull() -> SolidTable:
    """The coffin without its relief."""
    body, headdress = loft(_BODY, 2.5, JOINT_Y), loft(_HEADDRESS, 2.3, JOINT_Y)
    upright = np.eye(3)

    def implicit(points: np.ndarray) -> np.ndarray:
        dome = solids.ellipsoid(points, np.array([0.0, 4.2, 46.5]), upright, (15.3, 12.1, 12.2))
        face = solids.ellipsoid(points, np.array([0.0, -5.6, 43.6]), upright, (8.7, 7.6, 11.2))
        feet = solids.box(points, (0.0, -4.0, -51.5), (12.6, 15.0, 8.5), 3.0)
        slope = (points[:, 2] + 47.5) * 0.94 - (points[:, 1] + 14.0) * 0.34
        head = solids.joined([headdress(points), dome, face], 1.5)
        whole = solids.joined([body(points), head, np.maximum(feet, slope)], 5.0)
        return np.maximum(whole, _FOOT_Z - points[:, 2])

    return SolidTable.of(implicit, (-26, -25, -64), (26, 24, 64))


def pharaoh() -> Phantom:
    """The phantom: coffin, air, and the wrapped body with its skeleton, resin and amulet."""
    parts = [
        Part("gesso", surface, _GESSO),
        Part("lid", _lid, _LID),
        Part("trough", lambda points: np.maximum(hull().distance(points) + _GESSO_MM, JOINT_Y - points[:, 1]), _TROUGH),
        Part("joint", _joint, None),
        Part("dowels", _dowels, _DOWEL),
        Part("cavity", _cavity, None),
        *mummy_parts(),
    ]
    return Phantom(
        name="pharaoh",
        parts=tuple(parts),
        surface=surface,
        color=_color,
        size_mm=(50.0, 44.0, 122.0),
        energy_kev=_ENERGY_KEV,
        landmarks=_landmarks(),
    )


def surface(points: np.ndarray) -> np.ndarray:
    """(N,) signed distance of the coffin with all relief and the joint's groove."""
    bare = hull().distance(points)
    total = np.where(bare > 0, np.maximum(bare - 7.0, 0.2 * bare), bare)
    near = np.flatnonzero(np.abs(bare) < 9.0)
    if len(near):
        close, skin = points[near], bare[near]
        solid = skin
        for name, distance in relief(close, skin).items():
            solid = shapes.smooth_union(solid, distance.astype(np.float32), _BLENDS.get(name, 0.4))
        groove = np.maximum(-(skin + _GESSO_MM), np.abs(close[:, 1] - JOINT_Y) - 0.4)
        total[near] = np.maximum(solid, -groove)
    return total


def front_y(x: np.ndarray | float, z: np.ndarray | float, lift: np.ndarray | float = 0.0) -> np.ndarray:
    """y in mm of the bare coffin's front at (x, z), `lift` mm off its surface."""
    x, z, lift = np.broadcast_arrays(*(np.asarray(value, np.float32) for value in (x, z, lift)))
    depths = np.arange(-24.0, JOINT_Y, 0.05, dtype=np.float32)
    line = np.stack(np.broadcast_arrays(x[..., None], depths, z[..., None]), axis=-1)
    found = hull().distance(line.reshape(-1, 3)).reshape(line.shape[:-1])
    return depths[np.argmax(found < lift[..., None], axis=-1)]


@lru_cache(maxsize=64)
def _front_at(x: float, z: float, lift: float) -> float:
    return float(front_y(x, z, lift))


def _on_front(xz: list[tuple[float, float]], lift: float) -> np.ndarray:
    """(40, 3) a smooth curve `lift` mm off the front through points given as x and z."""
    flat = curve(xz)
    return np.stack([flat[:, 0], front_y(flat[:, 0], flat[:, 1], lift), flat[:, 1]], axis=1)


_SEAL_X, _SEAL_Z = 14.6, -2.0
_STRINGS = ((14.6, 17.0), (17.2, 18.4), (19.4, 20.4))
_BLENDS = {"nose": 1.0, "lips": 0.6, "chin": 1.5, "lower arm": 0.8, "upper arm": 0.8, "ears": 0.8}


@lru_cache(maxsize=1)
def _curves() -> dict[str, np.ndarray]:
    """Center lines of what is laid on the coffin's front, (K, 3) mm each."""
    return {
        "lower arm": _on_front([(18.5, 3.5), (6, 9.5), (-6.5, 15.5)], -0.4)[::8],
        "upper arm": _on_front([(-18.5, 3.5), (-6, 9.5), (6.5, 15.5)], 1.0)[::8],
        "crook": _on_front(
            [(-4.0, 8.5), (-7.5, 17), (-11.0, 26), (-12.3, 30), (-15.4, 31.6), (-17, 28.5), (-15.0, 26.6)], 2.4
        )[::2],
        "flail": _on_front([(4.4, 8.5), (7.5, 16.5), (11.8, 27.5)], 3.4)[::5],
        "brow": _on_front([(1.6, 48.6), (4.0, 49.4), (7.0, 47.9)], 0.0)[::5],
        "band": _on_front([(-9.6, 47.5), (-6.6, 52.0), (0.0, 53.8), (6.6, 52.0), (9.6, 47.5)], 0.5)[::3],
    }


def relief(points: np.ndarray, skin: np.ndarray) -> dict[str, np.ndarray]:
    """Signed distances (N,) of what stands out from the bare coffin, by name; `skin` (N,) is the distance to it."""
    found = solids.boxed(points, (-20, -23, 12), (20, 23, 62), lambda p: _dress(p, hull().distance(p)))
    found.update(solids.boxed(points, (-10.6, -20, 18), (10.6, -3, 60), _face))
    found.update(solids.boxed(points, (-22.5, -20, 0), (22.5, 3, 34), _regalia))
    reach = np.hypot(points[:, 0] - _SEAL_X, points[:, 2] - _SEAL_Z) - 3.2
    found["seal"] = np.maximum(skin - 0.9, np.maximum(reach, points[:, 1]))
    found["apron"] = np.maximum(skin - 0.7, _apron_outline(points))
    return found


def _dress(points: np.ndarray, skin: np.ndarray) -> dict[str, np.ndarray]:
    return {"cloth": _cloth(points, skin), "collar": _collar(points, skin)}


def _arms(points: np.ndarray) -> dict[str, np.ndarray]:
    found = {}
    for name in ("lower arm", "upper arm"):
        path = _curves()[name]
        fist = solids.ellipsoid(points, path[-1], np.eye(3), (3.3, 2.9, 2.9))
        found[name] = np.minimum(shapes.tube(points, path, 2.7), fist)
    return found


def _regalia(points: np.ndarray) -> dict[str, np.ndarray]:
    crook = shapes.tube(points, _curves()["crook"], 1.15)
    return {**_arms(points), "crook": crook, "flail": _stick(points), "beads": _beads(points)}


def _cloth(points: np.ndarray, skin: np.ndarray) -> np.ndarray:
    """The striped headdress: over the head around the face, two lappets on the chest, a flap down the back."""
    x, y, z = np.abs(points[:, 0]), points[:, 1], points[:, 2]
    lappet = np.maximum(solids.polygon(x, z, [(7.2, 13.0), (14.2, 14.5), (17.5, 32.0), (8.2, 34.0)]), y - 3.0)
    flap = np.maximum(solids.polygon(x, z, [(-7.0, 14.0), (7.0, 15.0), (17.0, 32.0), (-7.0, 36.0)]), 3.0 - y)
    outline = np.minimum(np.minimum(lappet, flap), 30.0 - z)
    opening = np.hypot(x, np.where(z > 42.0, 0.86, 0.66) * (z - 42.0)) - 9.4
    opening = np.maximum(opening, y - 2.0)
    throat = solids.plate(solids.polygon(x, z, [(-1, 20), (7.4, 20), (8.0, 40), (-1, 40)]), y + 12.0, 10.0)
    return np.maximum(skin - 1.5, np.maximum(outline, -np.minimum(opening, throat)) * 0.85)


def _collar(points: np.ndarray, skin: np.ndarray) -> np.ndarray:
    """The broad collar below the throat, wide from shoulder to shoulder."""
    outer = np.maximum(np.hypot(points[:, 0] * 0.85, points[:, 2] - 30.0) - 15.6, points[:, 2] - 31.5)
    return np.maximum(skin - 0.8, np.maximum(outer, points[:, 1] - 0.8))


def _apron_outline(points: np.ndarray) -> np.ndarray:
    """The column of writing down the front of the legs."""
    return np.maximum(
        solids.polygon(points[:, 0], points[:, 2], [(-4.4, -44), (4.4, -44), (5, 0), (-5, 0)]), points[:, 1]
    )


def _face(points: np.ndarray) -> dict[str, np.ndarray]:
    folded, upright = solids.mirrored(points), np.eye(3)
    curves = _curves()
    tilt = np.radians(8.0)
    slanted = np.array([[np.cos(tilt), 0, np.sin(tilt)], [0, 1, 0], [-np.sin(tilt), 0, np.cos(tilt)]])
    eye = solids.ellipsoid(folded, np.array([3.7, _front_at(3.7, 46.0, -0.25), 46.0]), slanted, (2.5, 0.9, 1.2))
    nose = solids.rod(points, (0, _front_at(0, 47.0, -0.4), 47.0), (0, _front_at(0, 42.6, 0.6), 42.6), 0.8, 1.35)
    nostril = shapes.sphere(folded, np.array([1.1, _front_at(1.1, 42.2, 0.0), 42.2]), 0.9)
    lip = _front_at(0, 39.2, 0.0)
    upper = solids.ellipsoid(points, np.array([0.0, lip, 39.6]), upright, (2.7, 1.0, 0.65))
    lower = solids.ellipsoid(points, np.array([0.0, lip, 38.5]), upright, (2.2, 1.1, 0.75))
    chin = shapes.sphere(points, np.array([0.0, _front_at(0, 35.6, -1.6), 35.6]), 2.4)
    serpent = shapes.tube(
        points, np.array([[0, -9.0, 52.5], [0, -10.6, 53.5], [0, -11.5, 55.5], [0, -12.6, 56.8]]), 1.1
    )
    hood = solids.ellipsoid(points, np.array([0.0, -11.2, 55.2]), upright, (1.9, 0.9, 2.2))
    return {
        "eyes": eye,
        "brows": shapes.tube(folded, curves["brow"], 0.55),
        "nose": np.minimum(nose, nostril),
        "lips": np.minimum(upper, lower),
        "chin": chin,
        "ears": solids.ellipsoid(folded, np.array([9.3, -6.6, 44.2]), upright, (1.0, 1.7, 2.9)),
        "beard": _beard(points),
        "band": shapes.tube(points, curves["band"], 1.25),
        "serpent": np.minimum(serpent, hood),
    }


def _beard(points: np.ndarray) -> np.ndarray:
    start = (0.0, _front_at(0.0, 35.0, 0.0), 34.6)
    end = np.array([0.0, _front_at(0.0, 22.0, 3.4), 22.0])
    tip = shapes.sphere(points, end + np.array([0.0, -1.3, -1.8]), 1.9)
    return shapes.smooth_union(solids.rod(points, start, end, 1.5, 2.3), tip, 0.8)


def _stick(points: np.ndarray) -> np.ndarray:
    return shapes.tube(points, _curves()["flail"], 1.1)


def _beads(points: np.ndarray) -> np.ndarray:
    """Three strings that hang from the flail's end over the shoulder."""
    total = np.full(len(points), np.inf, np.float32)
    for x, z in _STRINGS:
        string = _hanging(x, z)
        total = np.minimum(total, shapes.tube(points, string[::3], 0.55))
        for bead in string[2::3]:
            total = np.minimum(total, shapes.sphere(points, bead, 0.95))
    return total


@lru_cache(maxsize=8)
def _hanging(x: float, z: float) -> np.ndarray:
    return _on_front([(11.8, 27.5), (0.5 * (x + 12.4) + 0.8, 0.5 * (z + 28.0)), (x, z)], 2.2)[::4]


def _lid(points: np.ndarray) -> np.ndarray:
    """Front half with arms and beard, which are carved; finer relief is modelled in the gesso."""
    solid = hull().distance(points)
    carved = solids.boxed(points, (-22.5, -20, 0), (22.5, 3, 34), _arms)
    carved.update(solids.boxed(points, (-3, -20, 17), (3, -8, 37), lambda p: {"beard": _beard(p)}))
    solid = np.minimum.reduce([solid, *carved.values()]) + _GESSO_MM
    return np.maximum(solid, points[:, 1] - JOINT_Y)


def _joint(points: np.ndarray) -> np.ndarray:
    return np.maximum(hull().distance(points) - 1.0, np.abs(points[:, 1] - JOINT_Y) - 0.25)


@lru_cache(maxsize=1)
def _dowel_places() -> np.ndarray:
    """(8, 3) centres, in the middle of the walls at the joint."""
    heights = np.array([-42.0, -14.0, 12.0, 38.0], np.float32)
    reach = np.arange(8.0, 24.0, 0.05, dtype=np.float32)
    line = np.stack(np.broadcast_arrays(reach, np.float32(JOINT_Y), heights[:, None]), axis=-1)
    depth = hull().distance(line.reshape(-1, 3)).reshape(len(heights), -1)
    x = reach[np.argmax(depth > -0.5 * _WALL_MM, axis=1)]
    right = np.stack([x, np.full(4, JOINT_Y, np.float32), heights], axis=1)
    return np.concatenate([right, right * np.array([-1, 1, 1], np.float32)])


def _dowels(points: np.ndarray) -> np.ndarray:
    return np.minimum.reduce([solids.disc(points, place, 1, 1.2, 5.0) for place in _dowel_places()])


def _cavity(points: np.ndarray) -> np.ndarray:
    floor = np.float32(_FOOT_Z + _FOOT_WALL_MM) - points[:, 2]
    return np.maximum(hull().distance(points) + np.float32(_WALL_MM), floor)


def _color(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    skin = hull().distance(points)
    return paint(points, normals, relief(points, skin), skin)


def _landmarks() -> np.ndarray:
    """(8, 3) mm: nose tip, beard, both fists, crook's bend, seal, crown, middle of the feet's front edge."""
    curves = _curves()
    lower, upper = curves["lower arm"][-1], curves["upper arm"][-1]
    targets = [(0.0, 42.6), (0.0, 21.0), (lower[0], lower[2]), (upper[0], upper[2]), (-16.8, 29.0), (14.6, -2.0)]
    starts = [(np.array([x, -30.0, z]), np.array([0.0, 1.0, 0.0])) for x, z in targets]
    starts.append((np.array([0.0, 4.2, 70.0]), np.array([0.0, 0.0, -1.0])))
    starts.append((np.array([0.0, -30.0, -54.0]), np.array([0.0, 1.0, 0.0])))
    return np.array([_first_hit(start, direction) for start, direction in starts])


def _first_hit(start: np.ndarray, direction: np.ndarray) -> np.ndarray:
    line = start + np.arange(0, 30, 0.005)[:, None] * direction
    return line[np.argmax(surface(line.astype(np.float32)) < 0)]
