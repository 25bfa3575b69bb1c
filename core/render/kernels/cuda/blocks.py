"""How the 256 pixels of a tile are shared out among the threads of a block, and how torch calls a Warp kernel."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Any

import torch
import warp as wp
from torch import Tensor

TILE = 16
"""Side of a tile in pixels."""
TILE_PIXELS = TILE * TILE
PART = 1024
"""Pairs added up before their sum is added to a pixel: a running float32 sum of 1e6 like terms errs by 0.5 %."""
_THREADS_OF_A_BLOCK = 64

wp.config.log_level = max(wp.config.log_level, wp.LOG_WARNING)
wp.init()


def pixels_of_a_thread(device: torch.device) -> int:
    """1 on a card, where a block has a thread for every pixel of a tile.

    On Warp's CPU back end a block is one thread, which then goes through all 256, unless Warp's cooperative CPU
    blocks are switched on (`warp.config.enable_cpu_blocks`).
    """
    return 1 if device.type == "cuda" or wp.config.enable_cpu_blocks else TILE_PIXELS


def launch_blocks(kernel: Any, blocks: int, pixels: int, inputs: Sequence[Any], device: torch.device) -> None:
    """Runs `kernel` with one block for each of `blocks` tiles, a thread for every `pixels` of the tile's pixels."""
    if blocks:
        wp.launch_tiled(kernel, dim=[blocks], inputs=list(inputs), block_dim=TILE_PIXELS // pixels, **_where(device))


def launch_threads(kernel: Any, threads: int, inputs: Sequence[Any], device: torch.device) -> None:
    """Runs `kernel` with `threads` independent threads."""
    if threads:
        where = _where(device)
        if device.type == "cuda":
            # In small blocks ten thousand splats are enough for all of a card's processors.
            where["block_dim"] = _THREADS_OF_A_BLOCK
        wp.launch(kernel, dim=threads, inputs=list(inputs), **where)


def moved(tensor: Tensor, device: torch.device, dtype: torch.dtype) -> Tensor:
    """A few numbers that a view has, on the splats' device; a card goes on with what it was doing meanwhile."""
    return tensor.to(device, dtype, non_blocking=device.type == "cuda")


def view(tensor: Tensor, dtype: Any = None) -> Any:
    """A tensor as a Warp array; `dtype` is the Warp vector that the last axis makes up, if any."""
    # Of a tensor without numbers torch calls any strides contiguous.
    tensor = tensor.contiguous() if tensor.numel() else tensor.new_empty(tensor.shape)
    # A descriptor holds on to its tensor like an array does, and is made in a quarter of the time.
    return wp.from_torch(tensor, dtype=dtype, requires_grad=False, return_ctype=True)


def _where(device: torch.device) -> dict[str, Any]:
    if device.type != "cuda":
        return {"device": "cpu"}
    # torch's own stream: launches are then in order with torch's kernels, without waiting.
    return {"stream": _stream_of(torch.cuda.current_stream(device))}


@cache
def _stream_of(stream: Any) -> Any:
    """Of a torch stream; made once, because a step has many launches."""
    return wp.stream_from_torch(stream)
