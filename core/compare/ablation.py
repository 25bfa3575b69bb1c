"""The paper's ablation, and one row more for each thing that this project adds to the paper's five stages.

A row is added by one `Method` in `ABLATION`. A change that concerns one half alone is measured on that half.
"""

from __future__ import annotations

from dataclasses import replace

from .methods import METHODS, Method, with_stage, with_xray

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
        "ablation/without_finish",
        "alignment + internal rendering, without the finish on photos",
        "both",
        lambda settings: with_stage(METHODS["apart"].change(settings), "fuse", iterations=0),
    ),
    Method(
        "ablation/xray_half",
        "X-ray half alone, before the joint refinement",
        "xray",
        leave_out=("internal",),
        note="The rows below it change one thing each of this half.",
    ),
    Method(
        "ablation/without_fdk",
        "... X-ray half from a uniform cuboid, not FDK",
        "xray",
        lambda settings: with_stage(settings, "initialize", start="acui"),
        leave_out=("internal",),
    ),
    Method(
        "ablation/without_rising_smoothness",
        "... X-ray half with the same total variation to the end",
        "xray",
        lambda settings: with_xray(settings, smooth_final=None),
        leave_out=("internal",),
    ),
    Method(
        "ablation/without_smoothness",
        "... X-ray half without total variation",
        "xray",
        lambda settings: with_xray(settings, smooth_weight=0.0, smooth_final=None),
        leave_out=("internal",),
    ),
)
