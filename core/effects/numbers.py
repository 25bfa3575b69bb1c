"""A few numbers for each photo, trained with Adam as the photos are shown."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

BETA1, BETA2, EPSILON = 0.9, 0.999, 1e-15


class PhotoNumbers:
    """K numbers for each of P photos, float64; a photo's moments and steps are its own.

    Adam (Kingma and Ba, arXiv 1412.6980) as for the splats, but only the photo that was shown moves: the moments of
    the others would drift without a gradient.

    Args:
        values: (P, K) to start from.

    Attributes:
        values: (P, K), without gradient.
    """

    def __init__(self, values: Tensor) -> None:
        self.values = values.to(torch.float64).clone()
        self._first, self._second = torch.zeros_like(self.values), torch.zeros_like(self.values)
        self._steps = torch.zeros(len(self.values), dtype=torch.int64)
        self._shown: dict[int, Tensor] = {}

    def __len__(self) -> int:
        return len(self.values)

    def row(self, photo: int) -> Tensor:
        """(K,) numbers of a photo; gradients gather in it until `step`."""
        if photo not in self._shown:
            self._shown[photo] = self.values[photo].clone().requires_grad_(True)
        return self._shown[photo]

    def set_row(self, photo: int, values: Tensor) -> None:
        """Replaces a photo's numbers (K,) and forgets its moments."""
        self.values[photo] = values.detach()
        self._first[photo], self._second[photo], self._steps[photo] = 0.0, 0.0, 0
        self._shown.pop(photo, None)

    def step(self, photo: int, rates: Sequence[float]) -> None:
        """One step of a photo with a rate for each of its K numbers; none where the gradient is not finite."""
        shown = self._shown.pop(photo, None)
        if shown is None or shown.grad is None or not bool(torch.isfinite(shown.grad).all()):
            return
        self._steps[photo] += 1
        steps = int(self._steps[photo])
        self._first[photo].mul_(BETA1).add_(shown.grad, alpha=1 - BETA1)
        self._second[photo].mul_(BETA2).addcmul_(shown.grad, shown.grad, value=1 - BETA2)
        mean = self._first[photo] / (1 - BETA1**steps)
        root = (self._second[photo] / (1 - BETA2**steps)).sqrt()
        self.values[photo] -= torch.tensor(list(rates), dtype=torch.float64) * mean / (root + EPSILON)

    def forget_gradients(self) -> None:
        """Drops what `row` gathered: the step it belonged to is not made."""
        self._shown.clear()

    def state(self) -> dict[str, Any]:
        """For a checkpoint."""
        return {
            "values": self.values.clone(),
            "first": self._first.clone(),
            "second": self._second.clone(),
            "steps": self._steps.clone(),
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Becomes what `state()` was taken of, bit for bit. Raises ValueError for another number of photos."""
        if state["values"].shape != self.values.shape:
            raise ValueError(f"numbers of {tuple(state['values'].shape)}, not of {tuple(self.values.shape)}")
        self.values, self._first = state["values"].clone(), state["first"].clone()
        self._second, self._steps = state["second"].clone(), state["steps"].clone()
        self._shown.clear()
