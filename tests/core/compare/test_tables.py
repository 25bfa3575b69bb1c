"""What the tables say of made-up figures."""

from copy import deepcopy
from itertools import pairwise

import pytest

from insideout import __version__
from insideout.core.compare.cells import share
from insideout.core.compare.tables import markdown

OTHER_MACHINE = {
    "date": "2026-11-22", "cpu": "another processor", "cores": 8, "gpu": None, "system": "Linux", "python": "3.11",
    "versions": {"torch": "2.13"}, "load": 1.0,
}  # fmt: skip


def part(text, heading):
    """What stands under a heading."""
    after = text.split(f"## {heading}\n", 1)[1]
    return after.split("\n## ", 1)[0]


class TestHead:
    def test_the_program_s_version_and_the_machine_stand_first(self, content):
        text = markdown(content)
        assert f"InsideOut {__version__}, preset `draft`, seed 0, kernel `cpu`." in text
        assert "2026-11-21, a processor, 2 cores" in text.split("## ")[0]

    def test_rows_of_two_machines_in_one_capture_are_told_with_both_and_their_dates(self, content, skull):
        skull["methods"]["r2_gaussian"]["machine"] = OTHER_MACHINE
        head = markdown(content).split("## ")[0]
        assert "- skull: 2026-11-21, a processor, 2 cores, Linux, Python 3.11, torch 2.13; 2026-11-22, another" in head
        assert "- a vase: 2026-11-21, a processor" in head

    def test_the_machine_of_a_row_with_fewer_projections_counts_too(self, content, skull):
        skull["projections"]["25"]["fdk"]["machine"] = OTHER_MACHINE
        assert "2026-11-22, another processor, 8 cores" in markdown(content).split("## ")[0]

    def test_a_comparison_that_is_not_finished_says_so_at_its_top(self, content):
        content["coming"] = {"skull": ["FDK", "ablation, none"], "a vase": []}
        text = markdown(content)
        assert "**In progress.** Rows still to come: skull: FDK, ablation, none." in text.split("InsideOut 0")[0]
        content["coming"] = {"skull": []}
        assert "In progress" not in markdown(content)

    def test_rows_that_were_not_run_are_named_once_for_captures_that_lack_the_same(self, content, skull):
        assert "Rows not run" not in markdown(content)
        skull["possible"] += ["sart", "fdk"]
        content["captures"]["head"] = deepcopy(skull)
        text = markdown(content)
        assert "- Rows not run of skull, head: SART, FDK." in text
        assert "dB: best of the rows run?" in text
        assert "against the best of the rows run of published methods that see X-rays" in text

    def test_rows_that_are_still_to_come_are_not_named_as_not_run(self, content, skull):
        skull["possible"] += ["sart", "fdk"]
        content["coming"] = {"skull": ["FDK"]}
        assert "- Rows not run of skull: SART." in markdown(content)

    def test_rows_outside_their_time_are_named_before_the_tables(self, content, skull):
        assert "did not take the time" not in markdown(content)
        skull["methods"]["r2_gaussian"]["xray_seconds"] = 310.0
        assert "were to take: skull, R²-Gaussian (310 s of 250)." in part(
            markdown(content), "What it was measured against"
        )

    def test_figures_of_an_earlier_version_are_shown_as_far_as_they_go(self, content, skull):
        del content["version"], content["coming"], skull["possible"]
        for name in ("at_centers", "given", "measured_sections", "nothing", "inner_left_out", "no_surface"):
            del skull["truth"][name]
        del skull["methods"]["insideout"]["mesh"]["inner_found"], skull["alignment"]["chamfer_at_truth"]
        text = markdown(content)
        assert "Preset `draft`, seed 0" in text
        assert "measured on the 10 held-out sections" in text
        assert "voxels there" not in text
        assert "nothing at all" not in text


