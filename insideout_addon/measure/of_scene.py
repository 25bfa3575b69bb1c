"""What is measured of a scene: its model and its section plane, with the settings of the panels."""

from __future__ import annotations

from collections.abc import Callable, Generator
from dataclasses import dataclass

import bpy
import numpy as np

from ...core.errors import SettingError
from ...core.render.section_numpy import SectionSplats
from ...core.steps import part_of_work
from ...core.views import Plane
from ..scene.contours import automatic_level
from ..scene.following import shown_density_in_steps
from ..scene.section import automatic_window, model_box, section_as_seen, seen_in_steps, shown_plane
from ..scene.section_image import Contour, Window, contours_in_steps
from ..scene.section_picture import density_unit
from ..scene.section_survey import lacks_window
from ..scene.splats import read_density
from .histogram import Histogram, draw_histogram, section_histogram, volume_histogram_in_steps
from .look import Look
from .material_box import material_box_in_steps
from .page import Outline, Page
from .sheet import axis_series, draw_sheet_in_steps, plane_series
from .thickness import ThicknessFigures, thickness_figures, thickness_in_steps

_FEWEST_PIXELS = 8
# The model ends where less than this part of the window is left: air and haze are fainter, edges are blurred.
_SEEN = 0.25
# Shares of the work that are done when it is known where the model ends.
_BOX_OF_HISTOGRAM, _BOX_OF_SHEET = 0.3, 0.2
# Shares of that when a soft model is bent, and when it is ready to be cut.
_BENT, _TAKEN = 0.2, 0.4
# And of measuring walls when the model is cut, and when its outlines are found.
_CUT, _OUTLINED = 0.1, 0.3


@dataclass(frozen=True, eq=False)
class Walls:
    """The contours of a section with their thickness.

    Attributes:
        contours: the longest first.
        thickness: for each (n,) mm, as `wall_thickness` has it.
        figures: of all together.
        plane: of the section, mm in the model's frame.
        level: the setting of the contours, mm⁻¹; 0 for automatic.
    """

    contours: list[Contour]
    thickness: list[np.ndarray]
    figures: ThicknessFigures
    plane: Plane
    level: float


def measure_walls(scene: bpy.types.Scene) -> Generator[float, None, Walls]:
    """The walls on the scene's section, at the density that its contours have; in steps, which yield the share done.

    Raises:
        NoSectionError: as `section_as_seen`.
        SettingError: there is no edge, or no wall, on the section; or as `section_as_seen`.
    """
    level = scene.insideout.level
    values, plane = yield from part_of_work(seen_in_steps(scene), 0.0, _CUT)
    contours = yield from part_of_work(contours_in_steps(values, plane, level), _CUT, _OUTLINED)
    if not contours:
        raise SettingError("The plane meets no edge at this density; move it, or change Contour.")
    thickness = yield from part_of_work(thickness_in_steps(values, plane, contours), _OUTLINED, 1.0)
    figures = thickness_figures(contours, thickness)
    if figures is None:
        raise SettingError("No contour on the section has a wall behind it; move the plane, or change Contour.")
    return Walls(contours, thickness, figures, plane, level)


def measure_histogram(scene: bpy.types.Scene, of: str) -> Generator[float, None, Histogram]:
    """How much there is of which density; in steps, which yield the share done.

    Args:
        of: "SECTION" or "MODEL".

    Raises:
        NoSectionError, SettingError: as `section_as_seen`.
    """
    if of == "MODEL":
        splats, box = yield from part_of_work(_material(scene), 0.0, _BOX_OF_HISTOGRAM)
        return (yield from part_of_work(volume_histogram_in_steps(splats, box), _BOX_OF_HISTOGRAM, 1.0))
    values, plane = yield from seen_in_steps(scene)
    return section_histogram(values, plane, scene.insideout.level or automatic_level(values))


def histogram_page(scene: bpy.types.Scene, of: str, histogram: Histogram, letter: Callable[[str], Outline]) -> Page:
    """The histogram in the colours and the unit of the scene's sections."""
    title = scene.insideout.model.name + (", section" if of == "SECTION" else "")
    return draw_histogram(histogram, scene_look(scene), title, letter)


def sheet_page(
    scene: bpy.types.Scene,
    axis: str,
    count: int,
    letter: Callable[[str], Outline],
    dots_per_inch: float = 200.0,
    real_size: bool = False,
) -> Generator[float, None, Page]:
    """A sheet of `count` sections through the scene's model; in steps, which yield the share done.

    Args:
        axis: "X", "Y" or "Z" of the model, or "PLANE" for sections parallel to the section plane.

    Raises:
        SettingError: there is no section plane to be parallel to, or no paper is large enough; or as `section_as_seen`.
    """
    splats, box = yield from part_of_work(_material(scene), 0.0, _BOX_OF_SHEET)
    if axis != "PLANE":
        series = axis_series(box, axis, count)
    elif shown_plane(scene) is None:
        raise SettingError("There is no section plane to be parallel to; add one, or choose X, Y or Z.")
    else:
        series = plane_series(box, section_as_seen(scene, _FEWEST_PIXELS)[1], count)
    title = scene.insideout.model.name
    drawing = draw_sheet_in_steps(splats, series, scene_look(scene), title, letter, dots_per_inch, real_size)
    return (yield from part_of_work(drawing, _BOX_OF_SHEET, 1.0))


def _material(scene: bpy.types.Scene) -> Generator[float, None, tuple[SectionSplats, np.ndarray]]:
    """The model's splats, and the box (2, 3) of what they make up."""
    # Before any break: it may be another model afterwards.
    window = scene_look(scene).window
    gaussians = yield from part_of_work(shown_density_in_steps(scene.insideout.model), 0.0, _BENT)
    splats = yield from part_of_work(SectionSplats.in_steps(gaussians), _BENT, _TAKEN)
    boxing = material_box_in_steps(splats, model_box(gaussians), window.low + _SEEN * window.span)
    return splats, (yield from part_of_work(boxing, _TAKEN, 1.0))


def scene_look(scene: bpy.types.Scene) -> Look:
    """Window, colours and unit of the scene's sections; before the first of them, the window that the
    model's would get."""
    settings = scene.insideout
    window = Window(settings.low, settings.high)
    if lacks_window(settings.model, scene):
        gaussians = read_density(settings.model)
        window = automatic_window(gaussians, model_box(gaussians))
    return Look(window, settings.colors.lower(), density_unit(scene))
