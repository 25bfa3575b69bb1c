"""The density on a section plane as a picture in the scene, with the colour bar."""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import replace

import bpy
import numpy as np

from ...core.errors import CaptureError, InsideOutError, SettingError
from ...core.render.section_numpy import MOVING_SIGMAS, section_density
from ...core.steps import part_of_work, run_through
from ...core.views import Plane
from .color_bar import REACH_KEY, Legend, bar_parts, remove_color_bar, update_color_bar
from .ct_volume import has_volume, kept_volume, scan_densities
from .following import is_bent
from .hidden_for_now import hide_for_now, is_hidden_for_now, set_hidden, show_as_before
from .importing import densities_are_relative
from .kept_splats import kept_splats
from .placement import applied_to_splats, densities_times
from .section import (
    SIZE_KEY,
    Known,
    NoSectionError,
    active_section,
    sample_section,
    shown_plane,
    shown_sections,
)
from .section_beside import BAR_SHIFT, beside_kinds, beside_parts, remove_beside, show_beside
from .section_box import bar_frame, bar_size, box_pictures, box_views, paint_box, remove_box_pictures, shape_box
from .section_clip import hidden_pixels
from .section_face import paint
from .section_faces import shape_plane
from .section_image import (
    HOUNSFIELD,
    PER_MM,
    RELATIVE_UNIT,
    Picture,
    Unit,
    Window,
    difference_rgba,
    hounsfield,
    pixel_mm,
    section_rgba,
)
from .splats import WATER_KEY, shown_model, shows_density

# Share of the work that is done when a scan is read.
_READ = 0.9


def draw_picture(
    scene: bpy.types.Scene,
    section: bpy.types.PropertyGroup,
    divisor: int = 1,
    depsgraph: bpy.types.Depsgraph | None = None,
    quick: bool = False,
    known: Known | None = None,
) -> bool:
    """Computes what a plane or a box shows, if it is to show anything; whether there is anything to show.

    Args:
        divisor: > 1 takes coarser pixels, for speed.
        depsgraph: as in `sample_section`.
        quick: leaves out the splats' faint rims, and does not keep the picture in the .blend.
        known: densities that need not be worked out; of no quick picture.
    """
    drawn = _draw(scene, section, divisor, depsgraph, quick, known)
    if is_hidden_for_now(section.object):
        # Parts may be new.
        hide_for_now(section_parts(section))
    return drawn


def _draw(
    scene: bpy.types.Scene,
    section: bpy.types.PropertyGroup,
    divisor: int,
    depsgraph: bpy.types.Depsgraph | None,
    quick: bool,
    known: Known | None,
) -> bool:
    if not section.show_density or not has_picture(scene, section):
        return False
    sigmas = {"cutoff_sigmas": MOVING_SIGMAS} if quick else {}
    pixels = picture_pixels(scene, section.shape, divisor)
    if section.shape == "BOX":
        return _draw_box(scene, section, pixels, depsgraph, not quick, known, **sigmas)
    plane = section.object
    try:
        values, view = sample_section(scene, pixels, depsgraph, plane, known=known, **sigmas)
        picture = picture_of(values, view, scene, section.picture, depsgraph=depsgraph)
    except NoSectionError:
        return False
    except InsideOutError:
        # The picture of before would pass for what is asked for.
        paint(plane, np.zeros((8, 8, 4), np.float32))
        remove_beside(plane)
        return False
    shape_plane(scene, section, depsgraph)
    beside = _beside(values, view, scene, section, depsgraph)
    hidden = hidden_pixels(scene, section, view, depsgraph)
    for one in (picture, *beside.values()):
        one.rgba[hidden, 3] = 0.0
    paint(plane, picture.rgba, keep=not quick)
    if beside:
        show_beside(plane, beside, picture.unit, section.flip, keep=not quick)
    else:
        remove_beside(plane)
    if plane == shown_plane(scene):
        size = float(plane[SIZE_KEY])
        scale = pixel_mm(view)[0] * view.width / size
        shift, reach = BAR_SHIFT * size if beside else 0.0, float(plane[REACH_KEY])
        told = picture.window, reach, picture.colors, picture.unit
        update_color_bar(plane, Legend(size, *told, mm_per_unit=scale, shift=shift, flip=section.flip))
        _remove_other_bars(scene, plane)
    else:
        remove_color_bar(plane)
    return True


