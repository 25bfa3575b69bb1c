"""The sidebar as it is drawn: with nothing, with a model, while the engine works, narrow and wide."""

from __future__ import annotations

import errno

import bpy
import numpy as np
import pytest

from insideout.core.effect_names import PHOTO_EFFECTS, XRAY_EFFECTS
from insideout.insideout_addon import effects
from insideout.insideout_addon.effects import possible_effects
from insideout.insideout_addon.engine import job
from insideout.insideout_addon.engine.commands import forecast_subject
from insideout.insideout_addon.remembered import forget
from insideout.insideout_addon.scene.importing import WARNINGS_KEY
from insideout.insideout_addon.scene.splats import RESIDUAL, write_values
from insideout.panels import CLASSES


@pytest.fixture
def imported(blender, tmp_path, random_set):
    random_set.save(tmp_path / "fused.ply")
    settings = bpy.context.scene.insideout
    settings.run = str(tmp_path)
    bpy.ops.insideout.import_run()
    return settings


def test_an_empty_scene(draw_panels, no_engine):
    forget()
    texts = draw_panels()
    assert {"Make Environment...", "Check Capture", "Import", "Add Section Plane"} <= set(texts)
    assert any(text.startswith("No engine yet") for text in texts)


def test_what_a_run_is_to_do_is_asked_when_there_is_a_capture(draw_panels, tmp_path):
    """Whoever opens a finished run would scroll past it all."""
    asked = {"Preset", "Estimate Times", "Effects", "Start Over", "Reconstruct"}
    texts = draw_panels(2000)
    assert "Choose a capture folder first, under Capture" in texts
    assert not asked & set(texts)
    bpy.context.scene.insideout.capture = str(tmp_path)
    texts = draw_panels(2000)
    assert "Choose a capture folder first, under Capture" not in texts
    assert asked <= set(texts)


def test_the_folder_of_a_run_is_called_the_same_where_it_is_made_and_opened(draw_panels, tmp_path):
    bpy.context.scene.insideout.capture = str(tmp_path)
    assert draw_panels().count("Run Folder") == 2


def test_a_run_to_import(draw_panels, tmp_path, random_set):
    bpy.context.scene.insideout.run = str(tmp_path)
    assert "holds no fused splats" in " ".join(draw_panels())
    random_set.save(tmp_path / "fused.ply")
    forget()
    assert "200 splats as ellipsoids" in draw_panels()


def test_a_model_and_its_section(draw_panels, imported):
    assert "Add Section Plane" in draw_panels()
    bpy.ops.insideout.section_add()
    texts = draw_panels()
    assert {"Save Section...", "Save Contours...", "As Curve", "Automatic Window"} <= set(texts)


def test_what_a_model_looks_like(draw_panels, imported):
    texts = draw_panels()
    assert {"Color By", "Photos", "Prepare Peeling", "Show All"} <= set(texts)
    assert "Peel (mm)" not in texts
    assert bpy.ops.insideout.look_prepare() == {"FINISHED"}
    texts = draw_panels()
    assert "Prepare Peeling" not in texts
    assert {"Color By", "Peel (mm)", "Layer (mm)", "Show All"} <= set(texts)
    assert {"Denser Than (mm⁻¹)", "Less Dense Than (mm⁻¹)"} <= set(texts)
    imported.unit = "HU"
    assert {"Denser Than (HU)", "Less Dense Than (HU)"} <= set(draw_panels())
    imported.unit = "PER_MM"
    imported.color_by = "MODALITY"
    assert "Photos yellow, X-rays blue, clones red" in draw_panels(width=2000)
    imported.color_by = "DENSITY"
    assert {"Colors", "Low (mm⁻¹)", "High (mm⁻¹)", "Automatic Window"} <= set(draw_panels())


def test_what_the_users_modifiers_change_is_said_to_be_in_no_section(draw_panels, imported):
    def told():
        return "are of the splats before your modifiers; apply those first" in " ".join(draw_panels(width=2000))

    bpy.ops.insideout.section_add()
    imported.peel_mm = 1.0
    assert not told(), "those that show and cut it are ours"
    crop = imported.model.modifiers.new("Crop", "NODES")
    crop.node_group = bpy.data.node_groups.new("Crop", "GeometryNodeTree")
    assert told()
    crop.show_viewport = False
    assert not told()


