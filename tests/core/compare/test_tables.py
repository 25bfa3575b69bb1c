"""Tables and plot from made-up figures, and the paper's own figures."""

import json
from itertools import pairwise

import numpy as np
import pytest
from PIL import Image, ImageDraw

from insideout import __version__
from insideout.core.compare import paper
from insideout.core.compare.compare import _Tables, settings_digest
from insideout.core.compare.methods import METHODS
from insideout.core.compare.options import CompareSettings
from insideout.core.compare.plot import _mark, draw_plot, plot_points
from insideout.core.compare.study import FIGURES
from insideout.core.compare.tables import markdown
from insideout.core.errors import RunFolderError, SettingError
from insideout.core.files import write_json
from insideout.core.settings import Settings


def row(label, modality, psnr, seconds=60.0, **more):
    sections = {"piqe": 40.0, "psnr": psnr, "ssim": 0.9}
    if modality == "photos":
        sections = {"paper": sections, "occupancy": {"piqe": 50.0, "psnr": psnr + 1, "ssim": 0.8}}
    return {
        "label": label,
        "modality": modality,
        "note": "",
        "seconds": seconds,
        "splats": 1000,
        "budget": None,
        "sections": sections,
        **dict.fromkeys(("photos", "projections", "volume", "mesh", "chamfer")),
        **more,
    }


def distances(mean):
    return {"mean_mm": mean, "p95_mm": 2 * mean, "mean_voxels": 2 * mean, "p95_voxels": 4 * mean}


@pytest.fixture
def content():
    truth = {
        "source": "the true attenuation",
        "exact": True,
        "voxel_mm": [0.5, 0.5, 0.5],
        "held_out_sections": 10,
        "peak_per_mm": 0.08,
        "sections": {"piqe": 44.0},
        "box_diagonal_mm": 140.0,
        "normals": {
            str(bins): {"occupancy": 1.0, "patch_mean": 0.35, "patch_median": 0.33, "total_variation": None}
            for bins in (42, 242)
        },
    }
    mesh = {
        "watertight": True,
        "faces": 10,
        "outer": {"from_truth": distances(0.21), "to_truth": distances(0.22)},
        "inner": {"from_truth": distances(0.31), "to_truth": None},
        "normals": {
            str(bins): {"occupancy": 0.99, "patch_mean": 0.41, "patch_median": 0.39, "total_variation": 0.04}
            for bins in (42, 242)
        },
    }
    budget = {"iterations": 4321, "seconds": 250.0}
    skull = {
        "truth": {**truth, "mesh": {**mesh, "outer": {"from_truth": distances(0.07), "to_truth": distances(0.08)}}},
        "methods": {
            "insideout": row("InsideOut", "both", 31.5, 900.0, mesh=mesh),
            "r2_gaussian": row("R²-Gaussian", "xray", 29.0, 30.0, budget=budget, xray_seconds=263.0),
            "3dgs": row("3DGS", "photos", 15.0),
        },
        "alignment": {
            "chamfer": {"none": {"mm": 33.33, "percent_of_diagonal": 20.0}, "align": {"mm": 1.23}, "internal": None},
            "ambiguity": "none",
            "errors": None,
            "starts": {
                "shape": {
                    "found": 19,
                    "of": 20,
                    "ambiguous": 1,
                    "worst": {
                        "scale_percent": 0.61, "rotation_deg": 0.5, "tilt_deg": 0.4, "translation_mm": 0.3,
                    },
                }
            },
        },
        "ablation": {"ablation/none": row("none", "both", 28.0, photos={"psnr": 26.26, "ssim": 0.9})},
        "projections": {
            "25": {"fdk": row("FDK", "xray", 22.0, volume={"psnr": 21.21}, projections={"psnr": 33.33})},
        },
    }  # fmt: skip
    machine = {
        "date": "2026-11-21", "cpu": "a processor", "cores": 2, "gpu": None, "system": "Linux", "python": "3.11",
        "versions": {"torch": "2.13"}, "load": 1.0,
    }  # fmt: skip
    photos_alone = {"truth": None, "methods": {"3dgs": {**row("3DGS", "photos", 0), "sections": None}}}
    empty = {"ablation": {}, "projections": {}}
    return {
        "machine": machine,
        "preset": "draft",
        "seed": 0,
        "kernel": "cpu",
        "same_time": True,
        "captures": {"skull": skull, "a vase": {**photos_alone, **empty}},
    }


