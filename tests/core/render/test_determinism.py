"""The same bits from the same numbers: on one, two and four threads, from kernels compiled now and from Numba's cache.

Run as a script this file prints a digest for each renderer and number of threads that it is given. Numba fixes its
number of threads when it starts, so four of them need a process of their own on a smaller machine.
"""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

THREADS = (1, 2, 4)
FIELDS = ("means", "quats", "scales", "opacities", "sh", "density")
SPLATS = 3000
"""More than a task of any kernel takes, so that sums over tasks are part of it."""


def digests() -> dict[str, str]:
    """SHA-256 of images and all gradients, by renderer."""
    import torch

    from insideout.core.render import radiograph, section, splat
    from insideout.core.render.agreement import random_camera, random_detector, random_plane, random_set

    rng = np.random.default_rng(0)
    camera = random_camera(rng, 83, 61, orthographic=False)
    detector = random_detector(rng, 61, 45, "free")
    parallel = random_detector(np.random.default_rng(1), 61, 45, "tilted parallel")
    planes = [random_plane(rng, 61, 45, thickness) for thickness in (0.0, 0.1, 2.0)]
    small, large = random_set(rng, SPLATS, 0.5, 0.05, degree=3), random_set(rng, SPLATS, 5.0, 1.0, degree=1)
    result = {}

    def note(name, gaussians, render) -> None:
        scene = gaussians.to_torch()
        leaves = {field: getattr(scene, field).requires_grad_() for field in FIELDS}
        image, pose = render(replace(scene, **leaves))
        (image * torch.linspace(-1, 2, image.numel()).reshape(image.shape)).sum().backward()
        tensors = [image.detach(), *(leaf.grad for leaf in [*leaves.values(), *pose] if leaf.grad is not None)]
        assert all(tensor.isfinite().all() for tensor in tensors)
        assert len(tensors) > 4
        content = b"".join(tensor.numpy().tobytes() for tensor in tensors)
        result[name] = hashlib.sha256(content).hexdigest()

    def photo(scene):
        pose = torch.tensor(camera.world_to_camera, requires_grad=True)
        image = splat(scene, replace(camera, world_to_camera=pose))
        return torch.cat([image.color, image.alpha[..., None], image.depth[..., None]], dim=-1), [pose]

    def projection(scene, beam, mode):
        vectors = {
            name: torch.tensor(getattr(beam, name), requires_grad=True) for name in ("source", "center", "u", "v")
        }
        return radiograph(scene, replace(beam, **vectors), mode=mode), vectors.values()

    note("splat", small, photo)
    for kind, beam, mode in (
        ("cone", detector, "exact"),
        ("cone", detector, "affine"),
        ("parallel", parallel, "exact"),
    ):
        note(f"radiograph {kind} {mode}", large, lambda scene, beam=beam, mode=mode: projection(scene, beam, mode))
    for plane in planes:
        for quantity in ("density", "occupancy", "color"):
            name = f"section {quantity} {plane.thickness_mm}"
            note(name, large, lambda scene, plane=plane, quantity=quantity: (section(scene, plane, quantity), []))
    return result


def print_digests(numbers: list[int]) -> None:
    import numba
    import torch

    for threads in numbers:
        numba.set_num_threads(threads)
        torch.set_num_threads(threads)
        for name, digest in digests().items():
            print(threads, digest, name)


def printed(threads: tuple[int, ...], **environment: str) -> list[list[str]]:
    """Threads, digest and renderer of each line that this script prints in a process of its own."""
    run = subprocess.run(
        [sys.executable, __file__, *map(str, threads)],
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert run.returncode == 0, run.stderr[-2000:]
    return [line.split(" ", 2) for line in run.stdout.splitlines()]


def test_the_same_bits_on_one_two_and_four_threads() -> None:
    found: dict[str, list[str]] = {}
    for _, digest, name in printed((*THREADS, THREADS[0]), NUMBA_NUM_THREADS=str(max(THREADS))):
        found.setdefault(name, []).append(digest)
    assert len(found) == 13
    for name, several in found.items():
        assert len(several) == len(THREADS) + 1
        assert len(set(several)) == 1, name


@pytest.mark.slow
def test_the_same_bits_in_the_process_that_compiles_the_kernels_and_in_the_next(tmp_path) -> None:
    # A kernel carries copies of the functions that it calls under names that all kernels share, and a process keeps
    # the copy that comes first. The one that compiles has each function by itself, too: contracted otherwise. A
    # function with `fastmath` must therefore be inlined (`forceinline`).
    compiled, cached = (printed((1,), NUMBA_CACHE_DIR=str(tmp_path)) for _ in range(2))
    assert list(tmp_path.rglob("*.nbc")), "nothing was cached, so that nothing was compared"
    assert len(compiled) == 13
    assert compiled == cached


if __name__ == "__main__":
    print_digests([int(threads) for threads in sys.argv[1:]])
