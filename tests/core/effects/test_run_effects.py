"""Effects in a run: looked for once, kept in its folder, and the same for every stage that follows."""

import json
import shutil
from dataclasses import replace
from unittest.mock import ANY

import numpy as np
import pytest
import torch
from PIL import Image

from insideout.core.capture.background import foreground_mask
from insideout.core.capture.model import Capture, Photos
from insideout.core.capture.read import read_capture
from insideout.core.capture.registered import save_photos
from insideout.core.effects import Exposure
from insideout.core.effects.choose import Choice
from insideout.core.effects.kept import FILE
from insideout.core.effects.request import parse_effects
from insideout.core.errors import RunFolderError, SettingError
from insideout.core.phantoms.photos import BACKGROUND, exposed
from insideout.core.pipeline import reconstruct
from insideout.core.run_folder import RunFolder
from insideout.core.settings import Settings
from insideout.core.stages import effect_gains
from insideout.core.stages.context import StageContext
from insideout.core.stages.effects import FILES, NUMBERS, RunEffects, keep_choice
from insideout.core.stages.initialize.photos import first_splats
from insideout.core.stages.photo_effects import look_at_photos

OFFSET_PX = 1.5


@pytest.fixture(scope="module")
def scan(scans):
    return scans.displaced_scan(OFFSET_PX)


@pytest.fixture
def capture(scan, tmp_path):
    return Capture(tmp_path / "capture", projections=scan, digest="a scan")


def initialized(capture, tmp_path, effects):
    """The context of the stages after `initialize`."""
    settings = replace(Settings.of("draft"), effects=effects)
    reconstruct(capture, tmp_path / effects, settings=settings, stages=["initialize"])
    return StageContext(capture, RunFolder(tmp_path / effects))


def test_later_stages_get_projections_from_where_the_detector_stood(capture, scan, tmp_path):
    context = initialized(capture, tmp_path, "auto")
    rows = {row["name"]: row for row in context.effects.rows("xray")}
    assert rows["geometry"]["seconds"] > 0
    assert {name for name, row in rows.items() if row["used"]} == {"geometry"}
    assert {name for name, row in rows.items() if "gain_db" in row} == {"geometry"}
    assert rows["geometry"]["gain_db"] > 1
    first, given = context.projections.detectors[0], scan.detectors[0]
    assert (first.center - given.center) @ given.u / (given.u @ given.u) == pytest.approx(OFFSET_PX, abs=0.1)
    assert np.array_equal(context.projections.images, scan.images)
    plain = initialized(capture, tmp_path, "none")
    assert np.abs(context.run.volume().values - plain.run.volume().values).max() > 0.005


def test_later_stages_know_what_is_known_of_noisy_pixels(capture, scan, tmp_path):
    projections = initialized(capture, tmp_path, "noise").projections
    assert projections.images is scan.images
    assert 1 / projections.noise.per_photon == pytest.approx(50_000, rel=0.3)
    assert 1 / 50_000 < projections.noise.most < 1e-3
    assert projections.noise.floor < projections.noise.most
    assert projections.noise.known >= 0.003 * scan.peak(np.flatnonzero(~scan.held_out))


def test_without_effects_there_is_nothing_of_them(capture, scan, tmp_path):
    context = initialized(capture, tmp_path, "none")
    assert context.projections is scan
    assert not list((context.run.path / "initialize").glob("*effects*"))


def test_a_run_begun_anew_without_effects_does_not_go_on_with_those_found_before(capture, scan, tmp_path):
    run = initialized(capture, tmp_path, "geometry").run
    assert RunEffects(run.path / "initialize").used("xray") == ["geometry"]
    settings = replace(Settings.of("draft"), effects="none")
    reconstruct(capture, run.path, settings=settings, stages=["initialize"], fresh=True)
    assert StageContext(capture, run).projections is scan


def test_a_run_without_that_setting_was_made_without_effects(capture, tmp_path):
    context = initialized(capture, tmp_path, "none")
    marker = context.run.path / "settings.json"
    before = json.loads(marker.read_text())
    del before["effects"]
    marker.write_text(json.dumps(before))
    initialized(capture, tmp_path, "none")
    marker.write_text(json.dumps(before))
    with pytest.raises(RunFolderError, match="was made with effects none, not auto"):
        reconstruct(capture, context.run.path, settings=replace(Settings.of("draft"), effects="auto"))


