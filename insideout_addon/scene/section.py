"""The section plane: an object the user moves, which cuts the model and shows the density where it cuts."""

from __future__ import annotations

import time

import bpy
import numpy as np
from bpy.app.handlers import persistent
from mathutils import Matrix, Vector

from ...core.gaussians import GaussianSet
from ...core.render.section_numpy import section_density
from ...core.views import Plane
from .color_bar import REACH_KEY, update_color_bar
from .display import display_modifier
from .node_tree import TreeBuilder, set_modifier_input
from .section_image import Window, section_rgba
from .splats import is_splats, read_density

NAME = "InsideOut Section"
SIZE_KEY = "insideout_size_mm"
# The image floats this part of its size above the cut, so that it does not fight with the caps for depth.
_LIFT = 1.5e-3
_SETTLE_S, _QUICK_S, _QUICK_DIVISOR = 0.35, 0.05, 3


def model_box(gaussians: GaussianSet) -> np.ndarray:
    """(2, 3) the box of the model; stray splats (half a percent at each end) do not count."""
    if len(gaussians) == 0:
        return np.array([[-1.0] * 3, [1.0] * 3])
    return np.percentile(gaussians.means, [0.5, 99.5], axis=0) + np.array([[-1.0], [1.0]]) * np.median(gaussians.scales)


def add_section_plane(model: bpy.types.Object, context: bpy.types.Context) -> bpy.types.Object:
    """A plane half way into the model, facing the front view, set as the scene's section."""
    gaussians = read_density(model)
    box = model_box(gaussians)
    size = 1.12 * float((box[1] - box[0]).max())
    plane = bpy.data.objects.new(NAME, _plane_mesh(size))
    context.collection.objects.link(plane)
    plane[SIZE_KEY] = size
    plane[REACH_KEY] = 0.5 * float(box[1, 0] - box[0, 0])
    # Local z, the hidden side, points at the user in the front view (-y).
    turned = Matrix(((1, 0, 0), (0, 0, -1), (0, 1, 0))).to_4x4()
    plane.matrix_world = model.matrix_world @ Matrix.Translation(Vector(box.mean(axis=0))) @ turned
    plane.show_wire = True
    for ray in ("diffuse", "glossy", "transmission", "volume_scatter", "shadow"):
        setattr(plane, f"visible_{ray}", False)
    image = bpy.data.images.new(NAME, 8, 8, alpha=True)
    plane.data.materials.append(_image_material(image))
    settings = context.scene.insideout
    settings.model, settings.plane = model, plane
    window = automatic_window(gaussians, box)
    settings.low, settings.high = window.low, window.high
    context.view_layer.update()
    apply_cut(context.scene)
    refresh_section(context.scene)
    return plane


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
    """The section plane in the model's frame (mm), with square pixels."""
    matrix = np.array(model.matrix_world.inverted() @ plane.matrix_world)
    size = float(plane[SIZE_KEY])
    corner = matrix @ np.array([-0.5 * size, 0.5 * size, 0.0, 1.0])
    return Plane(corner[:3], matrix[:3, 0] * size / pixels, -matrix[:3, 1] * size / pixels, pixels, pixels)


def sample_section(scene: bpy.types.Scene, pixels: int | None = None) -> tuple[np.ndarray, Plane]:
    """Densities (height, width) on the scene's section plane, mm⁻¹, and that plane in the model's frame.

    Raises:
        ValueError: the scene has no model or no section plane.
    """
    settings = scene.insideout
    if settings.plane is None or not is_splats(settings.model):
        raise ValueError("The scene has no section yet; import a model and press Add Section Plane.")
    view = section_view(settings.plane, settings.model, pixels or settings.pixels)
    return section_density(_live.gaussians(settings.model), view), view


