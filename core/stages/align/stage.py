"""The stage itself: global, outline, local and fine fitting in order, each kept only if it helped."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ...evaluate.photos import photo_background, read_views, registered_photos, spread
from ...gaussians import GaussianSet
from ...render.options import SplatOptions
from ...render.voxels import voxel_averages
from ...similarity import Similarity
from ...told import Told
from ...views import Camera
from ...volume import Volume
from ..context import StageContext
from .global_fit import (
    GlobalFit,
    describe_ambiguity,
    expected_offset,
    fit_globally,
    fit_to_landmarks,
    landmarks_problem,
    landmarks_warning,
)
from .icp import mean_offset, offset_surface, two_way_score
from .local_steps import Judge, fit_locally
from .points_fit import PointsFit, refine_by_points
from .silhouettes import Outline, OutlineFit, refine_by_outlines
from .surfaces import OuterSurface, ShellPoints, foreground_views, outer_surface, shell_points


@dataclass(frozen=True)
class AlignSettings:
    """How thoroughly the two frames are laid on one another.

    Attributes:
        surface_points: samples of the X-rayed object's outer surface.
        rotations: uniform rotations tried besides PCA's 24.
        outline_photos: photos whose outlines refine the similarity; 0 leaves that step out.
        outline_size: their long side in pixels.
        local_points: at most this many splats and surface points are clustered in local fitting.
        check_photos: photos rendered after each local step, to take back what spoils them; 0 for no check.
    """

    surface_points: int = 12_000
    rotations: int = 576
    outline_photos: int = 24
    outline_size: int = 600
    local_points: int = 10_000
    check_photos: int = 4


PRESETS: dict[str, AlignSettings] = {
    "draft": AlignSettings(outline_photos=16, outline_size=400, local_points=5_000, check_photos=3),
    "standard": AlignSettings(),
    "paper": AlignSettings(
        surface_points=30_000, rotations=1152, outline_photos=48, outline_size=800, local_points=40_000
    ),
}


def reason_to_skip(context: StageContext) -> Told | None:
    """Why there is nothing to align, or None."""
    if not context.run.has_set("surface", "rgb"):
        return Told("there are no photos: nothing to align to the X-ray frame")
    if not context.run.has_set("surface", "xray") and not (context.run.path / "initialize" / "volume.npz").exists():
        return Told("there is no X-ray data: the photos stay in their own frame")
    return None


@dataclass(frozen=True, eq=False)
class _Seen:
    """What the photos say.

    Attributes:
        masked: cameras with foreground masks, None where the background is not plain.
        check: cameras with photos to compare renderings with.
        background: (3,) its plain colour, if it has one.
        points: (P, 3) triangulated points in the photo frame, if there are any.
    """

    masked: list[tuple[Camera, np.ndarray | None]]
    check: list[tuple[Camera, np.ndarray]]
    background: np.ndarray | None
    points: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class Placement:
    """Where the photo frame lies, before single splats are moved.

    Attributes:
        similarity: photo frame to mm.
        fit: the global fit that it was refined from.
        decided: whether landmarks decided it.
        warnings: for the user.
        refined: by what, and what of it is to be reported.
        rgb, shell, surface: the splats, those on the object, and the X-ray surface that they were laid on.
        seen: what the photos say.
    """

    similarity: Similarity
    fit: GlobalFit
    decided: bool
    warnings: list[Told]
    refined: dict[str, Any]
    rgb: GaussianSet
    shell: ShellPoints
    surface: OuterSurface
    seen: _Seen

    def ambiguity(self) -> dict[str, Any]:
        """`kind` ("none" where one placement is clearly best), `message`."""
        return describe_ambiguity(self.fit, self.shell, self.surface, self.decided)


def place(context: StageContext, settings: AlignSettings) -> Placement:
    """The similarity from the photo frame to mm: global fit, then triangulated points or outlines.

    Raises:
        CaptureError, Cancelled: as `run`.
    """
    context.progress("align", part="surfaces", fraction=0.0)
    rgb = context.run.read_set("surface", "rgb").to_numpy()
    surface = outer_surface(_inside(context), settings.surface_points, context.seed)
    seen = _look_at_photos(context, settings)
    shell = shell_points(rgb, seen.masked, seed=context.seed)
    context.progress("align", part="global", fraction=0.1)
    found = context.once("align", "global", lambda: _fit(context, settings, shell, surface))
    fit, decided = GlobalFit.from_json(found["fit"]), found["decided"]
    warnings = [Told.from_json(told) for told in found["warnings"]]
    refined = context.once("align", "refined", lambda: _refine(context, settings, fit, surface, seen))
    similarity = Similarity.from_json(refined["similarity"])
    return Placement(similarity, fit, decided, warnings, refined, rgb, shell, surface, seen)


def _inside(context: StageContext) -> Volume:
    """The radiative splats in voxels where projections made them: nearer to the truth than the FDK that they started
    from. Else, and where the user brought one, the volume."""
    volume, capture = context.run.volume(), context.capture
    if capture.projections is None or capture.volume is not None or not context.run.has_set("surface", "xray"):
        return volume
    return voxel_averages(context.run.read_set("surface", "xray"), volume, context.reporter.check)


def run(context: StageContext, settings: AlignSettings) -> dict[str, Any]:
    """Aligns `surface/rgb.ply` to the X-ray frame and leaves `align/rgb.ply` in mm.

    Paper, "Hierarchical Fitting", with what it leaves open settled so: a similarity instead of an affine map,
    because only that keeps rotations, scales and colours valid; shapes compared as surfaces, because RGB is a
    shell and X-rays fill the volume; trimmed distances both ways, because a bottom may be in no photo.

    A step that makes things worse is taken back: triangulated points are judged by their distance from the surface at
    their median height over it, outlines by their overlap, local steps by the trimmed chamfer of the centres of splats
    and by photos. Points, where there are enough, outrank centres, which lie inside of what they show by a thickness
    that varies; so `chamfer_mm`, of centres, may rise a little there. Points that scatter about the surface are used
    only where outlines do not help.

    Returns:
        `similarity` (photo frame to mm), `chamfer_mm` (two-way trimmed mean distance of the RGB shell and the
        outer surface after each step), `steps` (kept or taken back, and why), `ambiguity`, `runner_up`,
        `outlines`, `photo_psnr` (training photos before and after the local steps), `overlap`, `warnings`,
        `warnings_told` (the same as `Told.to_json`), `seconds`.

    Raises:
        CaptureError: the volume is uniform, or too few splats lie on the object.
        Cancelled: the user asked to stop.
    """
    started = time.monotonic()
    placed = place(context, settings)
    similarity, fit, shell, surface, seen = placed.similarity, placed.fit, placed.shell, placed.surface, placed.seen
    refined, warnings = placed.refined, placed.warnings
    offset = mean_offset(similarity, shell, surface, 2 * expected_offset(similarity, shell, surface))
    goal = offset_surface(surface, offset)
    if not fit.best.overlaps:
        apart = Told(
            "only {overlap:.0%} of the RGB surface lies near the X-ray surface: the shapes do not match; check that "
            "photos and X-rays show the same object, or give landmarks.json",
            overlap=fit.best.overlap,
        )
        warnings.append(apart)
    ambiguity = placed.ambiguity()
    if ambiguity["kind"] != "none" and not placed.decided:
        warnings.append(ambiguity["message"])
    chamfer = {
        "none": two_way_score(Similarity(), shell, goal)[0],
        "global": two_way_score(fit.best.similarity, shell, goal)[0],
    }
    if refined["by"] is not None:
        chamfer[refined["by"]] = two_way_score(similarity, shell, goal)[0]
    judge = Judge(
        replace(shell, spacing=shell.spacing * similarity.scale),
        goal,
        [(camera.transformed(similarity), image) for camera, image in seen.check],
        seen.background,
        context.kernel,
        SplatOptions.of(context.run),
    )
    in_mm = placed.rgb.transformed(similarity)
    moved, steps, photo_psnr = fit_locally(context, in_mm, judge, settings.local_points, chamfer)
    context.run.write_set("align", "rgb", moved)
    context.progress("align", part="done", fraction=1.0)
    return {
        "similarity": similarity.to_json(),
        "chamfer_mm": chamfer,
        "chamfer_measure": "two-way mean distance of splat centres and the X-ray surface at splat_offset_mm, "
        "the worst fifth of each way trimmed",
        "splat_offset_mm": offset,
        "overlap": fit.best.overlap,
        "photo_psnr": photo_psnr,
        "steps": [*refined["steps"], *steps],
        "outlines": refined["outlines"],
        "ambiguity": ambiguity,
        "runner_up": _runner_up(fit),
        "surface_threshold": surface.threshold,
        "rgb_splats_on_object": int(shell.members.sum()),
        "rgb_splats": len(placed.rgb),
        "splats": {"rgb": len(moved)},
        "warnings": warnings,
        "warnings_told": [warning.to_json() for warning in warnings],
        "seconds": time.monotonic() - started,
    }


def _look_at_photos(context: StageContext, settings: AlignSettings) -> _Seen:
    photos = registered_photos(context)
    if photos is None:
        return _Seen([], [], None)
    tick = context.reporter.check
    background = photo_background(photos, tick=tick)
    training = [photo for photo in photos.photos if photo.camera is not None and not photo.held_out]
    views = read_views(spread(training, max(settings.outline_photos, 12)), settings.outline_size, background, tick)
    masked = foreground_views([camera for camera, _ in views], [image for _, image in views], background, tick)
    check = read_views(spread(training, settings.check_photos), 300, background, tick) if settings.check_photos else []
    return _Seen(masked, check, background, photos.points)


def _fit(context: StageContext, settings: AlignSettings, shell: ShellPoints, surface: OuterSurface) -> dict[str, Any]:
    """The global `fit`, whether landmarks `decided` it, and `warnings` as `Told.to_json`; JSON-able."""

    def report(fraction: float) -> None:
        context.progress("align", part="global", fraction=0.1 + 0.4 * fraction)

    warnings = []
    landmarks = context.capture.landmarks
    if landmarks is not None:
        source, target = np.asarray(landmarks.photo, np.float64), np.asarray(landmarks.xray, np.float64)
        problem = landmarks_problem(source, target)
        if problem is None:
            fit = fit_to_landmarks(shell, surface, source, target, report)
            doubt = landmarks_warning(source, target, surface.extent)
            return {"fit": fit.to_json(), "decided": True, "warnings": [] if doubt is None else [doubt.to_json()]}
        unused = "landmarks.json was not used: {problem}; pick three or more points that span the object"
        warnings.append(Told(unused, problem=problem).to_json())
    fit = fit_globally(shell, surface, rotations=settings.rotations, on_iteration=report)
    return {"fit": fit.to_json(), "decided": False, "warnings": warnings}


def _refine(
    context: StageContext, settings: AlignSettings, fit: GlobalFit, surface: OuterSurface, seen: _Seen
) -> dict[str, Any]:
    """The `similarity` refined `by` "points", or "outlines" where points are few or scatter (None if neither helped),
    `steps` and `outlines` for the report; JSON-able."""
    similarity, by, outlines = fit.best.similarity, None, None
    by_points = _fit_points(context, fit, surface, seen)
    if by_points is None or not (by_points.accepted and by_points.sharp):
        outlines = _fit_outlines(context, settings, fit, surface, seen)
    if outlines is not None and outlines.accepted:
        similarity, by = outlines.similarity, "outlines"
    elif by_points is not None and by_points.accepted:
        similarity, by = by_points.similarity, "points"
    return {
        "similarity": similarity.to_json(),
        "by": by,
        "steps": [_points_step(by_points, by), _outline_step(by_points, outlines)],
        "outlines": _outline_report(outlines),
    }


def _fit_points(context: StageContext, fit: GlobalFit, surface: OuterSurface, seen: _Seen) -> PointsFit | None:
    if seen.points is None or len(seen.points) == 0:
        return None

    def report() -> None:
        context.progress("align", part="points", fraction=0.5)

    return refine_by_points(
        fit.best.similarity, seen.points, seen.masked, surface, landmarks=fit.landmarks, on_iteration=report
    )


def _fit_outlines(
    context: StageContext, settings: AlignSettings, fit: GlobalFit, surface: OuterSurface, seen: _Seen
) -> OutlineFit | None:
    outlines = [Outline.of(camera, mask) for camera, mask in seen.masked if mask is not None and mask.any()]
    if settings.outline_photos == 0 or len(outlines) < 3:
        return None

    def report(fraction: float) -> None:
        context.progress("align", part="outlines", fraction=0.5 + 0.3 * fraction)

    # Where the splats' thickness was told apart, the whole surface is a sharper measure than outlines.
    least_gain = 0.002 if fit.best.offset_mm == 0.0 else 0.015
    return refine_by_outlines(
        fit.best.similarity,
        surface,
        outlines,
        iterations=12,
        least_gain=least_gain,
        landmarks=fit.landmarks,
        on_iteration=report,
    )


def _points_step(by_points: PointsFit | None, by: str | None) -> dict[str, Any]:
    if by_points is None:
        return {"step": "points", "kept": False, "reason": "left out: no triangulated points"}
    scattered = by_points.accepted and by != "points"
    return {
        "step": "points",
        "kept": by == "points",
        "reason": "taken back: they scatter, and the outlines are sharper" if scattered else by_points.reason,
        "points": by_points.points,
        "misfit_before_mm": by_points.misfit_before_mm,
        "misfit_after_mm": by_points.misfit_after_mm,
        "residual_before_mm": by_points.residual_before_mm,
        "residual_after_mm": by_points.residual_after_mm,
        "surface_offset_mm": by_points.offset_mm,
    }


def _outline_step(by_points: PointsFit | None, outlines: OutlineFit | None) -> dict[str, Any]:
    if by_points is not None and by_points.accepted and by_points.sharp:
        return {"step": "outlines", "kept": False, "reason": "left out: triangulated points are the sharper measure"}
    if outlines is None:
        return {"step": "outlines", "kept": False, "reason": "left out: no photos with a plain background"}
    reason = "kept: the outlines fit better" if outlines.accepted else "taken back: the outlines did not fit better"
    return {"step": "outlines", "kept": outlines.accepted, "reason": reason}


def _outline_report(outlines: OutlineFit | None) -> dict[str, Any] | None:
    if outlines is None:
        return None
    return {
        "overlap_before": outlines.overlap_before,
        "overlap_after": outlines.overlap_after,
        "residual_px": outlines.residual_px,
        "surface_offset_mm": outlines.offset_mm,
    }


def _runner_up(fit: GlobalFit) -> dict[str, Any] | None:
    if fit.runner_up is None:
        return None
    return {
        "similarity": fit.runner_up.similarity.to_json(),
        "score_mm": fit.runner_up.score_mm,
        "best_score_mm": fit.best.score_mm,
    }
