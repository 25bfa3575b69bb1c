"""How deep each splat of a model lies, and how dense the model is there: worked out once, when first asked for."""

from __future__ import annotations

from collections.abc import Generator

import bpy
import numpy as np

from ...core.errors import SettingError
from ...core.gaussians import GaussianSet, Modality
from ...core.mesh.depth import depth_in_steps
from ...core.render.volume_numpy import sample_in_steps
from ...core.steps import part_of_work, run_through
from ...core.threshold import air_threshold
from .splats import DENSITY_HERE, DEPTH, read_density, read_values, shows_density, unchanged, write_values

# On a model: of how many splats these are. Where some are deleted the others keep theirs.
_COUNT_KEY = "insideout_inside"
# Half the time, and nothing that could be seen: a box of 3 standard deviations to each side holds 0.992 of a splat.
_CUTOFF_SIGMAS = 3.0
# Share of the work that is done when the densities are on the grid.
_SAMPLED = 0.6


def look_inside(model: bpy.types.Object) -> None:
    """Gives splats their depth under the outer surface (mm) and the density of all splats at their centre (mm⁻¹).

    Both are of the model on a grid, see `sample_volume`; the surface is where its mesh has it, at `air_threshold`.
    Clones and the photos' splats have them by their place, like all others.

    It takes a second or two, for which there is a progress cursor.

    Raises:
        SettingError: the model is of photos alone.
        DamagedSplatsError: as `read_density`.
    """
    if kept_inside(model) is not None:
        return
    manager = bpy.context.window_manager
    manager.progress_begin(0.0, 1.0)
    try:
        run_through(look_in_steps(model), manager.progress_update)
    finally:
        manager.progress_end()


def is_looked_into(model: bpy.types.Object) -> bool:
    """Whether `look_inside` has done its work, as far as can be told at once."""
    count, attributes = len(model.data.points), model.data.attributes
    return DEPTH in attributes and DENSITY_HERE in attributes and count <= model.data.get(_COUNT_KEY, 0)


def look_in_steps(model: bpy.types.Object) -> Generator[float, None, None]:
    """As `look_inside`, with breaks that tell the share that is done; closed before its end it changes nothing.

    Raises:
        ReferenceError: in a break splats were edited or taken away; nothing is changed then, either.
    """
    if kept_inside(model) is not None:
        return
    if not shows_density(model):
        raise SettingError(
            "{model} is of photos alone, which show no inside; choose a model with X-rays.", model=model.name
        )
    with unchanged(model, read_density) as own:
        depth, density = yield from inside_of(own)
    keep_inside(model, depth, density)


def kept_inside(model: bpy.types.Object) -> tuple[np.ndarray, np.ndarray] | None:
    """(N,) mm and (N,) mm⁻¹ that `look_inside` found; None where it has to look first, or again."""
    depth, density = (read_values(model, name) for name in (DEPTH, DENSITY_HERE))
    known = depth is not None and density is not None and is_looked_into(model) and not was_joined(model)
    return (depth, density) if known else None


def keep_inside(model: bpy.types.Object, depth: np.ndarray, density: np.ndarray) -> None:
    """Gives splats (N,) mm and (N,) mm⁻¹ as those that `look_inside` would find."""
    write_values(model, DEPTH, depth)
    write_values(model, DENSITY_HERE, density)
    model.data[_COUNT_KEY] = len(depth)
    model.data.update_tag()


def was_joined(model: bpy.types.Object) -> bool:
    """Whether splats have come in place of others that were deleted: of the model there they have not even their own.

    What is joined has 0 where it lacks an attribute, and `inside_of` gives no splat less than its own density.
    """
    here, own, modality = (read_values(model, name) for name in (DENSITY_HERE, "density", "modality"))
    if here is None or own is None or modality is None:
        return False
    # Clones have no part in the density; where it is no number nothing is less.
    return bool(((here < own) & (modality != Modality.CLONE)).any())


def inside_of(gaussians: GaussianSet) -> Generator[float, None, tuple[np.ndarray, np.ndarray]]:
    """What `look_inside` finds of splats, (N,) mm and (N,) mm⁻¹, with breaks that tell the share that is done."""
    yield 0.0
    sampling = sample_in_steps(gaussians, cutoff_sigmas=_CUTOFF_SIGMAS)
    volume = yield from part_of_work(sampling, 0.0, _SAMPLED)
    places = np.nan_to_num(gaussians.means.astype(np.float64))
    depth = yield from part_of_work(depth_in_steps(volume, air_threshold(volume.values), places), _SAMPLED, 1.0)
    # A grid smooths what is thinner than its voxels, and nowhere is less than a splat's own.
    return depth, no_less_than_own(volume.sample(places), gaussians)


def no_less_than_own(density: np.ndarray, gaussians: GaussianSet) -> np.ndarray:
    """Densities at splats (N,) mm⁻¹, of each at least its own; clones have none."""
    own = np.where(gaussians.modality == Modality.CLONE, 0.0, np.nan_to_num(gaussians.density))
    return np.maximum(density, own)