class TestInShort:
    def test_what_was_found_comes_first_in_a_line_for_each_capture(self, content, skull):
        skull["methods"]["insideout"]["photos"] = {"psnr": 33.21, "ssim": 0.95}
        text = markdown(content)
        line = "31.50 | yes | 0.787 | yes | R²-Gaussian +2.50 | 33.21 | 0.12, 0.23, 0.34 | 0.22 (0.44)"
        assert f"| skull | {line} | 0.31 (0.62), of 88 % of them | 15.0 |" in text
        assert text.index("## In short") < text.index("## What it was measured against") < text.index("## 1. ")

    def test_a_row_that_an_earlier_version_made_says_so(self, content, skull):
        skull["methods"]["insideout"]["label"] += " [as it was on a Monday]"
        assert "| skull [as it was on a Monday] | 31.50 |" in part(markdown(content), "In short")

    def test_without_an_insideout_row_there_is_nothing_in_short(self, content, skull):
        del skull["methods"]["insideout"]
        assert "In short" not in markdown(content)

    @pytest.mark.parametrize(
        ("name", "label", "modality", "psnr", "shown"),
        [
            ("additive", "InsideOut, projections alone", "xray", 32.81, "no: InsideOut, projections alone 32.81"),
            ("mcmc", "3DGS-MCMC", "photos", 33.0, "no: 3DGS-MCMC, occupancy 34.00"),
            ("additive", "InsideOut, projections alone", "xray", 31.499, "yes, as InsideOut, projections alone"),
            ("additive", "InsideOut, projections alone", "xray", 31.0, "yes"),
        ],
    )
    def test_the_best_of_all_rows_is_named_own_rows_and_photo_rows_too(
        self, content, skull, row, name, label, modality, psnr, shown
    ):
        skull["methods"][name] = row(label, modality, psnr)
        assert f"| skull | 31.50 | {shown} |" in markdown(content)

    def test_psnr_and_ssim_can_have_different_best_rows(self, content, skull):
        skull["methods"]["r2_gaussian"]["sections"]["ssim"] = 0.99
        assert "| skull | 31.50 | yes | 0.787 | no: R²-Gaussian 0.990 |" in markdown(content)

    def test_one_row_alone_is_not_called_the_best(self, content, skull):
        skull["methods"] = {"insideout": skull["methods"]["insideout"]}
        assert "| skull | 31.50 | the only row |" in markdown(content)

    def test_where_nobody_knows_the_truth_the_reader_is_told_so_and_there_is_no_lead(self, content, skull):
        skull["truth"] |= {"exact": False, "source": "the FDK of all projections", "mesh": None}
        text = markdown(content)
        assert "| skull † | 31.50 | yes | 0.787 | yes | – |" in text
        told = "skull: there is no truth; measured against the FDK of all projections, whose faults count as right."
        assert f"† {told}" in part(text, "In short")
        assert f"- {told}" in part(text, "What it was measured against")
        assert "R²-Gaussian +2.50" not in text

    def test_rows_that_were_given_the_volume_are_not_compared(self, content, skull):
        skull["truth"] |= {"exact": False, "given": True, "source": "the capture's volume", "mesh": None}
        text = markdown(content)
        assert "| skull † | 31.50 | – | 0.787 | – | – |" in text
        assert "Rows that see X-rays were given this volume, held-out sections too" in text
        assert "Here rows that see X-rays were given this very volume" in part(text, "1. Internal detail")
        assert "**31.50**" not in text


