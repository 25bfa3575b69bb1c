"""Table 3, meshes: their distances from the true surfaces, and how their normals are spread."""

from __future__ import annotations

from . import paper
from .cells import NONE, Figures, number, ordered, share, table
from .meshes import BINS

_TEXT = (
    "Distances in mm (voxels) from the true surfaces to the mesh, and from the mesh to them. Outer is what the air "
    "around the object touches, inner are all other surfaces between air and material; inner found is the share of "
    "those that the mesh comes within a voxel of."
)
_HEADINGS = (
    "",
    "method",
    "watertight",
    "outer, mean",
    "outer, p95",
    "mesh to truth, outer",
    "inner, mean",
    "inner, p95",
    "mesh to truth, inner",
    "inner found",
)
_OCCUPANCY = (
    "Spherical occupancy: the share of directions that normals take, over the parts of a mesh; the nearer to the "
    "truth's, the better. Of rows that the paper gives it for, whose columns are means over its objects; tables.json "
    "has it of all."
)
_NORMALS = ("", "method", "whole", "mean", "median", "distance", "paper: mean", "paper: median")
_VOXELS = "the truth's own voxels"


def mesh_tables(captures: Figures) -> str:
    """The tables of all captures that have a row with a mesh; "" if there is none."""
    rows: list[list[str]] = []
    normals: dict[int, list[list[str]]] = {bins: [] for bins in BINS}
    lines: list[str] = []
    for name, one in captures.items():
        found = _meshes_of(one)
        rows += [[name, label, *_distances(mesh)] for label, _, mesh in found]
        for bins in BINS:
            normals[bins] += _normals(name, one, found, str(bins))
        lines += _lines(name, one)
    if not rows:
        return "\n".join(["## 3. Meshes", "", *lines]) if lines else ""
    parts = ["## 3. Meshes", _TEXT, table(_HEADINGS, rows)]
    parts += ["\n".join(lines)] if lines else []
    parts.append(_OCCUPANCY)
    for bins in BINS:
        parts += [f"Of {bins} directions:", table(_NORMALS, normals[bins])]
    return "\n\n".join(parts)


def _meshes_of(one: Figures) -> list[tuple[str, str, Figures]]:
    """Label, method and figures of a capture's meshes; last what voxels as large as the truth's can tell at all."""
    found = [(row["label"], method, row["mesh"]) for method, row in ordered(one["methods"]) if row.get("mesh")]
    floor = (one.get("truth") or {}).get("mesh")
    if found and floor and "failed" not in floor:
        found.append((_VOXELS, "", floor))
    return found


def inner_measured(one: Figures) -> str:
    """Which share of a capture's inner surfaces is measured, as in "42 %"; "" where it is all."""
    left_out = (one.get("truth") or {}).get("inner_left_out")
    return "" if not left_out or share(left_out) == "0 %" else share(1.0 - left_out)


def _lines(name: str, one: Figures) -> list[str]:
    truth = one.get("truth") or {}
    if truth.get("surface_unknown"):
        return [
            f"- {name}: its truth.npz is from before the object's surfaces were kept in it, so no mesh is measured; "
            "make the capture again."
        ]
    if truth.get("no_surface"):
        return [f"- {name}: {truth['source']} has no surface, so no mesh is measured."]
    measured = inner_measured(one)
    if not measured or not _meshes_of(one):
        return []
    if truth["inner_left_out"] == 1.0:
        return [
            f"- {name}: there are no inner figures, since at all of its inner surfaces two materials meet, or the air "
            "is too thin for the truth's voxels."
        ]
    return [
        f"- {name}: inner figures are of {measured} of the area of the true inner surfaces; at the rest two materials "
        "meet, or the air is too thin for the truth's voxels. A room that is open to the outside counts as outer."
    ]


def _distances(mesh: Figures) -> list[str]:
    if "failed" in mesh:
        return ["no surface found", *[NONE] * 7]
    cells = ["yes" if mesh["watertight"] else "no"]
    for side in ("outer", "inner"):
        found = mesh.get(side) or {}
        there, back = found.get("from_truth"), found.get("to_truth")
        cells += [_mm(there, "mean"), _mm(there, "p95"), _mm(back, "mean")]
    return [*cells, share(mesh.get("inner_found"))]


def _mm(found: Figures | None, which: str) -> str:
    return NONE if not found else f"{found[f'{which}_mm']:.2f} ({found[f'{which}_voxels']:.2f})"


def _normals(name: str, one: Figures, found: list[tuple[str, str, Figures]], bins: str) -> list[list[str]]:
    rows = []
    for label, method, mesh in found:
        given = paper.occupancy(method, int(bins))
        if "failed" not in mesh and (given or label == _VOXELS):
            rows.append(
                [name, label, *_spread(mesh["normals"][bins]), *_paper(given if paper.object_of(name) else None)]
            )
    truth = one.get("truth") or {}
    if found and truth.get("normals"):
        rows.append([name, surface_label(truth), *_spread(truth["normals"][bins]), *_paper(None)])
    return rows


def surface_label(truth: Figures) -> str:
    """What the surfaces are called that rows are measured against."""
    if truth["exact"]:
        return "the truth"
    return "the FDK's own surface" if "FDK" in truth["source"] else "the volume's own surface"


def _spread(normals: Figures) -> list[str]:
    return [number(normals.get(key), 3) for key in ("occupancy", "patch_mean", "patch_median", "total_variation")]


def _paper(theirs: tuple[float, float] | None) -> list[str]:
    return [number(value, 3) for value in theirs or (None, None)]
