"""One file for each thing the user can do; each only hands over to `insideout_addon`."""

from __future__ import annotations

from . import (
    cancel,
    check,
    contours_save,
    engine_check,
    engine_setup,
    import_file,
    import_run,
    reconstruct,
    section_add,
    section_remove,
    section_save,
    section_window,
)

CLASSES = tuple(
    cls
    for module in (
        engine_check,
        engine_setup,
        check,
        reconstruct,
        cancel,
        import_run,
        import_file,
        section_add,
        section_remove,
        section_window,
        section_save,
        contours_save,
    )
    for cls in module.CLASSES
)
