"""The last part of the tables: how everything in them was measured, one fact in each line."""

from __future__ import annotations

from collections.abc import Iterator

from ..train.budget import ENOUGH, MOST
from .cells import Figures, ordered
from .methods import METHODS
from .sections import PAPER_READING
from .starts import ROTATION_DEG, SCALE_PERCENT, TRANSLATION_MM


def how_measured(content: Figures) -> str:
    """Facts of what the tables have rows of, then what is to be known of each row; "" if there is nothing."""
    captures = content["captures"]
    facts = [*_sections(captures), *_time(content), *_alignment(captures), *_meshes(captures), *_others(captures)]
    lines = [f"- {fact}" for fact in [*facts, *_notes(captures)]]
    return "\n".join(["## How it was measured", "", *lines]) if lines else ""


def _rows(captures: Figures) -> Iterator[tuple[str, Figures]]:
    for one in captures.values():
        yield from ordered(one["methods"])


def _sections(captures: Figures) -> Iterator[str]:
    truths = {name: one["truth"] for name, one in captures.items() if one.get("truth")}
    if not truths:
        return
    yield (
        "Every fifth axial and coronal section is held out from all training and measured, but for those that show "
        "next to no object."
    )
    yield (
        "PSNR's full scale is the 99.9th percentile of the true attenuation (of a thin rod its median); SSIM's and "
        "PIQE's grey goes from 0 to there, so that values beyond it are clipped for them, but not for PSNR."
    )
    # Comparisons of earlier versions do not say which.
    averages, at_centers = (
        [name for name, truth in truths.items() if truth.get("at_centers") is where] for where in (False, True)
    )
    if averages:
        yield (
            f"{', '.join(averages)}: voxels there count as averages, so splats are averaged over the same voxels, then "
            "both are cut alike: values at points would rate a sharper model below a blurred one."
        )
    if at_centers:
        yield f"{', '.join(at_centers)}: voxels there are values at their centres, so splats have theirs there, too."
    cut = [(method, row["sections"]) for method, row in _rows(captures) if row.get("sections")]
    if any("paper" in sections for _, sections in cut):
        yield f"“As the paper does”: {PAPER_READING}"
    if any("occupancy" in sections for _, sections in cut):
        yield (
            "Occupancy, of photo rows, which have no attenuation: 1 − Π(1 − opacity), averaged over the same voxels, "
            "times the one attenuation that fits the truth's other sections best; splats are brought to mm by the true "
            "similarity where it is known."
        )
    if any(method == "apart" for method, _ in cut):
        yield (
            "The paper's InsideOut stands beside both of ours: “halves apart” goes through its five stages, "
            "“InsideOut” refines jointly."
        )


def _time(content: Figures) -> Iterator[str]:
    timed = [row["label"] for _, row in _rows(content["captures"]) if (row.get("budget") or {}).get("seconds")]
    if content["same_time"] and timed:
        yield (
            f"{', '.join(dict.fromkeys(timed))}: they get the projections and the time that the InsideOut row spent on "
            f"X-rays. Each is run again with more or fewer iterations until it takes {100 * ENOUGH:.0f} to "
            f"{100 * MOST:.0f} % of it; the last run counts. Where the fourth missed, the number of iterations that "
            "took least of those that took enough is run once more."
        )


def _alignment(captures: Figures) -> Iterator[str]:
    found = [one["alignment"] for one in captures.values() if one.get("alignment")]
    if not found:
        return
    yield (
        "Chamfer distance: between the centres that are seen from 20 views (hidden points removed), mean of both ways; "
        "percent of the X-ray shell's box diagonal. Without alignment the photo frame's lengths are taken as mm, as in "
        "the paper."
    )
    yield (
        "“Internal” are the photo splats that followed the sections' contours."
        + (
            " “Joint” are those of the alignment in the frame that the joint refinement moved."
            if any(one.get("refined") == "joint" for one in found)
            else ""
        )
    )
    yield (
        f"A similarity counts as found within {SCALE_PERCENT} % in scale, {ROTATION_DEG:g}° and {TRANSLATION_MM} mm at "
        "the object's middle. The upright axis is how far the object leans: all that the shape of a body of revolution "
        "can decide."
    )
    if any(one.get("starts") for one in found):
        yield (
            "Random starts: photo splats, cameras, points and landmarks begin at any rotation, a fifth to five times "
            "their size, and up to three times the photo splats' extent away along each axis; then the alignment runs."
        )
    yield (
        "Where several ways to lay one half into the other look equally good, the program warns that shape alone does "
        "not decide, and asks for landmarks."
    )


def _meshes(captures: Figures) -> Iterator[str]:
    measured = [method for method, row in _rows(captures) if row.get("mesh")]
    if not measured:
        return
    yield (
        "Meshes: marching cubes between air and material, each vertex half way between what lies to either side of it, "
        "of the model voxelised as the truth is (rows that leave voxels: on their own)."
        + (" GS2Mesh's is of its fused depths." if "gs2mesh" in measured else "")
    )
    yield (
        "Distances are of points drawn evenly over the surfaces; p95 is their 95th percentile. A point of the mesh "
        "counts with the true surface that it is nearest to."
    )
    yield (
        "Spherical occupancy: the share of n directions (Fibonacci sphere) that a normal takes. Of a smooth closed "
        "surface it is 1; a box takes six directions. The paper gives a distribution without saying over what: mean "
        "and median here are over the parts of the mesh in cubes of an eighth of its longest side, “whole” is the "
        "whole mesh. Distance: total variation between the mesh's histogram of normals and the true one."
    )


def _others(captures: Figures) -> Iterator[str]:
    if any("ablation/none" in one["ablation"] for one in captures.values()):
        yield (
            "Ablation, “none”: without an alignment there is no set of both halves, so photos are then those of the "
            "photo splats in their own frame."
        )
    if any(one["projections"] for one in captures.values()):
        yield (
            "Volume PSNR of fewer projections: over all voxels of the truth's grid, with its largest value as full "
            "scale, as R²-Gaussian measures it, but that attenuations below zero, which mean nothing, count as air."
        )


def _notes(captures: Figures) -> Iterator[str]:
    """What is to be known of rows: once, where captures or tables have it alike."""
    told: dict[tuple[str, str], list[str]] = {}
    for name, one in captures.items():
        # A row of the ablation that is one of the methods, too, is told of there.
        more = {method: row for method, row in one["ablation"].items() if method not in METHODS}
        for _, row in [*ordered(one["methods"]), *more.items()]:
            if row.get("note"):
                told.setdefault((row["label"], row["note"]), []).append(name)
    labels = [label for label, _ in told]
    for (label, note), names in told.items():
        where = f" ({', '.join(names)})" if labels.count(label) > 1 else ""
        yield f"{label}{where}: {note}"
