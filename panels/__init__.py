"""One file for each section of the sidebar tab."""

from __future__ import annotations

from . import capture, engine, look, measure, model, physics, reconstruct, section, weigh

CLASSES = tuple(
    cls
    for module in (engine, capture, reconstruct, model, look, section, measure, weigh, physics)
    for cls in module.CLASSES
)
