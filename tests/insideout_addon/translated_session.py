"""What a user of another language sees, in a Blender program: `blender --background --python translated_session.py`.

Prints what it found as one line of JSON.
"""

from __future__ import annotations

import importlib.util
import json
import sys
from pathlib import Path

import bpy

_ROOT = Path(__file__).resolve().parents[2]


def main() -> None:
    spec = importlib.util.spec_from_file_location(
        "insideout", _ROOT / "__init__.py", submodule_search_locations=[str(_ROOT)]
    )
    sys.modules["insideout"] = package = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(package)
    found = {}
    package.register()
    for language in ("en_US", "de_DE"):
        bpy.context.preferences.view.language = language
        found[language] = _seen()
    package.unregister()
    found["disabled"] = _looked_up("Weigh", "Add Section Plane")
    print("found:" + json.dumps(found))


def _seen() -> dict[str, str]:
    """The labels of a panel and of a button as Blender looks them up, one that is broken into lines, and an error."""
    from insideout.panels import weigh

    drawing_path = Path(__file__).resolve().parents[1] / "panel_drawing.py"
    spec = importlib.util.spec_from_file_location("panel_drawing", drawing_path)
    drawing = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(drawing)
    (label,) = drawing.draw_panels(weigh.CLASSES, 5000)
    found = {**_looked_up(weigh.CLASSES[0].bl_label, "Add Section Plane"), "label": label}
    try:
        bpy.ops.insideout.assets_save(filepath=str(_ROOT))
    except RuntimeError as error:
        found["error"] = str(error).strip()
    return found


def _looked_up(panel: str, button: str) -> dict[str, str]:
    from bpy.app.translations import contexts, pgettext_iface

    label = pgettext_iface("Import a model first, under Model")
    return {
        "panel": pgettext_iface(panel),
        "button": pgettext_iface(button, contexts.operator_default),
        "label": label,
    }


if __name__ == "__main__":
    main()
