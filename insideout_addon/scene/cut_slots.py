"""Where each splat is cut: point attributes that hold up to `SLOTS` planes a splat.

The display shows of a splat what lies on the near side of all its planes, {x : n·(x - μ) ≤ height}, closed by caps.
"""

from __future__ import annotations

SLOTS = 6
# Unit normals towards the hidden side, in the splats' frame; zero where a slot is not used.
NORMALS = tuple(f"cut_normal_{slot}" for slot in range(SLOTS))
# Distances from a splat's centre to the plane along the normal, mm; below zero the centre is hidden.
HEIGHTS = tuple(f"cut_height_{slot}" for slot in range(SLOTS))
# How far planes have pulled a splat away from its place in the model; other planes cut it there, not where it is seen.
OFFSET = "cut_offset"
# True on a splat's second and third part beyond faces of a box: what shows whole splats has it in its first alone.
REPEATED = "cut_repeated"