def test_residuals_that_are_missing_are_said_to_come_with_a_run(draw_panels, imported):
    imported.color_by = "RESIDUAL"
    texts = " ".join(draw_panels())
    assert "has no residuals, which need projections: press Reconstruct again" in texts
    assert "Up To (%)" not in texts


def test_residuals_have_a_scale(draw_panels, imported):
    forget()
    write_values(imported.model, RESIDUAL, np.linspace(0, 10, 200))
    imported.color_by = "RESIDUAL"
    assert "0 to 9.9 % of the largest line integral, dark to bright" in " ".join(draw_panels(width=2000))


def test_findings(draw_panels, tmp_path):
    settings = bpy.context.scene.insideout
    settings.capture = settings.checked = str(tmp_path)
    row = settings.findings.add()
    row.level, row.subject, row.message, row.advice = "warning", str(tmp_path / "xray"), "few angles", "scan more"
    texts = draw_panels()
    assert [text for text in texts if text in ("xray", "few angles", "scan more")] == [
        "xray",
        "few angles",
        "scan more",
    ]


def test_findings_stay_when_saving_writes_the_capture_s_path_in_another_way(draw_panels, tmp_path):
    settings = bpy.context.scene.insideout
    settings.capture = settings.checked = f"{tmp_path}/"
    settings.findings.add().message = "few angles"
    (tmp_path / "scenes").mkdir()
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "scenes" / "a.blend"))
    settings.capture = "//../"
    assert "few angles" in draw_panels()


def test_times_of_presets_are_shown_for_the_capture_that_they_are_about(draw_panels, tmp_path):
    settings, state = bpy.context.scene.insideout, bpy.context.window_manager.insideout
    settings.capture = str(tmp_path)
    state.forecast_of = forecast_subject(settings)
    for name, seconds, cameras in (("draft", 77.0, False), ("standard", 400.0, True)):
        row = state.forecasts.add()
        row.name, row.seconds, row.cameras = name, seconds, cameras
    texts = draw_panels(width=2000)
    assert {"Draft: ~75 s", "Standard: ~6.5 min, more to find cameras"} <= set(texts)
    assert not any("dB" in text for text in texts)
    assert "Estimate Times" in texts
    settings.refine = "apart"
    assert not any(text.startswith("Draft: about") for text in draw_panels())
    settings.refine, settings.capture = "joint", str(tmp_path / "other")
    assert not any(text.startswith("Draft: about") for text in draw_panels())


def test_what_presets_may_reach_stands_beside_their_times(draw_panels, tmp_path):
    settings, state = bpy.context.scene.insideout, bpy.context.window_manager.insideout
    settings.capture = str(tmp_path)
    state.forecast_of = forecast_subject(settings)
    for name, least, most in (("draft", 27.6, 31.2), ("standard", 33.8, 34.2)):
        row = state.forecasts.add()
        row.name, row.seconds, row.quality, row.least_db, row.most_db = name, 77.0, "projections", least, most
    texts = draw_panels()
    assert {"Draft: ~75 s, 28–31 dB", "Standard: ~75 s, ~34 dB"} <= set(texts)
    assert "dB: projections kept back, of simulated objects" in " ".join(texts)
    state.forecast_known = True
    assert "dB: projections kept back, told from this run" in " ".join(draw_panels())


@pytest.mark.parametrize("name", ["standard", "paper"])
def test_hours_and_decibels_of_a_preset_fit_on_a_line_of_a_sidebar_as_blender_opens_it(draw_panels, tmp_path, name):
    settings, state = bpy.context.scene.insideout, bpy.context.window_manager.insideout
    settings.capture = str(tmp_path)
    state.forecast_of = forecast_subject(settings)
    row = state.forecasts.add()
    row.name, row.seconds, row.quality, row.least_db, row.most_db = name, 5887.0, "photos", 31.8, 32.7
    assert f"{name.capitalize()}: ~1 h 40 min, 32–33 dB" in draw_panels(width=292)


