"""One file for each section of the sidebar tab."""

from __future__ import annotations

from . import capture, engine, model, reconstruct, section

CLASSES = tuple(cls for module in (engine, capture, reconstruct, model, section) for cls in module.CLASSES)