class TestInternalDetail:
    def test_ours_stand_beside_the_paper_s_and_the_best_are_bold(self, content):
        text = part(markdown(content), "1. Internal detail")
        assert "| InsideOut | 40.00 | **31.50** | **0.787** | 20.01 | 20.33 | 0.650 |" in text
        assert "| R²-Gaussian | 40.00 | 29.00 | 0.725 |" in text
        assert "| 3DGS, occupancy | 50.00 | 16.00 | 0.300 | – | – | – |" in text
        assert "| the truth | 44.00 | – | – |" in text
        assert "PIQE ↓" not in text

    def test_the_sections_that_were_measured_are_counted(self, content, skull):
        title = "**skull**: measured on the 9 of 10 held-out sections that show the object of the true attenuation"
        assert title in markdown(content)
        skull["truth"]["measured_sections"] = 10
        assert "**skull**: measured on the 10 held-out sections of the true attenuation" in markdown(content)

    @pytest.mark.parametrize(
        ("psnr", "said"), [(15.51, ""), (15.49, " (found nothing)"), (13.6, " (found nothing)"),
                           (13.4, " (further off than nothing)")],
    )  # fmt: skip
    def test_air_everywhere_is_a_row_and_rows_that_are_hardly_better_say_so(self, content, skull, row, psnr, said):
        skull["methods"]["naf"] = row("NAF", "xray", psnr)
        text = markdown(content)
        assert "| nothing at all (air) | 100.00 | 14.50 | 0.250 | – | – | – |" in text
        assert f"| NAF{said} | 40.00 | {psnr:.2f} |" in text

    def test_a_row_that_found_nothing_is_no_rival(self, content, skull, row):
        skull["methods"] = {"insideout": row("InsideOut", "both", 14.8), "naf": row("NAF", "xray", 15.2)}
        skull["possible"] = []
        assert "dB against the best of published methods" not in markdown(content)
        skull["methods"]["fdk"] = row("FDK", "xray", 16.0)
        assert "- skull: InsideOut -1.20 dB against the best of published methods that see X-rays (FDK)" in markdown(
            content
        )

    def test_the_project_s_own_rows_are_not_rivals_of_each_other(self, content, skull, row):
        skull["methods"]["apart"] = row("InsideOut, halves apart", "both", 32.0)
        skull["methods"]["additive"] = row("InsideOut, X-ray half", "xray", 30.0)
        text = markdown(content)
        for label, lead in (("InsideOut", 2.5), ("InsideOut, halves apart", 3.0), ("InsideOut, X-ray half", 1.0)):
            line = f"{label} {lead:+.2f} dB against the best of published methods that see X-rays (R²-Gaussian)"
            assert f"- skull: {line}" in text

    def test_the_lead_over_r2_gaussian_at_our_rates_is_told_apart_from_that_over_published_methods(
        self, content, skull, row
    ):
        skull["methods"]["r2_at_our_rates"] = row("R²-Gaussian at our rates", "xray", 30.75)
        assert (
            "- skull: InsideOut +2.50 dB against the best of published methods that see X-rays (R²-Gaussian), "
            "+0.75 dB against R²-Gaussian at our rates" in markdown(content)
        )

    def test_the_mean_lead_names_its_objects_each_counted_once_and_only_where_the_truth_is_exact(
        self, content, skull, row
    ):
        head = {**skull, "methods": {**skull["methods"], "r2_gaussian": row("R²-Gaussian", "xray", 32.0)}}
        scanned = {**head, "truth": {**head["truth"], "exact": False, "source": "the FDK of all projections"}}
        content["captures"] |= {"head": head, "scanned": scanned, "skull_2": skull}
        text = markdown(content)
        assert "- head: InsideOut -0.50 dB" in text
        assert "- paper: +1.67 dB over X-Gaussian" in text
        assert "- mean of 2 objects (skull, head): InsideOut +1.00 dB against the best of each, ahead on 1" in text
        assert "scanned: InsideOut" not in text
        assert "full scale 0.0800 mm⁻¹ (no truth: its faults count as right)" in text

    def test_the_mean_is_over_the_paper_s_objects_each_once_and_the_paper_s_over_the_same(self, content, skull, row):
        pharaoh = deepcopy(skull)
        pharaoh["methods"]["insideout"]["sections"]["psnr"] = 29.5
        scan = {**skull, "methods": {"fdk": row("FDK", "xray", 22.0)}}
        content["captures"] |= {"pharaoh": pharaoh, "a scan": scan, "skull_2": skull}
        text = markdown(content)
        mean = text.split("**Mean of 2 objects** (skull, pharaoh)")[1]
        # Of 20.01 and 30.35, 20.33 and 15.14, 0.65 and 0.64.
        assert "| InsideOut | 40.00 | 30.50 | 0.787 | 25.18 | 17.73 | 0.645 |" in mean

    def test_x_gaussian_has_a_row_cut_as_the_paper_cuts_blended_sets(self, content, skull, row):
        rival = row("X-Gaussian", "xray", 17.0)
        rival["sections"] = {**rival["sections"], "paper": {"piqe": 30.0, "psnr": 16.0, "ssim": 0.5}}
        skull["methods"]["x_gaussian"] = rival
        text = markdown(content)
        assert "| X-Gaussian, as the paper does | 30.00 | 16.00 | 0.500 | 23.71 | 19.42 | 0.640 | 12.68 |" in text
        assert "| X-Gaussian | 40.00 | 17.00 | 0.425 | – | – | – | 11.30 | – | – | – |" in text

    def test_an_error_needs_no_full_scale_and_what_is_measured_of_the_whole_stands_once(self, content, skull, row):
        rows = {"volume": {"psnr": 33.3}, "projections": {"psnr": 44.4}, "photos": {"psnr": 22.2}}
        skull["methods"]["insideout"] |= rows
        text = markdown(content)
        # 80 thousandths at 31.5 dB.
        assert "| **0.787** | 20.01 | 20.33 | 0.650 | 2.13 | 33.30 | 44.40 | 22.20 |" in text
        assert "| nothing at all (air) | 100.00 | 14.50 | 0.250 | – | – | – | 15.07 | – | – | – |" in text

    def test_where_little_metal_makes_the_full_scale_the_decibels_of_the_rest_are_told(self, content, skull):
        assert "with that as full scale" not in markdown(content), "an earlier version did not measure it"
        skull["truth"]["material_per_mm"] = 0.008
        title = (
            "half of the object attenuates less than 0.0080 mm⁻¹: with that as full scale every PSNR here is 20.0 dB"
        )
        assert title in markdown(content)

    def test_the_paper_s_own_figures_stand_beside_its_own_five_stages_too(self, content, skull, row):
        skull["methods"]["apart"] = row("InsideOut, halves apart", "both", 30.0)
        assert "| InsideOut, halves apart | 40.00 | 30.00 | 0.750 | 20.01 | 20.33 | 0.650 |" in markdown(content)


