"""A ball in a shell, as splats in the scene, for the tests of what of a model is shown and how."""

from __future__ import annotations

from dataclasses import dataclass, replace

import bpy
import numpy as np
import pytest

from insideout.core.gaussians import GaussianSet, Modality
from insideout.core.render.section_numpy import SectionSplats, section_density
from insideout.core.views import Plane
from insideout.core.volume import Volume
from insideout.insideout_addon.scene.color_bar import bar_parts
from insideout.insideout_addon.scene.display import show_splats
from insideout.insideout_addon.scene.importing import import_splats
from insideout.insideout_addon.scene.section_face import face_image
from insideout.insideout_addon.scene.splats import create_splats


@dataclass(frozen=True, eq=False)
class Shells:
    """Splats a millimetre apart: a ball in a shell that photos have painted, with some clones.

    Attributes:
        gaussians: N splats.
        radius: (N,) mm from the middle.
        model: the object, shown as points; the scene's model.
        settings: the scene's.
    """

    OUTER = 10.0
    WALL = 2.5
    INNER = 4.0
    DENSITY = 0.02

    gaussians: GaussianSet
    radius: np.ndarray
    model: bpy.types.Object
    settings: bpy.types.PropertyGroup

    def __len__(self) -> int:
        return len(self.gaussians)

    def are(self, modality: Modality) -> np.ndarray:
        return self.gaussians.modality == modality

    def shown(self, splats: bpy.types.Object | None = None) -> np.ndarray:
        """Distances of the points that are shown from the middle."""
        depsgraph = bpy.context.evaluated_depsgraph_get()
        depsgraph.update()
        geometry = (splats or self.model).evaluated_get(depsgraph).evaluated_geometry()
        cloud = geometry.pointcloud
        places = np.empty(0 if cloud is None else 3 * len(cloud.points), np.float32)
        if len(places):
            cloud.attributes["position"].data.foreach_get("vector", places)
        return np.linalg.norm(places.reshape(-1, 3), axis=1)

    def colors(self, splats: bpy.types.Object | None = None) -> np.ndarray:
        """(N, 4) linear, with opacity."""
        data = (splats or self.model).data
        values = np.empty(4 * len(data.points), np.float32)
        data.attributes["display_color"].data.foreach_get("color", values)
        return values.reshape(-1, 4)

    def painted(self) -> bpy.types.Object:
        """The photos' splats alone, as the scene's model."""
        photos = create_splats(self.gaussians.select(self.are(Modality.RGB)), "photos", bpy.context)
        show_splats(photos, ellipsoids=False)
        self.settings.model = photos
        return photos


@pytest.fixture
def model(blender, random_set):
    """200 splats, shown, not cut."""
    splats = create_splats(random_set, "model", bpy.context)
    show_splats(splats, True)
    bpy.context.scene.insideout.pixels = 48
    return splats


@pytest.fixture
def drawn():
    """`drawn(plane)`: (height, width, 4) of a section's picture, its first row at the top."""

    def read(plane):
        image = face_image(plane)
        pixels = np.empty(image.size[0] * image.size[1] * 4, np.float32)
        image.pixels.foreach_get(pixels)
        return pixels.reshape(image.size[1], image.size[0], 4)[::-1]

    return read


@pytest.fixture
def bar_texts():
    """`bar_texts(plane)`: what a section's colour bar and scale bar say."""
    return lambda plane: [part.data.body for part in bar_parts(plane) if part.type == "FONT"]


@pytest.fixture
def shells(blender):
    grid = np.stack(np.meshgrid(*[np.arange(-11, 12.0)] * 3), axis=-1).reshape(-1, 3)
    away = np.linalg.norm(grid, axis=1)
    inside = grid[((away < Shells.OUTER) & (away > Shells.OUTER - Shells.WALL)) | (away < Shells.INNER)]
    # Gaussians of this size on this lattice add up to the same everywhere, to a thousandth.
    scale = 0.7
    peak = Shells.DENSITY / ((2 * np.pi) ** 1.5 * scale**3)
    xray = GaussianSet.create(inside, scale, density=peak, modality=Modality.XRAY, opacities=0.9)
    painted = grid[(away > Shells.OUTER) & (away < Shells.OUTER + 1)]
    rng = np.random.default_rng(0)
    photos = GaussianSet.create(painted, 0.5, sh=rng.normal(0, 0.5, (len(painted), 1, 3)), modality=Modality.RGB)
    clones = replace(photos.select(slice(0, 40)), modality=np.full(40, Modality.CLONE, np.uint8))
    gaussians = GaussianSet.concatenate([xray, photos, clones])
    model = create_splats(gaussians, "model", bpy.context)
    show_splats(model, ellipsoids=False)
    settings = bpy.context.scene.insideout
    settings.model = model
    return Shells(gaussians, np.linalg.norm(gaussians.means, axis=1), model, settings)


@pytest.fixture
def scanned(blender, random_set, tmp_path):
    """A model, shown and not cut, of a run whose CT volume is the splats' own density, 0.01 mm⁻¹ too high."""
    model = create_splats(random_set, "model", bpy.context)
    show_splats(model, True)
    bpy.context.scene.insideout.pixels = 48
    splats = SectionSplats(random_set)
    slices = [
        section_density(
            splats, Plane(np.array([-30.5, -30.5, z]), np.array([1.0, 0, 0]), np.array([0, 1.0, 0]), 61, 61)
        )
        for z in range(-30, 31)
    ]
    volume = Volume.centered(np.stack(slices) + np.float32(0.01), np.ones(3))
    volume.save(tmp_path / "initialize" / "volume.npz")
    model["insideout_source"] = str(tmp_path / "fused.ply")
    return model


@pytest.fixture
def load(blender, tmp_path, random_set):
    """`load()`: the 200 splats of `random_set` as an import shows them, and as their file has them."""

    def make(view_dependent=True):
        random_set.save(tmp_path / "fused.ply")
        model = import_splats(tmp_path / "fused.ply", "model", bpy.context, view_dependent=view_dependent)
        return model, GaussianSet.load(tmp_path / "fused.ply")

    return make
