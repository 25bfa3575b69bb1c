"""The add-on's texts in other languages: one file of this folder each, called as Blender calls the language.

Blender translates labels and tooltips of operators, panels and properties by itself, and so it does plain texts of
layouts and reports. Texts that are put together are marked: `iface_`, or `rpt_` in reports, translates the template,
which is then formatted; `n_` marks what is translated elsewhere. Errors are templates with values,
`SettingError("{model} was not weighed yet.", model=name)`: as they are made, in scripts, in the log and on the command
line, they are English, and `error_text` translates them where they are shown. The engine sends template and values of
its own errors, of what it finds and of what it is doing beside the sentence, and reports keep both (`core.told.Told`);
`told_text` shows them. What stays English are messages of Python and the system inside of an error, names of objects,
and saved pages.

To add a language, copy de_DE.json to the new one's name and write the new texts behind the colons; braces and what is
in them stay. "Operator" has the texts of buttons, "*" all others. What Blender itself has a translation for, it shows
in its own.
"""

from __future__ import annotations

import json
from pathlib import Path

import bpy

Texts = dict[tuple[str, str], str]
_FOLDER = Path(__file__).parent


def languages() -> list[str]:
    """The languages that there is a file for, as Blender calls them."""
    return sorted(path.stem for path in _FOLDER.glob("*.json"))


def texts_of(language: str) -> Texts:
    """The texts of a language by Blender's context and the English."""
    content = json.loads((_FOLDER / f"{language}.json").read_text("utf-8"))
    return {(context, english): text for context, texts in content.items() for english, text in texts.items()}


def attach() -> None:
    """Tells Blender all of them."""
    bpy.app.translations.register(__package__, {language: texts_of(language) for language in languages()})


def detach() -> None:
    """Takes them away again."""
    bpy.app.translations.unregister(__package__)
