"""Stages that several rows have in common are made once; others have them as hard links, or as copies."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ..capture.model import Landmarks
from ..files import plain, write_json
from ..resume import has_other_landmarks
from ..run_folder import STAGES, RunFolder
from ..settings import Settings
from .code import first_by_other_code

CODE_FILE = "code.json"
"""In a row's folder: the numbers of the code that makes the run there, see `code.CODE`."""
# Of the stages whose two halves do not look at each other: the names of a half in the report and its files.
_HALVES: dict[str, dict[str, tuple[str, tuple[str, ...]]]] = {
    "photos": {"initialize": ("photos", ("photos.json", "rgb.ply")), "surface": ("rgb", ("rgb.ply",))},
    "xray": {"initialize": ("xray", ("volume.npz", "reference.npz", "xray.ply")), "surface": ("xray", ("xray.ply",))},
}
_SETS = {"photos": "rgb", "xray": "xray"}


@dataclass(frozen=True)
class Wanted:
    """A run whose stages may have been made elsewhere.

    Attributes:
        run: its folder.
        digest: of what it sees of the capture.
        settings: it is made with.
        stages: it is to have, in order.
        half: "photos" or "xray" where it sees that half of the capture `whole` alone; "" where it sees all.
        whole: that capture's digest.
        landmarks: that its alignment is to be made with; no part of the digest.
        code: numbers of the code that it is made by, see `code.CODE`.
    """

    run: RunFolder
    digest: str
    settings: Settings
    stages: Sequence[str]
    half: str = ""
    whole: str = ""
    landmarks: Landmarks | None = None
    code: Mapping[str, int] = field(default_factory=dict)


def share(wanted: Wanted, folder: Path) -> None:
    """Copies the first stages that are missing from runs under `folder` that made them in the same way.

    Half of what a run of both halves made is taken where that run's halves do not look at each other (`initialize`
    and `surface`); its seconds are then those of that half.
    """
    others = [RunFolder(marker.parent) for marker in sorted(folder.rglob("capture.json"))]
    others = [other for other in others if other.path != wanted.run.path]
    for stage in wanted.stages:
        if wanted.run.is_done(stage):
            continue
        source = next((other for other in others if _made_alike(other, wanted, stage)), None)
        if source is not None:
            _copy_stage(source.path / stage, wanted.run.path / stage)
            continue
        source = next((other for other in others if _half_alike(other, wanted, stage)), None)
        if source is None:
            return
        _copy_half(source, wanted, stage)


def read_dict(path: Path) -> dict[str, Any] | None:
    """The dictionary in a JSON file; None where there is none or it is damaged."""
    try:
        content = json.loads(path.read_text("utf-8"))
    except (OSError, ValueError):
        return None
    return content if isinstance(content, dict) else None


def _made_alike(other: RunFolder, wanted: Wanted, stage: str) -> bool:
    """Whether another run has the stage of the same capture, with the same settings in it and all before."""
    if not _is_of(other, wanted.digest, wanted.settings) or not _by_same_code(other, wanted, stage):
        return False
    if STAGES.index(stage) >= STAGES.index("align") and has_other_landmarks(other, wanted.landmarks):
        return False
    return all(_same(other, wanted.settings, one) for one in STAGES[: STAGES.index(stage) + 1])


def _half_alike(other: RunFolder, wanted: Wanted, stage: str) -> bool:
    """Whether a run of the whole capture has the half of the stage, and of those before, with the same settings."""
    if stage not in _HALVES.get(wanted.half, {}) or not _is_of(other, wanted.whole, wanted.settings):
        return False
    if not _by_same_code(other, wanted, stage):
        return False
    before = STAGES[: STAGES.index(stage) + 1]
    return all(_same(other, wanted.settings, one, _HALVES[wanted.half][one][0]) for one in before)


def _is_of(other: RunFolder, digest: str, settings: Settings) -> bool:
    """Effects are no setting of any stage, and all stages may see captures without them."""
    known, made = read_dict(other.path / "capture.json"), read_dict(other.path / "settings.json")
    if known is None or made is None or known.get("digest") != digest:
        return False
    return made.get("seed") == settings.seed and made.get("effects", "none") == settings.effects


def _by_same_code(other: RunFolder, wanted: Wanted, stage: str) -> bool:
    """Whether the code that made another run's stage, and those before, is what would make them now."""
    first = first_by_other_code(read_dict(other.path / CODE_FILE) or {}, wanted.code)
    return first is None or STAGES.index(stage) < first


def _same(other: RunFolder, settings: Settings, stage: str, part: str | None = None) -> bool:
    report = read_dict(other.path / stage / "report.json")
    if report is None or report.get("left_out") or report.get("kernel", settings.kernel) != settings.kernel:
        return False
    if part is not None and "seconds" not in (report.get(part) or {}):
        return False
    made, asked = without_none(report.get("settings")), without_none(plain(settings.stages[stage]))
    if part is not None and made is not None and part in asked:
        return made[part] == asked[part]
    return made is None or made == asked


def without_none(plain_settings: Any) -> Any:
    """Settings without those that are None, off: these count as if there were no such setting, as before there was."""
    if isinstance(plain_settings, dict):
        return {name: without_none(value) for name, value in plain_settings.items() if value is not None}
    if isinstance(plain_settings, list):
        return [without_none(value) for value in plain_settings]
    return plain_settings


def _copy_stage(source: Path, target: Path) -> None:
    """A finished stage's folder, linked where the file system can: files are only ever replaced, never changed."""
    half = target.with_name(f".{target.name}.copy.tmp")
    shutil.rmtree(half, ignore_errors=True)
    shutil.copytree(source, half, copy_function=_link)
    shutil.rmtree(target, ignore_errors=True)
    os.replace(half, target)


def _copy_half(source: RunFolder, wanted: Wanted, stage: str) -> None:
    part, files = _HALVES[wanted.half][stage]
    target, whole = wanted.run.stage(stage), source.report(stage)
    for name in files:
        if (source.path / stage / name).exists():
            (target / name).unlink(missing_ok=True)
            _link(str(source.path / stage / name), str(target / name))
    kind = _SETS[wanted.half]
    report = {
        part: whole[part],
        "splats": {kind: whole["splats"][kind]},
        "seconds": whole[part]["seconds"],
        "kernel": whole["kernel"],
        "settings": plain(wanted.settings.stages[stage]),
    }
    write_json(target / "report.json", report)


def _link(source: str, target: str) -> None:
    try:
        os.link(source, target)
    except OSError:
        shutil.copy2(source, target)
