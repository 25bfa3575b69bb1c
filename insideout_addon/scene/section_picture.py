"""The density on a section plane as a picture in the scene, with the colour bar."""

from __future__ import annotations

from dataclasses import replace

import bpy
import numpy as np

from ...core.errors import InsideOutError
from ...core.render.section_numpy import MOVING_SIGMAS
from ...core.views import Plane
from .color_bar import Legend, remove_color_bar, update_color_bar
from .ct_volume import kept_volume
from .node_tree import shader_builder
from .placement import applied_to_splats
from .section import SIZE_KEY, NoSectionError, sample_section, shown_plane, shown_planes
from .section_clip import hidden_pixels
from .section_faces import shape_plane
from .section_image import PER_MM, Picture, Unit, Window, difference_rgba, hounsfield, pixel_mm, section_rgba
from .splats import shown_model, shows_density

NAME = "InsideOut Section"


def draw_picture(
    scene: bpy.types.Scene,
    section: bpy.types.PropertyGroup,
    divisor: int = 1,
    depsgraph: bpy.types.Depsgraph | None = None,
    quick: bool = False,
) -> bool:
    """Computes what a plane shows, if it is to show anything; whether there is anything to show.

    Args:
        divisor: > 1 takes coarser pixels, for speed.
        depsgraph: as in `sample_section`.
        quick: leaves out the splats' faint rims, and does not keep the picture in the .blend.
    """
    settings = scene.insideout
    if not section.show_density or not has_picture(scene, section):
        return False
    sigmas = {"cutoff_sigmas": MOVING_SIGMAS} if quick else {}
    try:
        values, view = sample_section(scene, max(settings.pixels // divisor, 16), depsgraph, section.object, **sigmas)
        picture = picture_of(values, view, scene, section.picture)
    except NoSectionError:
        return False
    except InsideOutError:
        # The picture of before would pass for what is asked for.
        _paint(section.object, np.zeros((8, 8, 4), np.float32))
        return False
    shape_plane(scene, section, depsgraph)
    picture.rgba[hidden_pixels(scene, section, view, depsgraph), 3] = 0.0
    image = _paint(section.object, picture.rgba)
    if not quick:
        image.pack()
    if section.object == shown_plane(scene):
        size = float(section.object[SIZE_KEY])
        scale = pixel_mm(view)[0] * view.width / size
        update_color_bar(section.object, Legend(size, picture.window, picture.colors, picture.unit, scale))
    else:
        remove_color_bar(section.object)
    return True


def picture_of(values: np.ndarray, view: Plane, scene: bpy.types.Scene, kind: str) -> Picture:
    """The model's density, that of the CT on the same plane, or the model's less that of the CT, in colours.

    Args:
        values: (height, width) the model's, mm⁻¹.
        view: where they are, in the model's frame.
        kind: "MODEL", "CT" or "DIFFERENCE".

    Raises:
        CaptureError: the model's run has no volume.
    """
    settings = scene.insideout
    window, colors = Window(settings.low, settings.high), settings.colors.lower()
    if kind == "MODEL":
        return Picture(section_rgba(values, window, colors), window, colors, density_unit(scene))
    model = shown_model(scene)
    scanned = kept_volume.of(model).section(_view_in_scan(view, model))
    if kind == "CT":
        return Picture(section_rgba(scanned, window, colors), window, colors, density_unit(scene))
    rgba = difference_rgba(values - scanned, np.maximum(values, scanned), window)
    return Picture(rgba, window.of_differences(), "difference", density_unit(scene, difference=True))


def _view_in_scan(view: Plane, model: bpy.types.Object) -> Plane:
    """A plane in the model's frame as the scan has it, whose frame is that of before any transform was applied."""
    applied = applied_to_splats(model)
    back = np.linalg.inv(applied.linear)
    origin = back @ (np.asarray(view.origin, np.float64) - applied.translation)
    u, v = (back @ np.asarray(step, np.float64) for step in (view.u, view.v))
    return replace(view, origin=origin, u=u, v=v)


def density_unit(scene: bpy.types.Scene, difference: bool = False) -> Unit:
    """What the scene's densities are written in."""
    settings = scene.insideout
    return hounsfield(settings.water, difference) if settings.unit == "HU" else PER_MM


def refresh_sections(scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph | None = None) -> None:
    """Draws the pictures of all planes anew, in full."""
    for section in shown_planes(scene):
        draw_picture(scene, section, depsgraph=depsgraph)


def has_picture(scene: bpy.types.Scene, section: bpy.types.PropertyGroup) -> bool:
    """Whether the model has density; where it has none the plane only cuts, without a picture or a colour bar."""
    model = shown_model(scene)
    if model is None or shows_density(model):
        return True
    section.object.hide_render, section.object.display_type = True, "WIRE"
    remove_color_bar(section.object)
    return False


def show_picture(scene: bpy.types.Scene, section: bpy.types.PropertyGroup) -> None:
    """Shows or hides a plane's picture and colour bar as its settings say, where the cut faces are."""
    plane = section.object
    shown = section.show_density and has_picture(scene, section)
    plane.hide_render = not shown
    plane.display_type = "TEXTURED" if shown else "WIRE"
    for part in plane.children:
        part.hide_render = part.hide_viewport = not section.show_density
    shape_plane(scene, section)


def _paint(plane: bpy.types.Object, rgba: np.ndarray) -> bpy.types.Image:
    """Puts (height, width, 4) float32 colours on a plane's image."""
    image = _image(plane)
    if tuple(image.size) != rgba.shape[1::-1]:
        image.scale(rgba.shape[1], rgba.shape[0])
    image.pixels.foreach_set(np.ascontiguousarray(rgba[::-1]).ravel())
    image.update()
    return image


def _image(plane: bpy.types.Object) -> bpy.types.Image:
    """The image that the plane shows; made anew where the user has taken it away, or has copied the scene."""
    found = _found_image(plane)
    if found is not None and not any(_found_image(other) == found for other in _other_planes(plane)):
        return found
    image = bpy.data.images.new(NAME, 8, 8, alpha=True)
    plane.data.materials.clear()
    plane.data.materials.append(_image_material(image))
    return image


def _found_image(plane: bpy.types.Object) -> bpy.types.Image | None:
    for material in plane.data.materials:
        for node in material.node_tree.nodes if material is not None and material.node_tree is not None else ():
            if node.bl_idname == "ShaderNodeTexImage" and node.image is not None:
                return node.image
    return None


def _other_planes(plane: bpy.types.Object) -> list[bpy.types.Object]:
    """All scenes' section planes but those that share this one's mesh, and its picture with it."""
    found = [section.object for scene in bpy.data.scenes for section in shown_planes(scene)]
    return [other for other in found if other.data != plane.data]


def _image_material(image: bpy.types.Image) -> bpy.types.Material:
    """Shows the image as it is, whatever the light; air lets the view through."""
    material = bpy.data.materials.new(NAME)
    material.surface_render_method = "BLENDED"
    build = shader_builder(material)
    texture = build.add("ShaderNodeTexImage", image=image, interpolation="Linear", extension="CLIP")
    clear = build.add("ShaderNodeBsdfTransparent")
    glow = build.add("ShaderNodeEmission", {"Color": texture.outputs["Color"], "Strength": 1.0})
    mix = build.add("ShaderNodeMixShader", {0: texture.outputs["Alpha"], 1: clear.outputs[0], 2: glow.outputs[0]})
    build.add("ShaderNodeOutputMaterial", {"Surface": mix.outputs[0]})
    return material