def test_ours_stand_beside_the_paper_s(content):
    text = markdown(content)
    assert "| InsideOut | 40.00 | 31.50 | 0.900 | 20.01 | 20.33 | 0.650 |" in text
    assert "| 3DGS, as the paper does | 40.00 | 15.00 | 0.900 | 51.71 | 16.24 | 0.610 |" in text
    assert "| 3DGS, occupancy | 50.00 | 16.00 | 0.800 | – | – | – |" in text
    assert "InsideOut +2.50 dB against the best published radiative row (R²-Gaussian)" in text
    assert "| skull | none | 33.33 | 20.00 | 722.45 |" in text
    assert "| skull | hierarchical + internal | – | – | 7.95 |" in text
    assert "| the truth | 44.00 | – | – |" in text
    assert "| skull | shape | 19 of 20 | 0.61 | 0.50 | 0.40 | 0.30 | 1 |" in text
    assert (
        "| skull | InsideOut | yes | 0.21 (0.42) | 0.42 (0.84) | 0.22 (0.44) | 0.31 (0.62) | 0.62 (1.24) | – |" in text
    )
    assert "| skull | the truth's own voxels | yes | 0.07 (0.14) | 0.14 (0.28) | 0.08 (0.16) | 0.31 (0.62)" in text
    assert "0.410 | 0.390 | 0.040 | 0.443 | 0.452" in text
    assert "| skull | none | 26.26 | – | 28.00 | 0.900 | 1.0 |" in text
    assert "| skull | 25 | FDK | 33.33 | 21.21 | 22.00 | 60 |" in text
    assert "| skull | R²-Gaussian | 0.5 | 1000 | 4321 | 250 | 263 (+5%) |" in text
    assert "a processor" in text


def test_what_was_found_comes_first_in_a_line_for_each_capture(content):
    skull = content["captures"]["skull"]
    skull["methods"]["insideout"]["photos"] = {"psnr": 33.21, "ssim": 0.95}
    skull["alignment"]["errors"] = {
        "scale_percent": 0.12, "rotation_deg": 0.23, "tilt_deg": 0.2, "translation_mm": 0.34,
    }  # fmt: skip
    text = markdown(content)
    line = "31.50 | 0.900 | R²-Gaussian +2.50 | 33.21 | 0.12, 0.23, 0.34 | 0.22 (0.44) | 0.31 (0.62) | 15.0 |"
    assert f"| skull | {line}" in text
    assert text.index("## In short") < text.index("## 1. Internal detail")
    skull["truth"]["exact"] = False
    skull["methods"]["insideout"]["mesh"] = {"failed": "no surface"}
    skull["alignment"] = None
    assert "| skull | 31.50 | 0.900 | – | 33.21 | – | – | – | 15.0 |" in markdown(content)
    del skull["methods"]["insideout"]
    assert "In short" not in markdown(content)


@pytest.mark.parametrize(("seconds", "shown"), [(251, "251 (+0%)"), (226, "226 (-10%) (!)"), (310, "310 (+24%) (!)")])
def test_a_row_that_did_not_take_its_time_is_marked(content, seconds, shown):
    content["captures"]["skull"]["methods"]["r2_gaussian"]["xray_seconds"] = seconds
    assert f"| 4321 | 250 | {shown} |" in markdown(content)


