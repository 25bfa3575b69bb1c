"""Pictures on planes and boxes follow what is moved and changed: quickly while it moves, in full when it rests."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Generator

import bpy
from bpy.app.handlers import persistent
from mathutils import Matrix

from ...core.errors import InsideOutError
from ..in_work import is_importing
from .ct_volume import kept_volume
from .display import display_modifier
from .following import cage_of, following_modifier
from .importing import BODY_KEY, hide_background
from .kept_splats import kept_splats
from .look import apply_look
from .node_tree import modifier_input
from .older_files import take_over
from .section import shown_sections
from .section_box import shape_box
from .section_clip import other_cuts, place_in_model
from .section_cut import apply_cuts
from .section_faces import shape_plane
from .section_picture import (
    draw_picture,
    forget_scan_unless_shown,
    hide_with_model,
    show_picture,
    wants_scan,
    wants_splats,
)
from .sections import remove_section
from .splats import WATER_KEY, WATER_SET_KEY, shown_model

_SETTLE_S, _SOON_S = 0.35, 0.005
# Blender's own cut and a quick picture may take this long together, so that fifteen can be shown in a second; else the
# picture's pixels get coarser. It has so long at least: what it takes to find the splats near the plane stays.
_QUICK_S, _LEAST_S, _COARSEST = 0.06, 0.02, 4
# Modal operators beside which no reading of a scan begins.
_BUSY = ("TRANSFORM_OT_", "INSIDEOUT_OT_")
# Between the window's ends where one has been moved along by the other: mm⁻¹, the least that the panel writes, or this
# part of a number that is too large for that.
_LEAST_WINDOW = 1e-4


def on_show_changed(section: bpy.types.PropertyGroup, context: bpy.types.Context) -> None:
    """Property callback of a section: what is cut and hidden, and whether the density is drawn."""
    scene = section.id_data
    with kept_splats.outlast(scene):
        apply_cuts(scene)
    if section in shown_sections(scene):
        show_picture(scene, section)
    for other in shown_sections(scene):
        (shape_box if other.shape == "BOX" else shape_plane)(scene, other)
    forget_scan_unless_shown()
    live.mark(scene)


def on_model_changed(settings: bpy.types.PropertyGroup, context: bpy.types.Context) -> None:
    """Property callback of the scene: another model is cut, peeled and coloured."""
    scene, model = settings.id_data, shown_model(settings.id_data)
    with kept_splats.outlast(scene):
        if model is not None:
            _use_water_of(model, settings)
            _hide_background_of(model, settings)
        apply_cuts(scene)
        apply_look(scene)
    hide_with_model(scene)
    for section in shown_sections(scene):
        show_picture(scene, section)
    live.mark(scene)


def _use_water_of(model: bpy.types.Object, settings: bpy.types.PropertyGroup) -> None:
    """Lets 0 HU be where the model's scan has it, as importing does, unless the user has set another water."""
    scene, told = settings.id_data, model.get(WATER_KEY, 0.0)
    now = settings.water if settings.is_property_set("water") else None
    of_scans = told, scene.pop(WATER_SET_KEY, 0.0)
    if now is not None and not any(math.isclose(now, water, rel_tol=1e-5) for water in of_scans):
        return
    if not told:
        settings.property_unset("water")
        return
    if now is None or not math.isclose(now, told, rel_tol=1e-5):
        settings.water = told
    scene[WATER_SET_KEY] = told


def _hide_background_of(model: bpy.types.Object, settings: bpy.types.PropertyGroup) -> None:
    """Brings a model in line with the setting, which may have changed while another one was shown."""
    display = display_modifier(model)
    if display is None or not model.is_editable or not model.get(BODY_KEY):
        return
    # Where nothing changes Blender need not work out again what is shown.
    if settings.hide_background != (modifier_input(display, "Farthest") > 0):
        hide_background(model, settings.hide_background)


def on_section_changed(settings: bpy.types.PropertyGroup, context: bpy.types.Context) -> None:
    """Property callback of the scene: window or pixels of the sections, or another one is chosen."""
    scene = settings.id_data
    live.mark(scene)
    # Splats that are coloured by density have the sections' window and colours.
    with kept_splats.outlast(scene):
        apply_look(scene)


