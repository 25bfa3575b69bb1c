"""Draws panels without a window, and holds what they ask for against what this Blender has.

A layout that knows Blender's own: an unknown icon, property, operator or argument fails as it would in the sidebar.
Loaded by file path, so that scripts in other processes can use it too.
"""

from __future__ import annotations

from types import SimpleNamespace

import bpy

_FUNCTIONS = bpy.types.UILayout.bl_rna.functions
_CONTAINERS = ("row", "column", "box", "split", "column_flow")


def draw_panels(classes, width=300):
    """Draws every panel that polls, header and body, as one sidebar of `width` pixels; returns its texts in order."""
    context = SimpleNamespace(
        scene=bpy.context.scene,
        window_manager=bpy.context.window_manager,
        preferences=bpy.context.preferences,
        view_layer=bpy.context.view_layer,
        region=SimpleNamespace(width=width),
    )
    texts = []
    for cls in classes:
        if issubclass(cls, bpy.types.UIList):
            continue
        if hasattr(cls, "poll") and not cls.poll(context):
            continue
        for part in ("draw_header", "draw_header_preset", "draw"):
            if part in vars(cls):
                vars(cls)[part](SimpleNamespace(layout=Layout(texts)), context)
    return texts


class Layout:
    """Takes the calls of `bpy.types.UILayout` that panels make, and writes down the texts."""

    def __init__(self, texts):
        object.__setattr__(self, "texts", texts)

    def __setattr__(self, name, value):
        assert name in bpy.types.UILayout.bl_rna.properties, f"UILayout has no {name}"

    def __getattr__(self, name):
        if name not in _CONTAINERS:
            raise AttributeError(name)

        def container(**options):
            _check(name, options)
            return Layout(self.texts)

        return container

    def label(self, **options):
        _check("label", options)
        self.texts.append(options.get("text", ""))

    def separator(self, **options):
        _check("separator", options)

    def progress(self, **options):
        _check("progress", options)
        assert 0.0 <= options["factor"] <= 1.0
        self.texts.append(options["text"])

    def prop(self, data, name, **options):
        _check("prop", options)
        if name.startswith('["'):
            # An input of a node group, before Blender 5.2.
            assert name[2:-2] in data.keys(), f"{data.name} has no {name}"  # noqa: SIM118
            self.texts.append(options["text"])
            return
        assert name in data.bl_rna.properties, f"{data.bl_rna.identifier} has no {name}"
        assert data.bl_rna.properties[name].description, f"{name} of {data.bl_rna.identifier} has no tooltip"
        self.texts.append(options.get("text", data.bl_rna.properties[name].name))

    def template_icon(self, **options):
        _check("template_icon", options)

    def template_list(self, kind, identifier, data, name, active_data, active_name, **options):
        _check("template_list", options)
        list_type = getattr(bpy.types, kind)
        assert name in data.bl_rna.properties
        assert active_name in active_data.bl_rna.properties
        for item in getattr(data, name):
            list_type.draw_item(None, bpy.context, self, data, item, 0, active_data, active_name)

    def operator(self, name, **options):
        _check("operator", options)
        kind = _operator_type(name)
        assert kind.description, f"{name} has no tooltip"
        text = options.get("text") or kind.name
        # Menus name a kind of file instead, as Blender's own do.
        assert text.endswith(("...", ")")) == kind.name.endswith("..."), f"{text}: whether a dialog follows is not told"
        self.texts.append(text)
        return SimpleNamespace()

    def operator_menu_enum(self, name, enum, **options):
        _check("operator_menu_enum", options)
        kind = _operator_type(name)
        assert kind.properties[enum].type == "ENUM"
        self.texts.append(options.get("text") or kind.name)


def _operator_type(name):
    group, _, operator = name.partition(".")
    return getattr(getattr(bpy.ops, group), operator).get_rna_type()


def _check(function, options):
    parameters = _FUNCTIONS[function].parameters
    assert set(options) <= set(parameters.keys()), (
        f"{function} takes no {sorted(set(options) - set(parameters.keys()))}"
    )
    if "icon" in options:
        assert options["icon"] in parameters["icon"].enum_items, f"no icon {options['icon']}"
