"""The paper's four tables as Markdown, each of ours beside the paper's own figures."""

from __future__ import annotations

from collections.abc import Sequence

from ..bench.machine import where
from ..train.budget import ENOUGH, MOST
from . import paper
from .ablation import ABLATION
from .cells import NONE, Figures, detail_cells, number, section_rows, table
from .methods import METHODS
from .sections import PAPER_READING
from .short import in_short, lead_lines
from .starts import ROTATION_DEG, SCALE_PERCENT, TRANSLATION_MM
from .thinning import THINNED

_READING = (
    "How to read them: PSNR (dB) says how near something is to the truth, 6 dB more are half the error; SSIM says how "
    "alike they look, 1 is the same; PIQE guesses visible faults from 0 to 100 without the truth, so a flat image has "
    "100. ↑: more is better, ↓: less is. A dash: there is no such figure."
)


def markdown(content: Figures) -> str:
    """`tables.md` of the content of `tables.json`."""
    captures = content["captures"]
    parts = [
        "# The paper's tables",
        f"Preset `{content['preset']}`, seed {content['seed']}, kernel `{content['kernel']}`.",
        _machines(content),
        "“Paper” are the figures of *InsideOut* (ICCV 2025) for its own five objects, which were never released; ours "
        "of the same names are other objects, so the columns stand side by side and are not a contest.",
        _READING,
        in_short(captures, content["same_time"]),
        _internal_detail(content, captures),
        _alignment(captures),
        _meshes(captures),
        _ablation(captures),
        _projections(captures),
        _time(content, captures),
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


def _machines(content: Figures) -> str:
    """On which machines rows were measured, and when; each capture on its own line where those are not the same."""
    found = {name: _places(one, content["machine"]) for name, one in content["captures"].items()}
    if len(set(found.values())) <= 1:
        return f"{next(iter(found.values()), where(content['machine']))}."
    return "\n".join(f"- {name}: {line}" for name, line in found.items())


def _places(capture: Figures, otherwise: Figures) -> str:
    rows = [*capture["methods"].values(), *capture["ablation"].values()]
    known = [row["machine"] for row in rows if row.get("machine")] or [capture.get("machine") or otherwise]
    dates: dict[str, list[str]] = {}
    for facts in known:
        dates.setdefault(where(facts), []).append(facts["date"])
    return "; ".join(
        f"{min(when)}, {found}" if len(set(when)) == 1 else f"{min(when)} to {max(when)}, {found}"
        for found, when in dates.items()
    )


def _internal_detail(content: Figures, captures: Figures) -> str:
    shown = {name: one for name, one in captures.items() if one.get("truth")}
    if not shown:
        return ""
    headings = ["", "PIQE ↓", "PSNR (dB) ↑", "SSIM ↑", "paper: PIQE", "paper: PSNR", "paper: SSIM"]
    parts = ["## 1. Internal detail", _how_sections(content, shown)]
    for name, one in shown.items():
        rows = []
        for method, row in _ordered(one["methods"]):
            for place, (label, figures) in enumerate(section_rows(method, row)):
                theirs = paper.detail(method, name) if place == 0 else None
                rows.append([label, *detail_cells(figures), *detail_cells(theirs)])
        truth = one["truth"]
        rows.append(["the truth", *detail_cells(truth.get("sections")), *[NONE] * 3])
        title = (
            f"**{name}**: {truth['held_out_sections']} held-out sections of {truth['source']}, "
            f"{number(max(truth['voxel_mm']))} mm voxels, full scale {truth['peak_per_mm']:.4f} mm⁻¹"
        )
        if not truth["exact"]:
            title += " (no truth: rows are measured by their likeness to it, faults of it included)"
        parts += [title, table(headings, rows)]
    whole = {name: one for name, one in shown.items() if paper.object_of(name) and one["truth"]["exact"]}
    if len(whole) > 1:
        parts += [f"**Mean of the {len(whole)} objects**", table(headings, _mean_rows(whole))]
    gain = lead_lines(shown)
    return "\n\n".join([*parts, gain] if gain else parts)


def _how_sections(content: Figures, captures: Figures) -> str:
    text = (
        "Every fifth axial and coronal section is held out from all training and compared; PSNR's full scale and "
        "PIQE's grey window go to the 99.9th percentile of the true attenuation (of a thin rod its median); sections "
        "that show no object are left out. The truth's voxels are averages, so radiative splats are averaged over the "
        "same voxels, then both are cut alike: values at points would rate a sharper model below a blurred one. Photo "
        "rows have no attenuation, so they have two rows. "
        + PAPER_READING
        + " Occupancy: 1 − Π(1 − opacity), averaged over the same voxels, times the one attenuation that fits the "
        "truth's other sections best; splats are brought to mm by the true similarity where it is known. The paper's "
        "InsideOut stands beside both of ours: “halves apart” goes through its five stages. Settings of InsideOut's "
        "presets were chosen on true sections of the five phantoms and the Shepp-Logan head; rivals have their "
        "published ones, but for what the notes below say."
    )
    if content["same_time"]:
        text += (
            " Radiative rows and NAF get the projections and the time that the InsideOut row spent on X-rays: each is "
            "run again with more or fewer iterations until it takes 100 to 120 % of it. The last run counts; where the "
            "fourth missed, the number of iterations that took least of those that took enough is run once more."
        )
    notes = {
        row["label"]: row["note"] for one in captures.values() for _, row in _ordered(one["methods"]) if row["note"]
    }
    return "\n".join([text, "", *(f"- {label}: {note}" for label, note in notes.items())]).rstrip()


def _mean_rows(captures: Figures) -> list[list[str]]:
    found: dict[str, tuple[str, int, list[Figures]]] = {}
    for one in captures.values():
        for method, row in _ordered(one["methods"]):
            for place, (label, figures) in enumerate(section_rows(method, row)):
                found.setdefault(label, (method, place, []))[2].append(figures)
    rows = []
    for label, (method, place, parts) in found.items():
        # A mean over fewer objects than the others' is not comparable.
        whole = len(parts) == len(captures)
        ours = {key: _mean([one.get(key) for one in parts]) for key in ("piqe", "psnr", "ssim")} if whole else None
        rows.append([label, *detail_cells(ours), *detail_cells(paper.mean_detail(method) if place == 0 else None)])
    return rows


def _alignment(captures: Figures) -> str:
    shown = {name: one for name, one in captures.items() if one.get("alignment")}
    if not shown:
        return ""
    rows, starts = [], []
    for name, one in shown.items():
        found = one["alignment"]
        for step, label, chamfer in _chamfer_rows(one):
            theirs = paper.chamfer_mm(step, name)
            rows.append(
                [name, label, number(chamfer.get("mm")), number(chamfer.get("percent_of_diagonal")), number(theirs)]
            )
        for way, result in (found["starts"] or {}).items():
            starts.append(
                [name, way, f"{result['found']} of {result['of']}", *_worst(result), str(result["ambiguous"])]
            )
        if found["errors"]:
            by = ", by landmarks" if found.get("by_landmarks") else ""
            starts.append([name, f"the run itself{by}", *_run_errors(found)])
    text = (
        "Chamfer distance between the photo splats and the radiative splats, centres seen from 20 views (hidden points "
        "removed), mean of both ways; percent of the X-ray shell's box diagonal. Without alignment the photo frame's "
        "lengths are taken as mm, as in the paper. “Internal” are the photo splats that followed the sections' "
        "contours; “joint” are those of the alignment in the frame that the joint refinement moved. "
        "The true similarity has a distance, too: centres of either half lie a little inside of the surface."
    )
    parts = ["## 2. Alignment", text, table(["", "alignment", "mm", "% of diagonal", "paper: mm"], rows)]
    if starts:
        headings = ["", "decided by", "found", "scale % (worst)", "rotation ° (worst)", "axis ° (worst)"]
        headings += ["translation mm (worst)", "told ambiguous"]
        text = (
            "Against the true similarity: photo splats, cameras and points start from random similarities, and count "
            f"as found within {SCALE_PERCENT} % in scale, {ROTATION_DEG:g}° and {TRANSLATION_MM} mm at the object's "
            "middle."
        )
        parts += [text, table(headings, starts)]
    return "\n\n".join(parts)


def _chamfer_rows(one: Figures) -> list[tuple[str, str, Figures]]:
    """Step, label and chamfer figures: the InsideOut row's, and with a joint refinement the paper's last step of the
    row whose halves stay apart."""
    chamfer, joint = one["alignment"]["chamfer"] or {}, one["alignment"].get("refined") == "joint"
    apart = (one["methods"].get("apart") or one["ablation"].get("apart") or {}).get("chamfer") or {}
    last = apart if joint else chamfer
    rows = [
        ("none", "none", chamfer.get("none")),
        ("align", "hierarchical", chamfer.get("align")),
        ("internal", "hierarchical + internal", last.get("internal")),
    ]
    if joint:
        rows.append(("joint", "hierarchical + joint", chamfer.get("internal")))
    if one["alignment"].get("chamfer_at_truth"):
        rows.append(("truth", "the true similarity", one["alignment"]["chamfer_at_truth"]))
    return [(step, label, figures or {}) for step, label, figures in rows]


def _worst(result: Figures) -> list[str]:
    names = ("scale_percent", "rotation_deg", "tilt_deg", "translation_mm")
    return [number(result["worst"][name]) for name in names]


def _run_errors(found: Figures) -> list[str]:
    ambiguous = "no" if found["ambiguity"] in (None, "none") else str(found["ambiguity"])
    return [NONE, *_worst({"worst": found["errors"]}), ambiguous]


def _meshes(captures: Figures) -> str:
    rows, normals = [], []
    for name, one in captures.items():
        for method, row in _ordered(one["methods"]):
            mesh = row.get("mesh")
            if mesh and "failed" in mesh:
                rows.append([name, row["label"], mesh["failed"], *[NONE] * 6])
            elif mesh:
                rows.append([name, row["label"], "yes" if mesh["watertight"] else "no", *_distances(mesh)])
                normals.append([name, row["label"], *_normals(mesh["normals"], method)])
        if one.get("truth") and any(row.get("mesh") for row in one["methods"].values()):
            floor = one["truth"].get("mesh")
            if floor and "failed" not in floor:
                rows.append(
                    [name, "the truth's own voxels", "yes" if floor["watertight"] else "no", *_distances(floor)]
                )
            normals.append([name, "truth", *_normals(one["truth"]["normals"], "")])
    if not rows:
        return ""
    text = (
        "Marching cubes between air and material, each vertex half way between what lies to either side of it, of the "
        "model voxelised on the truth's grid (rows that leave voxels: on their own; GS2Mesh: of its fused depths). "
        "Distances in mm (voxels): from the true surfaces to the mesh, mean and 95th percentile, and back; the back "
        "one counts a point of the mesh with the true surface that it is nearest to. Outer is what the air around the "
        "object touches, inner are all other surfaces between air and a material."
    )
    headings = ["", "method", "watertight", "outer, mean", "outer, p95", "back to outer"]
    headings += ["inner, mean", "inner, p95", "back to inner"]
    occupancy = (
        "Spherical occupancy: share of n directions (Fibonacci sphere) that a normal takes. Of a closed mesh it is 1; "
        "the paper gives a distribution without saying over what, here it is over the parts of the mesh in cubes of an "
        "eighth of its longest side. Distance: total variation between the mesh's normal orientation histogram and the "
        "true one."
    )
    parts = ["## 3. Meshes", text, table(headings, rows), occupancy]
    bins = ["whole", "mean", "median", "distance", "paper: mean", "paper: median"]
    return "\n\n".join([*parts, table(["", "method", *(f"{b}, {n}" for n in (42, 242) for b in bins)], normals)])


def _distances(mesh: Figures) -> list[str]:
    cells = []
    for side in ("outer", "inner"):
        found = mesh.get(side) or {}
        there, back = found.get("from_truth"), found.get("to_truth")
        cells += [_mm(there, "mean"), _mm(there, "p95"), _mm(back, "mean")]
    return cells


def _mm(found: Figures | None, which: str) -> str:
    return NONE if not found else f"{found[f'{which}_mm']:.2f} ({found[f'{which}_voxels']:.2f})"


def _normals(normals: Figures, method: str) -> list[str]:
    cells = []
    for bins in (42, 242):
        ours, theirs = normals[str(bins)], paper.occupancy(method, bins) or (None, None)
        cells += [number(ours[key], 3) for key in ("occupancy", "patch_mean", "patch_median", "total_variation")]
        cells += [number(value, 3) for value in theirs]
    return cells


_HOW_ABLATED = (
    "Held-out views of the final model; without an alignment there is none of both halves, so photos are then those of "
    "the photo splats in their own frame. A row that says so changes nothing on its object: what it leaves out is not "
    "in use there."
)
# The row that others change one thing of, by modality; of these rows another.
_WHOLE = {"both": "insideout", "xray": "ablation/xray_half"}
_WHOLE_OF = {"ablation/sections_kept": "apart", "ablation/without_finish": "apart"}


def _remark(rows: Figures, method: str) -> str:
    """What to say after a row's label."""
    row, base = rows[method], _WHOLE_OF.get(method, _WHOLE[rows[method]["modality"]])
    if row.get("taken_back"):
        return f" (sections not followed: {row['taken_back']})"
    measured = ("photos", "projections", "sections")
    if method != base and base in rows and all(row.get(key) == rows[base].get(key) for key in measured):
        return " (changes nothing here)"
    return ""


def _ablation(captures: Figures) -> str:
    rows = []
    labels = [method.name for method in ABLATION]
    for name, one in captures.items():
        for method in sorted(one["ablation"], key=lambda name: labels.index(name) if name in labels else len(labels)):
            row = one["ablation"][method]
            label = row["label"] + _remark(one["ablation"], method)
            photos, projections, sections = (row.get(key) or {} for key in ("photos", "projections", "sections"))
            rows.append(
                [
                    name,
                    label,
                    number(photos.get("psnr")),
                    number(projections.get("psnr")),
                    number(sections.get("psnr")),
                    number(sections.get("ssim"), 3),
                    number(row["seconds"] / 60, 1),
                ]
            )
    if not rows:
        return ""
    headings = ["", "", "held-out photos (dB)", "held-out projections (dB)", "sections (dB)", "SSIM", "minutes"]
    notes = {row["label"]: row["note"] for one in captures.values() for row in one["ablation"].values() if row["note"]}
    text = "\n".join([_HOW_ABLATED, "", *(f"- {label}: {note}" for label, note in notes.items())])
    return "\n\n".join(["## 4. Ablation", text.rstrip(), table(headings, rows)])


def _projections(captures: Figures) -> str:
    rows = []
    for name, one in captures.items():
        for count in sorted(one["projections"], key=int, reverse=True):
            for method in THINNED:
                if method in one["projections"][count]:
                    row = one["projections"][count][method]
                    shown = [(row.get(key) or {}).get("psnr") for key in ("projections", "volume", "sections")]
                    cells = [number(value) for value in shown]
                    rows.append([name, count, row["label"], *cells, number(row["seconds"], 0)])
    if not rows:
        return ""
    text = (
        "Training projections thinned to even steps. Volume PSNR over all voxels of the truth's grid with its largest "
        "value as full scale. InsideOut sees X-rays alone here."
    )
    headings = ["", "projections", "method", "held-out projections (dB)", "volume (dB)", "sections (dB)", "seconds"]
    return "\n\n".join(["## Fewer projections", text, table(headings, rows)])


def _time(content: Figures, captures: Figures) -> str:
    rows = []
    for name, one in captures.items():
        for _, row in _ordered(one["methods"]):
            budget = row.get("budget") or {}
            rows.append(
                [
                    name,
                    row["label"],
                    number(row["seconds"] / 60, 1),
                    NONE if row.get("splats") is None else str(row["splats"]),
                    NONE if not budget.get("iterations") else str(budget["iterations"]),
                    number(budget.get("seconds"), 0),
                    _taken(row.get("xray_seconds"), budget.get("seconds")),
                ]
            )
    if not rows:
        return ""
    text = (
        "Minutes of training, as each row took them; a row whose run was resumed has all its parts counted. X-ray "
        "seconds with how far they are from what the row was to take, and a mark (!) beyond 100 to 120 %: four tries "
        "and one more were still outside."
    )
    headings = ["", "method", "minutes", "splats", "X-ray iterations chosen", "for seconds", "X-ray seconds taken"]
    return "\n\n".join(["## Time", text, table(headings, rows)])


def _taken(seconds: float | None, wanted: float | None) -> str:
    if not seconds or not wanted:
        return number(seconds, 0)
    mark = "" if ENOUGH * wanted <= seconds <= MOST * wanted else " (!)"
    return f"{seconds:.0f} ({seconds / wanted - 1:+.0%}){mark}"


def _ordered(methods: Figures) -> list[tuple[str, Figures]]:
    known = list(METHODS)
    return sorted(methods.items(), key=lambda item: known.index(item[0]) if item[0] in known else len(known))


def _mean(values: Sequence[float | None]) -> float | None:
    given = [value for value in values if value is not None]
    return sum(given) / len(given) if given else None
