"""Projections of a voxel volume, by ITK-RTK on the CPU.

Joseph's method (IEEE Trans. Med. Imaging 1(3), 1982): a ray is sampled where it crosses the planes of voxel centres
along its main axis, with bilinear interpolation in each plane.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from .rtk import as_cone, circular_geometry, image_of, projection_image, run_filter
from .rtk_classes import rtk_class
from .told import Told
from .views import Detector
from .volume import Volume

_AT_ONCE = 8


def forward_project(
    volume: Volume, detectors: Sequence[Detector], step: Callable[[int], None] | None = None
) -> np.ndarray:
    """Line integrals of a volume through pixel centres; outside of it there is nothing, and none of it is lost.

    Args:
        volume: mm⁻¹.
        detectors: M of one size, in the world frame.
        step: called with the number of projections done so far; may raise to stop.

    Returns:
        (M, height, width) float32, no unit.

    Raises:
        CaptureError: a detector that RTK refuses.
    """
    import itk

    height, width = detectors[0].height, detectors[0].width
    images = np.zeros((len(detectors), height, width), np.float32)
    # Between the outermost centres and the volume's faces Joseph's planes end.
    spacing = np.asarray(volume.spacing_mm, np.float64)
    source = image_of(Volume(np.pad(volume.values, 1), spacing, volume.origin_mm - spacing))
    for first in range(0, len(detectors), _AT_ONCE):
        part = slice(first, min(first + _AT_ONCE, len(detectors)))
        geometry, pitches = circular_geometry([as_cone(one, volume.box_mm) for one in detectors[part]])
        empty = projection_image(images[part], pitches)
        solver = rtk_class("JosephForwardProjectionImageFilter", 2).New()
        solver.SetGeometry(geometry)
        solver.SetInput(0, empty)
        solver.SetInput(1, source)
        what = Told("projection of {count} views", count=part.stop - first)
        run_filter(solver, itk.ProgressEvent(), lambda: None, what)
        images[part] = itk.array_from_image(solver.GetOutput())[:, ::-1]
        if step is not None:
            step(part.stop)
    return images
