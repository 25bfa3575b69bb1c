"""Presets: the settings of all stages under one name."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from types import ModuleType
from typing import Any

from .errors import SettingError
from .run_folder import STAGES

PRESETS = ("draft", "standard", "paper")


def stage_module(stage: str) -> ModuleType:
    """The module of a stage: `run(context, settings)`, `reason_to_skip(context)` and `PRESETS`."""
    return import_module(f".stages.{stage}", __package__)


@dataclass(frozen=True)
class Settings:
    """What a run is made with.

    Attributes:
        preset: the name it came from.
        seed: of every random choice.
        kernel: "cpu" or "reference".
        stages: the settings dataclass of each stage, by its name.
    """

    preset: str
    seed: int
    kernel: str
    stages: dict[str, Any]

    @classmethod
    def of(cls, preset: str = "standard", seed: int = 0, kernel: str = "cpu") -> Settings:
        """The settings of a preset.

        Raises:
            SettingError: no such preset or kernel, or a seed below 0.
        """
        if preset not in PRESETS:
            raise SettingError(f"--preset {preset}: there is no such preset; choose {', '.join(PRESETS)}.")
        if kernel not in ("cpu", "reference"):
            raise SettingError(f"--kernel {kernel}: there is no such kernel; choose cpu or reference.")
        if seed < 0:
            raise SettingError(f"--seed {seed}: is below 0; choose 0 or any positive whole number.")
        return cls(preset, seed, kernel, {name: stage_module(name).PRESETS[preset] for name in STAGES})
