"""What a scene does to a soft body, the same for either of Blender's solvers."""

from __future__ import annotations

from dataclasses import dataclass

import bpy


@dataclass(frozen=True, eq=False)
class Motion:
    """Gravity, time and what is in the way.

    Attributes:
        gravity: (3,) Blender units per s².
        units_per_mm: Blender units in a millimetre.
        frame_s: what happens in a frame, in seconds; slow motion makes it less.
        slow_motion: how many times slower than in reality all is shown.
        fastest_mm_s: how fast the body may come to fall.
        colliders: a collection of what it falls onto and is touched by.
        first, last: frames of the animation.
    """

    gravity: tuple[float, float, float]
    units_per_mm: float
    frame_s: float
    slow_motion: float
    fastest_mm_s: float
    colliders: bpy.types.Collection
    first: int
    last: int