def on_low_changed(settings: bpy.types.PropertyGroup, context: bpy.types.Context) -> None:
    """Property callback of the scene: the window's low end, which moves the high one along where it would pass it."""
    if settings.low >= settings.high:
        # Its own callback does the rest, once.
        settings.high = settings.low + _least_window(settings.low)
    else:
        on_section_changed(settings, context)


def on_high_changed(settings: bpy.types.PropertyGroup, context: bpy.types.Context) -> None:
    """Property callback of the scene: the window's high end, as `on_low_changed`."""
    if settings.low >= settings.high:
        settings.low = settings.high - _least_window(settings.high)
    else:
        on_section_changed(settings, context)


def _least_window(density: float) -> float:
    return _LEAST_WINDOW * max(abs(density), 1.0)


def lost_sections(scene: bpy.types.Scene) -> list[bpy.types.PropertyGroup]:
    """Sections whose plane or box was deleted by hand: the colour bar is still there and the model still cut."""
    shown = shown_sections(scene)
    return [section for section in scene.insideout.sections if section not in shown]


def remove_lost(scene: bpy.types.Scene) -> None:
    """Takes away what sections that were deleted by hand left behind."""
    while lost := lost_sections(scene):
        remove_section(scene, lost[0])


class LiveSections:
    """Redraws pictures after planes, the model or settings have changed, of each scene that a window may show."""

    def __init__(self) -> None:
        self.clear()

    def clear(self) -> None:
        """Forgets everything: what comes is another file."""
        # By scene: when something last moved in it, and whether no quick picture of that was drawn yet.
        self._moved_at: dict[int, float] = {}
        self._waiting: set[int] = set()
        self._divisor = 1
        # What Blender took the last time to cut what is shown at a plane that moved.
        self._evaluation_began = self._cut_s = 0.0
        # By plane: the scene that its picture is of in full, and the places there: `_places`; gone when out of date.
        # Scenes may share a plane.
        self._drawn: dict[int, tuple[int, list[Matrix]]] = {}
        # Of a model's splats, a little with each call of the timer; and whose.
        self._reading: Generator[float, None, object] | None = None
        self._read_uid = 0

    def mark(self, scene: bpy.types.Scene) -> None:
        """Notes a change of everything shown; in background mode, where no timer runs, whoever needs it refreshes."""
        self._drawn = {plane: drawn for plane, drawn in self._drawn.items() if drawn[0] != scene.session_uid}
        self.moved(scene)

    def outdate(self) -> None:
        """Notes that what is drawn is not what it should be; it will be drawn with the next refresh."""
        self._drawn.clear()

    def moved(self, scene: bpy.types.Scene) -> None:
        """Notes that planes or the model may be elsewhere."""
        self._moved_at[scene.session_uid] = time.monotonic()
        self._waiting.add(scene.session_uid)
        if not bpy.app.background and not bpy.app.timers.is_registered(_redraw_live):
            bpy.app.timers.register(_redraw_live, first_interval=_SOON_S)

    def evaluation_begins(self) -> None:
        """Notes that Blender is about to work out what has changed."""
        self._evaluation_began = time.monotonic()

    def cut_anew(self) -> None:
        """Notes that Blender has just worked out what a plane that moved cuts."""
        self._cut_s = time.monotonic() - self._evaluation_began

    def has_drawn(self, scene: bpy.types.Scene, section: bpy.types.PropertyGroup) -> None:
        """Notes that a picture was drawn in full just now, and need not be again."""
        if shown_model(scene) is not None:
            self._drawn[section.object.session_uid] = (scene.session_uid, _places(scene, section, None))

    def refresh(self, scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph | None = None) -> None:
        """Draws in full what is out of date."""
        for section, places in self._out_of_date(scene, depsgraph):
            self._drawn.pop(section.object.session_uid, None)
            if draw_picture(scene, section, depsgraph=depsgraph):
                self._drawn[section.object.session_uid] = (scene.session_uid, places)

    def redraw(self) -> float | None:
        """Timer: the next quick pictures while something moves, the full ones when it rests."""
        if bpy.app.is_job_running("RENDER"):
            return _SETTLE_S
        scenes = {scene.session_uid: scene for scene in bpy.data.scenes}
        self._moved_at = {uid: moved for uid, moved in self._moved_at.items() if uid in scenes}
        waits = [self._redraw_scene(scenes[uid]) for uid in list(self._moved_at)]
        return min((wait for wait in waits if wait is not None), default=None)

    def _redraw_scene(self, scene: bpy.types.Scene) -> float | None:
        remove_lost(scene)
        uid = scene.session_uid
        if wants_scan(scene):
            _read_scan(scene)
            return _SETTLE_S
        if not self._knows_splats(scene):
            return _SOON_S
        rest = self._moved_at[uid] + _SETTLE_S - time.monotonic()
        if rest <= 0:
            self.refresh(scene)
            del self._moved_at[uid]
            return None
        if uid in self._waiting:
            self._waiting.remove(uid)
            self._draw_quickly(scene)
            return _SOON_S
        return min(rest, 4 * _SOON_S)

    def _knows_splats(self, scene: bpy.types.Scene) -> bool:
        """Whether the splats of the scene's sections are read; else a little more is, and the window does not wait.

        One model's are read to their end before another's, or two would begin anew for ever. What is edited again and
        again, as a soft body that falls is in each frame, would never be drawn: it is read at once.
        """
        wanted, model = wants_splats(scene), shown_model(scene)
        if wanted and following_modifier(model) is not None:
            return True
        if self._reading is None and wanted:
            self._reading, self._read_uid = kept_splats.of_in_steps(model), model.data.session_uid
        until = time.monotonic() + _QUICK_S
        try:
            while self._reading is not None:
                next(self._reading)
                if time.monotonic() >= until:
                    break
        except StopIteration:
            self._reading = None
            if wanted and model.data.session_uid == self._read_uid:
                return True
        except InsideOutError:
            # What is wrong with them is told where they are drawn.
            self._reading = None
            return True
        return not wants_splats(scene)

    def _draw_quickly(self, scene: bpy.types.Scene) -> None:
        changed = self._out_of_date(scene, None)
        started = time.monotonic()
        for section, _ in changed:
            draw_picture(scene, section, self._divisor, quick=True)
            self._drawn.pop(section.object.session_uid, None)
        if changed:
            took = (time.monotonic() - started) / len(changed)
            # Pixels count with their square.
            wanted = self._divisor * math.sqrt(took / max(_QUICK_S - self._cut_s, _LEAST_S))
            self._divisor = min(max(math.ceil(wanted) if wanted > 1 else 1, 1), _COARSEST)

    def _out_of_date(
        self, scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph | None
    ) -> list[tuple[bpy.types.PropertyGroup, list[Matrix]]]:
        if shown_model(scene) is None:
            return []
        changed = []
        for section in shown_sections(scene):
            places = _places(scene, section, depsgraph)
            if self._drawn.get(section.object.session_uid) != (scene.session_uid, places):
                changed.append((section, places))
        return changed


