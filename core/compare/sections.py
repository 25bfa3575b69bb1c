"""Held-out sections of every kind of model against the truth."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from ..evaluate import heldout
from ..gaussians import GaussianSet
from ..render import splat
from ..sections import SectionView, choose_planes
from ..threshold import air_threshold
from ..views import Camera, Plane
from ..volume import Volume
from .pictures import telling_sections

_GREY = np.array([0.299, 0.587, 0.114])

PAPER_READING = (
    "The paper slices its models into cross-sections and compares them with X-ray images, without saying how a "
    "coloured set is sliced. The closest reading: the splats whose centres lie in the slab around the section (as "
    "thick as the sections are apart) drawn by the method's own renderer along the section's normal, parallel, on "
    "black, as grey; full scale is the X-ray section's."
)


@dataclass(frozen=True, eq=False)
class SectionJudge:
    """Measures sections that no method was fitted to.

    Attributes:
        views: all sections; every fifth is held out.
        held_out, references: those, and the true attenuation there.
        peak: full scale and grey window, mm⁻¹.
        air: the threshold below which there is air, mm⁻¹.
    """

    volume: Volume
    views: list[SectionView]
    held_out: list[SectionView]
    references: list[np.ndarray]
    peak: float
    air: float
    kernel: str
    tick: Callable[[], None]

    @classmethod
    def of(cls, volume: Volume, kernel: str, tick: Callable[[], None]) -> SectionJudge:
        """For the truth's volume; `tick` is called between sections and may raise to stop."""
        views = choose_planes(volume.box_mm, pixel_mm=volume.spacing_mm)
        held_out = [view for view in views if view.held_out]
        references = heldout.references_of(volume, held_out)
        return cls(
            volume,
            views,
            held_out,
            references,
            heldout.section_peak(volume),
            air_threshold(volume.values),
            kernel,
            tick,
        )

    def density(self, volume: Volume, unit_known: bool = True) -> dict[str, Any]:
        """PSNR, SSIM and PIQE of the attenuation on the held-out sections.

        A set comes as voxels that were made as the truth's were (`voxel_averages` on the same grid where those are
        averages), and both are cut by the same planes: what fits the truth perfectly has no error. Values of splats at
        points would rate a sharper model down where the truth's are averages, the perfect one too.

        Args:
            unit_known: the values are mm⁻¹; else they are brought to that by the one factor that fits the other
                sections of the truth best, and `fitted_factor` is in the figures.
        """
        images = heldout.references_of(volume, self.held_out)
        if unit_known:
            return self._figures(images)
        factor = self._fitted(heldout.references_of(volume, self._others))
        return {**self._figures([factor * image for image in images]), "fitted_factor": factor}

    def colored(self, rgb: GaussianSet, drawing: Mapping[str, Any] | None = None) -> dict[str, Any]:
        """Photo splats in mm, which have no attenuation, in two ways.

        Args:
            drawing: keywords of `splat` that the set was trained with.

        Returns:
            `paper`: see `PAPER_READING`. `occupancy`: 1 − Π(1 − o·w), averaged over voxels as the truth is, times the
            one attenuation that fits the truth's other sections best, with that as `fitted_attenuation_per_mm`.
        """
        factor = self._fitted(self._occupancy(rgb, self._others))
        occupied = self._occupancy(rgb, self.held_out)
        return {
            "paper": self.slabs(rgb, drawing),
            "occupancy": {
                **self._figures([factor * image for image in occupied]),
                "fitted_attenuation_per_mm": factor,
            },
        }

    def slabs(self, shown: GaussianSet, drawing: Mapping[str, Any] | None = None) -> dict[str, Any]:
        """A blended set in mm cut as `PAPER_READING` says; `drawing` as of `colored`."""
        greys = []
        for view in self.held_out:
            self.tick()
            grey = slab_image(shown, view.plane, self._spacing(view.kind), self.kernel, drawing)
            greys.append(self.peak * grey)
        return self._figures(greys)

    @property
    def shown(self) -> list[int]:
        """Places of the held-out sections that stand for all in pictures, one of each kind."""
        return telling_sections(self.references, [view.kind for view in self.held_out])

    def cut(self, volume: Volume) -> list[np.ndarray]:
        """The sections of a volume that pictures show, (H, W) each in mm⁻¹."""
        return heldout.references_of(volume, [self.held_out[place] for place in self.shown])

    def truth(self) -> dict[str, Any]:
        """What the truth's own sections have: PIQE guesses without it, and gives flat sections of solids much."""
        return {"piqe": self._figures(self.references)["piqe"]}

    def nothing(self) -> dict[str, Any]:
        """What an empty model has, air everywhere: a row that is hardly better found nothing."""
        return self._figures([np.zeros_like(reference) for reference in self.references])

    @property
    def _others(self) -> list[SectionView]:
        """Sections that are not measured, every third of them: enough to fit one number to."""
        return [view for view in self.views if not view.held_out][::3]

    def _fitted(self, images: list[np.ndarray]) -> float:
        return heldout.fitted_factor(images, heldout.references_of(self.volume, self._others))

    def _occupancy(self, rgb: GaussianSet, views: list[SectionView]) -> list[np.ndarray]:
        """Means of 2 x 2 pixels on two planes for each pixel, all a quarter of a voxel from its middle."""
        means = []
        for view in views:
            step = 0.25 * float(np.abs(view.plane.normal) @ self.volume.spacing_mm)
            finer = [replace(view, plane=_halved(view.plane, side * step)) for side in (-1, 1)]
            image = np.mean(heldout.occupancy_images(rgb, finer, self.kernel, self.tick), axis=0)
            means.append(image.reshape(view.plane.height, 2, view.plane.width, 2).mean(axis=(1, 3)))
        return means

    def _figures(self, images: list[np.ndarray]) -> dict[str, Any]:
        return heldout.section_figures(images, self.references, self.peak, self.air)

    def _spacing(self, kind: str) -> float:
        places = sorted(view.position_mm for view in self.views if view.kind == kind)
        return float(np.median(np.diff(places))) if len(places) > 1 else float(np.max(self.volume.spacing_mm))


