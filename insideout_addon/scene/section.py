"""The section plane: an object the user moves, which cuts the model and shows the density where it cuts."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace

import bpy
import numpy as np
from bpy.app.handlers import persistent
from mathutils import Matrix, Quaternion, Vector

from ...core.errors import SettingError
from ...core.gaussians import GaussianSet
from ...core.render.section_numpy import section_density
from ...core.views import Plane
from .color_bar import NAME as COLOR_BAR
from .color_bar import REACH_KEY, remove_color_bar, update_color_bar
from .display import display_modifier
from .framing import without_background
from .node_tree import modifier_input, set_modifier_input, shader_builder
from .section_image import Window, section_rgba
from .splats import in_scene, is_splats, read_density, shown_model, shows_density

NAME = "InsideOut Section"
SIZE_KEY = "insideout_size_mm"
# The image floats this part of its size above the cut, so that it does not fight with the caps for depth.
_LIFT = 1.5e-3
_SETTLE_S, _QUICK_S, _QUICK_DIVISOR = 0.35, 0.05, 3
_FEWEST, _NOTHING = 8, 1e-9


class NoSectionError(ValueError):
    """There is nothing to sample; the message tells the user what is missing."""


def model_box(gaussians: GaussianSet) -> np.ndarray:
    """(2, 3) the box of the object; its background and stray splats (half a percent at each end) do not count."""
    gaussians = without_background(gaussians)
    if len(gaussians) == 0:
        return np.array([[-1.0] * 3, [1.0] * 3])
    return np.percentile(gaussians.means, [0.5, 99.5], axis=0) + np.array([[-1.0], [1.0]]) * np.median(gaussians.scales)


def turned_box(gaussians: GaussianSet, turn: Quaternion) -> np.ndarray:
    """(2, 3) `model_box` of a model that is turned about its origin."""
    return model_box(replace(gaussians, means=gaussians.means @ np.array(turn.to_matrix(), np.float32).T))


def add_section_plane(model: bpy.types.Object, context: bpy.types.Context) -> bpy.types.Object:
    """A plane half way into the model, facing the front view, set as the scene's section."""
    remove_section(context.scene)
    gaussians = read_density(model)
    place, turn, scale = model.matrix_world.decompose()
    box = turned_box(gaussians, turn)
    size = 1.12 * float((box[1] - box[0]).max())
    plane = bpy.data.objects.new(NAME, _plane_mesh(size))
    context.collection.objects.link(plane)
    plane[SIZE_KEY] = size
    plane[REACH_KEY] = 0.5 * float(box[1, 0] - box[0, 0])
    # Local z, the hidden side, points at the user in the front view (-y).
    facing = Matrix(((1, 0, 0), (0, 0, -1), (0, 1, 0))).to_4x4()
    middle = Matrix.Translation(Vector(box.mean(axis=0)))
    # The front of the world: a model of photos alone is turned upright.
    plane.matrix_world = Matrix.LocRotScale(place, None, scale) @ middle @ facing
    plane.show_wire = True
    for ray in ("diffuse", "glossy", "transmission", "volume_scatter", "shadow"):
        setattr(plane, f"visible_{ray}", False)
    # Lets each frame of an animation have its own section: see `on_frame_changed`.
    context.scene.render.use_lock_interface = True
    settings = context.scene.insideout
    settings.model, settings.plane = model, plane
    window = automatic_window(gaussians, model_box(gaussians))
    settings.low, settings.high = window.low, window.high
    context.view_layer.update()
    apply_cut(context.scene)
    refresh_section(context.scene)
    return plane


def place_plane(
    scene: bpy.types.Scene, position: Sequence[float] | None = None, normal: Sequence[float] | None = None
) -> None:
    """Moves the scene's section plane; what is None stays.

    Args:
        position: (3,) mm in the model's frame, the middle of the plane.
        normal: (3,) of any length in the model's frame, towards the side that is hidden; up stays up on the plane.

    Raises:
        SettingError: the normal has no direction.
    """
    plane, model = shown_plane(scene), shown_model(scene)
    place, turn, scale = (model.matrix_world.inverted() @ plane.matrix_world).decompose()
    if normal is not None:
        if not Vector(normal).length > 0:
            raise SettingError("The normal of the section plane is 0 0 0; give it a direction.")
        turn = Vector(normal).to_track_quat("Z", "Y")
    plane.matrix_world = model.matrix_world @ Matrix.LocRotScale(place if position is None else position, turn, scale)


