"""A ball and a hollow ball that was cut, for the tests of what measures a model and saves what it found."""

from __future__ import annotations

import bpy
import numpy as np
import pytest

from insideout.core.gaussians import GaussianSet, Modality
from insideout.insideout_addon.scene.section import sample_section, shown_plane

CENTER = (3.0, -2.0, 1.0)


@pytest.fixture
def center():
    """(3,) mm, of both balls."""
    return CENTER


@pytest.fixture
def model(blender, tmp_path, one_ball):
    one_ball.save(tmp_path / "ball.ply")
    bpy.ops.insideout.import_run(filepath=str(tmp_path / "ball.ply"))
    return bpy.context.scene.insideout.model


@pytest.fixture
def hollow_ball():
    """`hollow_ball(radius, count)`: splats of σ 1.5 mm that are spread evenly on a ball around `CENTER`."""

    def make(radius, count):
        height = 1 - (2 * np.arange(count) + 1) / count
        turn = np.pi * (1 + 5**0.5) * np.arange(count)
        around = np.sqrt(1 - height**2)
        ways = np.stack([around * np.cos(turn), around * np.sin(turn), height], axis=1)
        return GaussianSet.create(radius * ways + CENTER, 1.5, density=0.02, modality=Modality.XRAY)

    return make


@pytest.fixture
def cut_through_its_middle(blender):
    """`cut_through_its_middle(splats, path)`: the scene's settings when splats were imported from there and cut."""

    def cut(splats, path):
        splats.save(path)
        settings = bpy.context.scene.insideout
        settings.display, settings.pixels = "POINTS", 160
        bpy.ops.insideout.import_run(filepath=str(path))
        bpy.ops.insideout.section_add()
        shown_plane(bpy.context.scene).location = CENTER
        bpy.context.view_layer.update()
        return settings

    return cut


@pytest.fixture
def shell(tmp_path, hollow_ball, cut_through_its_middle):
    """A hollow ball of radius 20 mm."""
    return cut_through_its_middle(hollow_ball(20, 1500), tmp_path / "shell.ply")


@pytest.fixture
def half_of_the_top():
    """Half of what the wall of `shell` attenuates at most."""

    def measure():
        values, plane = sample_section(bpy.context.scene)
        distance = np.linalg.norm(plane.points() - CENTER, axis=2)
        return 0.5 * float(np.median(values[np.abs(distance - 20) < 0.2]))

    return measure
