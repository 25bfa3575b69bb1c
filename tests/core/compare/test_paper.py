"""The paper's own figures."""

import pytest

from insideout.core.compare import paper


@pytest.mark.parametrize(
    ("method", "capture", "piqe", "psnr", "ssim"),
    [
        ("3dgs", "matryoshka", 54.63, 16.25, 0.60),
        ("mcmc", "Pharaoh", 41.63, 13.82, 0.64),
        ("rolling_shutter", "Toy Gun", 44.67, 17.59, 0.61),
        ("naf", "skull", 67.82, 18.64, 0.63),
        ("x_gaussian", "terracotta", 25.11, 15.20, 0.49),
        ("insideout", "toygun_2", 20.74, 20.87, 0.66),
    ],
)
def test_the_paper_s_table_of_internal_detail(method, capture, piqe, psnr, ssim):
    assert paper.detail(method, capture) == {"piqe": piqe, "psnr": psnr, "ssim": ssim}


def test_the_paper_s_gains_follow_from_its_table():
    ours, x_gaussian, splats = (paper.mean_detail(name)["psnr"] for name in ("insideout", "x_gaussian", "3dgs"))
    assert ours - x_gaussian == pytest.approx(1.67, abs=0.01)
    assert ours - splats == pytest.approx(3.33, abs=0.01)


def test_the_paper_s_chamfer_and_occupancy():
    assert paper.chamfer_mm("none", "skull") == 722.45
    assert paper.chamfer_mm("align", "matryoshka") == 8.41
    assert paper.chamfer_mm("internal", "terracotta") == 2.42
    assert paper.occupancy("gs2mesh", 242) == (0.476, 0.475)
    assert paper.occupancy("3dgs", 42) is None
    assert paper.detail("insideout", "engine") is None


def test_a_mean_of_the_paper_s_figures_is_over_the_objects_that_are_asked_for():
    some = paper.mean_detail("insideout", ["skull", "toy_gun"])
    assert some == pytest.approx({"piqe": 20.375, "psnr": 20.60, "ssim": 0.655})
    assert paper.mean_detail("fdk", ["skull"]) is None


def test_in_a_mean_an_object_of_the_paper_counts_once():
    assert paper.one_of_each(["Toy Gun", "a fly", "toygun_2", "skull", "b fly"]) == [
        "Toy Gun", "a fly", "skull", "b fly",
    ]  # fmt: skip
