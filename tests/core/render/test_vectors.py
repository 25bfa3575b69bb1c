"""Vectors of the processor's width in Numba: every operation against numpy, and a picture drawn with eight lanes.

Run as a script this file tells how far the `cpu` kernel's image is from the `reference` one's; a process of its own is
asked that of a processor that has no wide registers.
"""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest
from numba import TypingError, njit

from insideout.core.render.kernels.cpu.vectors import (
    LANES,
    aligned,
    any_lane,
    exp2,
    exp2_negative,
    inverse_root,
    lane_numbers,
    least,
    load,
    prefetch,
    spread,
    store,
    store_run,
    totals,
    where,
)  # fmt: skip

LARGEST = 23


def vectors(count, seed=0):
    return np.random.default_rng(seed).normal(size=(count, LANES)).astype(np.float32)


@njit
def arithmetic(a, b, number, out):
    x, y = load(a, np.uint64(0)), load(b, np.uint64(0))
    for row, value in enumerate((x + y, x - y, x * y, x / y, x + number, number - x, x * number, number / x)):
        store(out, np.uint64(row * LANES), value)


def test_operators_work_lane_by_lane_and_a_number_stands_in_every_lane():
    a, b, number, out = *vectors(2), np.float32(1.7), np.zeros((8, LANES), np.float32)
    arithmetic(a, b, number, out)
    expected = [a + b, a - b, a * b, a / b, a + number, number - a, a * number, number / a]
    np.testing.assert_allclose(out, expected, rtol=1e-6)


@njit
def choices(a, b, out):
    x, y = load(a, np.uint64(0)), load(b, np.uint64(0))
    both = (x > np.float32(0)) & (y >= np.float32(0))
    for row, value in enumerate((where(x > y, x), where(x >= y, x), where(x < y, x), where(both, x), least(x, 0.5))):
        store(out, np.uint64(row * LANES), value)
    return any_lane(x > np.float32(1e9)), any_lane(x > np.float32(-1e9))


def test_comparisons_choose_lanes():
    a, b = vectors(2)
    b[0] = a[0]
    out = np.zeros((5, LANES), np.float32)
    found = choices(a, b, out)
    masks = [a > b, a >= b, a < b, (a > 0) & (b >= 0)]
    np.testing.assert_array_equal(out, [*(np.where(mask, a, 0) for mask in masks), np.minimum(a, np.float32(0.5))])
    assert found == (False, True)


def test_what_is_not_a_number_is_chosen_by_no_comparison():
    a = np.full(LANES, np.nan, np.float32)
    out = np.ones((5, LANES), np.float32)
    choices(a, a, out)
    np.testing.assert_array_equal(out[:4], 0)
    np.testing.assert_array_equal(out[4], 0.5)


@njit
def powers(x, out):
    for i in range(np.uint64(0), np.uint64(x.size), np.uint64(LANES)):
        store(out, i, exp2_negative(load(x, i)))


class TestPowersOfTwo:
    def test_are_right_to_three_parts_in_ten_millions(self):
        x = -np.linspace(0, 39.9, 4096 * LANES, dtype=np.float32)
        found = np.empty_like(x)
        powers(x, found)
        np.testing.assert_allclose(found, np.exp2(x.astype(np.float64)), rtol=3e-7)

    def test_of_zero_is_one(self):
        found = np.empty(LANES, np.float32)
        powers(np.zeros(LANES, np.float32), found)
        np.testing.assert_array_equal(found, 1)

    @pytest.mark.parametrize("x", [-40.0, -1e3, -3e38, -np.inf, np.nan])
    def test_end_at_a_millionth_of_a_millionth(self, x):
        found = np.empty(LANES, np.float32)
        powers(np.full(LANES, x, np.float32), found)
        np.testing.assert_array_equal(found, np.float32(2.0**-40))


@njit
def powers_and_roots(x, powers, roots):
    for i in range(np.uint64(0), np.uint64(x.size), np.uint64(LANES)):
        store(powers, i, exp2(load(x, i)))
        store(roots, i, inverse_root(load(powers, i)))


def test_powers_and_inverse_roots_of_all_sizes_are_right_to_three_parts_in_ten_millions():
    x = np.linspace(-122, 122, 4096 * LANES, dtype=np.float32)
    powers, roots = np.empty_like(x), np.empty_like(x)
    powers_and_roots(x, powers, roots)
    np.testing.assert_allclose(powers, np.exp2(x.astype(np.float64)), rtol=3e-7)
    np.testing.assert_allclose(roots, powers.astype(np.float64) ** -0.5, rtol=3e-7)