live = LiveSections()


def _places(
    scene: bpy.types.Scene, section: bpy.types.PropertyGroup, depsgraph: bpy.types.Depsgraph | None
) -> list[Matrix]:
    """Where a plane or a box is in the model, and the sections that hide a part of its picture or pull it apart."""
    model = shown_model(scene)
    return [place_in_model(part, model, depsgraph) for part in (section, *other_cuts(scene, section))]


def _read_scan(scene: bpy.types.Scene) -> None:
    """Begins to read the scan that a section is to show, in a window that shows the scene.

    While someone moves a plane in any window, or something else of ours goes on in steps, as a scan that is read
    already, nothing begins; it is asked again later. Operators of other add-ons may never end.
    """
    windows = bpy.context.window_manager.windows
    busy = any(operator.bl_idname.startswith(_BUSY) for window in windows for operator in window.modal_operators)
    if busy or is_importing():
        return
    for window in windows:
        if window.scene == scene:
            with bpy.context.temp_override(window=window):
                bpy.ops.insideout.scan_read("INVOKE_DEFAULT")
            return


def _redraw_live() -> float | None:
    # Blender tells timers apart by the object that is called, and a bound method is a new one each time.
    return live.redraw()


@persistent
def on_evaluation(scene: bpy.types.Scene, _: object = None) -> None:
    """Handler: Blender is about to work out what has changed."""
    live.evaluation_begins()


