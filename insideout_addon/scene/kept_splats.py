"""What sections need of the splats of the model that was cut last, kept until it is edited or replaced."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator
from contextlib import contextmanager

import bpy

from ...core.gaussians import GaussianSet
from ...core.render.section_numpy import SectionSplats
from ...core.steps import part_of_work, run_through
from .following import shown_density_in_steps

# Share of the work that is done when the splats are read.
_READ = 0.3

Read = Callable[[bpy.types.Object, bpy.types.Depsgraph | None], Generator[float, None, GaussianSet]]
"""Reads a model's splats in its own frame (mm), all before its first break."""


class KeptSplats:
    """Of one model at a time; read again when it is edited or replaced."""

    def __init__(self, read: Read) -> None:
        self._read = read
        self.clear()

    def clear(self) -> None:
        """Forgets them: what comes is another file."""
        self._uid = 0
        self._splats: SectionSplats | None = None
        # Of the splats that are being made: gone where they are edited meanwhile.
        self._making: object | None = None
        self.are_shown_otherwise = False

    @contextmanager
    def shown_otherwise(self) -> Iterator[None]:
        """What Blender updates in here is how splats are shown, though it says that they were edited."""
        self.are_shown_otherwise = True
        try:
            yield
        finally:
            self.are_shown_otherwise = False

    @contextmanager
    def outlast(self, scene: bpy.types.Scene) -> Iterator[None]:
        """Settings that change in here are of how the scene's splats are shown: the window need not read them again.

        Without a window nobody drags a slider, and a script that sets ten of them would have ten evaluations.
        """
        context = bpy.context
        none = self._splats is None and self._making is None
        if none or bpy.app.background or context.scene != scene:
            yield
            return
        # What was edited just before this is an edit.
        context.view_layer.update()
        yield
        with self.shown_otherwise():
            context.view_layer.update()

    def has(self, model: bpy.types.Object) -> bool:
        """Whether the model's splats, as they are now, are kept."""
        return self._splats is not None and model.data.session_uid == self._uid

    def of(self, model: bpy.types.Object, depsgraph: bpy.types.Depsgraph | None = None) -> SectionSplats:
        """The model's splats, in its own frame (mm), as they are bent where it is soft."""
        return run_through(self.of_in_steps(model, depsgraph))

    def of_in_steps(
        self, model: bpy.types.Object, depsgraph: bpy.types.Depsgraph | None = None
    ) -> Generator[float, None, SectionSplats]:
        """As `of`, with breaks that tell the share that is done; what is edited in one of them is not kept."""
        if self.has(model):
            return self._splats
        return (yield from self.read_in_steps(model, depsgraph))[1]

    def read_in_steps(
        self, model: bpy.types.Object, depsgraph: bpy.types.Depsgraph | None = None
    ) -> Generator[float, None, tuple[GaussianSet, SectionSplats]]:
        """As `of_in_steps`, with the set itself, which is read each time."""
        known = self._splats if self.has(model) else None
        self._uid, self._splats, self._making = model.data.session_uid, known, (making := object())
        gaussians = yield from part_of_work(self._read(model, depsgraph), 0.0, _READ)
        splats = known
        if splats is None:
            splats = yield from part_of_work(SectionSplats.in_steps(gaussians), _READ, 1.0)
        if self._making is making:
            self._splats, self._making = splats, None
        return gaussians, splats

    def edited(self, data: bpy.types.ID) -> bool:
        """Forgets the splats if they are of this point cloud, and says whether they were."""
        if data.session_uid != self._uid:
            return False
        self._splats = self._making = None
        return True


kept_splats = KeptSplats(shown_density_in_steps)
