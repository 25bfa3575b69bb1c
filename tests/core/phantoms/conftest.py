from __future__ import annotations

import pytest

from insideout.core.phantoms.make import CaptureSettings, make_capture
from insideout.core.phantoms.matryoshka import matryoshka
from insideout.core.phantoms.part_tables import PartTables

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
)


@pytest.fixture(scope="session")
def doll():
    return matryoshka()


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