class TestAlignment:
    def test_distances_stand_beside_that_of_the_true_similarity_and_the_paper_s(self, content):
        text = part(markdown(content), "2. Alignment")
        assert "| skull | none | 33.33 | 20.00 | +32.22 | 722.45 |" in text
        assert "| skull | hierarchical | 1.23 | – | +0.12 | 9.53 |" in text
        assert "| skull | hierarchical + internal | – | – | – | 7.95 |" in text
        assert "| skull | the true similarity | 1.11 | 0.70 | – | – |" in text

    def test_starts_and_the_run_itself_say_whether_they_found_it(self, content, skull):
        text = part(markdown(content), "2. Alignment")
        assert "| skull | shape, random starts | 19 of 20 | 0.61 | 0.50 | 0.40 | 0.30 | 1 of 20 |" in text
        assert "| skull | shape, the run itself | yes | 0.12 | 0.23 | 0.20 | 0.34 | no |" in text
        assert "no random starts were tried" not in text
        skull["alignment"] |= {"starts": None, "by_landmarks": True, "ambiguity": "discrete"}
        skull["alignment"]["errors"]["rotation_deg"] = 1.01
        text = part(markdown(content), "2. Alignment")
        assert "| skull | landmarks, the run itself | no | 0.12 | 1.01 | 0.20 | 0.34 | yes (discrete) |" in text
        assert "skull: no random starts were tried." in text

    def test_with_a_joint_refinement_the_paper_s_last_step_is_that_of_the_row_whose_halves_stay_apart(
        self, content, skull, row
    ):
        skull["alignment"] |= {"refined": "joint"}
        skull["alignment"]["chamfer"]["internal"] = {"mm": 1.25, "percent_of_diagonal": 1.0}
        chamfer = {"internal": {"mm": 1.11, "percent_of_diagonal": 0.9}}
        skull["ablation"]["apart"] = row("apart", "both", 28.0, chamfer=chamfer)
        text = markdown(content)
        assert "| skull | hierarchical + internal | 1.11 | 0.90 | +0.00 | 7.95 |" in text
        assert "| skull | hierarchical + joint | 1.25 | 1.00 | +0.14 | – |" in text


