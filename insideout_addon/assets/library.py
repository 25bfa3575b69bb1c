"""The add-on's node groups and materials as an asset library: a .blend that any other can take them from."""

from __future__ import annotations

import os
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

import bpy
import numpy as np

from ... import __version__
from ...core.errors import RunFolderError, SettingError
from ...core.files import explained
from ...core.steps import part_of_work, run_through
from ..physics.appearance import piece_materials
from ..scene.capping import capped_group
from ..scene.clipping import clipped_group
from ..scene.cutting import cut_group, cut_group_in_steps
from ..scene.display import display_group, display_in_steps
from ..scene.leftovers import known_looks, remove_unused_looks
from ..scene.materials import splat_material
from ..scene.native_colors import colored_group
from .catalogs import add_catalogs, catalog_id, check_catalogs

Block = bpy.types.NodeTree | bpy.types.Material
FILE = "insideout.blend"
LIBRARY = "InsideOut"
GROUPS, MATERIALS = "InsideOut/Node Groups", "InsideOut/Materials"
_PICTURES = Path(__file__).parent / "pictures"
_AUTHOR, _LICENSE = "InsideOut developers", "GPL-3.0-or-later"


@dataclass(frozen=True)
class Asset:
    """What the library offers.

    Attributes:
        name: of the block, and in the asset browser.
        build: gives the node group or the material, built in the open file on first use.
        catalog: GROUPS or MATERIALS.
        description: for the asset browser.
        tags: to find it by.
    """

    name: str
    build: Callable[[], Block]
    catalog: str
    description: str
    tags: tuple[str, ...] = ()

    @property
    def picture(self) -> Path:
        """What the asset browser shows of it."""
        kind, name = self.catalog.rpartition("/")[2], self.name.removeprefix("InsideOut ")
        return _PICTURES / kind.lower().replace(" ", "_") / f"{name.lower().replace(' ', '_')}.png"


ASSETS = (
    Asset(
        "InsideOut Splats",
        display_group,
        GROUPS,
        "Shows a point cloud of Gaussian splats as ellipsoids or points, also those that Blender itself imports",
        ("splats", "display", "modifier"),
    ),
    Asset(
        "InsideOut Section Cut",
        cut_group,
        GROUPS,
        "Notes on splats where a plane or a box cuts them; comes before InsideOut Splats, whose Cut is on",
        ("splats", "section", "cut", "modifier"),
    ),
    Asset(
        "InsideOut Cut Splats",
        capped_group,
        GROUPS,
        "Splats that one plane cuts as closed solids: the exact ellipse is their cap",
        ("splats", "section", "cap"),
    ),
    Asset(
        "InsideOut Clipped Splats",
        clipped_group,
        GROUPS,
        "Splats that several planes cut as closed solids, by the planes that InsideOut Section Cut has noted",
        ("splats", "section", "clip"),
    ),
    Asset(
        "InsideOut Splat Colors",
        colored_group,
        GROUPS,
        "Gives splats without display_color the color of their harmonics, so that materials show it",
        ("splats", "color"),
    ),
    Asset(
        "InsideOut Splats",
        lambda: splat_material("Splats"),
        MATERIALS,
        "Color of splats on points and on meshes made of them, partly lit",
        ("splats", "points", "section"),
    ),
    Asset(
        "InsideOut Solid Splats",
        lambda: splat_material("Solid Splats"),
        MATERIALS,
        "Color of splats on instances, partly lit",
        ("splats", "instances"),
    ),
    Asset(
        "InsideOut Soft Splats",
        lambda: splat_material("Soft Splats"),
        MATERIALS,
        "Splats on instances of a unit ball with the soft edges of Gaussians",
        ("splats", "instances", "gaussian"),
    ),
    Asset(
        "InsideOut Outside",
        lambda: piece_materials()[0],
        MATERIALS,
        "Outer faces of broken pieces: the color attribute Color, smooth",
        ("pieces",),
    ),
    Asset(
        "InsideOut Broken",
        lambda: piece_materials()[1],
        MATERIALS,
        "Broken faces of pieces: the color attribute Color, rough",
        ("pieces", "section"),
    ),
)


_BUILT_IN_STEPS = {display_group: display_in_steps, cut_group: cut_group_in_steps}


