"""Presets: the settings of all stages under one name."""

from __future__ import annotations

from dataclasses import dataclass, replace
from importlib import import_module
from types import ModuleType
from typing import Any

from .errors import SettingError
from .render import KERNELS
from .run_folder import STAGES

PRESETS = ("draft", "standard", "paper")
ROUTES = ("joint", "apart")


def stage_module(stage: str) -> ModuleType:
    """The module of a stage: `run(context, settings)`, `reason_to_skip(context)` and `PRESETS`."""
    return import_module(f".stages.{stage}", __package__)


@dataclass(frozen=True)
class Settings:
    """What a run is made with.

    Attributes:
        preset: the name it came from.
        seed: of every random choice.
        kernel: "cpu", "cuda" (on an NVIDIA card; see `core.render.card.require_card`) or "reference".
        stages: the settings dataclass of each stage, by its name.
        time_budget_s: the whole run is to take; None for as long as it takes.
        until_db: held-out figure at which an optimisation ends, of photos where there are any, else of projections;
            None to make all steps.
        effects: which effects to look for and to use, as `core.effects.request.parse_effects` has it.
    """

    preset: str
    seed: int
    kernel: str
    stages: dict[str, Any]
    time_budget_s: float | None = None
    until_db: float | None = None
    effects: str = "none"

    @property
    def refine(self) -> str:
        """The route: "joint" or "apart"."""
        return "apart" if self.stages["internal"].joint is None else "joint"

    def with_preset(self, preset: str) -> Settings:
        """Those of another preset, with the same seed, kernel, route, time, figure and effects."""
        other = Settings.of(preset, self.seed, self.kernel, self.refine)
        return replace(other, time_budget_s=self.time_budget_s, until_db=self.until_db, effects=self.effects)

    @classmethod
    def of(cls, preset: str = "standard", seed: int = 0, kernel: str = "cpu", refine: str = "joint") -> Settings:
        """The settings of a preset.

        Args:
            refine: "joint" fits one set to photos, projections and sections together after the alignment; "apart"
                refines each half by itself, the paper's route.

        Raises:
            SettingError: no such preset, kernel or route, or a seed below 0.
        """
        if preset not in PRESETS:
            raise SettingError(
                "--preset {preset}: there is no such preset; choose {known}.", preset=preset, known=", ".join(PRESETS)
            )
        if kernel not in KERNELS:
            raise SettingError(
                "--kernel {kernel}: there is no such kernel; choose {known}.", kernel=kernel, known=", ".join(KERNELS)
            )
        if seed < 0:
            raise SettingError("--seed {seed}: is below 0; choose 0 or any positive whole number.", seed=seed)
        if refine not in ROUTES:
            raise SettingError(
                "--refine {refine}: there is no such way; choose {known}.", refine=refine, known=", ".join(ROUTES)
            )
        stages = {name: stage_module(name).PRESETS[preset] for name in STAGES}
        if refine == "apart":
            stages["internal"] = replace(stages["internal"], joint=None)
        return cls(preset, seed, kernel, stages)