class TestEarlierComparisons:
    def tables(self, out, content, **how):
        chosen = Settings.of("draft", seed=0, kernel="cpu")
        made = {"settings": settings_digest(chosen), "version": __version__, "figures": FIGURES}
        write_json(out / "earlier.json", {**content, **made, **how})
        return _Tables(out, chosen, CompareSettings(also=(out / "earlier.json",)))

    def test_their_captures_stand_beside_the_new_ones_with_their_own_machine(self, content, tmp_path):
        tables = self.tables(tmp_path, content)
        head = tables.of("head")
        head["methods"]["fdk"] = row("FDK", "xray", 22.0)
        head["truth"] = content["captures"]["skull"]["truth"]
        tables.write()
        text = (tmp_path / "tables.md").read_text("utf-8")
        assert "| InsideOut | 40.00 | 31.50 |" in text
        assert "| FDK | 40.00 | 22.00 |" in text
        assert "- skull: 2026-11-21, a processor" in text
        assert "- head: " in text

    def test_a_capture_that_is_compared_again_is_shown_with_its_new_figures_alone(self, content, tmp_path):
        assert self.tables(tmp_path, content).of("skull")["methods"] == {}

    @pytest.mark.parametrize("how", [{"preset": "paper"}, {"seed": 1}, {"same_time": False}, {"figures": 0}])
    def test_what_was_made_in_another_way_is_refused(self, content, tmp_path, how):
        with pytest.raises(SettingError, match="compare like with like"):
            self.tables(tmp_path, content, **how)

    def test_a_preset_that_meant_something_else_is_refused(self, content, tmp_path):
        with pytest.raises(SettingError, match=r"another version of the program, whose preset draft"):
            self.tables(tmp_path, content, settings="of another version")

    def test_captures_that_this_comparison_comes_to_again_stay_in_its_tables_until_then(self, content, tmp_path):
        self.tables(tmp_path, content).write()
        chosen = Settings.of("draft", seed=0, kernel="cpu")
        again = _Tables(tmp_path, chosen, CompareSettings())
        assert set(again.content["captures"]) == set(content["captures"])

    @pytest.mark.parametrize(("other", "message"), [
        (("standard", 0), "made with preset draft, not standard"), (("draft", 1), "made with seed 0, not 1"),
    ])  # fmt: skip
    def test_another_comparison_in_its_folder_is_refused_so_that_no_row_is_given_up(
        self, content, tmp_path, other, message
    ):
        self.tables(tmp_path, content).write()
        with pytest.raises(RunFolderError, match=f"{message}; choose another --out"):
            _Tables(tmp_path, Settings.of(*other), CompareSettings(), ["skull", "a vase"])
        # Nothing was finished: nothing is lost.
        kept = json.loads((tmp_path / "tables.json").read_text("utf-8"))
        write_json(tmp_path / "tables.json", {**kept, "captures": {}})
        assert _Tables(tmp_path, Settings.of(*other), CompareSettings()).content["captures"] == {}

    def test_files_of_something_else_are_not_written_over(self, tmp_path):
        (tmp_path / "tables.md").write_text("a carpenter's", "utf-8")
        with pytest.raises(RunFolderError, match=r"tables\.md: is not of a comparison"):
            _Tables(tmp_path, Settings.of("draft"), CompareSettings())

    def test_figures_that_were_measured_in_another_way_are_not_shown_again(self, content, tmp_path):
        self.tables(tmp_path, content).write()
        kept = json.loads((tmp_path / "tables.json").read_text("utf-8"))
        write_json(tmp_path / "tables.json", {**kept, "figures": 0})
        chosen = Settings.of("draft", seed=0, kernel="cpu")
        with pytest.raises(RunFolderError, match=r"another version of the program.* choose another --out"):
            _Tables(tmp_path, chosen, CompareSettings(), ["skull"])
        assert _Tables(tmp_path, chosen, CompareSettings(), ["skull", "a vase"]).content["captures"] == {}

    def test_a_file_of_something_else_is_refused(self, content, tmp_path):
        with pytest.raises(SettingError, match=r"no tables\.json"):
            self.tables(tmp_path, content, captures=None)


