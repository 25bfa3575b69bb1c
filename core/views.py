"""The three things a GaussianSet is looked at with: Camera (photo), Detector (X-ray), Plane (cut).

Images are row-major from the top-left corner; the centre of pixel (row i, column j) is at (j + 0.5, i + 0.5).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from .similarity import Similarity


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole (or orthographic) camera in OpenCV axes: x right, y down, z forward.

    Attributes:
        width, height: image size in pixels.
        fx, fy: focal lengths in pixels; of an orthographic camera pixels per unit of length.
        cx, cy: principal point in pixels (the middle of a w-pixel image is w / 2).
        world_to_camera: (4, 4), numpy, or a torch tensor when its gradient is wanted.
        orthographic: parallel rays along camera z.
        near: splats whose centre lies nearer than this (camera z, units of the frame) are not drawn.
        slopes: smallest and largest x / z and y / z between which splats have their own projection's slope, those
            of the image and a margin if None. A part of an image keeps those of the whole, so that its splats have
            the same shape.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    world_to_camera: Any
    orthographic: bool = False
    near: float = 0.01
    slopes: tuple[float, float, float, float] | None = None

    @property
    def center(self) -> np.ndarray:
        """(3,) position of the camera in the world."""
        matrix = np.asarray(self.world_to_camera, np.float64)
        return -matrix[:3, :3].T @ matrix[:3, 3]

    def resized(self, width: int, height: int) -> Camera:
        """The same view with another number of pixels."""
        x, y = width / self.width, height / self.height
        return replace(self, width=width, height=height, fx=self.fx * x, fy=self.fy * y, cx=self.cx * x, cy=self.cy * y)

    def pixels_of(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Column and row (P,) of points (P, 3) in the image, and which of them lie in it; 0 for those that do not."""
        matrix = np.asarray(self.world_to_camera, np.float64)
        local = points @ matrix[:3, :3].T + matrix[:3, 3]
        depth = np.where(local[:, 2] > self.near, local[:, 2], np.inf)
        scale = 1.0 if self.orthographic else depth
        columns = np.floor(self.fx * local[:, 0] / scale + self.cx)
        rows = np.floor(self.fy * local[:, 1] / scale + self.cy)
        inside = np.isfinite(depth) & (columns >= 0) & (columns < self.width) & (rows >= 0) & (rows < self.height)
        return np.where(inside, columns, 0).astype(int), np.where(inside, rows, 0).astype(int), inside

    def field_of_view(self) -> tuple[float, float, float, float]:
        """`slopes`: smallest and largest x / z and y / z of the image and 15 % of its size around it."""
        if self.slopes is not None:
            return self.slopes
        margin_x, margin_y = 0.15 * self.width / self.fx, 0.15 * self.height / self.fy
        return (
            -self.cx / self.fx - margin_x,
            (self.width - self.cx) / self.fx + margin_x,
            -self.cy / self.fy - margin_y,
            (self.height - self.cy) / self.fy + margin_y,
        )

    def rows(self, first: int, stop: int) -> Camera:
        """The camera of the rows from `first` up to before `stop` of its image."""
        return replace(self, height=stop - first, cy=self.cy - first, slopes=self.field_of_view())

    def transformed(self, similarity: Similarity) -> Camera:
        """The camera moved along with a scene that `similarity` moves: it sees the same image."""
        matrix = np.asarray(self.world_to_camera, np.float64)
        rotation = matrix[:3, :3] @ similarity.rotation.T
        moved = np.eye(4)
        moved[:3, :3] = rotation
        moved[:3, 3] = similarity.scale * matrix[:3, 3] - rotation @ similarity.translation
        zoom = 1.0 / similarity.scale if self.orthographic else 1.0
        return replace(
            self,
            world_to_camera=moved,
            fx=self.fx * zoom,
            fy=self.fy * zoom,
            near=self.near * similarity.scale,
        )


