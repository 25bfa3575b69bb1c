"""The paper's own figures (InsideOut, ICCV 2025): tables "internal detail" and "alignment", and spherical occupancy.

They were measured on the paper's five objects, which were never released; ours of the same names are other objects.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

OBJECTS = ("matryoshka", "pharaoh", "terracotta", "skull", "toy_gun")

_DETAIL: dict[str, tuple[tuple[float, float, float], ...]] = {
    "3dgs": (
        (54.63, 16.25, 0.60),
        (43.71, 13.66, 0.62),
        (30.35, 13.47, 0.46),
        (51.71, 16.24, 0.61),
        (44.63, 18.48, 0.61),
    ),
    "mcmc": (
        (50.84, 16.12, 0.59),
        (41.63, 13.82, 0.64),
        (30.36, 13.98, 0.46),
        (50.35, 16.81, 0.61),
        (43.22, 18.68, 0.61),
    ),
    "defocus": (
        (53.62, 16.59, 0.60),
        (43.25, 13.85, 0.63),
        (31.83, 14.31, 0.47),
        (50.79, 16.71, 0.62),
        (44.29, 18.36, 0.61),
    ),
    "mask": (
        (54.34, 16.43, 0.60),
        (42.15, 13.41, 0.63),
        (30.02, 13.82, 0.46),
        (56.66, 16.35, 0.61),
        (43.58, 18.26, 0.61),
    ),
    "pixel_integration": (
        (52.71, 16.67, 0.60),
        (41.29, 13.37, 0.62),
        (31.85, 13.24, 0.47),
        (50.39, 15.87, 0.61),
        (43.82, 17.58, 0.60),
    ),
    "rolling_shutter": (
        (52.96, 16.88, 0.60),
        (44.08, 13.64, 0.62),
        (32.75, 13.57, 0.47),
        (52.32, 15.41, 0.61),
        (44.67, 17.59, 0.61),
    ),
    "naf": (
        (59.63, 17.03, 0.61),
        (64.39, 14.21, 0.64),
        (61.51, 14.88, 0.49),
        (67.82, 18.64, 0.63),
        (60.32, 18.23, 0.63),
    ),
    "x_gaussian": (
        (29.82, 17.46, 0.61),
        (33.33, 14.78, 0.64),
        (25.11, 15.20, 0.49),
        (23.71, 19.42, 0.64),
        (21.27, 19.53, 0.64),
    ),
    # The paper's own five stages, which the row `apart` goes through; `insideout` refines jointly.
    "insideout": (
        (25.28, 18.86, 0.61),
        (30.35, 15.14, 0.64),
        (25.35, 19.56, 0.55),
        (20.01, 20.33, 0.65),
        (20.74, 20.87, 0.66),
    ),
}
_DETAIL["apart"] = _DETAIL["insideout"]

_CHAMFER_MM = {
    "none": (38.56, 27.93, 21.29, 722.45, 23.02),
    "align": (8.41, 12.52, 11.44, 9.53, 4.59),
    "internal": (6.45, 4.10, 2.42, 7.95, 3.42),
}

_OCCUPANCY = {
    "r2_gaussian": {42: (0.431, 0.429), 242: (0.468, 0.466)},
    "gs2mesh": {42: (0.437, 0.429), 242: (0.476, 0.475)},
    "insideout": {42: (0.443, 0.452), 242: (0.471, 0.471)},
}
_OCCUPANCY["apart"] = _OCCUPANCY["insideout"]


def object_of(capture: str) -> str | None:
    """Which of the paper's objects a capture's name stands for ("Toy Gun", "toy-gun_2" ...), or None."""
    name = "".join(letter if letter.isalnum() else "_" for letter in capture.lower())
    return next((one for one in OBJECTS if name.startswith((one, one.replace("_", "")))), None)


def detail(method: str, capture: str) -> dict[str, float] | None:
    """PIQE, PSNR (dB) and SSIM of sections that the paper gives for a method on the object of that name."""
    known = object_of(capture)
    if known is None or method not in _DETAIL:
        return None
    return dict(zip(("piqe", "psnr", "ssim"), _DETAIL[method][OBJECTS.index(known)], strict=True))


def mean_detail(method: str, objects: Sequence[str] = OBJECTS) -> dict[str, float] | None:
    """The same, mean over some of its objects, all five if none are named."""
    if method not in _DETAIL:
        return None
    columns = zip(*(_DETAIL[method][OBJECTS.index(name)] for name in objects), strict=True)
    return {name: sum(column) / len(column) for name, column in zip(("piqe", "psnr", "ssim"), columns, strict=True)}


def one_of_each(names: Iterable[str]) -> list[str]:
    """Names of captures without those that stand for an object of the paper that one before them stands for: in a
    mean an object counts once."""
    kept: dict[str, str] = {}
    for name in names:
        kept.setdefault(object_of(name) or f"capture {name}", name)
    return list(kept.values())


def chamfer_mm(step: str, capture: str) -> float | None:
    """Chamfer distance by step: "none", "align" (hierarchical alignment), "internal" (and internal rendering)."""
    known = object_of(capture)
    return None if known is None or step not in _CHAMFER_MM else _CHAMFER_MM[step][OBJECTS.index(known)]


def occupancy(method: str, bins: int) -> tuple[float, float] | None:
    """Mean and median spherical occupancy at 42 or 242 bins, which the paper gives as means over its objects."""
    return _OCCUPANCY.get(method, {}).get(bins)