@pytest.mark.parametrize("width", [240, 292])
def test_what_is_said_of_a_preset_beyond_a_line_is_not_cut_off(draw_panels, tmp_path, width):
    settings, state = bpy.context.scene.insideout, bpy.context.window_manager.insideout
    settings.capture = str(tmp_path)
    state.forecast_of = forecast_subject(settings)
    row = state.forecasts.add()
    row.name, row.seconds, row.cameras = "standard", 5887.0, True
    row.quality, row.least_db, row.most_db = "photos", 31.8, 32.7
    texts = draw_panels(width=width)
    first = next(index for index, text in enumerate(texts) if text.startswith("Standard:"))
    assert " ".join(texts[first : first + 3]).startswith("Standard: ~1 h 40 min, more to find cameras, 32–33 dB")
    assert max(map(len, texts[first : first + 3])) <= width / 7.2 - 6


PHOTO_BOXES = {"Room Behind a Turntable", "Exposure", "Rolling Shutter", "Defocus", "Motion Blur", "Pixel Area"}
# Where cameras are not given, structure from motion finds the lens with them.
POSED_BOXES = PHOTO_BOXES | {"Distortion by the Lens"}
XRAY_BOXES = {"Truncation", "Scatter", "Focal Spot", "Beam Hardening", "Motion", "Geometry", "Rings", "Noise"}


@pytest.mark.parametrize(
    ("made", "boxes"),
    [
        (["photos/"], PHOTO_BOXES),
        (["xray/meta_data.json"], XRAY_BOXES),
        (["Images/", "xray/scan.xtekct"], PHOTO_BOXES | XRAY_BOXES),
        (["photos/", "xray/volume.nrrd"], PHOTO_BOXES),
        (["a.jpg"], PHOTO_BOXES),
        (["sparse/0/cameras.bin", "train/"], POSED_BOXES),
        (["transforms_train.json", "train/"], POSED_BOXES),
        (["photos/transforms.json"], POSED_BOXES),
        (["sparse/0/", "train/"], set()),
        (["meta_data.json", "proj_train/", "preview.png"], XRAY_BOXES),
        (["a.jpg", "soft.nrrd", "bone.nrrd"], set()),
        (["photos/", "xray/first.xtekct", "xray/again.xtekct"], set()),
        ([], set()),
    ],
)
def test_effects_have_a_box_where_the_capture_can_have_them(draw_panels, tmp_path, made, boxes):
    for name in made:
        path = tmp_path / "capture" / name
        (path if name.endswith("/") else path.parent).mkdir(parents=True, exist_ok=True)
        if not name.endswith("/"):
            path.touch()
    (tmp_path / "capture").mkdir(exist_ok=True)
    forget()
    settings = bpy.context.scene.insideout
    settings.capture = str(tmp_path / "capture")
    assert "Effects" in draw_panels()
    assert not (POSED_BOXES | XRAY_BOXES) & set(draw_panels()), "nobody has asked for the list"
    settings.effects = "NAMED"
    texts = set(draw_panels())
    assert (POSED_BOXES | XRAY_BOXES) & texts == boxes
    assert ("No photos and no projections there" in texts) == (not boxes)


def test_boxes_that_exclude_each_other_are_told(draw_panels, tmp_path):
    (tmp_path / "photos").mkdir()
    forget()
    settings = bpy.context.scene.insideout
    settings.capture, settings.effects = str(tmp_path), "NAMED"
    settings.named_effects.motion_blur = True
    told = "Motion Blur cannot be learned beside Rolling Shutter or Defocus"
    assert told not in " ".join(draw_panels())
    settings.named_effects.defocus = True
    assert told in " ".join(draw_panels())


def test_a_capture_that_is_gone_has_no_effects(draw_panels, tmp_path):
    forget()
    settings = bpy.context.scene.insideout
    settings.capture, settings.effects = str(tmp_path / "gone"), "NAMED"
    assert "No photos and no projections there" in draw_panels()


