"""Colour transfer and detail cloning (paper, "Visual Alignment"). Nothing here is optimised."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ...colormap import density_colors
from ...gaussians import GaussianSet, Modality
from ...render.voxels import voxelize
from ...spherical_harmonics import rgb_to_sh
from ..refine import median_spacing

# Colours and details come from splats that are seen; fainter ones are left-overs of the training.
_VISIBLE_OPACITY = 0.1

_MOST_VOXELS = 160


@dataclass(frozen=True, eq=False)
class Fusion:
    """The fused set, radiative splats first.

    Attributes:
        fused: radiative splats (modality XRAY) in their order, then the clones (modality CLONE, density 0).
        near_surface: (N_x,) bool, the radiative splats that took a photo colour.
        photo_sh: (N_x, K, 3) the colour function of the nearest photo splat, of all radiative splats.
        surface: (N_s, 3) centres of the photo splats that are seen.
        depth_mm: the depth up to which colours went.
        largest_detail_mm2: the threshold T_p on λmax(Σ) for clones.
    """

    fused: GaussianSet
    near_surface: np.ndarray
    photo_sh: np.ndarray
    surface: np.ndarray
    depth_mm: float
    largest_detail_mm2: float


def fuse_sets(
    rgb: GaussianSet,
    xray: GaussianSet,
    percentile: float = 95.0,
    depth_spacings: float = 2.0,
    paint_all: bool = False,
) -> Fusion:
    """Colours the radiative splats near the surface from their nearest photo splat and adds the photos' details.

    Radiative splats within `depth_spacings` median spacings of a photo splat take its colour function, all SH bands;
    deeper ones show their density as a colour, because the nearest photo splat says nothing about the inside. The
    spacing is the larger of the two sets' median distances to the nearest neighbour: the coarser set decides how
    well "on the surface" can be told.

    Args:
        rgb, xray: numpy sets in the world frame, not empty.
        percentile: p of T_p: photo splats with λmax(Σ) up to this percentile are cloned.
        depth_spacings: how deep photo colours go, in median spacings.
        paint_all: every radiative splat takes a photo colour, as the paper's equation says.
    """
    seen = rgb.select(rgb.opacities > _VISIBLE_OPACITY) if (rgb.opacities > _VISIBLE_OPACITY).any() else rgb
    distance, nearest = _nearest(seen.means, xray.means)
    depth = depth_spacings * max(median_spacing(seen.means), median_spacing(xray.means))
    near = np.ones(len(xray), bool) if paint_all else distance <= depth
    sh = color_by_density(xray).with_sh_coefficients(rgb.sh.shape[1]).sh
    photo_sh = seen.sh[nearest]
    sh[near] = photo_sh[near]
    body = replace(xray, sh=sh, modality=np.full(len(xray), Modality.XRAY, np.uint8))
    threshold = detail_threshold(rgb, percentile)
    clones = clone_details(rgb, threshold)
    return Fusion(GaussianSet.concatenate([body, clones]), near, photo_sh, seen.means, float(depth), threshold)


def color_as_photos(fusion: Fusion, which: np.ndarray) -> Fusion:
    """The fusion with the radiative splats of mask `which` (N_x,) in photo colours too."""
    sh = fusion.fused.sh.copy()
    body = sh[: len(which)]
    body[which] = fusion.photo_sh[which]
    return replace(fusion, fused=replace(fusion.fused, sh=sh), near_surface=fusion.near_surface | which)


def detail_threshold(rgb: GaussianSet, percentile: float = 95.0) -> float:
    """T_p, the percentile of the largest eigenvalue of Σ, mm²; eigenvalues are the squared scales."""
    largest = np.square(rgb.scales.astype(np.float64)).max(axis=1)
    return float(np.quantile(largest, percentile / 100.0))


def clone_details(rgb: GaussianSet, threshold_mm2: float) -> GaussianSet:
    """The splats with λmax(Σ) ≤ T_p as clones: modality CLONE and no attenuation, so that X-rays do not see them."""
    largest = np.square(rgb.scales.astype(np.float64)).max(axis=1)
    detail = rgb.select(largest <= threshold_mm2)
    return replace(
        detail,
        density=np.zeros(len(detail), np.float32),
        modality=np.full(len(detail), Modality.CLONE, np.uint8),
    )


def color_by_density(xray: GaussianSet) -> GaussianSet:
    """The set with each splat coloured by the attenuation at its centre (degree 0).

    That is the sum over all splats there, what a section shows. A splat's own density is only its share of it, which
    depends on how many neighbours overlap: the same material would come out in blotches.
    """
    colors = density_colors(density_at_centers(xray))
    return replace(xray, sh=rgb_to_sh(colors).astype(np.float32)[:, None, :])


def density_at_centers(xray: GaussianSet) -> np.ndarray:
    """Attenuation (N,) in mm⁻¹ of the whole set at each splat's centre, read from a grid of voxels.

    Voxels are half the median scale wide, more where that would take more than 160 along a side. A grid smooths
    splats thinner than its voxels, so that no value is below the splat's own density.
    """
    if len(xray) == 0:
        return np.zeros(0, np.float32)
    means = xray.means.astype(np.float64)
    low, high = _box_without_floaters(means)
    spacing = max(0.5 * float(np.median(xray.scales)), float((high - low).max()) / _MOST_VOXELS, 1e-9)
    shape = np.ceil((high - low) / spacing).astype(int) + 3
    volume = voxelize(xray, low - spacing, spacing, (shape[2], shape[1], shape[0]), cutoff_sigmas=3.0)
    return np.maximum(volume.sample(means), xray.density).astype(np.float32)


def _box_without_floaters(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest corner (3,); of the middle 99 % along an axis where the rest more than doubles it."""
    low, high = points.min(axis=0), points.max(axis=0)
    inner_low, inner_high = np.percentile(points, [0.5, 99.5], axis=0)
    stretched = high - low > 2 * (inner_high - inner_low)
    return np.where(stretched, inner_low, low), np.where(stretched, inner_high, high)


def _nearest(surface: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    from scipy.spatial import cKDTree

    return cKDTree(surface).query(points)
