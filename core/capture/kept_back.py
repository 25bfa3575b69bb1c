"""Whether views are kept back from training, to be measured on."""

from __future__ import annotations

from .model import Photos, Projections
from .values import every_eighth


def photos_kept_back(photos: Photos | None) -> bool:
    """Whether any photo is; those without cameras are chosen when the cameras are found."""
    if photos is None:
        return False
    if photos.posed:
        return any(photo.held_out for photo in photos.photos)
    return bool(every_eighth(len(photos.photos)).any())


def projections_kept_back(projections: Projections | None) -> bool:
    """Whether any projection is."""
    return projections is not None and bool(projections.held_out.any())
