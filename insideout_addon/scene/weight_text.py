"""A model's weight in words, in the language of Blender's interface."""

from __future__ import annotations

from collections.abc import Sequence

from bpy.app.translations import pgettext_iface as iface_

from ...core.mesh.cavities import Cavity
from ...core.mesh.weight import Weight, center_text, mass_text, volume_text


def weight_text(weight: Weight) -> str:
    """One line: "412.3 g, center 1.2 / -0.3 / 44.1 mm, 2 cavities 3.1 cm³"."""
    mass, center = mass_text(weight.properties.mass_g), center_text(weight.properties.center_mm)
    parts = [iface_("{mass}, center {place}").format(mass=mass, place=center)]
    if weight.cavities is not None:
        parts.append(cavities_text(weight.cavities))
    return ", ".join(parts)


def cavities_text(cavities: Sequence[Cavity]) -> str:
    """How many there are and their volume together."""
    if not cavities:
        return iface_("no cavities")
    text = iface_("1 cavity {volume}") if len(cavities) == 1 else iface_("{count} cavities {volume}")
    return text.format(count=len(cavities), volume=volume_text(sum(cavity.volume_mm3 for cavity in cavities)))


def moments_text(moments: Sequence[float]) -> str:
    """Moments of inertia, given in g mm², with three digits: "493 / 1210 / 1250 g cm²"."""
    # In g mm² those of what a hand can hold have powers of ten.
    texts = (f"{0.01 * moment:.0f}" if 999.5 <= 0.01 * moment < 1e6 else f"{0.01 * moment:.3g}" for moment in moments)
    return " / ".join(texts) + " g cm²"
