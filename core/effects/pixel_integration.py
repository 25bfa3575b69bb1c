"""Photos from near and far, or much larger than they are trained: splats have to be averaged over each pixel's area.

3DGS widens what a splat covers of an image by 0.3 px² whatever it is, and leaves it as bright; Analytic-Splatting
(arXiv 2403.11056) integrates over pixels instead. They are alike while a pixel spans the same on the object everywhere.
Widened as in 3DGS a line half a pixel wide covers √((s² + 0.3) / s²) times what it should: 1.5 at its distance, 1.9
half as far again, 30 % more. Splats that become fainter for it (Mip-Splatting's filter, arXiv 2311.16493), as those
of presets, cover as much as they should. Photos of six captures that were kept back came within
0.15 dB of those of splats averaged over pixels, those of two from twice as far away and from half as far were up
to 0.4 better; from farther away they were not tried (docs/settings.md).

The effect itself is an option of the renderer (`core.render.options`). Splats are trained without the 0.3 px², so
viewers that add it show them bolder.
"""

from __future__ import annotations

import numpy as np

from ..told import Told
from ..views import Camera
from .finding import EffectFinding
from .photos import PhotoEvidence

THRESHOLD = 1.5
"""Times; see above."""

_NAME, _UNIT = "pixel_integration", "times"
_FEWEST_POINTS, _FEWEST_PHOTOS = 10, 2


def detect(evidence: PhotoEvidence) -> EffectFinding:
    """How many times as much of the object a pixel spans in far photos as in near ones, or as it would if photos were
    as large as they are, whichever is more; not needed by splats that become fainter by as much as they are widened.

    Of what pixels of training span at the middle one of the object's points the 95th over the 5th percentile over
    photos counts, and of how much larger photos are than they are trained the median.
    """
    spans = [_span(camera, evidence.points) for camera in evidence.cameras]
    known = [span for span in spans if span is not None]
    widths = [photo.camera.width for photo in evidence.training if photo.camera is not None]
    shrunk = [width / camera.width for width, camera in zip(widths, evidence.cameras, strict=True)]
    larger = float(np.median(shrunk)) if shrunk else 1.0
    if len(known) >= _FEWEST_PHOTOS:
        near, far = np.percentile(known, [5, 95])
        times = max(float(far / near), larger)
        said = Told(
            "A pixel spans {times:.2f} times as much of the object in far photos as in near ones, and photos are "
            "{larger:.2f} times as large as they are trained",
            times=far / near,
            larger=larger,
        )
        found: bool | None = times >= THRESHOLD
    else:
        times = larger
        said = Told(
            "Too few photos show known points of the object to say what their pixels span, and photos are {larger:.2f} "
            "times as large as they are trained",
            larger=larger,
        )
        found = True if times >= THRESHOLD else None
    if evidence.mip_filter:
        found = False
        why = Told("splats that become fainter by as much as images widen them do without.")
        reason = Told("{said}; {why}", said=said, why=why)
    elif found is None:
        reason = Told("{said}.", said=said)
    else:
        why = Told(
            "from {least:g} times on fine detail would change its brightness between them. Other viewers show such a "
            "model bolder."
            if found
            else "less than {least:g} times does no harm.",
            least=THRESHOLD,
        )
        reason = Told("{said}; {why}", said=said, why=why)
    return EffectFinding(_NAME, found, times, _UNIT, THRESHOLD, reason, 0.0)


def _span(camera: Camera, points: np.ndarray) -> float | None:
    """Lengths a pixel at the middle one of the points in the image; None where there are hardly any."""
    shown = points[camera.pixels_of(points)[2]]
    if len(shown) < _FEWEST_POINTS:
        return None
    matrix = np.asarray(camera.world_to_camera, np.float64)
    depth = 1.0 if camera.orthographic else float(np.median(shown @ matrix[2, :3] + matrix[2, 3]))
    return depth / float(np.sqrt(camera.fx * camera.fy))
