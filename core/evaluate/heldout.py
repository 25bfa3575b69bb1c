"""Held-out photos, projections and sections against what models show of them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from ..capture.model import Projections
from ..gaussians import GaussianSet
from ..progress import Tick
from ..render import radiograph, section, splat
from ..render.options import SplatOptions
from ..render.splat import SplatImage
from ..sections import SectionView, reference_section
from ..spherical_harmonics import C0
from ..threshold import large_attenuation
from ..views import Camera
from ..volume import Volume
from .metrics import piqe, psnr, ssim

if TYPE_CHECKING:
    from ..effects.kept import KeptEffects

Figures = dict[str, Any]
MOST_COMPARED = 16
"""Views that are looked at while a model is made, photos or projections; `report.json` has the figures of all."""


def some_of(count: int, most: int = MOST_COMPARED) -> np.ndarray:
    """Up to `most` places of `count`, evenly spread, (M,) int."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(int)) if count else np.zeros(0, int)


def some_held_out(projections: Projections) -> np.ndarray:
    """Indices of up to `MOST_COMPARED` held-out projections, evenly spread."""
    held_out = np.flatnonzero(projections.held_out)
    return held_out[some_of(len(held_out))]


def photo_figures(
    gaussians: GaussianSet,
    views: Iterable[tuple[Camera, np.ndarray]],
    background: np.ndarray | None,
    kernel: str,
    tick: Tick,
    options: SplatOptions | None = None,
    effects: KeptEffects | None = None,
    names: Sequence[str] | None = None,
) -> Figures:
    """Mean PSNR (dB, peak 1) and SSIM over photos, rendered in front of the background's colour.

    Args:
        gaussians: numpy set in the cameras' frame.
        views: cameras and photos (H, W, 3) 0..1, gone through once.
        background: (3,), black if None.
        tick: called between photos; may raise to stop.
        options: how the model is drawn, as it was trained; plainly if None.
        effects: what photos show besides the object, fitted to each of these.
        names: of these photos, where they were trained on: their effects are known and not fitted.
    """
    tensors = gaussians.to_torch()
    drawn = vars(options or SplatOptions())
    behind = torch.as_tensor(np.zeros(3) if background is None else background, dtype=torch.float32)

    def draw(shown: GaussianSet, camera: Camera) -> SplatImage:
        return splat(shown, camera, behind, kernel=kernel, **drawn)

    def pairs() -> Iterator[tuple[np.ndarray, np.ndarray]]:
        for place, (camera, image) in enumerate(views):
            tick()
            with torch.no_grad():
                if effects is None:
                    rendered = draw(tensors, camera)
                elif names is not None:
                    rendered = effects.render(names[place], draw, tensors, camera)
                else:
                    rendered = effects.fitted(draw, tensors, camera, torch.from_numpy(image), tick)
            yield np.clip(rendered.color.numpy(), 0.0, 1.0), image

    return _psnr_and_ssim(pairs(), 1.0)


