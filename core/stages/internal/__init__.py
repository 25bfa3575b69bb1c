"""Stage four, `internal`: both sets refined, jointly or each against sections (paper, "Internal Rendering")."""

from .stage import PRESETS, InternalSettings, reason_to_skip, run

__all__ = ["PRESETS", "InternalSettings", "reason_to_skip", "run"]