def automatic_window(gaussians: GaussianSet, box: np.ndarray) -> Window:
    """Densities to show: from 0 to the 99.5th percentile of three coarse sections through the middle."""
    middle, size = box.mean(axis=0), float((box[1] - box[0]).max())
    pixels, values = 96, []
    axes = np.eye(3) * size / pixels
    for u, v in ((0, 1), (0, 2), (1, 2)):
        origin = middle - 0.5 * pixels * (axes[u] + axes[v])
        values.append(section_density(gaussians, Plane(origin, axes[u], axes[v], pixels, pixels)).ravel())
    found = np.concatenate(values)
    material = found[found > 0.02 * found.max(initial=0.0)]
    return Window(0.0, float(np.percentile(material, 99.5)) if material.size else 0.05)


def section_view(plane: bpy.types.Object, model: bpy.types.Object, pixels: int) -> Plane:
    """The section plane in the model's frame (mm), `pixels` along its longer side; pixels are as square as can be.

    Raises:
        NoSectionError: the model or the plane is scaled to nothing.
    """
    for scaled in (model, plane):
        if min(map(abs, scaled.matrix_world.to_scale())) < _NOTHING:
            raise NoSectionError(f"{scaled.name} is scaled to nothing, so there is no section; give it a size again.")
    matrix = np.array(model.matrix_world.inverted() @ plane.matrix_world)
    size = float(plane[SIZE_KEY])
    sides = size * np.linalg.norm(matrix[:3, :2], axis=0)
    width, height = (max(round(pixels * side / sides.max()), _FEWEST) for side in sides)
    corner = matrix @ np.array([-0.5 * size, 0.5 * size, 0.0, 1.0])
    return Plane(corner[:3], matrix[:3, 0] * size / width, -matrix[:3, 1] * size / height, width, height)


def sample_section(
    scene: bpy.types.Scene, pixels: int | None = None, depsgraph: bpy.types.Depsgraph | None = None
) -> tuple[np.ndarray, Plane]:
    """Densities (height, width) on the scene's section plane, mm⁻¹, and that plane in the model's frame.

    Args:
        depsgraph: whose places of model and plane count, while one is rendered; else what the viewport shows.

    Raises:
        NoSectionError: the scene has no model or no section plane, or one of them no size.
    """
    plane, model = shown_plane(scene), shown_model(scene)
    if plane is None or model is None:
        raise NoSectionError("The scene has no section yet; import a model and press Add Section Plane.")
    view = section_view(*_evaluated(scene, depsgraph), pixels or scene.insideout.pixels)
    return section_density(_live.gaussians(model), view), view


def _evaluated(
    scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph | None
) -> tuple[bpy.types.Object, bpy.types.Object]:
    plane, model = scene.insideout.plane, scene.insideout.model
    return (plane, model) if depsgraph is None else (plane.evaluated_get(depsgraph), model.evaluated_get(depsgraph))


def _placed(scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph | None) -> tuple[int, Matrix]:
    plane, model = _evaluated(scene, depsgraph)
    return scene.session_uid, model.matrix_world.inverted_safe() @ plane.matrix_world