class TestMeshes:
    def test_distances_stand_above_those_of_the_truth_s_own_voxels(self, content):
        text = part(markdown(content), "3. Meshes")
        line = "0.21 (0.42) | 0.42 (0.84) | 0.22 (0.44) | 0.31 (0.62) | 0.62 (1.24) | – | 88 % |"
        assert f"| skull | InsideOut | yes | {line}" in text
        assert "| skull | the truth's own voxels | yes | 0.07 (0.14) | 0.14 (0.28) | 0.08 (0.16)" in text
        assert "- skull: inner figures are of 88 % of the area of the true inner surfaces" in text

    @pytest.mark.parametrize("left_out", [None, 0.0, 0.0004])
    def test_nothing_is_said_of_inner_surfaces_that_are_all_there(self, content, skull, left_out):
        skull["truth"]["inner_left_out"] = left_out
        assert "inner figures are of" not in part(markdown(content), "3. Meshes")

    def test_the_spread_of_normals_stands_beside_the_truth_s_for_each_number_of_bins(self, content):
        text = part(markdown(content), "3. Meshes")
        small, large = text.split("Of 42 directions:")[1].split("Of 242 directions:")
        assert "| skull | InsideOut | 0.990 | 0.410 | 0.390 | 0.040 | 0.443 | 0.452 |" in small
        assert "| skull | InsideOut | 0.990 | 0.410 | 0.390 | 0.040 | 0.471 | 0.471 |" in large
        for table in (small, large):
            assert "| skull | the truth's own voxels | 0.990 | 0.410 | 0.390 | 0.040 | – | – |" in table
            assert "| skull | the truth | 1.000 | 0.350 | 0.330 | – | – | – |" in table

    def test_the_paper_s_spread_stands_beside_its_own_objects_alone(self, content, skull):
        content["captures"]["a fly"] = skull
        assert "| a fly | InsideOut | 0.990 | 0.410 | 0.390 | 0.040 | – | – |" in markdown(content)

    @pytest.mark.parametrize(
        ("source", "label"),
        [("the FDK of all projections", "the FDK's own surface"), ("the capture's volume", "the volume's own surface")],
    )
    def test_a_surface_that_is_not_the_truth_s_is_not_called_so(self, content, skull, source, label):
        skull["truth"] |= {"exact": False, "source": source, "mesh": None}
        text = part(markdown(content), "3. Meshes")
        assert f"| skull | {label} | 1.000 |" in text
        assert "| skull | the truth |" not in text

    def test_a_row_without_a_surface_says_so_in_plain_words(self, content, skull):
        skull["methods"]["insideout"]["mesh"] = {"failed": "no surface at 0.02 mm⁻¹: choose a level between them."}
        text = markdown(content)
        assert "| skull | InsideOut | no surface found | – |" in text
        assert "choose a level" not in text

    def test_a_reference_without_a_surface_is_named(self, content, skull):
        skull["truth"] |= {"no_surface": True, "normals": None, "mesh": None, "inner_left_out": None}
        skull["methods"]["insideout"]["mesh"] = None
        assert "- skull: the true attenuation has no surface, so no mesh is measured." in markdown(content)

    def test_a_truth_that_does_not_tell_its_surface_is_named(self, content, skull):
        skull["truth"] |= {"surface_unknown": True, "normals": None, "mesh": None, "inner_left_out": None}
        skull["methods"]["insideout"]["mesh"] = None
        assert "- skull: its truth.npz is from before the object's surfaces were kept" in markdown(content)

    def test_an_object_without_air_inside_has_no_inner_figures(self, content, skull):
        skull["truth"]["inner_left_out"] = 1.0
        text = part(markdown(content), "3. Meshes")
        assert "- skull: there are no inner figures, since at all of its inner surfaces two materials meet, or" in text
        assert "inner figures are of" not in text


