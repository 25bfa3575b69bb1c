"""The attenuation field: hash grid, then a small network; all its numbers in one flat buffer."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..train.adam import adam_step, all_finite
from .hash_grid import HashGrid

# Numbers of the table are drawn from ± this at first.
_SPREAD = 1e-4
_BETA1, _BETA2, _EPSILON = 0.9, 0.999, 1e-8


class Field:
    """σ(x) in 0..1 over the unit cube: features of a `HashGrid`, linear layers with LeakyReLU between, a sigmoid.

    Args:
        grid: the encoding.
        layers: linear layers, at least 2.
        hidden: their width.
        skips: before these layers the features are appended to the values once more.
        seed: of the first numbers.

    Attributes:
        steps: optimisation steps made.
    """

    def __init__(self, grid: HashGrid, layers: int, hidden: int, skips: tuple[int, ...], seed: int) -> None:
        self.grid, self.skips, self.steps = grid, skips, 0
        shapes: list[tuple[int, ...]] = [(grid.rows, grid.features)]
        for layer in range(layers):
            fan_in = grid.width if layer == 0 else hidden + (grid.width if layer in skips else 0)
            fan_out = 1 if layer == layers - 1 else hidden
            shapes += [(fan_out, fan_in), (fan_out,)]
        ends = np.cumsum([math.prod(shape) for shape in shapes])
        self._values, self._gradients, self._first, self._second = (np.zeros(ends[-1], np.float32) for _ in range(4))
        rng = np.random.default_rng([seed, 23])
        self._parts: list[Tensor] = []
        for shape, end in zip(shapes, ends, strict=True):
            span = slice(int(end) - math.prod(shape), int(end))
            # As torch draws the weights and the bias of a linear layer; a bias has the spread of its weights.
            spread = _SPREAD if not self._parts else 1 / math.sqrt(shape[1] if len(shape) == 2 else self._last_fan_in())
            self._values[span] = rng.uniform(-spread, spread, math.prod(shape))
            part = torch.from_numpy(self._values[span].reshape(shape)).requires_grad_(True)
            part.grad = torch.from_numpy(self._gradients[span].reshape(shape))
            self._parts.append(part)

    def __call__(self, points: Tensor) -> Tensor:
        """(P,) values of points (P, 3) in 0..1, float32."""
        table, *layers = self._parts
        features = self.grid.encode(points, table)
        values = features
        for index in range(len(layers) // 2):
            if index in self.skips:
                values = torch.cat([features, values], dim=-1)
            values = torch.nn.functional.linear(values, layers[2 * index], layers[2 * index + 1])
            if 2 * index + 2 < len(layers):
                values = torch.nn.functional.leaky_relu(values)
        return torch.sigmoid(values[:, 0])

    def begin_at(self, level: float) -> None:
        """Lets a field that has made no step yet be about `level`, in 0..1, everywhere."""
        self._values[-1] = math.log(level / (1 - level))

    def step(self, rate: float) -> bool:
        """One step of Adam by the gradients that `backward()` left, which are 0 afterwards.

        Returns:
            False, with nothing changed, when a gradient is not finite.
        """
        if not all_finite(self._gradients):
            self._gradients.fill(0.0)
            return False
        self.steps += 1
        buffers = self._values, self._gradients, self._first, self._second
        ends, limits = np.array([self._values.size]), np.array([[-np.inf, np.inf]], np.float32)
        adam_step(*buffers, ends, np.array([rate]), limits, self.steps, _BETA1, _BETA2, _EPSILON)
        return True

    def state(self) -> dict[str, Any]:
        """Everything that a checkpoint needs; see `restore`."""
        names = ("values", "first", "second")
        return {name: torch.from_numpy(getattr(self, f"_{name}").copy()) for name in names} | {"steps": self.steps}

    def restore(self, state: dict[str, Any]) -> None:
        """Becomes what `state()` was taken of, bit for bit.

        Raises:
            ValueError: it was taken of a field of another size.
        """
        for name in ("values", "first", "second"):
            getattr(self, f"_{name}")[:] = state[name].numpy()
        self._gradients.fill(0.0)
        self.steps = int(state["steps"])

    def _last_fan_in(self) -> int:
        return int(self._parts[-1].shape[1])