def test_a_capture_whose_cameras_cannot_be_read_has_no_effects(draw_panels, tmp_path, monkeypatch):
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "a.png").write_bytes(b"")
    forget()
    assert possible_effects(str(tmp_path))

    def refuse(folder):
        raise PermissionError(errno.EACCES, "Permission denied", str(folder))

    monkeypatch.setattr(effects, "find_transforms", refuse)
    forget()
    assert possible_effects(str(tmp_path)) == ()


def test_there_is_a_box_for_every_effect_that_the_engine_knows(blender):
    settings = bpy.context.scene.insideout
    names = [p.identifier for p in settings.named_effects.bl_rna.properties if p.type == "BOOLEAN"]
    assert names == [*PHOTO_EFFECTS, *XRAY_EFFECTS]
    assert not any(getattr(settings.named_effects, name) for name in names)
    assert settings.effects == "NONE"


def test_a_running_job(draw_panels, make_engine):
    seen = []
    python = make_engine(
        "send('stage', stage='surface', state='started')\n"
        "for i in range(1, 5): send('progress', stage='surface', part='rgb', fraction=i / 10, iteration=i,"
        " iterations=10, loss=1 / i, heldout_psnr=20.0 + i, splats=5); time.sleep(0.1)\n"
        "send('done')\n"
    )
    command = [str(python), "-m", "insideout.core.worker", "run"]

    def look(message):
        job._handle(job._current[0], message)
        seen.append(draw_panels())

    state = bpy.context.window_manager.insideout
    running = job.Job(job.EngineProcess(command), "Reconstructing", lambda message: None, lambda message: None)
    job._current[:] = [running]
    try:
        running.process.wait(look)
    finally:
        job._finish(running)
    assert state.message == "Done"
    *_, last, _ = seen
    assert "Surface photos (2 of 5)  40 %" in last
    assert any(text.startswith("Surface") and text.endswith("24.0 dB") for text in last)
    assert "24.0 dB" in last
    assert "Cancel" in last
    assert "Reconstructing: done" in draw_panels()


def test_no_line_changes_its_place_from_the_start_of_a_run_to_its_end(draw_panels, make_engine, tmp_path):
    """A panel that grows or shrinks makes Blender slide all below it, frame by frame."""
    bpy.context.scene.insideout.capture = str(tmp_path)
    names = ("INSIDEOUT_PT_reconstruct", "INSIDEOUT_PT_run_curve", "INSIDEOUT_PT_progress")
    reconstruct = [cls for cls in CLASSES if cls.bl_idname in names]
    python = make_engine(
        "send('progress', stage='capture', fraction=0.5); time.sleep(0.2)\n"
        "send('stage', stage='surface', state='started'); time.sleep(0.2)\n"
        "send('progress', stage='surface', part='rgb', fraction=0.5, message='fitting', loss=0.1); time.sleep(0.2)\n"
        "send('stage', stage='surface', state='done', seconds=3.0)\n"
        "send('done')\n"
    )
    idle = draw_panels(classes=reconstruct)
    assert "Cancel" not in idle
    assert "Surface" not in idle
    command = [str(python), "-m", "insideout.core.worker", "run"]
    running = job.Job(job.EngineProcess(command), "Reconstructing", lambda message: None, lambda message: None)

    def look(message):
        job._handle(running, message)
        heights.append(len(draw_panels(classes=reconstruct)))

    job._reset_state("Reconstructing", "reconstruct")
    job._current[:] = [running]
    heights = [len(draw_panels(classes=reconstruct))]
    try:
        running.process.wait(look)
    finally:
        job._finish(running)
    assert len(heights) > 4
    assert set(heights) == {heights[0]}


def test_a_failure_stays_readable(draw_panels):
    state = bpy.context.window_manager.insideout
    state.title, state.error = "Reconstructing", "photos/: empty; add photos."
    assert "photos/: empty; add photos." in draw_panels()