@dataclass(frozen=True, eq=False)
class Detector:
    """One X-ray projection: a flat detector anywhere, lit from a point source or by parallel rays.

    The ray of pixel (row i, column j) passes through
    ``center + (j + 0.5 - width / 2) · u + (i + 0.5 - height / 2) · v``,
    so detector offsets, tilts and a free pose for each projection need no special case.

    Attributes:
        width, height: pixels.
        source: (3,) mm, the focal spot of a cone beam; for a parallel beam the unit direction of the rays.
        center: (3,) mm, the middle of the detector.
        u, v: (3,) mm a pixel, the steps along a row (to the right) and down a column.
        parallel: parallel beam.
    """

    width: int
    height: int
    source: Any
    center: Any
    u: Any
    v: Any
    parallel: bool = False

    def rays(self) -> tuple[np.ndarray, np.ndarray]:
        """Origins and unit directions, each (height, width, 3) in float64, mm."""
        columns = np.arange(self.width) + 0.5 - self.width / 2
        rows = np.arange(self.height) + 0.5 - self.height / 2
        pixels = (
            np.asarray(self.center, np.float64)
            + columns[None, :, None] * np.asarray(self.u, np.float64)
            + rows[:, None, None] * np.asarray(self.v, np.float64)
        )
        source = np.asarray(self.source, np.float64)
        if self.parallel:
            return pixels, np.broadcast_to(source / np.linalg.norm(source), pixels.shape)
        directions = pixels - source
        return np.broadcast_to(source, pixels.shape), directions / np.linalg.norm(directions, axis=-1, keepdims=True)

    def moved(self, turn: np.ndarray, shift_mm: np.ndarray, middle_mm: np.ndarray) -> Detector:
        """Source and detector as an object sees them that has moved: the same image, of the object at its place.

        Args:
            turn: (3, 3) rotation of the object about `middle_mm`.
            shift_mm: (3,) its way after that, mm.
            middle_mm: (3,) mm.
        """
        back = np.asarray(turn, np.float64).T

        def seen(point: Any) -> np.ndarray:
            return middle_mm + back @ (np.asarray(point, np.float64) - middle_mm - shift_mm)

        u, v = (back @ np.asarray(step, np.float64) for step in (self.u, self.v))
        source = back @ np.asarray(self.source, np.float64) if self.parallel else seen(self.source)
        return replace(self, source=source, center=seen(self.center), u=u, v=v)

    def in_blocks(self, block: int) -> Detector:
        """The detector whose pixels are blocks of `block` x `block` pixels; what is left over at its right and bottom
        is cut. Raises ValueError if nothing is left."""
        width, height = self.width // block, self.height // block
        if block < 1 or width < 1 or height < 1:
            raise ValueError(f"a detector of {self.width} x {self.height} pixels has no blocks of {block} x {block}")
        u, v = np.asarray(self.u, np.float64), np.asarray(self.v, np.float64)
        cut = 0.5 * ((self.width - width * block) * u + (self.height - height * block) * v)
        return replace(
            self, width=width, height=height, center=np.asarray(self.center, np.float64) - cut, u=block * u, v=block * v
        )


@dataclass(frozen=True, eq=False)
class Plane:
    """A cut through the model: pixel (row i, column j) lies at ``origin + (j + 0.5) · u + (i + 0.5) · v``.

    Attributes:
        origin: (3,) mm, the image's top-left corner.
        u, v: (3,) mm a pixel along a row and down a column, at right angles.
        width, height: pixels.
        thickness_mm: 0 for a cut, else the mean over a slab of this thickness centred on the plane.
    """

    origin: Any
    u: Any
    v: Any
    width: int
    height: int
    thickness_mm: float = 0.0

    @property
    def normal(self) -> np.ndarray:
        """(3,) unit normal u × v."""
        n: np.ndarray = np.cross(np.asarray(self.u, np.float64), np.asarray(self.v, np.float64))
        return n / np.linalg.norm(n)

    def points(self) -> np.ndarray:
        """(height, width, 3) pixel centres in mm, float64."""
        columns = np.arange(self.width) + 0.5
        rows = np.arange(self.height) + 0.5
        return (
            np.asarray(self.origin, np.float64)
            + columns[None, :, None] * np.asarray(self.u, np.float64)
            + rows[:, None, None] * np.asarray(self.v, np.float64)
        )
