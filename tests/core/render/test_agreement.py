"""The float32 kernels against the reference in float64 on random scenes; R2-Gaussian's affine form against the exact.

`insideout bench agreement` prints the table of all 200 scenes of each renderer.
"""

from __future__ import annotations

import numpy as np
import pytest
import torch

from insideout.core.bench.agreement import compare
from insideout.core.gaussians import GaussianSet
from insideout.core.render import radiograph
from insideout.core.render.agreement import (
    COUNTS,
    DETECTORS,
    SIZES,
    _relative,
    decided_pixels,
    random_camera,
    scene_errors,
)
from insideout.core.render.agreement import random_set as random_gaussians
from insideout.core.views import Detector

RENDERERS = ("splat", "radiograph", "section")
PARAMETERS = {
    "splat": {"image", "means", "quats", "scales", "opacities", "sh", "pose"},
    "radiograph": {"image", "means", "quats", "scales", "density", "pose"},
    "section": {"image", "means", "quats", "scales", "density", "opacities", "sh"},
}


def assert_within_limits(rows, renderer: str) -> None:
    assert {row.parameter for row in rows} == PARAMETERS[renderer]
    assert not [row.complaint for row in rows if row.over_bar]


@pytest.mark.parametrize("renderer", RENDERERS)
def test_twenty_random_scenes_agree_in_value_and_in_every_gradient(renderer: str) -> None:
    assert_within_limits(compare(renderer, range(20)), renderer)


@pytest.mark.slow
@pytest.mark.parametrize("renderer", RENDERERS)
def test_two_hundred_random_scenes_agree_in_value_and_in_every_gradient(renderer: str) -> None:
    assert_within_limits(compare(renderer, range(200)), renderer)


@pytest.mark.parametrize("renderer", RENDERERS)
def test_the_warp_kernel_agrees_as_well(renderer: str) -> None:
    pytest.importorskip("warp")
    device = "cuda" if torch.cuda.is_available() else "cpu"
    assert_within_limits(compare(renderer, range(20), "cuda", device), renderer)


@pytest.mark.parametrize("kernel", ["cpu", "cuda"])
def test_gradients_that_are_nothing_are_not_divided_by_their_rounding(kernel: str) -> None:
    """Scene 80: one splat in one pixel, in colour. Its gradients but that by `sh` are 1e-16 in float64."""
    if kernel == "cuda":
        pytest.importorskip("warp")
    errors = scene_errors("section", 80, kernel)
    assert set(errors) == {"image", "means", "quats", "scales", "opacities", "sh"}
    assert max(errors.values()) < 1e-3


def test_a_gradient_where_there_is_none_is_an_error() -> None:
    """Of a largest gradient of 1, float32 may leave 1e-7 and not 1e-5."""
    nothing = np.full(3, 1e-16)
    assert _relative(np.full(3, 1e-7), nothing, 1.0) < 1e-3 < _relative(np.full(3, 1e-5), nothing, 1.0)


@pytest.mark.slow
def test_the_affine_form_agrees_with_its_own_reference() -> None:
    assert_within_limits(compare("radiograph", range(200), mode="affine"), "radiograph")


def test_the_scenes_cover_every_size_count_and_kind_of_detector() -> None:
    """The lists' lengths have no common factor that would keep one size to one kind."""
    seen = {(seed % len(SIZES), seed % len(COUNTS)) for seed in range(200)}
    assert len(seen) == len(SIZES) * len(COUNTS)
    assert {seed % len(DETECTORS) for seed in range(200)} == set(range(6))


def test_hardly_any_pixel_is_left_out_as_undecided() -> None:
    kept = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        camera = random_camera(rng, 48, 40, orthographic=seed % 2 == 1)
        kept.append(decided_pixels(random_gaussians(rng, 120, 0.5, 0.12), camera).float().mean().item())
    assert np.mean(kept) > 0.98


@pytest.mark.parametrize(
    ("sigma", "on_axis", "beside"), [(0.02, 1.7e-5, 9.2e-4), (0.2, 1.7e-3, 1.1e-2), (0.5, 1.1e-2, 3.2e-2)]
)
def test_the_affine_form_errs_by_as_much_of_the_peak_as_is_known(sigma: float, on_axis: float, beside: float) -> None:
    """Source five units from a ball: with σ² on the axis, with σ a unit beside it, where a cone stretches one flank."""
    u, v = np.array([0, 0.12 * sigma, 0]), np.array([0, 0, -0.12 * sigma])
    for place, expected in ((0.0, on_axis), (1.0, beside)):
        detector = Detector(201, 201, np.array([5.0, 0, 0]), np.array([-5.0, 2 * place, 0]), u, v)
        ball = GaussianSet.create(np.array([[0.0, place, 0.0]]), sigma, density=1.0).to_torch(torch.float64)
        exact, affine = (radiograph(ball, detector, "reference", mode) for mode in ("exact", "affine"))
        error = ((exact - affine).abs().max() / exact.max()).item()
        print(f"\nσ = {sigma}, {place} beside the axis: affine errs by {100 * error:.2g} % of the peak")
        assert error == pytest.approx(expected, rel=0.1)