def adder(count):
    """A function that writes the totals of `count` vectors."""
    names = ", ".join(f"load(a, np.uint64({i * LANES}))" for i in range(count))
    space = {"load": load, "totals": totals, "np": np}
    exec(f"def add(a, out):\n    totals(out, np.uint64(1), ({names},))", space)
    return njit(space["add"])


@pytest.mark.parametrize("count", [1, 2, 3, 7, 8, 10, LANES, LARGEST])
def test_totals_stand_in_the_vectors_order_and_touch_nothing_else(count):
    a, out = vectors(count), np.full(count + 2, 7.0, np.float32)
    adder(count)(a, out)
    np.testing.assert_allclose(out[1:-1], a.sum(axis=1), rtol=1e-5, atol=1e-6)
    assert out[0] == out[-1] == 7


@njit
def write(ints, floats, where_from):
    store_run(ints, np.uint64(1), np.int32(-3), np.int32(5))
    prefetch(floats, np.uint64(0))
    store(floats, np.uint64(where_from), lane_numbers() * spread(np.float32(2)))


def test_runs_of_whole_numbers_and_of_lanes():
    ints, floats = np.zeros(LANES + 2, np.int32), np.zeros(LANES + 2, np.float32)
    write(ints, floats, 1)
    np.testing.assert_array_equal(ints, [0, *(-3 + 5 * np.arange(LANES)), 0])
    np.testing.assert_array_equal(floats, [0, *(2 * np.arange(LANES)), 0])


@njit
def place_of(count):
    array = aligned(count)
    return array.size, array.ctypes.data


@pytest.mark.parametrize("count", [1, 16, 1000, 12345])
def test_aligned_arrays_begin_with_a_line_of_the_cache(count):
    size, place = place_of(count)
    assert size == count
    assert place % 64 == 0


@njit
def first_of(array):
    return any_lane(load(array, np.uint64(0)) > np.float32(0))


@pytest.mark.parametrize("array", [np.zeros(64), np.zeros(128, np.float32)[::2]], ids=["float64", "every second"])
def test_arrays_that_are_not_float32_side_by_side_are_refused(array):
    with pytest.raises(TypingError):
        first_of(array)


@njit
def asked_for(array):
    prefetch(array, np.uint64(3))
    return array[0, 0]


@pytest.mark.parametrize("kind", [np.float32, np.float64, np.int32])
def test_any_array_whose_elements_lie_side_by_side_may_be_asked_for(kind):
    assert asked_for(np.ones((2, 3), kind)) == 1
    with pytest.raises(TypingError):
        asked_for(np.ones((2, 6), kind)[:, ::2])


def difference_between_kernels(mode):
    """‖cpu − reference‖ / ‖reference‖ of an image and of a gradient: a photo without a mode, else a radiograph."""
    from dataclasses import replace

    import torch

    from insideout.core.render import radiograph, splat
    from insideout.core.render.agreement import random_camera, random_detector, random_set

    rng = np.random.default_rng(0)
    camera, scene = random_camera(rng, 45, 37, orthographic=False), random_set(rng, 300, 0.5, 0.1, degree=1)
    detector = random_detector(rng, 45, 37, "free")
    found = {}
    for kernel, kind in (("cpu", torch.float32), ("reference", torch.float64)):
        gaussians = scene.to_torch(kind)
        means = gaussians.means.requires_grad_()
        seen = replace(gaussians, means=means)
        image = radiograph(seen, detector, kernel, mode) if mode else splat(seen, camera, kernel=kernel).color
        (image * torch.linspace(-1, 1, image.numel(), dtype=kind).reshape(image.shape)).sum().backward()
        found[kernel] = image.detach().double(), means.grad.double()
    return [
        float((ours - truth).norm() / truth.norm())
        for ours, truth in zip(found["cpu"], found["reference"], strict=True)
    ]


@pytest.mark.slow
@pytest.mark.parametrize("features", ["", "+sse4.2,+avx,+avx2,+fma"])
def test_a_processor_without_wide_registers_draws_the_same(features):
    """All kernels are compiled anew, which takes a minute and more: other tests see the registers of their machine."""
    environment = {**os.environ, "NUMBA_CPU_NAME": "generic", "NUMBA_CPU_FEATURES": features}
    done = subprocess.run([sys.executable, __file__], capture_output=True, text=True, env=environment, timeout=600)
    assert done.returncode == 0, done.stderr
    lanes, *errors = done.stdout.split()
    assert int(lanes) == 8
    assert len(errors) == 6
    assert max(float(image) for image in errors[::2]) < 1e-4
    assert max(float(gradient) for gradient in errors[1::2]) < 1e-3


if __name__ == "__main__":
    print(LANES, *(number for mode in (None, "exact", "affine") for number in difference_between_kernels(mode)))