@persistent
def on_depsgraph_update(scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph) -> None:
    """Handler: a plane, a box, the model or the cage that it follows was moved, deleted or edited."""
    settings, model = scene.insideout, shown_model(scene)
    cage = None if model is None else cage_of(model)
    lost = bool(lost_sections(scene))
    moving = {settings.model, *(section.object for section in settings.sections)} - {None}
    moved = edited = bent = False
    for update in depsgraph.updates:
        thing = update.id.original
        moved = moved or (update.is_updated_transform and thing in moving)
        # A cage stays where it is when the splats that follow it are moved. Their own geometry is worked out anew with
        # each move of a plane.
        bends = update.is_updated_transform if thing == model else thing == cage
        bent = bent or (cage is not None and bends)
        changed = update.is_updated_geometry and not kept_splats.are_shown_otherwise
        if changed and isinstance(thing, bpy.types.PointCloud):
            # What is kept may be of another scene's model.
            edited = kept_splats.edited(thing) or (model is not None and thing == model.data) or edited
    if bent:
        _forget_bent(scene)
    if edited or bent or lost:
        live.mark(scene)
    elif moved:
        live.cut_anew()
        live.moved(scene)
    # Without a window no timer will do it. Not before the loop: the updates point at what is removed.
    if lost and bpy.app.background:
        remove_lost(scene)


@persistent
def on_frame_changed(scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph | None) -> None:
    """Handler: an animated plane or model may be elsewhere; what is rendered shows its own section, never a coarse one.

    Blender calls it for each rendering, of a still too.
    """
    rendering = bpy.app.is_job_running("RENDER")
    if rendering and not scene.render.use_lock_interface:
        # We are in the thread that renders, and the window may be drawing the picture that would be changed.
        return
    _forget_bent(scene)
    if bpy.app.background or rendering:
        live.refresh(scene, depsgraph)
    elif shown_sections(scene):
        live.moved(scene)


@persistent
def on_undone(scene: bpy.types.Scene, _: object = None) -> None:
    """Handler: settings went back without their callbacks, and pictures are drawn between the steps of undo.

    So are cuts taken away whose plane was deleted by hand: where that plane is back, Blender leaves the model uncut.
    """
    for other in bpy.data.scenes:
        if shown_sections(other):
            apply_cuts(other)
        if other == scene or shown_sections(other):
            live.mark(other)


@persistent
def on_file_loaded(_: object) -> None:
    """Handler: another file; the splats kept for sections are of the one before."""
    _forget()
    take_over()


def _forget_bent(scene: bpy.types.Scene) -> None:
    """A soft body has another shape in each frame."""
    model = shown_model(scene)
    if model is not None and following_modifier(model) is not None:
        kept_splats.edited(model.data)
        live.outdate()


def _forget() -> None:
    live.clear()
    kept_splats.clear()
    kept_volume.clear()


def _handlers() -> tuple[tuple[list, Callable], ...]:
    follow = bpy.app.handlers
    return (
        (follow.depsgraph_update_pre, on_evaluation),
        (follow.depsgraph_update_post, on_depsgraph_update),
        (follow.load_post, on_file_loaded),
        (follow.frame_change_post, on_frame_changed),
        (follow.undo_post, on_undone),
        (follow.redo_post, on_undone),
        # When rendering ends, the plane is where it was before.
        (follow.render_complete, on_frame_changed),
        (follow.render_cancel, on_frame_changed),
    )


def attach() -> None:
    """Starts to follow the planes."""
    for handlers, handler in _handlers():
        handlers.append(handler)


def detach() -> None:
    """Stops to follow the planes and forgets the splats."""
    for handlers, handler in _handlers():
        # A script may have cleared them.
        if handler in handlers:
            handlers.remove(handler)
    if bpy.app.timers.is_registered(_redraw_live):
        bpy.app.timers.unregister(_redraw_live)
    _forget()