def slab_image(
    gaussians: GaussianSet,
    plane: Plane,
    thickness_mm: float,
    kernel: str,
    drawing: Mapping[str, Any] | None = None,
) -> np.ndarray:
    """(H, W) grey 0..1 of the splats whose centres lie within half of `thickness_mm` of a plane.

    Alpha-blended along the plane's normal with parallel rays on black; pixels are the plane's.
    """
    normal = plane.normal
    away = (gaussians.means.astype(np.float64) - np.asarray(plane.origin)) @ normal
    inside = gaussians.select(np.abs(away) <= 0.5 * thickness_mm)
    if len(inside) == 0:
        return np.zeros((plane.height, plane.width), np.float32)
    camera = facing(plane, 2 * thickness_mm)
    with torch.no_grad():
        color = splat(inside.to_torch(), camera, kernel=kernel, **(drawing or {})).color.numpy()
    return np.clip(color, 0.0, 1.0) @ _GREY


def _halved(plane: Plane, along_mm: float) -> Plane:
    """The plane with pixels half as large, moved along its normal."""
    u, v = (0.5 * np.asarray(side, np.float64) for side in (plane.u, plane.v))
    origin = np.asarray(plane.origin, np.float64) + along_mm * plane.normal
    return replace(plane, origin=origin, u=u, v=v, width=2 * plane.width, height=2 * plane.height)


def facing(plane: Plane, distance_mm: float) -> Camera:
    """The orthographic camera whose pixels are those of a plane, seen from `distance_mm` before it along u × v."""
    u, v = np.asarray(plane.u, np.float64), np.asarray(plane.v, np.float64)
    wide, high = float(np.linalg.norm(u)), float(np.linalg.norm(v))
    rotation = np.stack([u / wide, v / high, plane.normal])
    matrix = np.eye(4)
    matrix[:3, :3] = rotation
    matrix[:3, 3] = -rotation @ (np.asarray(plane.origin, np.float64) - distance_mm * plane.normal)
    return Camera(plane.width, plane.height, 1 / wide, 1 / high, 0.0, 0.0, matrix, orthographic=True)