def mean_color(images: Sequence[np.ndarray]) -> np.ndarray:
    """(3,) mean colour of the middle ninth of photos (H, W, 3), where the object is."""
    middle = [
        image[image.shape[0] // 3 : -image.shape[0] // 3, image.shape[1] // 3 : -image.shape[1] // 3]
        for image in images
    ]
    return np.mean([part.reshape(-1, 3).mean(axis=0) for part in middle], axis=0)


def in_one_color(xray: GaussianSet, color: np.ndarray) -> GaussianSet:
    """The radiative set as photo splats in one colour (3,), shown by their opacity: X-rays know no colour."""
    sh = np.broadcast_to(((color - 0.5) / C0).astype(np.float32), (len(xray), 1, 3)).copy()
    return GaussianSet(
        xray.means, xray.quats, xray.scales, xray.opacities, sh, xray.density, np.zeros(len(xray), np.uint8)
    )


def projection_peak(projections: Projections) -> float:
    """The largest line integral of the held-out projections, of all if none is: full scale for all models."""
    measured = projections.held_out if projections.held_out.any() else ~projections.held_out
    return projections.peak(np.flatnonzero(measured))


def projection_figures(
    gaussians: GaussianSet,
    projections: Projections,
    kernel: str,
    tick: Tick,
    factor: float = 1.0,
    views: np.ndarray | None = None,
    draw: Callable[[int], np.ndarray] | None = None,
) -> Figures:
    """Mean PSNR (dB) over projections; full scale is the largest line integral of the held-out ones.

    Args:
        gaussians: numpy set in mm.
        factor: multiplies the rendered line integrals.
        views: indices of the projections to measure on; the held-out ones if None. Those that are not finite are left
            out.
        draw: line integrals (H, W) that the set shows in the place of the projection of an index; exact ones if None.
    """
    tensors = gaussians.to_torch()

    def exact(index: int) -> np.ndarray:
        with torch.no_grad():
            lines: np.ndarray = radiograph(tensors, projections.detectors[index], kernel=kernel).numpy()
        return lines

    peak, drawn = projection_peak(projections), draw or exact
    values = []
    shown = np.flatnonzero(projections.held_out) if views is None else views
    for index in [index for index in shown if np.isfinite(projections.images[index]).all()]:
        tick()
        values.append(psnr(factor * drawn(int(index)), projections.images[index], peak))
    return {"psnr": _mean(values), "count": len(values)}


def fitted_attenuation(rgb: GaussianSet, projections: Projections, kernel: str, tick: Tick) -> float:
    """The attenuation in mm⁻¹ of a fully opaque splat that fits up to twelve training projections best.

    RGB splats know opacity only. With ρ = κ · opacity, line integrals are linear in κ: one least-squares number.
    """
    tensors = opacity_as_density(rgb).to_torch()
    training = np.flatnonzero(~projections.held_out)
    above = below = 0.0
    for index in training[:: max(1, len(training) // 12)][:12]:
        tick()
        with torch.no_grad():
            lines = radiograph(tensors, projections.detectors[index], kernel=kernel).numpy().astype(np.float64)
        above += float((lines * projections.images[index]).sum())
        below += float((lines * lines).sum())
    return max(above / below, 0.0) if below > 0 else 0.0


def opacity_as_density(rgb: GaussianSet) -> GaussianSet:
    """The set with its opacities as densities, and no splat left out as a clone."""
    return GaussianSet(
        rgb.means, rgb.quats, rgb.scales, rgb.opacities, rgb.sh, rgb.opacities, np.zeros(len(rgb), np.uint8)
    )


def section_peak(volume: Volume) -> float:
    """`large_attenuation` of the reference volume: full scale and grey window for all models."""
    return large_attenuation(volume.values)


def occupancy_images(gaussians: GaussianSet, views: Sequence[SectionView], kernel: str, tick: Tick) -> list[np.ndarray]:
    """(H, W) cuts 0..1 of a numpy set in mm, by its opacities."""
    tensors = gaussians.to_torch()
    images = []
    for view in views:
        tick()
        with torch.no_grad():
            images.append(section(tensors, view.plane, "occupancy", kernel=kernel).numpy())
    return images


def fitted_factor(images: Sequence[np.ndarray], references: Sequence[np.ndarray]) -> float:
    """The number that brings images nearest to references in the least squares, ≥ 0."""
    below = sum(float((a.astype(np.float64) ** 2).sum()) for a in images)
    above = sum(float((a.astype(np.float64) * b).sum()) for a, b in zip(images, references, strict=True))
    return max(above / below, 0.0) if below > 0 else 0.0


def section_figures(images: Sequence[np.ndarray], references: Sequence[np.ndarray], peak: float, air: float) -> Figures:
    """Mean PSNR (dB), SSIM and PIQE over sections; full scale and PIQE's window are 0..`peak`.

    Sections of which under 1 % lies over `air` (the volume's `air_threshold`) show no object and are left out.
    """
    shown = [i for i, reference in enumerate(references) if (reference > air).mean() >= 0.01]
    kept = [(images[i], references[i]) for i in shown]
    figures = _psnr_and_ssim(iter(kept), peak)
    figures["piqe"] = _mean([piqe(image, 0.0, peak) for image, _ in kept])
    return figures


def references_of(volume: Volume, views: Sequence[SectionView]) -> list[np.ndarray]:
    """(H, W) attenuation in mm⁻¹ on each section, clipped at 0 where FDK undershoots."""
    return [reference_section(volume, view) for view in views]


def _psnr_and_ssim(pairs: Iterator[tuple[np.ndarray, np.ndarray]], peak: float) -> Figures:
    signal, similarity = [], []
    for image, reference in pairs:
        signal.append(psnr(image, reference, peak))
        similarity.append(ssim(np.clip(image, 0.0, peak), np.clip(reference, 0.0, peak), peak))
    return {"psnr": _mean(signal), "ssim": _mean(similarity), "count": len(signal)}


def _mean(values: Sequence[float | None]) -> float | None:
    given = [value for value in values if value is not None]
    return float(np.mean(given)) if given else None
