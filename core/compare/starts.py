"""How often `align` finds the true similarity when the photos' frame starts anywhere."""

from __future__ import annotations

import shutil
from dataclasses import replace
from typing import Any

import numpy as np

from ..capture.model import Capture, Landmarks, Photos
from ..capture.registered import load_photos, save_photos
from ..files import plain
from ..progress import Reporter
from ..run_folder import RunFolder
from ..similarity import Similarity
from ..stages.align.stage import place
from ..stages.context import StageContext
from .study import Made, Study, kept_figures, titled

SCALE_PERCENT, ROTATION_DEG, TRANSLATION_MM = 0.5, 1.0, 0.5
"""Within these a similarity counts as found."""


def random_starts(study: Study, reference: Made, count: int) -> dict[str, Any] | None:
    """Aligns the InsideOut row's photo splats from random similarities of the photos' frame.

    Each start moves splats, cameras, sparse points and landmarks, and runs global fitting and its refinement; the later
    steps of `align` move single splats and leave the similarity as it is.

    Args:
        reference: the InsideOut row, whose stages `initialize` and `surface` are used.

    Returns:
        By "shape", and by "landmarks" where the capture has some: `found`, `of`, the largest errors, how many starts
        were reported as ambiguous, and every start's errors. None where there is no true similarity.

    Raises:
        Cancelled: the user asked to stop; starts that are done are kept.
    """
    truth, photos = study.truth, study.capture.photos
    if count < 1 or truth is None or truth.similarity is None or photos is None or not photos.posed:
        return None
    ways = {"shape": replace(study.capture, landmarks=None)}
    if study.capture.landmarks is not None:
        ways["landmarks"] = study.capture
    stamp = {"stages": reference.report["stages"], "settings": plain(study.settings), "truth": truth.digest}
    found = {}
    for way, capture in ways.items():
        of = stamp if capture.landmarks is None else {**stamp, "landmarks": plain(capture.landmarks)}
        found[way] = summary([_kept_start(study, reference, capture, way, index, of) for index in range(count)])
    return found


def random_similarity(seed: int, index: int, extent: float) -> Similarity:
    """Any rotation, a scale of 1/5 to 5, and a move of up to three times `extent` along each axis."""
    rng = np.random.default_rng([seed, 17, index])
    quat = rng.normal(size=4)
    w, x, y, z = quat / np.linalg.norm(quat)
    rotation = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    return Similarity(float(np.exp(rng.uniform(-1, 1) * np.log(5))), rotation, rng.uniform(-3, 3, 3) * extent)


def errors_of(found: Similarity, true: Similarity, middle_mm: np.ndarray) -> dict[str, float]:
    """How far a similarity is from the true one: scale in percent, rotation in degrees (`tilt_deg`: of the world's z
    axis alone, all that the shape of a body of revolution about it decides), and the move of the object's middle."""
    turn = found.rotation @ true.rotation.T
    moved = found.apply(true.inverse().apply(middle_mm)) - middle_mm
    return {
        "scale_percent": 100 * abs(found.scale / true.scale - 1),
        "rotation_deg": float(np.degrees(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1)))),
        "tilt_deg": float(np.degrees(np.arccos(np.clip(turn[2, 2], -1, 1)))),
        "translation_mm": float(np.linalg.norm(moved)),
    }


def is_found(errors: dict[str, Any]) -> bool:
    """Whether a similarity counts as found."""
    return (
        errors["scale_percent"] <= SCALE_PERCENT
        and errors["rotation_deg"] <= ROTATION_DEG
        and errors["translation_mm"] <= TRANSLATION_MM
    )


def summary(starts: list[dict[str, Any]]) -> dict[str, Any]:
    """How many of the starts found the true similarity, and how far off the worst of them were."""
    names = ("scale_percent", "rotation_deg", "tilt_deg", "translation_mm")
    return {
        "found": sum(is_found(start) for start in starts),
        "of": len(starts),
        "ambiguous": sum(start["ambiguity"] != "none" for start in starts),
        "worst": {name: max(start[name] for start in starts) for name in names},
        "median": {name: float(np.median([start[name] for start in starts])) for name in names},
        "starts": starts,
    }


def _kept_start(
    study: Study, reference: Made, capture: Capture, way: str, index: int, stamp: dict[str, Any]
) -> dict[str, Any]:
    study.reporter.check()
    reporter = titled(study.reporter, f"{study.name}, start {index + 1} by {way}")
    path = study.folder / "starts" / way / f"{index}.json"
    return kept_figures(path, stamp, lambda: _start(study, reference, capture, index, reporter))


def _start(study: Study, reference: Made, capture: Capture, index: int, reporter: Reporter) -> dict[str, Any]:
    truth = study.truth
    assert truth is not None
    assert truth.similarity is not None
    rgb = reference.run.read_set("surface", "rgb").to_numpy()
    spread = np.percentile(rgb.means, [5, 95], axis=0)
    start = random_similarity(study.settings.seed, index, float((spread[1] - spread[0]).max()))
    run = RunFolder(study.folder / "starts" / "work")
    shutil.rmtree(run.path, ignore_errors=True)
    try:
        photos = load_photos(reference.folder / "initialize" / "photos.json")
        save_photos(run.stage("initialize") / "photos.json", moved_photos(photos, start))
        shutil.copy2(reference.folder / "initialize" / "volume.npz", run.stage("initialize"))
        run.write_set("surface", "rgb", rgb.transformed(start))
        if reference.run.has_set("surface", "xray"):
            shutil.copy2(reference.folder / "surface" / "xray.ply", run.stage("surface"))
        landmarks = capture.landmarks
        if landmarks is not None:
            landmarks = Landmarks(start.apply(landmarks.photo), landmarks.xray)
        moved = replace(capture, landmarks=landmarks)
        context = StageContext(moved, run, study.settings.seed, study.settings.kernel, reporter)
        placed = place(context, study.settings.stages["align"])
        found = placed.similarity.after(start)
        return {
            **errors_of(found, truth.similarity, truth.middle_mm),
            "ambiguity": "none" if placed.decided else placed.ambiguity()["kind"],
            "refined_by": placed.refined["by"],
        }
    finally:
        shutil.rmtree(run.path, ignore_errors=True)


def moved_photos(photos: Photos, similarity: Similarity) -> Photos:
    """Photos whose cameras and points are moved along with the scene."""
    moved = [
        photo if photo.camera is None else replace(photo, camera=photo.camera.transformed(similarity))
        for photo in photos.photos
    ]
    points = None if photos.points is None else similarity.apply(photos.points)
    return Photos(moved, points, photos.colors)
