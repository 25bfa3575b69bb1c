"""Another model is chosen under Shown: what of the scene's settings follows it, and what stays."""

from __future__ import annotations

import json

import bpy
import pytest

from insideout.core.affine import Kept
from insideout.insideout_addon.scene.display import display_modifier
from insideout.insideout_addon.scene.importing import BODY_KEY, import_splats
from insideout.insideout_addon.scene.node_tree import modifier_input
from insideout.insideout_addon.scene.placement import apply_transform


@pytest.fixture
def settings(blender):
    return bpy.context.scene.insideout


@pytest.fixture
def of_a_scan(settings, tmp_path, random_set):
    """`of_a_scan(water)`: a model whose scan was converted with that water, mm⁻¹; None: not from Hounsfield units."""

    def bring(water):
        run = tmp_path / str(water)
        random_set.save(run / "fused.ply")
        (run / "report.json").write_text(json.dumps({"stages": {}, "water_per_mm": water}), "utf-8")
        return import_splats(run / "fused.ply", str(water), bpy.context)

    return bring


def test_water_is_that_of_the_chosen_models_scan(settings, of_a_scan):
    waters = 0.0206, 0.022, None
    models = {water: of_a_scan(water) for water in waters}
    for water in (*waters, *reversed(waters)):
        settings.model = models[water]
        assert settings.water == pytest.approx(water or 0.0195), f"{water} chosen"


def test_water_is_not_that_of_a_model_that_was_deleted(settings, of_a_scan):
    first, second = of_a_scan(0.0206), of_a_scan(0.022)
    bpy.data.objects.remove(second)
    settings.model = first
    assert settings.water == pytest.approx(0.0206)


def test_water_that_followed_a_corrected_size_is_that_model_s_alone(settings, of_a_scan):
    first, second = of_a_scan(0.0206), of_a_scan(0.022)
    settings.model = first
    first.scale = (2.0,) * 3
    bpy.context.view_layer.update()
    apply_transform(first, Kept.LINE_INTEGRALS)
    assert settings.water == pytest.approx(0.0103)
    for model, water in ((second, 0.022), (first, 0.0103)):
        settings.model = model
        assert settings.water == pytest.approx(water)


def test_a_water_of_the_users_stays(settings, of_a_scan):
    models = [of_a_scan(water) for water in (0.0206, None, 0.022)]
    settings.water = 0.02
    for model in models:
        settings.model = model
        assert settings.water == pytest.approx(0.02)


def _hides_background(model):
    return modifier_input(display_modifier(model), "Farthest") > 0


def test_the_background_of_the_chosen_model_is_hidden_as_the_setting_says(settings, photo_run):
    first, second = (import_splats(photo_run / "fused.ply", name, bpy.context) for name in ("first", "second"))
    settings.hide_background = False
    settings.model = first
    assert not _hides_background(first)
    settings.hide_background = True
    settings.model = second
    assert modifier_input(display_modifier(second), "Farthest") == pytest.approx(second[BODY_KEY])


def test_a_linked_model_keeps_its_background(blender, photo_run, tmp_path):
    splats = import_splats(photo_run / "fused.ply", "photos", bpy.context)
    bpy.data.libraries.write(str(tmp_path / "library.blend"), {splats})
    bpy.ops.wm.read_homefile(use_empty=True)
    with bpy.data.libraries.load(str(tmp_path / "library.blend"), link=True) as (_, wanted):
        wanted.objects = ["photos"]
    (linked,) = wanted.objects
    bpy.context.scene.collection.objects.link(linked)
    bpy.context.scene.insideout.hide_background = False
    bpy.context.scene.insideout.model = linked
    assert _hides_background(linked)
