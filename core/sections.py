"""Cuts through the object: where they lie, what the volume shows on them, and the object's outer contour there.

Paper section "Internal Rendering": axial and coronal cross-sections of the X-ray volume are the pseudo ground
truth for both modalities. Choosing planes and sampling them needs numpy alone; contours need scikit-image and
OpenCV.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from .errors import SettingError
from .threshold import air_threshold
from .views import Plane
from .volume import Volume

STEP_MM = 15.0
"""The paper's distance between neighbouring planes; the upper bound of ours."""
PLANES_PER_EXTENT = 24
"""At least this many planes along an axis, so that an object smaller than 36 cm is not sampled too thinly."""
HOLD_OUT_EVERY = 5

# kind -> (axis of the normal, world axis along a row, world axis down a column): seen from above and from the front.
_AXES = {"axial": (2, 0, 1), "coronal": (1, 0, 2), "sagittal": (0, 1, 2)}


@dataclass(frozen=True, eq=False)
class SectionView:
    """One cut of a series.

    Attributes:
        plane: where its pixels lie.
        kind: "axial" (normal z), "coronal" (normal y) or "sagittal" (normal x).
        position_mm: world coordinate along the normal's axis.
        held_out: for measuring only, never trained on.
    """

    plane: Plane
    kind: str
    position_mm: float
    held_out: bool = False


@dataclass(frozen=True, eq=False)
class OuterContour:
    """Where the object is on a section, seen from outside.

    Attributes:
        mask: (H, W) bool, inside the outer contours; cavities count as inside.
        edge: (H, W) bool, the mask's outermost pixels.
    """

    mask: np.ndarray
    edge: np.ndarray


def section_step(extent_mm: float) -> float:
    """Distance between planes along an extent: min(15 mm, extent / 24)."""
    return min(STEP_MM, extent_mm / PLANES_PER_EXTENT)


def choose_planes(
    box_mm: np.ndarray,
    step_mm: float | None = None,
    planes: Sequence[str] = ("axial", "coronal"),
    pixel_mm: float | np.ndarray | None = None,
    jitter_seed: int | None = None,
) -> list[SectionView]:
    """Planes through a box at equal steps, every fifth held out.

    Each plane owns the cell half a step to either side of it. Jitter moves a training plane anywhere inside its own
    cell, so it comes no closer than half a step to a held-out plane; held-out planes never move.

    Args:
        box_mm: (2, 3) lowest and highest corner.
        step_mm: wanted distance between planes; `section_step` of each axis' extent if None. The extent is divided
            into whole cells, none wider than this.
        planes: which series, of "axial", "coronal", "sagittal".
        pixel_mm: pixel size, one number or (3,) along x, y, z (a volume's voxel size); a 128th of the box's longest
            side if None. Pixels are made to divide the box exactly.
        jitter_seed: draws the training planes' positions; None leaves them in the middle of their cells.

    Raises:
        SettingError: an unknown series, an empty box, or a step or pixel size that is not above 0.
    """
    box = np.asarray(box_mm, np.float64)
    extent = box[1] - box[0]
    if box.shape != (2, 3) or not np.all(np.isfinite(extent)) or np.any(extent <= 0):
        raise SettingError(
            "The box {box} mm for sections is empty; give its lowest and highest corner.", box=box.tolist()
        )
    pixel = np.broadcast_to(np.asarray(extent.max() / 128 if pixel_mm is None else pixel_mm, np.float64), 3)
    if np.any(pixel <= 0) or (step_mm is not None and step_mm <= 0):
        raise SettingError(
            "Sections need a step and a pixel size above 0 mm, not {step_mm} and {pixel}.",
            step_mm=step_mm,
            pixel=pixel.tolist(),
        )
    random = None if jitter_seed is None else np.random.default_rng(jitter_seed)
    views: list[SectionView] = []
    for kind in planes:
        if kind not in _AXES:
            raise SettingError(
                "There is no section series '{kind}'; choose of {known}.", kind=kind, known=", ".join(_AXES)
            )
        axis = _AXES[kind][0]
        wanted = section_step(extent[axis]) if step_mm is None else step_mm
        cells = max(1, int(np.ceil(extent[axis] / wanted - 1e-9)))
        step = extent[axis] / cells
        for cell in range(cells):
            held_out = cell % HOLD_OUT_EVERY == HOLD_OUT_EVERY // 2
            shift = 0.0 if random is None else random.uniform(-0.5, 0.5)
            position = box[0, axis] + (cell + 0.5 + (0.0 if held_out else shift)) * step
            views.append(SectionView(_plane(box, kind, position, pixel), kind, float(position), held_out))
    return views


