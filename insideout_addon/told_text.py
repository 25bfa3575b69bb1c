"""What the engine tells, in Blender's language."""

from __future__ import annotations

from contextlib import suppress

from bpy.app.translations import pgettext_rpt as rpt_


def told_text(told: object, english: object) -> str:
    """A text of the engine, in Blender's language where there is a translation, as `displayable`.

    Args:
        told: what `core.told.Told.to_json` makes of it, or a list of that: of sentences that follow each other.
        english: the text itself, for where an engine of before tells no more, or a place cannot be filled in.
    """
    sentences = told if isinstance(told, list) else [told]
    # A translation's places are those of this version, the values another's; and JSON has no infinite numbers.
    with suppress(KeyError, IndexError, ValueError, TypeError, AttributeError, OverflowError, MemoryError):
        if sentences:
            return displayable(" ".join(map(_said, sentences)))
    return displayable(english or "")


def displayable(text: object) -> str:
    """A text as Blender takes it in labels, reports, names and properties: with ? for what is no UTF-8.

    Names of files on Linux may be any bytes; Python keeps those as surrogates, at which Blender raises an error.
    """
    return str(text).encode("utf-8", "replace").decode("utf-8")


def _said(told: dict[str, object]) -> str:
    template, values = told["template"], told["values"]
    if not isinstance(template, str) or not isinstance(values, dict):
        raise TypeError("no text that was told")
    # What is said inside of another text is translated by itself.
    filled = {name: _said(one) if isinstance(one, dict) else one for name, one in values.items()}
    # Without words of its own nothing is looked up: Blender gives "" its catalogue's header.
    text = rpt_(template) if template else ""
    return text.format(**filled) if filled else text
