"""The effects that photos were found to have, kept beside the splats, for the stages that follow."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from io import BytesIO
from pathlib import Path

import torch
from torch import Tensor

from ..capture.registered import relative_path
from ..errors import RunFolderError
from ..files import atomic_write
from ..gaussians import GaussianSet
from ..progress import Tick, unstopped
from ..render.splat import SplatImage
from ..views import Camera
from .imaging import Draw, Effect, PhotoEffects

FILE = "effects.pt"


def keep_effects(path: Path, effects: PhotoEffects, names: Sequence[str], cameras: Sequence[Camera]) -> None:
    """Writes the numbers of all training photos.

    As in `core.capture.registered`, paths are kept both as they are and relative to the file.

    Args:
        names: of the photos, their paths, in the order of training.
        cameras: as they were trained.
    """
    content = {
        "photos": list(names),
        "relative": [relative_path(Path(name), path.parent) for name in names],
        "sizes": [[camera.width, camera.height] for camera in cameras],
        "extent": effects.extent,
        "state": effects.state(),
    }
    buffer = BytesIO()
    torch.save(content, buffer)
    with atomic_write(path) as stream:
        stream.write(buffer.getvalue())


class KeptEffects:
    """Draws training photos with what was found of them; numbers are no longer learnt.

    Args:
        path: of `keep_effects`.
        effects: the settings that they were learnt with.
        cameras: by the names of the photos, in the frame that is drawn in.
        scale: of that frame over the one that they were learnt in.

    Raises:
        RunFolderError: the file is damaged, or of other effects.
    """

    def __init__(self, path: Path, effects: Sequence[Effect], cameras: dict[str, Camera], scale: float = 1.0) -> None:
        try:
            content = torch.load(path, weights_only=True)
            names, sizes = content["photos"], content["sizes"]
            # Older files have no relative paths.
            ways = content.get("relative") or [None] * len(names)
            names = [_found(name, way, path.parent, cameras) for name, way in zip(names, ways, strict=True)]
            known = [cameras[name].resized(*size) for name, size in zip(names, sizes, strict=True)]
            self._effects = PhotoEffects(effects, known, scale * content["extent"])
            self._effects.restore(content["state"])
            steps = torch.stack([part["steps"] for part in content["state"].values()]).amax(dim=0)
        except Exception as error:
            # A damaged file makes torch raise anything.
            raise RunFolderError(
                "{path}: cannot be read ({error}); run the stage surface again.", path=path, error=error
            ) from error
        # Of a photo that a training ended before it came to, nothing is known.
        self._places = {name: place for place, name in enumerate(names) if steps[place] > 0}

    def render(self, name: str, draw: Draw, gaussians: GaussianSet, camera: Camera) -> SplatImage:
        """The photo of this name as its camera saw it; one that was not trained on as `draw` has it."""
        place = self._places.get(name)
        if place is None:
            return draw(gaussians, camera)
        image = self._effects.render(place, draw, gaussians, camera)
        # They stay as they are, and what a loss sends back ends here.
        self._effects.forget_gradients()
        return image

    def fitted(
        self, draw: Draw, gaussians: GaussianSet, camera: Camera, target: Tensor, tick: Tick = unstopped
    ) -> SplatImage:
        """A photo that was not trained on; see `PhotoEffects.fitted`."""
        return self._effects.fitted(draw, gaussians, camera, target, tick=tick)


def _found(name: str, way: str | None, folder: Path, cameras: Mapping[str, Camera]) -> str:
    """The name that a photo has where capture and run lie now."""
    return name if name in cameras or way is None else str((folder / way).resolve())
