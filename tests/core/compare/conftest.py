"""A comparison of some methods on the tiny capture, made once; and a made-up one for the tables."""

import pytest

from insideout import __version__
from insideout.core.compare.compare import compare
from insideout.core.compare.methods import with_rgb
from insideout.core.compare.options import CompareSettings
from insideout.core.render.splat import PUBLISHED_LOW_PASS

MACHINE = {
    "date": "2026-11-21", "cpu": "a processor", "cores": 2, "gpu": None, "system": "Linux", "python": "3.11",
    "versions": {"torch": "2.13"}, "load": 1.0,
}  # fmt: skip


@pytest.fixture(scope="session")
def compared(tiny_capture, tiny_settings, tmp_path_factory):
    """Folder, options and tables of a comparison; read only."""
    out = tmp_path_factory.mktemp("comparisons") / "out"
    options = CompareSettings(
        ("3dgs", "fdk", "additive", "gs2mesh", "insideout"),
        # So that the row 3dgs has the photo half of the whole.
        with_rgb(tiny_settings, low_pass=PUBLISHED_LOW_PASS, mip_filter=False, degree=3),
        starts=1,
        projections=(8,),
        ablation_rows=("none", "published_rates"),
    )
    with pytest.MonkeyPatch.context() as patch:
        # Loading ITK-RTK takes seconds; it stays for the whole comparison.
        for module in ("stages.initialize.stage", "compare.methods"):
            patch.setattr(f"insideout.core.{module}.end_fdk", lambda: None)
        return out, options, compare([tiny_capture], out, options)


def made_up_row(label, modality, psnr, seconds=60.0, **more):
    sections = {"piqe": 40.0, "psnr": psnr, "ssim": psnr / 40}
    if modality == "photos":
        sections = {"paper": sections, "occupancy": {"piqe": 50.0, "psnr": psnr + 1, "ssim": psnr / 50}}
    return {
        "label": label,
        "modality": modality,
        "note": "",
        "seconds": seconds,
        "splats": 1000,
        "budget": None,
        "machine": MACHINE,
        "sections": sections,
        **dict.fromkeys(("photos", "projections", "volume", "mesh", "chamfer", "xray_seconds")),
        **more,
    }


def distances(mean):
    return {"mean_mm": mean, "p95_mm": 2 * mean, "mean_voxels": 2 * mean, "p95_voxels": 4 * mean}


@pytest.fixture
def row():
    """`row(label, modality, psnr, seconds, ...)`: the figures of a row; SSIM is a 40th of its PSNR."""
    return made_up_row


@pytest.fixture
def skull(content):
    """The figures of the capture "skull" in `content`."""
    return content["captures"]["skull"]


@pytest.fixture
def content():
    """A tables.json of a synthetic skull, and of a vase of which there are photos alone."""
    truth = {
        "source": "the true attenuation",
        "exact": True,
        "at_centers": False,
        "given": False,
        "voxel_mm": [0.5, 0.5, 0.5],
        "held_out_sections": 10,
        "measured_sections": 9,
        "peak_per_mm": 0.08,
        "sections": {"piqe": 44.0},
        "nothing": {"piqe": 100.0, "psnr": 14.5, "ssim": 0.25},
        "normals": {
            str(bins): {"occupancy": 1.0, "patch_mean": 0.35, "patch_median": 0.33, "total_variation": None}
            for bins in (42, 242)
        },
        "inner_left_out": 0.12,
        "no_surface": False,
    }
    mesh = {
        "watertight": True,
        "faces": 10,
        "outer": {"from_truth": distances(0.21), "to_truth": distances(0.22)},
        "inner": {"from_truth": distances(0.31), "to_truth": None},
        "inner_found": 0.876,
        "normals": {
            str(bins): {"occupancy": 0.99, "patch_mean": 0.41, "patch_median": 0.39, "total_variation": 0.04}
            for bins in (42, 242)
        },
    }
    skull = {
        "possible": ["3dgs", "r2_gaussian", "insideout"],
        "photos": 60,
        "training_projections": 75,
        "truth": {**truth, "mesh": {**mesh, "outer": {"from_truth": distances(0.07), "to_truth": distances(0.08)}}},
        "methods": {
            "insideout": made_up_row("InsideOut", "both", 31.5, 900.0, mesh=mesh, xray_seconds=250.0),
            "r2_gaussian": made_up_row(
                "R²-Gaussian", "xray", 29.0, 30.0, budget={"iterations": 4321, "seconds": 250.0}, xray_seconds=263.0
            ),
            "3dgs": made_up_row("3DGS", "photos", 15.0),
        },
        "alignment": {
            "chamfer": {"none": {"mm": 33.33, "percent_of_diagonal": 20.0}, "align": {"mm": 1.23}, "internal": None},
            "chamfer_at_truth": {"mm": 1.11, "percent_of_diagonal": 0.7},
            "refined": "apart",
            "ambiguity": "none",
            "by_landmarks": False,
            "errors": {"scale_percent": 0.12, "rotation_deg": 0.23, "tilt_deg": 0.2, "translation_mm": 0.34},
            "starts": {
                "shape": {
                    "found": 19,
                    "of": 20,
                    "ambiguous": 1,
                    "worst": {"scale_percent": 0.61, "rotation_deg": 0.5, "tilt_deg": 0.4, "translation_mm": 0.3},
                }
            },
        },
        "ablation": {
            "ablation/none": made_up_row("none", "both", 28.0, photos={"psnr": 26.26, "ssim": 0.9}, xray_seconds=101.0)
        },
        "projections": {
            "25": {"fdk": made_up_row("FDK", "xray", 22.0, volume={"psnr": 21.21}, projections={"psnr": 33.33})},
        },
    }
    vase = {
        "possible": ["3dgs"],
        "truth": None,
        "methods": {"3dgs": {**made_up_row("3DGS", "photos", 0), "sections": None}},
        "ablation": {},
        "projections": {},
    }
    return {
        "machine": MACHINE,
        "preset": "draft",
        "seed": 0,
        "kernel": "cpu",
        "same_time": True,
        "version": __version__,
        "coming": {},
        "captures": {"skull": skull, "a vase": vase},
    }
