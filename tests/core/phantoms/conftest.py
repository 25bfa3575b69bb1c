from __future__ import annotations

import numpy as np
import pytest

from insideout.core.phantoms.make import PHANTOMS, CaptureSettings, make_capture
from insideout.core.phantoms.materials import Material
from insideout.core.phantoms.matryoshka import matryoshka
from insideout.core.phantoms.model import Part, Phantom
from insideout.core.phantoms.part_tables import PartTables
from insideout.core.phantoms.shapes import sphere

SMALL = CaptureSettings(
    photos=9,
    photo_width=48,
    photo_height=64,
    projections=36,
    heldout_projections=2,
    detector_width=60,
    detector_height=74,
    voxel_mm=1.5,
    table_mm=1.0,
    surface_mm=3.0,
    shells=5,
)


@pytest.fixture(scope="session")
def doll():
    return matryoshka(5)


@pytest.fixture(scope="session")
def doll_tables(doll):
    return PartTables.bake(doll, 0.5)


@pytest.fixture(scope="session")
def small_settings():
    return SMALL


@pytest.fixture(scope="session")
def small_capture(tmp_path_factory):
    """A Matryoshka's capture folder with few, small images."""
    return make_capture("matryoshka", tmp_path_factory.mktemp("captures") / "doll", SMALL, seed=5)


WOOD, STEEL = Material("wood", "C6H10O5", 0.7), Material("steel", "Fe", 7.8)


@pytest.fixture(scope="session")
def ball():
    """A wooden ball of 30 mm, hollow, with a steel ball of 8 mm in its middle; striped, so that blur shows."""

    def solid(radius):
        return lambda points: sphere(points, np.zeros(3), radius)

    def stripes(points, normals):
        dark = np.sin(2.2 * points[:, 0]) * np.sin(2.2 * points[:, 2]) > 0
        return np.where(dark[:, None], [0.6, 0.1, 0.1], [0.95, 0.9, 0.2])

    parts = (Part("shell", solid(15.0), WOOD), Part("hole", solid(12.0), None), Part("core", solid(4.0), STEEL))
    landmarks = 15.0 * np.eye(3)
    return Phantom("ball", parts, parts[0].distance, stripes, (32.0, 32.0, 32.0), 60.0, landmarks, of_revolution=True)


@pytest.fixture
def only_ball(ball, monkeypatch):
    """The command and `make_capture` know "ball"."""
    monkeypatch.setitem(PHANTOMS, "ball", lambda: ball)


@pytest.fixture
def ball_settings():
    return CaptureSettings(
        photos=2,
        photo_width=32,
        photo_height=32,
        projections=2,
        heldout_projections=1,
        detector_width=24,
        detector_height=24,
        effects=(),
        voxel_mm=2.0,
        table_mm=0.5,
        surface_mm=1.0,
    )