def refresh_section(scene: bpy.types.Scene, divisor: int = 1) -> None:
    """Computes the density on the plane and shows it; `divisor` > 1 does so with coarser pixels, for speed."""
    settings = scene.insideout
    if not settings.show_density or settings.plane is None or not is_splats(settings.model):
        return
    values, _ = sample_section(scene, max(settings.pixels // divisor, 16))
    window = Window(settings.low, settings.high)
    image = _image(settings.plane)
    rgba = np.ascontiguousarray(section_rgba(values, window)[::-1])
    if tuple(image.size) != rgba.shape[1::-1]:
        image.scale(rgba.shape[1], rgba.shape[0])
    image.pixels.foreach_set(rgba.ravel())
    image.update()
    if divisor == 1:
        image.pack()
    update_color_bar(settings.plane, float(settings.plane[SIZE_KEY]), window)


def apply_cut(scene: bpy.types.Scene) -> None:
    """Hands the section settings to the model's display."""
    settings = scene.insideout
    if not is_splats(settings.model):
        return
    modifier = display_modifier(settings.model)
    if modifier is None:
        return
    if settings.plane is not None:
        set_modifier_input(modifier, "Section", settings.plane)
    set_modifier_input(modifier, "Cut", settings.cut and settings.plane is not None)
    set_modifier_input(modifier, "Flip", settings.flip)
    set_modifier_input(modifier, "Slab", settings.slab_mm)


def on_show_changed(settings: bpy.types.PropertyGroup, context: bpy.types.Context) -> None:
    """Property callback: what is hidden, and whether the density is drawn."""
    apply_cut(settings.id_data)
    if settings.plane is not None:
        for shown in (settings.plane, *settings.plane.children):
            shown.hide_render = not settings.show_density
        for part in settings.plane.children:
            part.hide_set(not settings.show_density)
        settings.plane.display_type = "TEXTURED" if settings.show_density else "WIRE"
    on_section_changed(settings, context)


def on_section_changed(settings: bpy.types.PropertyGroup, context: bpy.types.Context) -> None:
    """Property callback: window or pixels of the section."""
    _live.mark(settings.id_data)


class _LiveSection:
    """Redraws the section after the plane has moved: coarsely while it moves, in full when it rests."""

    def __init__(self) -> None:
        self.clear()

    def clear(self) -> None:
        self._moved_at = 0.0
        self._key: tuple[int, int] | None = None
        self._gaussians: GaussianSet | None = None
        self._scene = ""

    def gaussians(self, model: bpy.types.Object) -> GaussianSet:
        """The model's splats; read again only when another model, or another number of splats, is cut."""
        key = (model.data.session_uid, len(model.data.points))
        if key != self._key or self._gaussians is None:
            self._key, self._gaussians = key, read_density(model)
        return self._gaussians

    def mark(self, scene: bpy.types.Scene) -> None:
        """Notes a change; in background mode, where no timer runs, whoever needs the image refreshes it."""
        self._moved_at, self._scene = time.monotonic(), scene.name
        if not bpy.app.background and not bpy.app.timers.is_registered(self.redraw):
            bpy.app.timers.register(self.redraw, first_interval=_QUICK_S)

    def redraw(self) -> float | None:
        scene = bpy.data.scenes.get(self._scene)
        if scene is None:
            return None
        resting = time.monotonic() - self._moved_at > _SETTLE_S
        refresh_section(scene, 1 if resting else _QUICK_DIVISOR)
        return None if resting else _SETTLE_S / 3


_live = _LiveSection()


@persistent
def on_depsgraph_update(scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph) -> None:
    """Handler: the plane or the model was moved."""
    settings = scene.insideout
    if settings.plane is None:
        return
    for update in depsgraph.updates:
        if update.is_updated_transform and update.id.original in (settings.plane, settings.model):
            _live.mark(scene)
            return


@persistent
def on_file_loaded(_: object) -> None:
    """Handler: another file; the splats kept for sections are of the old one."""
    _live.clear()


def attach() -> None:
    """Starts to follow the plane."""
    bpy.app.handlers.depsgraph_update_post.append(on_depsgraph_update)
    bpy.app.handlers.load_post.append(on_file_loaded)


def detach() -> None:
    """Stops to follow the plane and forgets the splats."""
    bpy.app.handlers.depsgraph_update_post.remove(on_depsgraph_update)
    bpy.app.handlers.load_post.remove(on_file_loaded)
    if bpy.app.timers.is_registered(_live.redraw):
        bpy.app.timers.unregister(_live.redraw)
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
    tree = plane.data.materials[0].node_tree
    return next(node.image for node in tree.nodes if node.bl_idname == "ShaderNodeTexImage")


def _image_material(image: bpy.types.Image) -> bpy.types.Material:
    """Shows the image as it is, whatever the light; air lets the view through."""
    material = bpy.data.materials.new(NAME)
    material.use_nodes = True
    material.surface_render_method = "BLENDED"
    tree = material.node_tree
    tree.nodes.clear()
    build = TreeBuilder(tree)
    texture = build.add("ShaderNodeTexImage", image=image, interpolation="Linear", extension="CLIP")
    clear = build.add("ShaderNodeBsdfTransparent")
    glow = build.add("ShaderNodeEmission", {"Color": texture.outputs["Color"], "Strength": 1.0})
    mix = build.add("ShaderNodeMixShader", {0: texture.outputs["Alpha"], 1: clear.outputs[0], 2: glow.outputs[0]})
    build.add("ShaderNodeOutputMaterial", {"Surface": mix.outputs[0]})
    return material
