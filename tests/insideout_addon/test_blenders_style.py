"""Labels, tooltips and undo are as Blender's guidelines for its own interface ask for them."""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path

import pytest
from bpy_extras.io_utils import ExportHelper

from insideout.operators import CLASSES as OPERATORS
from insideout.operators.waiting import AskedInSteps

_PATH = Path(__file__).parents[1] / "translatable.py"
_SPEC = importlib.util.spec_from_file_location("translatable", _PATH)
translatable = importlib.util.module_from_spec(_SPEC)
_SPEC.loader.exec_module(translatable)

# They start or end the engine, which goes on whatever is undone; write a file; or read a file that is only shown.
WITHOUT_UNDO = {
    *("engine_check", "engine_setup", "check", "forecast", "reconstruct", "cancel"),
    *("export_file", "assets_save", "section_save", "contours_save", "thickness_save", "section_sheet"),
    *("histogram_save", "weigh_save"),
    "scan_read",
}
# Within a title these are written small.
_SMALL = {"a", "an", "and", "as", "at", "by", "for", "in", "of", "on", "or", "over", "per", "the", "to", "with"}
_UNIT = re.compile(r"\([^)]*\)|g/cm³|mm⁻¹|\.{3}$")
_BRITISH = re.compile(
    r"colour|centre|grey|metres?\b|learnt|cancell(ed|ing)|alumini|dentine|neighbour|behaviour|favour|labell|modell|"
    r"catalogue|analyse|\w{3,}isation",
    re.IGNORECASE,
)


@pytest.fixture
def properties(blender):
    """(class, property) of all that panels, dialogs and file browsers show."""
    found = []
    for cls in translatable.shown_classes():
        declared = translatable.registered(cls).properties
        names = getattr(cls, "__annotations__", {})
        found += [(cls.__name__, declared[name]) for name in names if translatable.is_shown(declared[name])]
    return found


@pytest.fixture
def labels(properties):
    """Of properties, their choices, operators and panels."""
    found = {prop.name for _, prop in properties}
    found |= {item.name for _, prop in properties if prop.type == "ENUM" for item in prop.enum_items}
    return found | {cls.bl_label for cls in translatable.shown_classes() if hasattr(cls, "bl_label")}


def test_every_property_has_a_tooltip(properties):
    assert len(properties) > 100
    assert [f"{owner}.{prop.identifier}" for owner, prop in properties if not prop.description] == []


def test_every_choice_has_a_tooltip(properties):
    choices = [(owner, prop, item) for owner, prop in properties if prop.type == "ENUM" for item in prop.enum_items]
    assert len(choices) > 50
    assert [
        f"{owner}.{prop.identifier}.{item.identifier}" for owner, prop, item in choices if not item.description
    ] == []


@pytest.mark.parametrize("cls", OPERATORS, ids=lambda cls: cls.bl_idname)
def test_every_operator_has_a_tooltip(blender, cls):
    assert translatable.registered(cls).description


def test_tooltips_end_without_a_full_stop(properties):
    tooltips = {prop.description for _, prop in properties}
    tooltips |= {item.description for _, prop in properties if prop.type == "ENUM" for item in prop.enum_items}
    tooltips |= {translatable.registered(cls).description for cls in OPERATORS}
    assert [text for text in tooltips if text.endswith(".") or text[:1].islower()] == []


def test_what_changes_the_scene_can_be_undone():
    without = {cls.bl_idname for cls in OPERATORS if "UNDO" not in getattr(cls, "bl_options", ())}
    assert without == {f"insideout.{name}" for name in WITHOUT_UNDO}


def test_labels_are_titles(labels):
    def is_title(label):
        words = _UNIT.sub("1", label).split()
        return all(
            not word[0].islower() or (word in _SMALL and 0 < place < len(words) - 1) for place, word in enumerate(words)
        )

    assert is_title("Less Dense Than")
    assert not is_title("Denser than")
    assert [label for label in labels if not is_title(label)] == []


def test_texts_are_american_as_all_of_blenders(blender):
    assert _BRITISH.search("Add Centre of Mass")
    assert [text for _, text in translatable.catalogue() if _BRITISH.search(text)] == []


def test_attenuation_has_one_unit(labels):
    assert {"Low (mm⁻¹)", "mm⁻¹"} <= labels
    assert [label for label in labels if "1/mm" in label] == []


@pytest.mark.parametrize("cls", OPERATORS, ids=lambda cls: cls.bl_idname)
def test_an_ellipsis_tells_that_something_is_asked_first(cls):
    asks = issubclass(cls, (AskedInSteps, ExportHelper)) or "invoke" in vars(cls)
    assert cls.bl_label.endswith("...") == asks
