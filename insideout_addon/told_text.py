"""What the engine tells, in Blender's language."""

from __future__ import annotations

from contextlib import suppress

from bpy.app.translations import pgettext_rpt as rpt_


def told_text(told: object, english: object) -> str:
    """A text of the engine, in Blender's language where there is a translation.

    Args:
        told: what `core.told.Told.to_json` makes of it, or a list of that: of sentences that follow each other.
        english: the text itself, for where an engine of before tells no more, or a place cannot be filled in.
    """
    sentences = told if isinstance(told, list) else [told]
    # A translation's places are those of this version, the values another's; and JSON has no infinite numbers.
    with suppress(KeyError, IndexError, ValueError, TypeError, AttributeError, OverflowError, MemoryError):
        if sentences:
            return " ".join(map(_said, sentences))
    return str(english or "")


def _said(told: dict[str, object]) -> str:
    template, values = told["template"], told["values"]
    if not isinstance(template, str) or not isinstance(values, dict):
        raise TypeError("no text that was told")
    # What is said inside of another text is translated by itself.
    filled = {name: _said(one) if isinstance(one, dict) else one for name, one in values.items()}
    # Without words of its own nothing is looked up: Blender gives "" its catalogue's header.
    text = rpt_(template) if template else ""
    return text.format(**filled) if filled else text
