"""The effects that a run's capture was found to have: looked for in `initialize`, read by all that follows."""

from __future__ import annotations

import io
import json
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..capture.model import Projections
from ..errors import RunFolderError
from ..files import atomic_write, write_json
from ..progress import Tick, unstopped
from ..volume import ARCHIVE_ERRORS

if TYPE_CHECKING:
    from ..effects import Effect
    from ..effects.choose import Choice
    from ..effects.request import Request
    from .context import StageContext

FILES = {
    "background": "background-effects.json",
    "lens": "lens-effects.json",
    "photos": "photo-effects.json",
    "xray": "ray-effects.json",
}
BARE_PHOTOS = "photos-without-background.json"
STRAIGHT_PHOTOS = "photos-with-lens.json"
NUMBERS = "ray-effects.npz"


def forget_choice(folder: Path) -> None:
    """Deletes what `keep_choice` left: a run that looks for nothing would go on with what another had found."""
    names = (*FILES.values(), NUMBERS, BARE_PHOTOS, STRAIGHT_PHOTOS)
    for path in (*(folder / name for name in names), *folder.glob("backdrop-*.png")):
        path.unlink(missing_ok=True)


def keep_choice(folder: Path, half: str, choice: Choice, looked_at: Mapping[str, Any] | None = None) -> None:
    """Writes what was looked for and what is used into the folder of `initialize`.

    Args:
        half: "photos", "xray", "background" for what is looked for before cameras are found, or "lens" for what is
            before splats are placed.
        looked_at: settings of later stages that the findings hang on.
    """
    from ..effects.choose import flat

    if half == "xray":
        buffer = io.BytesIO()
        np.savez(buffer, **flat(choice.numbers))  # type: ignore[arg-type]
        with atomic_write(folder / NUMBERS) as stream:
            stream.write(buffer.getvalue())
    write_json(folder / FILES[half], {"looked_at": looked_at or {}, "rows": choice.rows})


def tries_effects(context: StageContext, rows: list[dict[str, Any]]) -> bool:
    """Whether what effects are worth is tried (`.effect_gains`): any is in use, and no time budget needs the time."""
    return context.pace is None and any(row["used"] for row in rows)


def choose(
    context: StageContext,
    names: Sequence[str],
    look: Callable[[Request], Choice],
    tell_gains: Callable[[Choice], str | None],
) -> Choice:
    """What is looked for and used, without effects that `auto` found and that do harm in trials.

    Others are looked for again without such a one: numbers may hang on what was taken out before, and of two that
    cannot be learned at once the other may be right.

    Args:
        names: of the effects, in the order of rows.
        look: for what a request asks for.
        tell_gains: tries the effects in use; the name of the one that does harm.
    """
    if context.request is None:
        raise AssertionError("nobody asks for effects")
    request = context.request
    harmful: list[dict[str, Any]] = []
    while True:
        choice = look(request)
        name = tell_gains(choice) if tries_effects(context, choice.rows) else None
        if name is None:
            choice.rows[:] = sorted([*harmful, *choice.rows], key=lambda row: names.index(row["name"]))
            return choice
        harmful += [row for row in choice.rows if row["name"] == name]
        # While the next look makes its own, no third copy of a large scan has to be held.
        choice.without = None
        request = request.without(name)


class RunEffects:
    """Effects of a run.

    Args:
        folder: of `initialize`.
        asked: what photos show as a script asked for it, whatever is found.
    """

    def __init__(self, folder: Path, asked: tuple[Effect, ...] = ()) -> None:
        self._folder, self._asked = folder, asked
        self._known: Projections | None = None

    def rows(self, half: str) -> list[dict[str, Any]]:
        """What was looked for, see `Choice`; nothing where nothing was.

        Raises RunFolderError for a damaged file.
        """
        rows: list[dict[str, Any]] = self._kept(half)["rows"]
        return rows

    def looked_at(self, half: str) -> dict[str, Any]:
        """As it was given to `keep_choice`; nothing where nothing was looked for, or by an older version.

        Raises RunFolderError for a damaged file.
        """
        given: dict[str, Any] = self._kept(half)["looked_at"]
        return given

    def _kept(self, half: str) -> dict[str, Any]:
        path = self._folder / FILES[half]
        if not path.exists():
            return {"looked_at": {}, "rows": []}
        try:
            content = json.loads(path.read_text("utf-8"))
            # Of an older version there are the rows alone.
            kept = {"looked_at": {}, "rows": content} if isinstance(content, list) else content
            return {name: kept[name] for name in ("looked_at", "rows")}
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise self._damaged(path, error) from error

    def used(self, half: str) -> list[str]:
        """The names of the effects in use."""
        return [row["name"] for row in self.rows(half) if row["used"]]

    @cached_property
    def photos(self) -> tuple[Effect, ...]:
        """Settings of those that are learnt with the splats."""
        names = [] if self._asked else self.used("photos")
        if not names:
            return self._asked
        from ..effects import EFFECTS

        return tuple(EFFECTS[name]() for name in names if name in EFFECTS)

    @cached_property
    def numbers(self) -> Mapping[str, Mapping[str, Any]]:
        """What effects of X-rays in use work with, by their names. Raises RunFolderError for a damaged file."""
        names = self.used("xray")
        if not names:
            return {}
        from ..effects.choose import unflat

        path = self._folder / NUMBERS
        try:
            with np.load(path, allow_pickle=False) as stored:
                return unflat({name: stored[name] for name in stored}, names)
        except (*ARCHIVE_ERRORS, KeyError) as error:
            raise self._damaged(path, error) from error

    def know(self, without: Projections | None) -> None:
        """Notes the projections with all effects in use taken out, where whoever looked has them already."""
        self._known = without

    def projections(self, given: Projections, tick: Tick = unstopped) -> Projections:
        """With the effects in use taken out; `given` itself where there are none.

        Args:
            given: those of the capture.
            tick: called between views; may raise to stop.
        """
        if not self.numbers:
            return given
        if self._known is not None:
            return self._known
        from ..effects.choose import without_effects

        return without_effects(given, self.numbers, tick)

    @staticmethod
    def _damaged(path: Path, error: Exception) -> RunFolderError:
        return RunFolderError(
            "{path}: cannot be read ({error}); run the stage initialize again.", path=path, error=error
        )
