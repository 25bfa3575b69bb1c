"""How the splats of a model are drawn: part of the model, so that training, measuring and showing it agree."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from .splat import PUBLISHED_LOW_PASS

if TYPE_CHECKING:
    from ..run_folder import RunFolder


@dataclass(frozen=True)
class SplatOptions:
    """Keywords of `splat` that go with a model.

    `splat(gaussians, camera, **vars(options))` draws it as it was trained.

    Attributes:
        pixel_integration, low_pass, mip_filter: see `core.render.splat`; models of before there was a choice had 3DGS's
            low-pass, and none of them was fainter for it.
    """

    pixel_integration: bool = False
    low_pass: float = PUBLISHED_LOW_PASS
    mip_filter: bool = False

    @classmethod
    def of(cls, run: RunFolder) -> SplatOptions:
        """How the photo splats that a run's `surface` left were drawn when they were fitted: so from then on."""
        fitted = run.report("surface").get("rgb", {}) if run.is_done("surface") else {}
        return cls(**fitted.get("options", {}))