def save_assets(path: Path, assets: Sequence[Asset] = ASSETS) -> None:
    """Writes a .blend with all assets, and lists their catalogues beside it. The open file stays as it is.

    Raises:
        SettingError: the path is that of the open file, or the folder's catalogues cannot be read.
        RunFolderError, DiskFullError: it cannot be written.
    """
    run_through(save_in_steps(path, assets))


def save_in_steps(path: Path, assets: Sequence[Asset] = ASSETS) -> Generator[float, None, None]:
    """As `save_assets`, with breaks that tell the share that is done, 0 to 1; closed before its end nothing stays.

    Marking and writing, a tenth of a second, have no break: in one the open file would not be as it was.
    """
    path = Path(path)
    if bpy.data.filepath and path.resolve() == Path(bpy.data.filepath).resolve():
        raise SettingError("{file}: is the open file; choose another name for the assets.", file=path.name)
    check_catalogs(path.parent)
    before = known_looks()
    try:
        for index, asset in enumerate(assets):
            if asset.build in _BUILT_IN_STEPS:
                yield from part_of_work(_BUILT_IN_STEPS[asset.build](), index / len(assets), (index + 1) / len(assets))
            else:
                asset.build()
                yield (index + 1) / len(assets)
        with explained(path):
            path.parent.mkdir(parents=True, exist_ok=True)
        with ExitStack() as stack:
            # What an undo in a break has taken away is built again.
            blocks = {asset.build(): asset for asset in assets}
            for block, asset in blocks.items():
                stack.enter_context(_marked(block, asset))
            _write(path, set(blocks), sorted({asset.catalog for asset in assets}))
    finally:
        remove_unused_looks(before)


def add_to_asset_libraries(folder: Path) -> bool:
    """Lists a folder among the asset libraries of the preferences, unless it is there; returns whether it is new."""
    libraries = bpy.context.preferences.filepaths.asset_libraries
    folder = Path(folder).resolve()
    if any(library.path and Path(bpy.path.abspath(library.path)).resolve() == folder for library in libraries):
        return False
    libraries.new(name=LIBRARY, directory=str(folder))
    return True


@contextmanager
def _marked(block: Block, asset: Asset) -> Iterator[None]:
    """An asset by the asset's name, and only in here; one that the user has marked keeps what they wrote."""
    with _called(block, asset.name):
        if block.asset_data is not None:
            yield
            return
        kept = block.use_fake_user
        block.asset_mark()
        try:
            _describe(block, asset)
            yield
        finally:
            block.asset_clear()
            block.use_fake_user = kept


@contextmanager
def _called(block: Block, name: str) -> Iterator[None]:
    """In here the block has this name; another that has it, as one of an earlier version, makes way."""
    if block.name == name:
        yield
        return
    kind = bpy.data.materials if isinstance(block, bpy.types.Material) else bpy.data.node_groups
    other, before = next((b for b in kind if b.name == name and b.library is None), None), block.name
    if other is not None:
        other.name = f"{name} aside"
    block.name = name
    try:
        yield
    finally:
        block.name = before
        if other is not None:
            other.name = name


def _describe(block: Block, asset: Asset) -> None:
    data = block.asset_data
    data.description, data.author, data.license = asset.description, _AUTHOR, _LICENSE
    data.catalog_id = catalog_id(asset.catalog)
    for tag in ("InsideOut", *asset.tags, f"InsideOut {__version__}"):
        data.tags.new(tag, skip_if_exists=True)
    picture = bpy.data.images.load(str(asset.picture))
    try:
        pixels = np.empty(len(picture.pixels), np.float32)
        picture.pixels.foreach_get(pixels)
        preview = block.preview_ensure()
        preview.image_size = picture.size
        preview.image_pixels_float.foreach_set(pixels)
    finally:
        bpy.data.images.remove(picture)


def _write(path: Path, blocks: set[Block], catalogs: Sequence[str]) -> None:
    """All or nothing, but for catalogues without an asset where the last renaming fails."""
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.blend")
    try:
        bpy.data.libraries.write(str(temporary), blocks, path_remap="NONE", fake_user=True, compress=True)
        add_catalogs(path.parent, catalogs)
        with explained(path):
            os.replace(temporary, path)
    except RuntimeError as error:
        raise RunFolderError("{path}: cannot be written; choose another folder.", path=path) from error
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)
