"""Looking for the effects of photos in a run: in `initialize`, and anew where they are trained otherwise since then."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..capture.model import Photos
from ..capture.registered import load_photos, save_photos
from ..effect_names import BEFORE_CAMERAS, BEFORE_SPLATS, PHOTO_EFFECTS
from ..errors import CaptureError
from .effects import BARE_PHOTOS, FILES, STRAIGHT_PHOTOS, choose, keep_choice

if TYPE_CHECKING:
    from ..effects.choose import Choice
    from ..effects.request import Request
    from ..gaussians import GaussianSet
    from .context import StageContext


def without_background(context: StageContext, photos: Photos) -> Photos:
    """The capture's photos as the run takes them: with a background that stands still taken out where that is asked
    for, or looked for and found. Leaves `background-effects.json`, and what it finds beside it.

    Raises:
        CaptureError: a photo cannot be read.
        DiskFullError, RunFolderError: the run's folder cannot be written.
        Cancelled: the user asked to stop.
    """
    request = context.request
    if request is None or not any(map(request.wants, BEFORE_CAMERAS)):
        return photos
    folder = context.run.stage("initialize")

    def look() -> dict[str, Any]:
        from ..effects.choose import look_at_background
        from ..effects.moving_background import BareEvidence

        message = "looking for a background that stands still"
        context.progress("initialize", part="effects", fraction=0.0, message=message)
        choice, kept = look_at_background(request, BareEvidence(photos, context.reporter.check), folder)
        save_photos(folder / BARE_PHOTOS, kept)
        keep_choice(folder, "background", choice)
        return {}

    context.once("initialize", "background", look, (FILES["background"], BARE_PHOTOS, *backdrops(folder / BARE_PHOTOS)))
    return load_photos(folder / BARE_PHOTOS)


def without_lens(context: StageContext, photos: Photos, triangulate: Callable[[Photos, Path], Photos]) -> Photos:
    """The photos with a lens that their files do not tell, where that is asked for, or looked for and found.

    Leaves `lens-effects.json` and `photos-with-lens.json`.

    Args:
        photos: with the cameras that were given, if any.
        triangulate: the photos with sparse points, and a model of them left in a folder.

    Returns:
        The photos that were given where no lens is taken out; else with lenses and without points.

    Raises:
        CaptureError: a photo cannot be read.
        DiskFullError, RunFolderError: the run's folder cannot be written.
        Cancelled: the user asked to stop.
    """
    request = context.request
    if request is None or not any(map(request.wants, BEFORE_SPLATS)):
        return photos
    folder = context.run.stage("initialize")

    def look() -> dict[str, Any]:
        choice, kept = _look_at_lens(context, photos, triangulate, folder)
        save_photos(folder / STRAIGHT_PHOTOS, kept)
        keep_choice(folder, "lens", choice)
        return {}

    context.once("initialize", "lens", look, (FILES["lens"], STRAIGHT_PHOTOS))
    if not context.effects.used("lens"):
        return photos
    # Backdrops and paths are as they were given.
    kept = load_photos(folder / STRAIGHT_PHOTOS).photos
    straight = [replace(one, camera=own.camera, lens=own.lens) for one, own in zip(photos.photos, kept, strict=True)]
    return Photos(straight)


def _look_at_lens(
    context: StageContext, photos: Photos, triangulate: Callable[[Photos, Path], Photos], folder: Path
) -> tuple[Choice, Photos]:
    from ..capture.tracks import brought_model
    from ..effects import lens
    from ..effects.choose import Choice, look_at_lens
    from ..effects.photos import PhotoEvidence

    request, choice = context.request, Choice()
    if request is None:
        raise AssertionError("nobody asks for effects")
    if not photos.posed or all(photo.lens is not None for photo in photos.photos):
        # There is nothing of it to take out, whoever asks.
        finding = lens.told_by_files() if photos.posed else lens.found_with_cameras()
        choice.add(finding, replace(request, on=frozenset()), 0.0)
        return choice, photos

    def model(some: Photos, place: Path) -> Path | None:
        try:
            triangulate(some, place)
        except CaptureError:
            # Without points nothing is seen of a lens; whoever needs them says why there are none.
            return None
        return place / "model"

    # Not what an earlier look left in `sfm`: its points are of photos without the lens that was found then.
    found = model(photos, folder / "sfm") if photos.points is None else brought_model(context.capture.path)
    context.progress("initialize", part="effects", fraction=0.5, message="looking for a lens that bends lines")
    apart = folder / "sfm-lens"
    evidence = PhotoEvidence(photos, np.zeros((0, 3)), context.photo_side, found, tick=context.reporter.check)
    try:
        return look_at_lens(request, evidence, lambda some: model(some, apart))
    finally:
        shutil.rmtree(apart, ignore_errors=True)


def backdrops(path: Path) -> list[str]:
    """The files that photos kept in `path` need beside their own: what stands behind the object; none without `path`.

    Raises RunFolderError for a damaged file.
    """
    if not path.exists():
        return []
    return sorted({str(photo.backdrop.path) for photo in load_photos(path).photos if photo.backdrop is not None})


def before_another_background(context: StageContext) -> list[Path]:
    """Those of the capture's photos that were left out since none of the backgrounds that stand still is behind them.

    Raises RunFolderError for a damaged file.
    """
    path = context.run.stage("initialize") / BARE_PHOTOS
    if context.capture.photos is None or not path.exists():
        return []
    kept = {photo.path for photo in load_photos(path).photos}
    return [photo.path for photo in context.capture.photos.photos if photo.path.resolve() not in kept]


def look_at_photos(context: StageContext, stage: str, fraction: float) -> None:
    """Leaves `photo-effects.json` in the folder of `initialize`, whose cameras and first splats are there already;
    what was found before these is in it, too.

    Args:
        stage, fraction: where the run is meanwhile.

    Raises:
        CaptureError: a photo cannot be read.
        Cancelled: the user asked to stop.
    """
    from ..effects.choose import look_at_photos as look
    from ..effects.photos import PhotoEvidence

    if context.request is None:
        raise AssertionError("nobody asks for effects")
    folder = context.run.stage("initialize")
    photos = load_photos(folder / "photos.json")
    points = _points_of_object(context.run.read_set("initialize", "rgb"), photos)
    model = _model_of_points(context)
    drawn, tick = context.photo_options.mip_filter, context.reporter.check
    evidence = PhotoEvidence(photos, points, context.photo_side, model, drawn, tick)

    def tell_gains(choice: Choice) -> str | None:
        from .effect_gains import tell_gains_of_photos

        return tell_gains_of_photos(context, photos, choice.rows, stage, fraction)

    def look_for(request: Request) -> Choice:
        context.progress(stage, part="effects", fraction=fraction, message="looking for effects in the photos")
        return look(request, evidence, bool(context.photo_effects))

    choice = choose(context, PHOTO_EFFECTS, look_for, tell_gains)
    choice.rows[:0] = [*context.effects.rows("background"), *context.effects.rows("lens")]
    keep_choice(folder, "photos", choice, _looked_at(context))


def _points_of_object(first: GaussianSet, photos: Photos) -> np.ndarray:
    """(P, 3) float64 sparse points and those of the hull among the first splats.

    Where there are few of both others fill the ball that cameras look at: they are grey, as no pixel of eight bits is,
    and in none of the sparse points' places.
    """
    grey = ~np.any(first.sh, axis=(1, 2))
    sparse = np.zeros((0, 3)) if photos.points is None else photos.points
    known = {place.tobytes() for place in np.asarray(sparse, np.float32)}
    random = [dull and place.tobytes() not in known for dull, place in zip(grey, first.means, strict=True)]
    return np.asarray(first.means[~np.array(random, bool)], np.float64)


def _model_of_points(context: StageContext) -> Path | None:
    """The folder of the model that the run's sparse points are from; None where there is none."""
    from ..capture.tracks import brought_model, find_model

    given = context.capture.photos
    brought = given is not None and given.posed and given.points is not None
    if brought and not context.effects.used("lens"):
        # In `sfm` there may be points of photos without a lens that was found when `initialize` was made before.
        return brought_model(context.capture.path)
    return find_model(context.run.stage("initialize") / "sfm", context.capture.path)


def look_again(context: StageContext, stage: str, fraction: float) -> None:
    """`look_at_photos` where effects were looked for with other settings of `surface` than those of now.

    What a pixel spans hangs on how large photos are trained, whether that matters on how splats are drawn, and what is
    used on what a script gives itself; `surface` may be made again with other settings while `initialize` stays.
    """
    wanted = context.request is not None and context.request.concerns("photos")
    if wanted and context.effects.looked_at("photos") != _looked_at(context):
        look_at_photos(context, stage, fraction)


def _looked_at(context: StageContext) -> dict[str, Any]:
    drawn = {"long_side": context.photo_side, "mip_filter": context.photo_options.mip_filter}
    return {**drawn, "given": bool(context.photo_effects)}