def reference_section(volume: Volume, view: SectionView) -> np.ndarray:
    """(H, W) attenuation in mm⁻¹ that the volume shows on a section, clipped at 0: FDK undershoots beside edges."""
    return np.maximum(volume.section(view.plane), 0.0)


def outer_contour(image: np.ndarray, threshold: float | None = None, smallest_part: float = 0.01) -> OuterContour:
    """The object's outline on a section: the paper's Canny contour, with islands kept.

    Canny edges are closed, everything that cannot be reached from the border without crossing an edge or material is
    the object, and of its parts those of at least `smallest_part` of the largest part's area are kept. (The paper
    keeps the contour with the largest bounding box alone, which loses a part that the section cuts off.)

    Args:
        image: (H, W) attenuation.
        threshold: attenuation between air and material; pass the volume's (`air_threshold`) so that a section that
            misses the object comes out empty. That of the image if None.
        smallest_part: share of the largest part's area, 0..1.
    """
    import cv2
    from skimage.feature import canny

    image = np.asarray(image, np.float64)
    level = air_threshold(image) if threshold is None else float(threshold)
    nothing = np.zeros(image.shape, bool)
    if not np.isfinite(level) or level <= 0 or image.max() <= level:
        return OuterContour(nothing, nothing)
    margin = 3
    padded = np.pad(np.clip(image / (2 * level), 0, 1), margin)
    smooth = cv2.GaussianBlur(padded, (0, 0), 1.0)
    # A step of height 1 smoothed with sigma 1 has a Sobel magnitude of 8 / sqrt(2 pi) = 3.2: edges start where the
    # step is as high as from air to the threshold and go on down to half of that.
    edges = canny(padded, sigma=1.0, low_threshold=0.8, high_threshold=1.6)
    closed = cv2.morphologyEx(edges.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    # An edge with a gap would leak; solid material stops the flood there.
    barrier = ((closed > 0) & (smooth > 0.25)) | (smooth > 0.5)
    reached = barrier.astype(np.uint8)
    cv2.floodFill(reached, np.zeros((reached.shape[0] + 2, reached.shape[1] + 2), np.uint8), (0, 0), 2)
    contours, _ = cv2.findContours((reached != 2).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    areas = np.array([cv2.contourArea(contour) + len(contour) / 2 for contour in contours])
    kept = [contour for contour, area in zip(contours, areas, strict=True) if area >= smallest_part * areas.max()]
    mask = cv2.drawContours(np.zeros(padded.shape, np.uint8), kept, -1, 1, cv2.FILLED)
    edge = cv2.drawContours(np.zeros(padded.shape, np.uint8), kept, -1, 1, 1)
    inner = (slice(margin, -margin), slice(margin, -margin))
    return OuterContour(mask[inner] > 0, edge[inner] > 0)


def _plane(box: np.ndarray, kind: str, position: float, pixel: np.ndarray) -> Plane:
    axis, across, up = _AXES[kind]
    extent = box[1] - box[0]
    width, height = (max(1, round(extent[a] / pixel[a])) for a in (across, up))
    u, v, origin = np.zeros(3), np.zeros(3), np.zeros(3)
    u[across] = extent[across] / width
    v[up] = -extent[up] / height
    origin[[across, up, axis]] = box[0, across], box[1, up], position
    return Plane(origin, u, v, width, height)
