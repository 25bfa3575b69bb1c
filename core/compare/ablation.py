"""The paper's ablation, and one row more for each thing that this project adds to the paper's five stages.

A row is added by one `Method` in `ABLATION`. A change that concerns one half alone is measured on that half.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

from ..capture.model import Capture
from ..errors import SettingError
from ..settings import Settings
from ..stages.surface.rivals import r2_gaussian
from ..train.schedule import Decay
from .methods import METHODS, RATES, Method, as_it_is, with_stage, with_xray, without_repeats


def _joint(**changes: Any) -> Callable[[Settings], Settings]:
    def change(settings: Settings) -> Settings:
        joint = settings.stages["internal"].joint
        return settings if joint is None else with_stage(settings, "internal", joint=replace(joint, **changes))

    return change


def _halving(settings: Settings) -> Settings:
    strategy = replace(settings.stages["surface"].xray.strategy, share_density=False, halve_density=True)
    return with_xray(settings, strategy=strategy)


def _published_rates(settings: Settings) -> Settings:
    _, published = r2_gaussian()
    return with_xray(settings, **{name: getattr(published, name) for name in RATES})


def _smoothed_edges(settings: Settings) -> Settings:
    weight = settings.stages["surface"].xray.smooth_weight / 10
    return with_xray(settings, smooth_weight=weight, smooth_edge=None, smooth_trial=None)


def _published_smoothness(settings: Settings) -> Settings:
    published = r2_gaussian()[1]
    names = ("smooth_weight", "smooth_edge", "smooth_trial")
    return with_xray(settings, **{name: getattr(published, name) for name in names})


ABLATED = "ablation/"
"""What names of rows of the ablation alone begin with; on the command line they stand without it."""


def _half(name: str, label: str, change: Callable[[Settings], Settings] = as_it_is, note: str = "") -> Method:
    return Method(ABLATED + name, label, "xray", change, leave_out=("internal",), note=note)


ABLATION: tuple[Method, ...] = (
    Method("ablation/none", "none", "both", leave_out=("align", "internal")),
    Method("ablation/align", "alignment", "both", leave_out=("internal",)),
    replace(METHODS["apart"], label="alignment + internal rendering"),
    replace(METHODS["insideout"], label="alignment + joint refinement"),
    Method(
        "ablation/without_outlines",
        "... without outlines in the alignment",
        "both",
        lambda settings: with_stage(settings, "align", outline_photos=0),
    ),
    Method(
        "ablation/without_frame",
        "... joint refinement in the alignment's frame as it is",
        "both",
        _joint(similarity_rate=Decay(0.0)),
    ),
    Method("ablation/without_sections", "... joint refinement without sections", "both", _joint(section_weight=0.0)),
    Method(
        "ablation/photos_attenuate",
        "... joint refinement in which photo splats attenuate, too",
        "both",
        _joint(photos_attenuate=True),
    ),
    Method(
        "ablation/photos_shape_xray",
        "... joint refinement in which photos move and stretch radiative splats, too",
        "both",
        _joint(photos_shape_xray=True),
        note="Radiative splats have the rates and the memory of Adam that photo splats have, then.",
    ),
    Method(
        "ablation/frame_grows",
        "... joint refinement of the frame's scale, too",
        "both",
        _joint(frame_grows=True),
    ),
    Method(
        "ablation/without_finish",
        "alignment + internal rendering, without the finish on photos",
        "both",
        lambda settings: with_stage(METHODS["apart"].change(settings), "fuse", iterations=0),
    ),
    Method(
        "ablation/sections_kept",
        "alignment + internal rendering, sections followed whatever that costs the projections",
        "both",
        lambda settings: with_stage(METHODS["apart"].change(settings), "internal", projection_loss_db=None),
        note="As the paper has it.",
    ),
    _half(
        "xray_half",
        "X-ray half alone, before the joint refinement",
        note="The rows below that say “... X-ray half” change one thing each of it.",
    ),
    _half(
        "fine_start",
        "... X-ray half from random voxels of the FDK that have material, not from coarse cells",
        lambda settings: with_stage(settings, "initialize", start="fdk"),
    ),
    _half("published_rates", "... X-ray half at R²-Gaussian's rates", _published_rates),
    _half("affine", "... X-ray half with affine line integrals", lambda settings: with_xray(settings, mode="affine")),
    _half("halving", "... X-ray half, children of a split halve the density", _halving),
    _half("published_smoothness", "... X-ray half with R²-Gaussian's total variation", _published_smoothness),
    _half(
        "edges_smoothed",
        "... X-ray half, edges smoothed as all else (total variation), at a tenth of the weight",
        _smoothed_edges,
    ),
    _half(
        "without_trial",
        "... X-ray half with all of the smoothness, whether less would do better or not",
        lambda settings: with_xray(settings, smooth_trial=None),
    ),
    _half(
        "peak",
        "... X-ray half, line integrals as shares of the largest one",
        lambda settings: with_xray(settings, full_scale="peak"),
    ),
    _half(
        "squares",
        "... X-ray half, all differences squared",
        lambda settings: with_xray(settings, straight_from=None),
    ),
    _half(
        "absolute",
        "... X-ray half with L1 and D-SSIM as R²-Gaussian has them",
        lambda settings: with_xray(settings, squares_weight=None, straight_from=None, structure_weight=0.25),
    ),
    _half(
        "long_memory",
        "... X-ray half with Adam's usual memory",
        lambda settings: with_xray(settings, memory=0.999),
    ),
    _half(
        "without_thickness",
        "... X-ray half, splats as thin as they like",
        lambda settings: with_xray(settings, least_pixels=0.0),
    ),
    _half(
        "without_smoothness",
        "... X-ray half without smoothness",
        lambda settings: with_xray(settings, smooth_weight=0.0, smooth_trial=None),
    ),
    METHODS["r2_at_our_rates"],
)

_BY_NAME = {method.name.removeprefix(ABLATED): method for method in ABLATION}


def ablation_of(settings: Settings, capture: Capture, names: Sequence[str] = ()) -> list[Method]:
    """The rows that change something: a row whose setting the preset has already would only repeat another.

    Args:
        settings: the comparison's.
        capture: without photos there are the rows of the X-ray half alone.
        names: of rows, as in "none"; all if empty.

    Raises:
        SettingError: there is no row of such a name.
    """
    for name in names:
        if name not in _BY_NAME:
            raise SettingError(f"--ablation-rows {name}: there is no such row; choose of {', '.join(_BY_NAME)}.")

    shown = [
        method
        for method in _BY_NAME.values()
        if method.reason_not_for(capture) is None and (capture.photos is not None or method.modality != "both")
    ]
    rows = without_repeats([METHODS["r2_gaussian"], *shown], settings)[1:]
    for name in names:
        if _BY_NAME[name] in shown and _BY_NAME[name] not in rows:
            raise SettingError(
                f"--ablation-rows {name}: at preset {settings.preset} it changes nothing or is another row; leave it "
                "out."
            )
    return [method for method in rows if not names or method.name.removeprefix(ABLATED) in names]