def test_the_outcome_is_told_in_the_panel_that_asked(draw_panels):
    state = bpy.context.window_manager.insideout
    state.title, state.error = "Checking the capture", "no torch here"
    for panel in ("engine", "capture", "reconstruct"):
        state.panel = panel
        telling = [cls.bl_idname for cls in CLASSES if "no torch here" in draw_panels(classes=[cls])]
        assert telling == [f"INSIDEOUT_PT_{panel}"]


def test_a_check_under_way_does_not_say_that_nothing_was_found(draw_panels, make_engine, tmp_path):
    make_engine("time.sleep(0.2); send('finding', level='info', subject='x', message='fine'); send('done')\n")
    settings, drawn = bpy.context.scene.insideout, []
    settings.capture = settings.checked = f"{tmp_path}/"
    settings.findings.add().message = "of the last time"
    bpy.context.window_manager.insideout.panel = "capture"
    handle = job._handle
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(job, "_handle", lambda now, message: (drawn.append(draw_panels()), handle(now, message)))
        bpy.ops.insideout.check()
    assert len(drawn) == 2
    for texts in drawn:
        assert "No photos and no X-rays found" not in texts
        assert "of the last time" not in texts
        assert any("Checking the capture" in text for text in texts)
    assert "fine" in draw_panels()


def test_findings_on_the_capture_itself_have_its_name(draw_panels, tmp_path):
    """A file browser ends folders with a slash."""
    settings = bpy.context.scene.insideout
    settings.capture = settings.checked = f"{tmp_path}/"
    settings.findings.add().subject = str(tmp_path)
    texts = draw_panels()
    assert tmp_path.name in texts
    assert "." not in texts


def test_an_engine_that_is_not_where_it_was_is_told(draw_panels, no_engine, monkeypatch):
    monkeypatch.setenv("INSIDEOUT_ENGINE", "/gone/python")
    forget()
    assert "/gone/python: INSIDEOUT_ENGINE is not there" in " ".join(draw_panels())


def test_a_model_of_photos_alone_claims_neither_millimetres_nor_density(draw_panels, photo_run):
    bpy.context.scene.insideout.run = str(photo_run)
    bpy.ops.insideout.import_run()
    texts = draw_panels()
    assert {"Hide Background", "Lengths in an arbitrary unit: no X-ray", "photos: few photos"} <= set(texts)
    bpy.ops.insideout.section_add()
    texts = draw_panels()
    assert texts.count("Lengths in an arbitrary unit: no X-ray") == 2
    assert "Photos alone have no density to show" in texts
    assert {"Slab", "Position"} <= set(texts)
    assert "Photos alone have no depth and no density to peel by" in " ".join(texts)
    assert not any("mm" in text for text in texts)


def test_a_model_with_density_has_millimetres(draw_panels, imported):
    bpy.ops.insideout.section_add()
    texts = draw_panels()
    assert {"Slab (mm)", "Position (mm)", "X", "Y", "Z"} <= set(texts)
    assert not {"Hide Background", "Lengths in an arbitrary unit: no X-ray"} & set(texts)


def test_a_plane_without_a_model_and_a_box_have_no_position(draw_panels, imported):
    bpy.ops.insideout.section_add()
    bpy.ops.insideout.section_add_box()
    assert "Position (mm)" not in draw_panels()
    imported.section_index = 0
    assert "Position (mm)" in draw_panels()
    imported.model = None
    assert "Position (mm)" not in draw_panels()


def test_many_warnings_stay_short(draw_panels, imported):
    imported.model[WARNINGS_KEY] = "\n".join(["x" * 1000, "second", "third", "fourth", "fifth"])
    texts = draw_panels()
    assert 50 < sum(text.count("x" * 5) for text in texts) * 5 < 300
    assert "third" in texts
    assert "fourth" not in texts
    assert "2 more in report.json" in texts


@pytest.mark.parametrize("width", [1, 120, 2000])
def test_any_width(draw_panels, imported, width):
    """Blender gives a sidebar that is closed one pixel."""
    state = bpy.context.window_manager.insideout
    state.error = "/a/very/long/path" * 30 + ": cannot be read; choose another folder."
    texts = draw_panels(width)
    assert "".join(texts).count("/a/very/long/path") > 10
    assert "choose another" in " ".join(texts)
