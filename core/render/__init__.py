"""Differentiable images of a GaussianSet: `splat` (photo), `radiograph` (X-ray), `section` (cut).

Importable with numpy alone, because Blender's process samples sections without torch: the public modules import
torch and the kernels when a renderer is called.
"""

from __future__ import annotations

from .radiograph import radiograph
from .section import section
from .splat import SplatImage, SplatInfo, splat

__all__ = ["SplatImage", "SplatInfo", "radiograph", "section", "splat"]
