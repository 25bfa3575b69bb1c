"""One file for each thing the user can do; each only hands over to `insideout_addon`."""

from __future__ import annotations

from . import (
    apply_transform,
    bake_physics,
    break_model,
    cancel,
    check,
    contours_save,
    engine_check,
    engine_setup,
    export_file,
    histogram_save,
    import_file,
    import_run,
    make_rigid,
    make_soft,
    points,
    probe,
    reconstruct,
    relink,
    section_add,
    section_remove,
    section_save,
    section_sheet,
    section_window,
    thickness,
    unbreak,
    weigh,
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
        export_file,
        relink,
        apply_transform,
        section_add,
        section_remove,
        section_window,
        section_save,
        contours_save,
        points,
        probe,
        thickness,
        section_sheet,
        histogram_save,
        weigh,
        break_model,
        make_rigid,
        make_soft,
        bake_physics,
        unbreak,
    )
    for cls in module.CLASSES
)