def picture_pixels(scene: bpy.types.Scene, shape: str, divisor: int = 1) -> int:
    """Pixels along the longer side of a plane's picture, or along the longest edge of a box.

    A box is about half as wide as a plane, so pixels are as large.
    """
    pixels = max(scene.insideout.pixels // divisor, 16)
    return max(pixels // 2, 16) if shape == "BOX" else pixels


def _draw_box(
    scene: bpy.types.Scene,
    section: bpy.types.PropertyGroup,
    pixels: int,
    depsgraph: bpy.types.Depsgraph | None,
    keep: bool,
    known: Known | None,
    **sigmas: float,
) -> bool:
    """Draws the density on the faces of a box."""
    model, box = shown_model(scene), section.object
    if model is None:
        return False
    try:
        evaluated = [thing if depsgraph is None else thing.evaluated_get(depsgraph) for thing in (box, model)]
        splats, pictures = kept_splats.of(model, depsgraph), []
        for view in box_views(*evaluated, pixels):
            values = None if known is None else known.on(view, splats)
            values = section_density(splats, view, **sigmas) if values is None else values
            picture = picture_of(values, view, scene, section.picture, depsgraph=depsgraph)
            picture.rgba[hidden_pixels(scene, section, view, depsgraph), 3] = 0.0
            pictures.append(picture)
    except InsideOutError:
        # The pictures of before would pass for what is asked for.
        remove_box_pictures(box)
        remove_color_bar(box)
        return False
    paint_box(box, [picture.rgba for picture in pictures], keep)
    shape_box(scene, section, depsgraph)
    if box == _box_with_bar(scene):
        size, reach, middle = bar_size(*evaluated)
        legend = Legend(size, pictures[0].window, reach, pictures[0].colors, pictures[0].unit, middle=middle)
        update_color_bar(box, legend, bar_frame(*evaluated))
        _remove_other_bars(scene, box)
    else:
        remove_color_bar(box)
    return True


def _box_with_bar(scene: bpy.types.Scene) -> bpy.types.Object | None:
    """The box beside which the colour bar stands: where a plane shows densities it stands beside that."""
    plane, drawn = shown_plane(scene), [section for section in shown_sections(scene) if section.show_density]
    if any(section.object == plane for section in drawn):
        return None
    chosen, boxes = active_section(scene), [section for section in drawn if section.shape == "BOX"]
    return chosen.object if chosen in boxes else boxes[0].object if boxes else None


def _remove_other_bars(scene: bpy.types.Scene, owner: bpy.types.Object) -> None:
    """One is enough: all pictures have the same colours and window."""
    for section in shown_sections(scene):
        if section.object != owner:
            remove_color_bar(section.object)


def _beside(
    values: np.ndarray,
    view: Plane,
    scene: bpy.types.Scene,
    section: bpy.types.PropertyGroup,
    depsgraph: bpy.types.Depsgraph | None,
) -> dict[str, Picture]:
    """The pictures that are wanted beside a plane, by their kinds; none without a CT, no difference of two units."""
    kinds, model = beside_kinds(section), shown_model(scene)
    try:
        scanned = scan_on(view, model, depsgraph) if kinds else None
    except InsideOutError:
        return {}
    if kinds and only_scan_is_relative(model):
        kinds = tuple(kind for kind in kinds if kind != "DIFFERENCE")
    return {kind: picture_of(values, view, scene, kind, scanned) for kind in kinds}


def only_scan_is_relative(model: bpy.types.Object | None) -> bool:
    """Whether a model's CT has densities without a unit, of gray values that fit no projections, and the model has not:
    the projections gave it mm⁻¹. One less the other means nothing."""
    try:
        return model is not None and not densities_are_relative(model) and scan_densities(model).relative
    except (CaptureError, OSError):
        return False


def scan_on(view: Plane, model: bpy.types.Object, depsgraph: bpy.types.Depsgraph | None = None) -> np.ndarray:
    """(height, width) float32, mm⁻¹: the scan that a model was made from, on a plane in the model's frame.

    Where the model's size was corrected, so are its densities: the projections are those of the same line integrals.

    Args:
        depsgraph: as in `sample_section`.

    Raises:
        CaptureError: the model's run has no volume.
        SettingError: the model is a soft body that is bent, or has fallen; the scan is as it was.
    """
    return run_through(scan_in_steps(view, model, depsgraph))


def scan_in_steps(
    view: Plane, model: bpy.types.Object, depsgraph: bpy.types.Depsgraph | None = None
) -> Generator[float, None, np.ndarray]:
    """As `scan_on`, with breaks that tell the share that is done: a scan may be gigabytes, and has to be read first."""
    if is_bent(model, depsgraph):
        raise SettingError(
            "{model} is bent as a soft body, and its CT is not; go to the first frame, or press Back to Whole.",
            model=model.name,
        )
    volume = yield from part_of_work(kept_volume.of_in_steps(model), 0.0, _READ)
    view, factor = _view_in_scan(view, model), np.float32(densities_times(model))
    return factor * (yield from part_of_work(volume.section_in_steps(view), _READ, 1.0))


def wants_splats(scene: bpy.types.Scene) -> bool:
    """Whether a section draws the density of the scene's model, and its splats have to be read first."""
    model = shown_model(scene)
    if model is None or kept_splats.has(model) or not shows_density(model):
        return False
    return any(section.show_density for section in shown_sections(scene))


def forget_scan_unless_shown() -> None:
    """Does not hold the scan, which may be gigabytes, longer than a section shows it."""
    if not any(_of_scan(section) for scene in bpy.data.scenes for section in shown_sections(scene)):
        kept_volume.clear()


def wants_scan(scene: bpy.types.Scene) -> bool:
    """Whether a section is to show the scan, and it has to be read first."""
    model = shown_model(scene)
    wanted = any(section.show_density and _of_scan(section) for section in shown_sections(scene))
    return wanted and has_volume(model) and not kept_volume.holds(model)


def show_without_scan(scene: bpy.types.Scene) -> None:
    """Lets the scene's sections show the model alone."""
    for section in [section for section in shown_sections(scene) if _of_scan(section)]:
        if section.picture != "MODEL":
            section.picture = "MODEL"
        if beside_kinds(section):
            section.beside = "NONE"


def _of_scan(section: bpy.types.PropertyGroup) -> bool:
    return section.picture != "MODEL" or bool(beside_kinds(section))


def picture_of(
    values: np.ndarray,
    view: Plane,
    scene: bpy.types.Scene,
    kind: str,
    scanned: np.ndarray | None = None,
    depsgraph: bpy.types.Depsgraph | None = None,
) -> Picture:
    """The model's density, that of the CT on the same plane, or the model's less that of the CT, in colours.

    Both have one window and one colour bar. Where that is in Hounsfield units, the CT has those of its own water.

    Args:
        values: (height, width) the model's, mm⁻¹.
        view: where they are, in the model's frame.
        kind: "MODEL", "CT" or "DIFFERENCE".
        scanned: `scan_on` this view where it is known already.
        depsgraph: as in `sample_section`.

    Raises:
        CaptureError, SettingError: as `scan_on`.
        SettingError: the difference of a model in mm⁻¹ and a CT without a unit.
    """
    settings = scene.insideout
    window, colors = Window(settings.low, settings.high), settings.colors.lower()
    if kind == "MODEL":
        return Picture(section_rgba(values, window, colors), window, colors, density_unit(scene))
    model = shown_model(scene)
    scanned = scan_on(view, model, depsgraph) if scanned is None else scanned
    of_scan, unit = scan_densities(model), density_unit(scene, difference=kind == "DIFFERENCE")
    if of_scan.relative:
        if kind == "DIFFERENCE" and only_scan_is_relative(model):
            raise SettingError(
                "{model}: gray values of its CT have no unit, so there is no difference between them and mm⁻¹; "
                "show the CT alone.",
                model=model.name,
            )
        unit = RELATIVE_UNIT
    elif unit.label == HOUNSFIELD and of_scan.water_per_mm is not None:
        scanned = scanned * np.float32(_denser_in_model(model, of_scan.water_per_mm))
    if kind == "CT":
        return Picture(section_rgba(scanned, window, colors), window, colors, unit, "CT")
    rgba = difference_rgba(values - scanned, np.maximum(values, scanned), window)
    return Picture(rgba, window.of_differences(), "difference", unit, "Difference (model - CT)")


def _denser_in_model(model: bpy.types.Object, water: float) -> float:
    """By what the water of a model's scan, of so many mm⁻¹ there, is denser in the model, which projections showed."""
    return float(model.get(WATER_KEY, water * densities_times(model))) / (water * densities_times(model))


def _view_in_scan(view: Plane, model: bpy.types.Object) -> Plane:
    """A plane in the model's frame as the scan has it, whose frame is that of before any transform was applied."""
    applied = applied_to_splats(model)
    back = np.linalg.inv(applied.linear)
    origin = back @ (np.asarray(view.origin, np.float64) - applied.translation)
    u, v = (back @ np.asarray(step, np.float64) for step in (view.u, view.v))
    return replace(view, origin=origin, u=u, v=v)


def density_unit(scene: bpy.types.Scene, difference: bool = False) -> Unit:
    """What the scene's densities are written in."""
    settings, model = scene.insideout, shown_model(scene)
    if model is not None and densities_are_relative(model):
        return RELATIVE_UNIT
    return hounsfield(settings.water, difference) if settings.unit == "HU" else PER_MM


def refresh_sections(scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph | None = None) -> None:
    """Draws the pictures of all planes and boxes anew, in full."""
    for section in shown_sections(scene):
        draw_picture(scene, section, depsgraph=depsgraph)


def has_picture(scene: bpy.types.Scene, section: bpy.types.PropertyGroup) -> bool:
    """Whether the model has density; where it has none the plane only cuts, without a picture or a colour bar."""
    model = shown_model(scene)
    if model is None or shows_density(model):
        return True
    if section.shape == "BOX":
        remove_box_pictures(section.object)
        remove_color_bar(section.object)
        return False
    _show_face(section.object, False)
    remove_color_bar(section.object)
    remove_beside(section.object)
    return False


def show_picture(scene: bpy.types.Scene, section: bpy.types.PropertyGroup) -> None:
    """Shows or hides the pictures of a plane or a box, and the colour bar, as its settings say, where the cut is."""
    plane = section.object
    if section.shape == "BOX":
        if has_picture(scene, section):
            # What else a user has parented to the box is the user's.
            for part in (*bar_parts(plane), box_pictures(plane)):
                if part is not None:
                    set_hidden(part, viewport=not section.show_density, render=not section.show_density)
        shape_box(scene, section)
        return
    if not beside_kinds(section):
        remove_beside(plane)
    shown = section.show_density and has_picture(scene, section)
    _show_face(plane, shown)
    # What else a user has parented to the plane is the user's.
    for part in (*bar_parts(plane), *beside_parts(plane)):
        set_hidden(part, viewport=not section.show_density, render=not section.show_density)
    shape_plane(scene, section)


def _show_face(plane: bpy.types.Object, shown: bool) -> None:
    """Shows the picture on a plane, or its outline alone; whether it is rendered changes only with that, for the user
    may have chosen otherwise since."""
    display = "TEXTURED" if shown else "WIRE"
    if plane.display_type != display:
        plane.display_type = display
        set_hidden(plane, render=not shown)


def section_parts(section: bpy.types.PropertyGroup) -> list[bpy.types.Object]:
    """The plane or the box of a section, its pictures and its colour bar."""
    thing = section.object
    pictures = box_pictures(thing)
    return [thing, *bar_parts(thing), *beside_parts(thing), *([] if pictures is None else [pictures])]


def hide_with_model(scene: bpy.types.Scene) -> None:
    """Hides the scene's sections where its model is hidden for now, else shows them as they were before."""
    model = shown_model(scene)
    parts = [part for section in shown_sections(scene) for part in section_parts(section)]
    (hide_for_now if model is not None and is_hidden_for_now(model) else show_as_before)(parts)