class TestAblation:
    def test_each_row_has_its_x_ray_seconds(self, content):
        assert "| skull | none | 26.26 | – | 28.00 | 0.700 | 101 | 1.0 |" in markdown(content)

    def test_rows_that_are_known_no_more_stand_last(self, content, skull, row):
        skull["ablation"] = {"ablation/of_old": row("... a part of old", "xray", 29.0), **skull["ablation"]}
        text = markdown(content)
        assert text.index("| skull | none |") < text.index("| skull | ... a part of old |")

    def test_rows_say_what_was_taken_back_and_what_changes_nothing(self, content, skull, row):
        skull["ablation"] |= {
            "insideout": row("alignment + joint refinement", "both", 30.0),
            "ablation/without_outlines": row("... without outlines in the alignment", "both", 30.0),
            "apart": row("alignment + internal rendering", "both", 29.0, taken_back="projections fell"),
        }
        text = markdown(content)
        assert "| skull | ... without outlines in the alignment (changes nothing here) |" in text
        assert "| skull | alignment + internal rendering (sections not followed: projections fell) |" in text
        assert "| skull | alignment + joint refinement |" in text

    def test_a_line_says_what_the_joint_refinement_brings(self, content, skull, row):
        joint, apart, aligned = (
            row(label, "both", sections, photos={"psnr": photos, "ssim": 0.9})
            for label, sections, photos in (("joint", 30.0, 33.0), ("apart", 29.5, 33.4), ("aligned", 28.0, 30.0))
        )
        skull["ablation"] |= {"insideout": joint, "apart": apart}
        assert "the joint refinement brings" not in markdown(content)
        skull["alignment"]["refined"] = "joint"
        stages = "- skull: the joint refinement brings, against the paper's five stages +0.50 dB on sections and -0.40"
        assert f"{stages} dB on photos." in markdown(content)
        skull["ablation"]["ablation/align"] = aligned
        alone = "; against the alignment alone +2.00 dB on sections and +3.00 dB on photos."
        assert f"{stages} dB on photos{alone}" in markdown(content)


class TestFewerProjections:
    def test_rows_have_their_seconds_in_all_and_on_x_rays(self, content, skull, row):
        budget = {"iterations": 900, "seconds": 40.0}
        rival = row("R²-Gaussian", "xray", 24.0, 77.0, budget=budget, xray_seconds=30.0)
        skull["projections"]["25"]["r2_gaussian"] = rival
        text = part(markdown(content), "Fewer projections")
        assert "| skull | 25 | FDK | 33.33 | 21.21 | 22.00 | – | 60 |" in text
        assert "| skull | 25 | R²-Gaussian | – | – | 24.00 | 30 (-25%) (!) | 77 |" in text
        assert "include ITK-RTK being loaded" in text

    def test_of_x_rays_alone_the_methods_own_rows_are_those_with_all_projections(self, content, skull, row):
        figures = {"projections": {"psnr": 34.56}, "volume": {"psnr": 23.45}}
        skull["methods"]["fdk"] = row("FDK", "xray", 30.0, **figures)
        skull |= {"photos": 60, "training_projections": 75}
        assert "| skull | 75 |" not in part(markdown(content), "Fewer projections")
        skull["photos"] = None
        text = part(markdown(content), "Fewer projections")
        assert "| skull | 75 | FDK | 34.56 | 23.45 |" in text
        assert text.index("| skull | 75 | FDK |") < text.index("| skull | 25 | FDK |")


class TestTime:
    @pytest.mark.parametrize(
        ("seconds", "shown"),
        [
            (251, "251 (+0%)"),
            (263, "263 (+5%)"),
            (226, "226 (-10%) (!)"),
            (285, "285 (+14%) (!)"),
            (310, "310 (+24%) (!)"),
        ],
    )
    def test_a_row_that_did_not_take_its_time_is_marked(self, content, skull, seconds, shown):
        skull["methods"]["r2_gaussian"]["xray_seconds"] = seconds
        assert f"| skull | R²-Gaussian | 0.5 | 1000 | 4321 | 250 | {shown} |" in markdown(content)

    def test_a_row_of_another_machine_than_the_insideout_row_s_is_marked(self, content, skull):
        skull["methods"]["r2_gaussian"]["machine"] = OTHER_MACHINE
        text = part(markdown(content), "Time")
        assert "| skull | R²-Gaussian (!) other machine | 0.5 |" in text
        assert text.count("other machine") == 1

    def test_a_capture_without_x_rays_is_only_in_the_table_of_times(self, content):
        del content["captures"]["skull"]
        text = markdown(content)
        assert "Internal detail" not in text
        assert "| a vase | 3DGS | 1.0 | 1000 | – | – | – |" in text
        assert "- a vase: photos alone, so there is nothing that its inside could be measured against." in text


