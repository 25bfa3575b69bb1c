"""How often held-out photos are measured on the way of a training, and how often where that is dear."""

from __future__ import annotations

WITH_EFFECTS = {"surface rgb": 2, "internal joint": 1, "internal rgb": 2, "fuse finish": 2}
"""By the part: what photos show besides the object is fitted to each that is measured, which takes long."""

UNTIL = 20
"""Where they decide when a training ends."""

# Three in the second half tell where a curve leads.
UNTIL_WITH_EFFECTS = 6


def measured_with_effects(part: str, until: bool) -> int:
    """How often, where effects are fitted to each photo.

    Args:
        part: "stage part", of `WITH_EFFECTS`.
        until: a figure of held-out photos ends trainings.
    """
    return max(WITH_EFFECTS[part], UNTIL_WITH_EFFECTS if until else 0)
