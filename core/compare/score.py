"""All figures of one row: sections against the truth, held-out views, volume and mesh; and those of the truth."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from ..capture.pinhole import camera_of
from ..errors import SettingError
from ..evaluate.heldout import projection_figures
from ..evaluate.lines import volume_projection_figures
from ..evaluate.metrics import psnr
from ..evaluate.shells import shell_distances
from ..gaussians import GaussianSet
from ..mesh.surface import extract_mesh
from ..render import radiograph
from ..render.options import SplatOptions
from ..render.voxels import voxel_averages, voxelize
from ..stages.surface.x_gaussian import projected
from ..threshold import air_threshold
from ..volume import Volume
from .meshes import BINS, Surfaces, mesh_figures, normals_of
from .pictures import CUT, save_cut
from .sections import SectionJudge
from .study import Made, Study
from .truth import Truth

Figures = dict[str, Any]
_NO_SURFACE = "no surface found"


def row_figures(study: Study, made: Made, judge: SectionJudge | None, surfaces: Surfaces | None) -> Figures:
    """What the tables say of a row.

    Returns:
        `modality`, `seconds`, `splats`, `budget`, `xray_seconds`; `sections` {piqe, psnr, ssim}, of photo splats one
        such as `paper` and one as `occupancy`, of X-Gaussian's one as `paper` beside its own; `taken_back`, why
        radiative splats do not follow the sections after all; `photos` {psnr, ssim}; `projections` {psnr}; `volume`
        {psnr}; `mesh`; `chamfer`; None for what the row or the capture has not.

    Raises:
        Cancelled: the user asked to stop.
    """
    method, report = made.method, made.report
    figures: Figures = {
        "modality": method.modality,
        "seconds": made.seconds,
        "budget": made.budget,
        "xray_seconds": made.xray_seconds,
        "splats": (report.get("splats") or {}).get("final"),
        "taken_back": (((report.get("stages") or {}).get("internal") or {}).get("xray") or {}).get("taken_back"),
        **dict.fromkeys(("sections", "photos", "projections", "volume", "mesh", "chamfer")),
    }
    if method.mesh is not None:
        return {**figures, "mesh": _photo_mesh(study, made, surfaces)}
    if method.volume is not None:
        volume = made.volume()
        return {**figures, **_density(study, made, volume, judge, surfaces), **_volume_projections(study, volume)}
    figures["photos"] = _only(report["heldout"]["photos"], "psnr", "ssim")
    if method.modality == "photos":
        return {**figures, "sections": _colored(study, made, judge)}
    figures["projections"] = _projections(study, made)
    figures["chamfer"] = shell_distances(made.run, study.settings.seed, study.reporter.check)
    if (made.folder / "xray.ply").exists():
        voxels = _voxels(study, made)
        figures |= _density(study, made, voxels, judge, surfaces)
        if _settings(made, "xray").get("model") == "x_gaussian" and judge is not None:
            # Its opacities know no mm⁻¹: as photo splats, it has the factor that suits it best. They are blended like
            # those of photos, so the paper can have cut them in the same way.
            blended = made.run.read_set("surface", "xray").to_numpy()
            figures["sections"] = {**judge.density(voxels, unit_known=False), "paper": judge.slabs(blended)}
    return figures


def truth_figures(study: Study, truth: Truth, judge: SectionJudge, surfaces: Surfaces | None) -> Figures:
    """What the tables say of what a capture is measured against.

    Returns:
        `source`, `exact`, `at_centers`, `given` (rows that see X-rays are given a volume, held-out sections too),
        `voxel_mm`, `peak_per_mm`; `material_per_mm`, the median attenuation of what is not air;
        `held_out_sections`, and `measured_sections`, those of them that show the object;
        `sections` {piqe} of its own, `nothing` {psnr, ssim, piqe} of air everywhere; `normals`, `inner_left_out`, and
        `mesh`, what voxels of that size can tell at all, None where the surfaces were taken from them or they are
        values at points; `no_surface`, true where there are no surfaces; `surface_unknown`, true where there are some
        that the truth does not tell.
    """
    nothing = judge.nothing()
    of_averages = truth.outer is not None and not truth.at_centers
    return {
        "source": truth.source,
        "exact": truth.exact,
        "at_centers": truth.at_centers,
        "given": study.capture.volume is not None and study.capture.projections is None,
        "voxel_mm": truth.volume.spacing_mm,
        "peak_per_mm": judge.peak,
        "material_per_mm": _material(truth.volume, judge.air),
        "held_out_sections": len(judge.held_out),
        "measured_sections": nothing["count"],
        "sections": judge.truth(),
        "nothing": nothing,
        "normals": None if surfaces is None else {str(bins): normals_of(surfaces.whole, bins) for bins in BINS},
        "inner_left_out": None if surfaces is None else surfaces.inner_left_out,
        "mesh": None if surfaces is None or not of_averages else volume_mesh(truth.volume, surfaces),
        "no_surface": surfaces is None and not truth.surface_unknown,
        "surface_unknown": truth.surface_unknown,
    }


def _material(volume: Volume, air: float) -> float | None:
    inside = volume.values[volume.values > air]
    return float(np.median(inside)) if inside.size else None


def _voxels(study: Study, made: Made) -> Volume:
    """The run's final model as the truth has its voxels, else on the run's own; its photo splats have no density."""
    model = GaussianSet.load(made.folder / "fused.ply").to_numpy()
    if study.truth is None:
        return voxel_averages(model, made.run.volume(), tick=study.reporter.check)
    grid = study.truth.volume
    if study.truth.at_centers:
        nz, ny, nx = grid.values.shape
        return voxelize(model, grid.origin_mm, grid.spacing_mm, (nz, ny, nx))
    return voxel_averages(model, grid, tick=study.reporter.check)


def _density(
    study: Study, made: Made, volume: Volume, judge: SectionJudge | None, surfaces: Surfaces | None
) -> Figures:
    """Sections, volume and mesh of the voxels of a model that knows attenuation; keeps some sections for pictures."""
    study.reporter.check()
    found: Figures = {"sections": None}
    if judge is not None:
        found["sections"] = judge.density(volume)
        save_cut(made.folder / CUT, judge.cut(volume))
    if study.truth is not None:
        found["volume"] = volume_figures(volume, study.truth.volume)
    study.reporter.check()
    if surfaces is not None:
        found["mesh"] = volume_mesh(volume, surfaces)
    return found


def volume_figures(volume: Volume, truth: Volume) -> Figures:
    """PSNR (dB) over all voxels of the truth's grid; full scale is its largest value (R²-Gaussian's measure)."""
    nz, ny, nx = truth.values.shape
    steps = [truth.origin_mm[k] + truth.spacing_mm[k] * np.arange(n) for k, n in enumerate((nx, ny, nz))]
    shown = np.empty(truth.values.shape, np.float32)
    for index, height in enumerate(steps[2]):
        shown[index] = volume.sample(np.stack(np.broadcast_arrays(steps[0][None, :], steps[1][:, None], height), -1))
    peak = max(float(truth.values.max()), 1e-12)
    return {"psnr": psnr(np.maximum(shown, 0.0), np.maximum(truth.values, 0.0), peak)}


def _volume_projections(study: Study, volume: Volume) -> Figures:
    projections = study.capture.projections
    if projections is None or not projections.held_out.any():
        return {}
    return {"projections": volume_projection_figures(volume, projections, study.reporter.check)}


def _colored(study: Study, made: Made, judge: SectionJudge | None) -> Figures | None:
    frame = study.photo_frame()
    if judge is None or frame is None:
        return None
    similarity, source = frame
    rgb = made.run.read_set("surface", "rgb").to_numpy().transformed(similarity)
    return {**judge.colored(rgb, vars(SplatOptions.of(made.run))), "frame": source}


def _projections(study: Study, made: Made) -> Figures | None:
    """Held-out projections as the method itself draws them: X-Gaussian blends, R²-Gaussian's integrals are affine and
    its splats end where they were trained to.

    Those are methods without `internal`: of a whole run the model in the end counts, which is drawn exactly.
    """
    projections, drawn = study.capture.projections, _settings(made, "xray")
    alone = "internal" in made.method.leave_out
    blends, is_affine = alone and drawn.get("model") == "x_gaussian", alone and drawn.get("mode") == "affine"
    if projections is None or not projections.held_out.any() or not (blends or is_affine):
        return _only(made.report["heldout"]["projections"], "psnr")
    fitted, kernel = made.run.read_set("surface", "xray").to_numpy(), study.settings.kernel
    tensors, peak = fitted.to_torch(), projections.peak(np.flatnonzero(~projections.held_out))

    def draw(index: int) -> np.ndarray:
        detector = projections.detectors[index]
        if blends:
            return projected(fitted, camera_of(detector), peak, kernel)
        with torch.no_grad():
            return radiograph(tensors, detector, kernel, "affine", drawn["cutoff_sigmas"]).numpy()

    return _only(projection_figures(fitted, projections, kernel, study.reporter.check, draw=draw), "psnr")


def _settings(made: Made, half: str) -> Figures:
    return made.report["stages"]["surface"].get("settings", {}).get(half, {})


def volume_mesh(volume: Volume, surfaces: Surfaces) -> Figures:
    """`mesh_figures` of a volume, with its `air_threshold`; `failed` where it has no surface."""
    try:
        mesh = extract_mesh(volume)
    except SettingError:
        # What its message advises, to choose a level, is nothing that a reader of tables can do.
        return {"failed": _NO_SURFACE}
    return {
        **mesh_figures(mesh, surfaces, float(np.mean(volume.spacing_mm))),
        "air_threshold_per_mm": air_threshold(volume.values),
    }


def _photo_mesh(study: Study, made: Made, surfaces: Surfaces | None) -> Figures | None:
    """Of a mesh in the photo frame, which the photos can know from outside only."""
    frame = study.photo_frame()
    if surfaces is None or frame is None:
        return None
    mesh = made.mesh()
    if len(mesh.faces) == 0:
        return {"failed": _NO_SURFACE}
    mesh.vertices = frame[0].apply(np.asarray(mesh.vertices))
    assert study.truth is not None
    voxel_mm = float(np.mean(study.truth.volume.spacing_mm))
    return {**mesh_figures(mesh, surfaces, voxel_mm), "frame": frame[1]}


def _only(figures: Figures | None, *names: str) -> Figures | None:
    if figures is None or figures.get(names[0]) is None:
        return None
    return {name: figures.get(name) for name in names}
