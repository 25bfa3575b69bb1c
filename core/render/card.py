"""Models that the processor holds, drawn on a graphics card: tensors go there, images and gradients come back."""

from __future__ import annotations

from dataclasses import replace
from importlib.util import find_spec
from typing import TYPE_CHECKING

from ..errors import SettingError
from ..gaussians import GaussianSet

if TYPE_CHECKING:
    import torch


def require_warp() -> None:
    """Raises SettingError where the `cuda` kernel is not installed."""
    if find_spec("warp") is None:
        raise SettingError('--kernel cuda: NVIDIA Warp is not installed; run pip install "insideout[cuda]".')


def require_card() -> None:
    """Raises SettingError where the `cuda` kernel is not installed, or torch or Warp finds no NVIDIA card."""
    import torch

    require_warp()
    if not torch.cuda.is_available():
        raise SettingError(
            "--kernel cuda: torch finds no NVIDIA card (its build for processors never does); "
            "choose cpu, or install torch for CUDA."
        )
    import warp

    # torch also calls AMD's cards so, and may bring a driver's libraries that Warp does not see.
    if not warp.is_cuda_available():
        raise SettingError(
            "--kernel cuda: torch has a card that NVIDIA Warp cannot use; update its driver, or choose cpu."
        )


def on_card(gaussians: GaussianSet, *names: str) -> GaussianSet:
    """`gaussians` (torch tensors) with what is named where the `cuda` kernel draws it: on a card; differentiable.

    What is on a card already is not moved. Without any card all stays where it is, for Warp's CPU back end.
    """
    device = _card_for(gaussians.means.device)
    return replace(gaussians, **{name: getattr(gaussians, name).to(device) for name in names})


def _card_for(device: torch.device) -> torch.device:
    import torch

    return torch.device("cuda") if device.type == "cpu" and torch.cuda.is_available() else device