def test_the_project_s_own_rows_are_not_rivals_of_each_other(content):
    content["captures"]["skull"]["methods"]["apart"] = row("InsideOut, halves apart", "both", 32.0)
    content["captures"]["skull"]["methods"]["additive"] = row("InsideOut, X-ray half", "xray", 30.0)
    text = markdown(content)
    assert "- skull: InsideOut +2.50 dB against the best published radiative row (R²-Gaussian)" in text
    assert "- skull: InsideOut, halves apart +3.00 dB against the best published radiative row (R²-Gaussian)" in text
    assert "- skull: InsideOut, X-ray half +1.00 dB against the best published radiative row (R²-Gaussian)" in text


def test_the_lead_is_also_told_as_the_mean_of_the_objects_whose_truth_is_exact(content):
    skull = content["captures"]["skull"]
    head = {**skull, "methods": {**skull["methods"], "r2_gaussian": row("R²-Gaussian", "xray", 32.0)}}
    scanned = {**head, "truth": {**head["truth"], "exact": False, "source": "the FDK of all projections"}}
    content["captures"] |= {"head": head, "scanned": scanned}
    text = markdown(content)
    assert "- head: InsideOut -0.50 dB" in text
    assert "- mean of 2 objects: InsideOut +1.00 dB against the best of each, ahead on 1" in text
    assert "scanned: InsideOut" not in text
    assert "the FDK of all projections, 0.50 mm voxels, full scale 0.0800 mm⁻¹ (no truth:" in text


def test_the_lead_over_r2_gaussian_at_our_rates_is_told_apart_from_that_over_published_methods(content):
    content["captures"]["skull"]["methods"]["r2_at_our_rates"] = row("R²-Gaussian at our rates", "xray", 30.75)
    text = markdown(content)
    assert (
        "- skull: InsideOut +2.50 dB against the best published radiative row (R²-Gaussian), "
        "+0.75 dB against R²-Gaussian at our rates" in text
    )


def test_the_mean_is_over_the_paper_s_objects_alone(content):
    skull, fdk = content["captures"]["skull"], row("FDK", "xray", 22.0)
    content["captures"] |= {"pharaoh": skull, "a scan": {**skull, "methods": {"fdk": fdk}}}
    text = markdown(content)
    assert "**Mean of the 2 objects**" in text
    assert text.count("| InsideOut | 40.00 | 31.50 |") == 3


def test_ablation_rows_that_are_known_no_more_stand_last(content):
    ablation = content["captures"]["skull"]["ablation"]
    content["captures"]["skull"]["ablation"] = {"ablation/of_old": row("... a part of old", "xray", 29.0), **ablation}
    text = markdown(content)
    assert text.index("| skull | none |") < text.index("| skull | ... a part of old |")


def test_the_plot_shows_x_gaussian_s_attenuation_as_it_shows_that_of_others(content):
    rival = row("X-Gaussian", "xray", 17.0)
    rival["sections"] = {**rival["sections"], "paper": {"piqe": 30.0, "psnr": 16.0, "ssim": 0.5}}
    content["captures"]["skull"]["methods"]["x_gaussian"] = rival
    assert {point.label: point.psnr for point in plot_points(content)}["X-Gaussian"] == 17.0


def test_no_two_rows_have_the_same_mark():
    """All filled, as rows that saw X-rays are."""
    image = Image.new("RGB", (40 * len(METHODS), 40), "white")
    for index in range(len(METHODS)):
        _mark(ImageDraw.Draw(image), (40 * index + 20, 20), index, True)
    marks = {image.crop((40 * index, 0, 40 * index + 40, 40)).tobytes() for index in range(len(METHODS))}
    assert len(marks) == len(METHODS)


def test_x_gaussian_has_a_row_cut_as_the_paper_cuts_blended_sets(content):
    rival = row("X-Gaussian", "xray", 17.0)
    rival["sections"] = {**rival["sections"], "paper": {"piqe": 30.0, "psnr": 16.0, "ssim": 0.5}}
    content["captures"]["skull"]["methods"]["x_gaussian"] = rival
    text = markdown(content)
    assert "| X-Gaussian, as the paper does | 30.00 | 16.00 | 0.500 | 23.71 | 19.42 | 0.640 |" in text
    assert "| X-Gaussian | 40.00 | 17.00 | 0.900 | – | – | – |" in text