class TestHowItWasMeasured:
    def how(self, content):
        return part(markdown(content), "How it was measured")

    def test_it_stands_last_with_the_notes_of_the_rows_that_there_are(self, content, skull):
        skull["methods"]["r2_gaussian"]["note"] = "Its published numbers."
        skull["ablation"]["ablation/none"]["note"] = "Photos alone."
        text = self.how(content)
        assert "- R²-Gaussian: Its published numbers." in text
        assert "- none: Photos alone." in text
        assert markdown(content).rstrip().endswith(text.rstrip())

    def test_a_note_that_is_not_the_same_for_all_captures_names_them(self, content, skull):
        content["captures"]["head"] = deepcopy(skull)
        skull["methods"]["insideout"]["note"] = "Of both."
        content["captures"]["head"]["methods"]["insideout"]["note"] = "Of projections alone."
        text = self.how(content)
        assert "- InsideOut (skull): Of both." in text
        assert "- InsideOut (head): Of projections alone." in text

    def test_nothing_is_said_of_photo_rows_or_times_where_there_are_none(self, content, skull):
        assert "Occupancy, of photo rows" in self.how(content)
        assert "- R²-Gaussian: they get the projections and the time" in self.how(content)
        skull["methods"] = {"insideout": skull["methods"]["insideout"]}
        assert "photo rows" not in self.how(content)
        assert "they get the projections" not in self.how(content)

    def test_voxels_at_centres_and_voxels_of_averages_are_told_apart(self, content, skull):
        content["captures"]["head"] = {**skull, "truth": {**skull["truth"], "at_centers": True}}
        text = self.how(content)
        assert "- skull: voxels there count as averages" in text
        assert "- head: voxels there are values at their centres" in text

    def test_starts_are_told_of_where_there_are_some(self, content, skull):
        assert "a fifth to five times" in self.how(content)
        skull["alignment"]["starts"] = None
        assert "a fifth to five times" not in self.how(content)


def test_presets_that_were_chosen_on_an_object_are_told_of(content, skull):
    content["captures"]["real_head"] = skull
    text = part(markdown(content), "What it was measured against")
    assert "InsideOut's presets were chosen on true sections of skull, among others" in text
    assert "InsideOut's presets were not chosen on real_head." in text


def test_the_paper_is_not_spoken_of_beside_other_objects(content, skull):
    content["captures"] = {"a fly": skull}
    text = markdown(content)
    assert "- a fly: InsideOut +2.50 dB" in text
    assert "- paper:" not in text
    assert "“Paper” are the figures" not in text


def test_every_table_has_as_many_cells_in_each_line_whatever_a_capture_is_called(content, skull):
    content["captures"]["one | two"] = skull
    lines = markdown(content).splitlines()
    assert any(line.startswith("| one \\| two |") for line in lines)
    for before, line in pairwise(lines):
        if before.startswith("|") and line.startswith("|"):
            assert before.replace("\\|", "").count("|") == line.replace("\\|", "").count("|"), line


@pytest.mark.parametrize(
    ("part", "text"),
    [
        (None, "–"),
        (0.0, "0 %"),
        (0.002, "0.2 %"),
        (0.414, "41 %"),
        (0.9991, "99.9 %"),
        (0.9999, "100 %"),
        (1.0, "100 %"),
    ],
)
def test_shares_that_are_nearly_nothing_or_all_are_not_rounded_to_it(part, text):
    assert share(part) == text
