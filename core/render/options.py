"""How the splats of a model are drawn: part of the model, so that training, measuring and showing it agree."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class SplatOptions:
    """Keywords of `splat` that go with a model.

    `splat(gaussians, camera, **vars(options))` draws it as it was trained.

    Attributes:
        pixel_integration: see `core.render.splat`.
    """

    pixel_integration: bool = False