def test_the_same_effects_in_another_order_are_the_same_run(capture, tmp_path, monkeypatch):
    monkeypatch.setattr(effect_gains, "STEPS", 30)
    for effects in ("geometry,scatter", "scatter, geometry"):
        settings = replace(Settings.of("draft"), effects=effects)
        reconstruct(capture, tmp_path / "run", settings=settings, stages=["initialize"])
    # As earlier versions wrote it.
    marker = tmp_path / "run" / "settings.json"
    marker.write_text(marker.read_text("utf-8").replace("geometry,scatter", "scatter, geometry"), "utf-8")
    settings = replace(Settings.of("draft"), effects="geometry,scatter")
    reconstruct(capture, tmp_path / "run", settings=settings, stages=["initialize"])
    with pytest.raises(RunFolderError, match=r"effects geometry,scatter, not geometry"):
        reconstruct(capture, tmp_path / "run", settings=replace(Settings.of("draft"), effects="geometry"))


def test_what_cannot_be_is_refused_before_anything_is_made(capture, tmp_path):
    with pytest.raises(SettingError, match="exposure is an effect of photos, and the capture has none"):
        initialized(capture, tmp_path, "exposure")
    assert not (tmp_path / "exposure" / "settings.json").exists()


def test_numbers_come_back_as_they_were(tmp_path):
    choice = Choice([{"name": "geometry", "used": True}], {"geometry": {"shift_mm": np.arange(6.0), "times": 3}})
    keep_choice(tmp_path, "xray", choice)
    numbers = RunEffects(tmp_path).numbers["geometry"]
    assert np.array_equal(numbers["shift_mm"], np.arange(6.0))
    assert numbers["times"] == 3


def test_damaged_numbers_are_no_clean_capture(tmp_path):
    keep_choice(tmp_path, "xray", Choice([{"name": "geometry", "used": True}], {"geometry": {"shift_mm": np.ones(2)}}))
    (tmp_path / NUMBERS).write_bytes(b"half")
    with pytest.raises(RunFolderError, match="run the stage initialize again"):
        _ = RunEffects(tmp_path).numbers


def test_effects_of_photos_are_learnt_where_they_are_asked_for(tiny_capture, tiny_settings, tmp_path):
    settings = replace(tiny_settings, effects="exposure,pixel_integration")
    out = tmp_path / "run"
    report = reconstruct(tiny_capture, out, settings=settings, stages=["initialize", "surface"])
    rgb = report["stages"]["surface"]["rgb"]
    assert np.array(rgb["effects"]["exposure"]["gain"]).shape[1] == 3
    assert rgb["options"]["pixel_integration"] is True
    assert [row["chosen_by"] for row in RunEffects(out / "initialize").rows("photos")] == ["user", "user"]


@pytest.fixture
def exposures(tiny_capture, tmp_path):
    """The tiny capture's photos, of exposures up to a stop and more apart."""
    photos = tmp_path / "exposures" / "photos"
    shutil.copytree(tiny_capture / "photos", photos)
    for index, path in enumerate(sorted(photos.glob("*.jpg"))):
        pixels = exposed(np.asarray(Image.open(path)), (0.5 + 0.2 * (index % 5),) * 3)
        Image.fromarray(pixels).save(path, quality=95, subsampling=0)
    return read_capture(photos.parent)


@pytest.mark.parametrize("found", [True, False])
def test_photos_of_several_exposures_are_found(found, exposures, tiny_capture, tiny_settings, tmp_path):
    capture = exposures if found else read_capture(tiny_capture).photos_only()
    settings = replace(tiny_settings, effects="auto")
    reconstruct(capture, tmp_path / "run", settings=settings, stages=["initialize"])
    effects = RunEffects(tmp_path / "run" / "initialize")
    rows = {row["name"]: row for row in effects.rows("photos")}
    assert (rows["exposure"]["found"], rows["pixel_integration"]["found"]) == (found, False)
    assert rows["exposure"]["seconds"] > 0
    assert effects.photos == ((Exposure(),) if found else ())
    assert [name for name, row in rows.items() if row.get("gain_db", 0) > 0.3] == (["exposure"] if found else [])
    assert [name for name, row in rows.items() if row.get("times_as_long", 0) > 0] == (["exposure"] if found else [])


def _trained(settings, **rgb):
    """Settings whose photos are trained otherwise."""
    surface = settings.stages["surface"]
    return replace(settings, stages={**settings.stages, "surface": replace(surface, rgb=replace(surface.rgb, **rgb))})


@pytest.mark.parametrize("cut_out", [True, False])
def test_what_is_put_behind_cut_out_objects_has_no_exposure(cut_out, tiny_capture, tiny_settings, tmp_path):
    photos = tmp_path / "capture" / "photos"
    shutil.copytree(tiny_capture / "photos", photos)
    for path in sorted(photos.glob("*.jpg")) if cut_out else []:
        pixels = np.asarray(Image.open(path))
        clear = ~foreground_mask(pixels / 255, BACKGROUND)
        Image.fromarray(np.dstack([pixels, np.where(clear, 0, 255).astype(np.uint8)])).save(path, "PNG")
    settings, out = _trained(tiny_settings, effects=(Exposure(),)), tmp_path / "run"
    report = reconstruct(photos.parent, out, settings=settings, stages=["initialize", "surface"])
    put = report["stages"]["surface"]["rgb"]["background"] if cut_out else None
    learnt = torch.load(out / "surface" / FILE, weights_only=True)["state"]["exposure"]
    assert learnt["behind"] == (put and tuple(put))