def refresh_section(scene: bpy.types.Scene, divisor: int = 1, depsgraph: bpy.types.Depsgraph | None = None) -> None:
    """Computes the density on the plane and shows it; `divisor` > 1 does so with coarser pixels, for speed."""
    settings = scene.insideout
    if not settings.show_density or not _has_something_to_show(scene):
        return
    try:
        values, _ = sample_section(scene, max(settings.pixels // divisor, 16), depsgraph)
    except NoSectionError:
        return
    window = Window(settings.low, settings.high)
    image = _image(settings.plane)
    rgba = np.ascontiguousarray(section_rgba(values, window)[::-1])
    if tuple(image.size) != rgba.shape[1::-1]:
        image.scale(rgba.shape[1], rgba.shape[0])
    image.pixels.foreach_set(rgba.ravel())
    image.update()
    if divisor == 1:
        image.pack()
        _live.drawn = _placed(scene, depsgraph)
    update_color_bar(settings.plane, float(settings.plane[SIZE_KEY]), window)


def _has_something_to_show(scene: bpy.types.Scene) -> bool:
    """Whether the model has density; where it has none the plane only cuts, without a picture or a colour bar."""
    plane, model = shown_plane(scene), shown_model(scene)
    if plane is None or model is None or shows_density(model):
        return True
    plane.hide_render, plane.display_type = True, "WIRE"
    remove_color_bar(plane)
    return False


def shown_plane(scene: bpy.types.Scene) -> bpy.types.Object | None:
    """The scene's section plane, unless it was deleted by hand."""
    plane = scene.insideout.plane
    return plane if in_scene(plane, scene) else None


def section_is_lost(scene: bpy.types.Scene) -> bool:
    """Whether the plane was deleted by hand: its colour bar is still there and the model still cut."""
    settings = scene.insideout
    if settings.plane is not None:
        return not in_scene(settings.plane, scene)
    modifier = display_modifier(settings.model) if shown_model(scene) is not None else None
    return modifier is not None and modifier_input(modifier, "Cut")


def remove_section(scene: bpy.types.Scene) -> None:
    """Takes the plane, its colour bar and the cut away, whatever of them there is."""
    plane = scene.insideout.plane
    parts = [o for o in scene.objects if o.name.startswith(COLOR_BAR) and o.parent in (plane, None)]
    for part in [*parts, plane]:
        # A plane that other scenes show too stays there.
        if part is not None and set(part.users_scene) <= {scene}:
            bpy.data.objects.remove(part)
    if scene.insideout.plane is not None:
        scene.insideout.plane = None
    apply_cut(scene)


def apply_cut(scene: bpy.types.Scene) -> None:
    """Hands the section settings to the model's display."""
    settings, model, plane = scene.insideout, shown_model(scene), shown_plane(scene)
    _make_others_whole(scene)
    modifier = display_modifier(model) if model is not None else None
    if modifier is None:
        return
    if plane is not None:
        set_modifier_input(modifier, "Section", plane)
    set_modifier_input(modifier, "Cut", settings.cut and plane is not None)
    set_modifier_input(modifier, "Flip", settings.flip)
    set_modifier_input(modifier, "Slab", settings.slab_mm)


def _make_others_whole(scene: bpy.types.Scene) -> None:
    """Takes the cut by the scene's plane from splats that are not the scene's model any more."""
    plane, model = scene.insideout.plane, scene.insideout.model
    for other in scene.objects:
        modifier = display_modifier(other) if other != model and is_splats(other) else None
        if plane is not None and modifier is not None and modifier_input(modifier, "Section") == plane:
            set_modifier_input(modifier, "Section", None)
            set_modifier_input(modifier, "Cut", False)


def on_show_changed(settings: bpy.types.PropertyGroup, context: bpy.types.Context) -> None:
    """Property callback: what is cut and hidden, and whether the density is drawn."""
    scene = settings.id_data
    apply_cut(scene)
    plane = shown_plane(scene)
    if plane is not None:
        shown = settings.show_density and _has_something_to_show(scene)
        plane.hide_render = not shown
        plane.display_type = "TEXTURED" if shown else "WIRE"
        for part in plane.children:
            part.hide_render = part.hide_viewport = not settings.show_density
    on_section_changed(settings, context)


def on_section_changed(settings: bpy.types.PropertyGroup, context: bpy.types.Context) -> None:
    """Property callback: window or pixels of the section."""
    _live.mark(settings.id_data)


class _LiveSection:
    """Redraws the section after the plane has moved: coarsely while it moves, in full when it rests."""

    def __init__(self) -> None:
        self.clear()

    def clear(self) -> None:
        """Forgets everything: what comes is another file."""
        self._moved_at = 0.0
        self._uid = 0
        self._gaussians: GaussianSet | None = None
        self._scene = 0
        # Scene and place of the plane that the picture on it is of; None when that is coarse or out of date.
        self.drawn: tuple[int, Matrix] | None = None

    def gaussians(self, model: bpy.types.Object) -> GaussianSet:
        """The model's splats; read again only when another model is cut, or this one was `edited`."""
        if model.data.session_uid != self._uid or self._gaussians is None:
            self._uid, self._gaussians = model.data.session_uid, read_density(model)
        return self._gaussians

    def edited(self, data: bpy.types.ID) -> bool:
        """Forgets the splats if they are of this point cloud, and says whether they were."""
        if data.session_uid != self._uid:
            return False
        self._gaussians = None
        return True

    def mark(self, scene: bpy.types.Scene) -> None:
        """Notes a change; in background mode, where no timer runs, whoever needs the image refreshes it."""
        self._moved_at, self._scene, self.drawn = time.monotonic(), scene.session_uid, None
        if not bpy.app.background and not bpy.app.timers.is_registered(_redraw_live):
            bpy.app.timers.register(_redraw_live, first_interval=_QUICK_S)

    def redraw(self) -> float | None:
        scene = next((scene for scene in bpy.data.scenes if scene.session_uid == self._scene), None)
        if scene is None:
            return None
        if bpy.app.is_job_running("RENDER"):
            return _SETTLE_S
        if section_is_lost(scene):
            remove_section(scene)
        resting = time.monotonic() - self._moved_at > _SETTLE_S
        refresh_section(scene, 1 if resting else _QUICK_DIVISOR)
        return None if resting else _SETTLE_S / 3


_live = _LiveSection()


def _redraw_live() -> float | None:
    # Blender tells timers apart by the object that is called, and a bound method is a new one each time.
    return _live.redraw()


@persistent
def on_depsgraph_update(scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph) -> None:
    """Handler: the plane or the model was moved, deleted or edited."""
    settings = scene.insideout
    changed = lost = section_is_lost(scene)
    for update in depsgraph.updates:
        thing = update.id.original
        if update.is_updated_transform and thing in (settings.plane, settings.model):
            changed = True
        if update.is_updated_geometry and isinstance(thing, bpy.types.PointCloud) and _live.edited(thing):
            changed = True
    if changed:
        _live.mark(scene)
    # Without a window no timer will do it. Not before the loop: the updates point at what is removed.
    if lost and bpy.app.background:
        remove_section(scene)


@persistent
def on_frame_changed(scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph | None) -> None:
    """Handler: an animated plane or model may be elsewhere; what is rendered shows its own section, never a coarse one.

    Blender calls it for each rendering, of a still too.
    """
    rendering = bpy.app.is_job_running("RENDER")
    if rendering and not scene.render.use_lock_interface:
        # We are in the thread that renders, and the window may be drawing the picture that would be changed.
        return
    if shown_plane(scene) is None or shown_model(scene) is None or _placed(scene, depsgraph) == _live.drawn:
        return
    if bpy.app.background or rendering:
        refresh_section(scene, depsgraph=depsgraph)
    else:
        _live.mark(scene)


@persistent
def on_file_loaded(_: object) -> None:
    """Handler: another file; the splats kept for sections are of the old one."""
    _live.clear()


def _handlers() -> tuple[tuple[list, Callable], ...]:
    follow = bpy.app.handlers
    return (
        (follow.depsgraph_update_post, on_depsgraph_update),
        (follow.load_post, on_file_loaded),
        (follow.frame_change_post, on_frame_changed),
        # When rendering ends, the plane is where it was before.
        (follow.render_complete, on_frame_changed),
        (follow.render_cancel, on_frame_changed),
    )


def attach() -> None:
    """Starts to follow the plane."""
    for handlers, handler in _handlers():
        handlers.append(handler)


def detach() -> None:
    """Stops to follow the plane and forgets the splats."""
    for handlers, handler in _handlers():
        handlers.remove(handler)
    if bpy.app.timers.is_registered(_redraw_live):
        bpy.app.timers.unregister(_redraw_live)
    _live.clear()


def _plane_mesh(size: float) -> bpy.types.Mesh:
    half, lift = 0.5 * size, _LIFT * size
    mesh = bpy.data.meshes.new(NAME)
    corners = [(-half, -half, lift), (half, -half, lift), (half, half, lift), (-half, half, lift)]
    mesh.from_pydata(corners, [], [(0, 1, 2, 3)])
    layer = mesh.uv_layers.new(name="UVMap")
    layer.data.foreach_set("uv", [0, 0, 1, 0, 1, 1, 0, 1])
    return mesh


def _image(plane: bpy.types.Object) -> bpy.types.Image:
    """The image that the plane shows; made anew where the user has taken it away."""
    for material in plane.data.materials:
        for node in material.node_tree.nodes if material is not None and material.node_tree is not None else ():
            if node.bl_idname == "ShaderNodeTexImage" and node.image is not None:
                return node.image
    image = bpy.data.images.new(NAME, 8, 8, alpha=True)
    plane.data.materials.clear()
    plane.data.materials.append(_image_material(image))
    return image


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