def test_the_paper_s_own_figures_stand_beside_its_own_five_stages_too(content):
    content["captures"]["skull"]["methods"]["apart"] = row("InsideOut, halves apart", "both", 32.0)
    assert "| InsideOut, halves apart | 40.00 | 32.00 | 0.900 | 20.01 | 20.33 | 0.650 |" in markdown(content)


def test_ablation_rows_say_what_was_taken_back_and_what_changes_nothing(content):
    ablation = content["captures"]["skull"]["ablation"]
    ablation["insideout"] = row("alignment + joint refinement", "both", 30.0)
    ablation["ablation/without_outlines"] = row("... without outlines in the alignment", "both", 30.0)
    ablation["apart"] = row("alignment + internal rendering", "both", 29.0, taken_back="projections fell")
    text = markdown(content)
    assert "| skull | ... without outlines in the alignment (changes nothing here) |" in text
    assert "| skull | alignment + internal rendering (sections not followed: projections fell) |" in text
    assert "| skull | alignment + joint refinement |" in text


def test_with_a_joint_refinement_the_paper_s_last_step_is_that_of_the_row_whose_halves_stay_apart(content):
    skull = content["captures"]["skull"]
    skull["alignment"] |= {"refined": "joint"}
    skull["alignment"]["chamfer"]["internal"] = {"mm": 1.25, "percent_of_diagonal": 1.0}
    skull["ablation"]["apart"] = row(
        "apart", "both", 28.0, chamfer={"internal": {"mm": 1.11, "percent_of_diagonal": 0.9}}
    )
    text = markdown(content)
    assert "| skull | hierarchical + internal | 1.11 | 0.90 | 7.95 |" in text
    assert "| skull | hierarchical + joint | 1.25 | 1.00 | – |" in text


def test_what_a_reader_has_to_know_of_an_ablation_row_stands_over_the_table(content):
    content["captures"]["skull"]["ablation"]["ablation/none"]["note"] = "Photos alone."
    text = markdown(content)
    assert "- none: Photos alone." in text[text.index("## 4. Ablation") :].split("| skull")[0]


def test_every_table_has_as_many_cells_in_each_line(content):
    lines = markdown(content).splitlines()
    for before, line in pairwise(lines):
        if before.startswith("|") and line.startswith("|"):
            assert before.count("|") == line.count("|"), line


def test_a_capture_without_x_rays_is_only_in_the_table_of_times(content):
    del content["captures"]["skull"]
    text = markdown(content)
    assert "Internal detail" not in text
    assert "| a vase | 3DGS | 1.0 | 1000 | – | – | – |" in text


def test_the_plot_has_a_mark_for_every_row_with_sections(content, tmp_path):
    points = plot_points(content)
    assert [(point.label, round(point.seconds), point.psnr, point.solid) for point in points] == [
        ("3DGS", 60, 15.0, False),
        ("R²-Gaussian", 30, 29.0, True),
        ("InsideOut", 900, 31.5, True),
    ]
    draw_plot(content, tmp_path / "plot.png")
    drawn = np.asarray(Image.open(tmp_path / "plot.png").convert("RGB")).reshape(-1, 3)
    # The mark in the plot and the one in the legend; that of photos alone is hollow.
    for color, least in (((213, 94, 0), 400), ((0, 114, 178), 400), ((0, 158, 115), 200)):
        assert (drawn == color).all(axis=1).sum() > least


def test_the_plot_has_a_panel_for_each_capture_and_says_so_when_there_is_nothing(content, tmp_path):
    sizes = []
    for count in (0, 1, 2, 5):
        captures = {f"capture {i}": content["captures"]["skull"] for i in range(count)}
        draw_plot({**content, "captures": captures}, tmp_path / "plot.png")
        sizes.append(Image.open(tmp_path / "plot.png").size)
    assert sizes == [(980, 510), (980, 510), (1620, 510), (1620, 1370)]


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