def test_photos_that_are_trained_smaller_are_looked_at_anew(tiny_capture, tiny_settings, tmp_path):
    """What a pixel spans hangs on it; `surface` alone may be made again, and then has the findings of its own size."""
    capture, out = read_capture(tiny_capture).photos_only(), tmp_path / "run"
    side = max(capture.photos.photos[0].camera.width, capture.photos.photos[0].camera.height)

    def run(long_side, stages, mip_filter=False):
        settings = _trained(replace(tiny_settings, effects="auto"), long_side=long_side, mip_filter=mip_filter)
        report = reconstruct(capture, out, settings=settings, stages=stages)
        found = {row["name"]: row for row in RunEffects(out / "initialize").rows("photos")}["pixel_integration"]
        return report["stages"]["surface"]["rgb"]["options"]["pixel_integration"], found

    used, found = run(side, ["initialize", "surface"])
    assert (used, found["used"]) == (False, False)
    used, smaller = run(side // 2, ["surface"])
    assert (used, smaller["found"], smaller["used"]) == (True, True, True)
    assert smaller["strength"] == pytest.approx(2.0, rel=0.05)
    used, fainter = run(side // 2, ["surface"], mip_filter=True)
    assert (used, fainter["found"], fainter["strength"]) == (False, False, smaller["strength"])
    assert run(side, ["surface"]) == (False, {**found, "seconds": ANY})


def test_photos_that_are_trained_as_before_are_looked_at_once(tiny_capture, tiny_settings, tmp_path, monkeypatch):
    capture, out = read_capture(tiny_capture).photos_only(), tmp_path / "run"
    settings = replace(tiny_settings, effects="pixel_integration")
    reconstruct(capture, out, settings=settings, stages=["initialize"])

    def look(*_):
        raise AssertionError("looked at again")

    monkeypatch.setattr("insideout.core.effects.choose.look_at_photos", look)
    reconstruct(capture, out, settings=settings, stages=["surface"])
    with pytest.raises(AssertionError, match="looked at again"):
        reconstruct(capture, out, settings=_trained(settings, effects=(Exposure(),)), stages=["surface"])


@pytest.mark.parametrize("most", [50_000, 5_000])
@pytest.mark.parametrize("known", ["points", "points and colours", "nothing"])
def test_random_points_are_not_the_objects(known, most, photographs, cameras, tmp_path, monkeypatch):
    """They fill the viewed ball where there is no hull and hardly any point: its front is no depth of edges."""
    rng = np.random.default_rng(0)
    points, colors = rng.normal(0, 20, (450, 3)), rng.choice([0.2, 0.7], size=(450, 3))
    noise = [rng.random((24, 24, 3)) for _ in cameras]
    taken = photographs.saved(tmp_path / "photos", [camera.resized(24, 24) for camera in cameras], noise)
    photos = Photos(
        taken,
        points=None if known == "nothing" else points,
        colors=colors if known == "points and colours" else None,
    )
    run = RunFolder(tmp_path / "run")
    context = StageContext(Capture(tmp_path, photos=photos), run, request=parse_effects("auto"))
    save_photos(run.stage("initialize") / "photos.json", photos)
    splats, found = first_splats(context, photos, 0, most, 0.1, 0)
    run.write_set("initialize", "rgb", splats)
    assert found["random"] > 0
    seen = []

    def look(request, evidence, given):
        seen.append(evidence.points)
        return Choice()

    monkeypatch.setattr("insideout.core.effects.choose.look_at_photos", look)
    look_at_photos(context, "initialize", 0.7)
    sparse = set() if known == "nothing" else {tuple(point) for point in points.astype(np.float32).tolist()}
    assert {tuple(point) for point in seen[0].tolist()} <= sparse
    assert len(seen[0]) == len(sparse) if most > 10_500 else len(seen[0]) >= 0.3 * len(sparse)


def test_findings_of_an_older_version_are_read_and_looked_at_anew(tmp_path):
    """It kept the rows alone, and no word of how photos were to be trained."""
    (tmp_path / FILES["photos"]).write_text(json.dumps([{"name": "exposure", "used": True}]), "utf-8")
    effects = RunEffects(tmp_path)
    assert effects.used("photos") == ["exposure"]
    assert effects.looked_at("photos") == {}


@pytest.mark.parametrize("content", ["{", "{}", "3"])
def test_damaged_findings_are_told(content, tmp_path):
    (tmp_path / FILES["photos"]).write_text(content, "utf-8")
    with pytest.raises(RunFolderError, match="run the stage initialize again"):
        RunEffects(tmp_path).rows("photos")
