"""Differentiable images of a GaussianSet: `splat` (photo), `radiograph` (X-ray), `section` (cut).

Importable with numpy alone, because Blender's process samples sections without torch: the public modules import
torch and the kernels when a renderer is called.
"""

from __future__ import annotations

from .radiograph import radiograph
from .section import section
from .splat import SplatImage, SplatInfo, splat

KERNELS = ("cpu", "cuda", "reference")
"""What draws: Numba on the processor, NVIDIA Warp on a card, plain torch, which the other two are tested against."""

__all__ = ["KERNELS", "SplatImage", "SplatInfo", "radiograph", "section", "splat"]
