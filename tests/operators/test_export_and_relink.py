"""Export, relink and Apply, as a script, a button or a menu calls them."""

from __future__ import annotations

from types import SimpleNamespace
from unittest.mock import MagicMock

import bpy
import numpy as np
import pytest

import insideout
from insideout.core import fingerprint, ply
from insideout.core.gaussians import GaussianSet
from insideout.insideout_addon.remembered import forget
from insideout.insideout_addon.scene import provenance
from insideout.insideout_addon.scene.display import display_modifier
from insideout.insideout_addon.scene.node_tree import modifier_input, set_modifier_input
from insideout.insideout_addon.scene.sources import SOURCE_KEY
from insideout.insideout_addon.scene.splats import DENSITY_HERE, WATER_KEY, read_values
from insideout.operators import apply_transform, menus, relink


@pytest.fixture
def imported(blender, tmp_path, random_set):
    random_set.save(tmp_path / "run" / "fused.ply")
    settings = bpy.context.scene.insideout
    settings.run, settings.view_dependent = str(tmp_path / "run"), True
    assert bpy.ops.insideout.import_run() == {"FINISHED"}
    return settings


class TestExport:
    """File > Export > Gaussian Splats."""

    def test_what_was_edited_is_in_the_file(self, imported, tmp_path, random_set):
        imported.model.location.x = 7
        assert bpy.ops.insideout.export_file(filepath=str(tmp_path / "out.ply")) == {"FINISHED"}
        np.testing.assert_allclose(
            GaussianSet.load(tmp_path / "out.ply").means, random_set.means + np.array([7, 0, 0]), atol=1e-4
        )

    def test_beside_the_blend(self, imported, tmp_path):
        bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "a.blend"))
        bpy.ops.insideout.export_file(filepath="//out.ply")
        assert (tmp_path / "out.ply").is_file()

    def test_options(self, imported, tmp_path, random_set):
        imported.model.scale = (2, 2, 2)
        imported.model[WATER_KEY] = 0.03
        bpy.ops.insideout.export_file(filepath=str(tmp_path / "a.ply"))
        bpy.ops.insideout.export_file(filepath=str(tmp_path / "b.ply"), density="LINE_INTEGRALS")
        material, integrals = (GaussianSet.load(tmp_path / name).density for name in ("a.ply", "b.ply"))
        np.testing.assert_allclose(material, random_set.density)
        np.testing.assert_allclose(integrals, random_set.density / 2, rtol=1e-6)
        water = [provenance.provenance_in_comments(tmp_path / name)["water_per_mm"] for name in ("a.ply", "b.ply")]
        assert water == pytest.approx([0.03, 0.015]), "so that HU stay what they are"

    @pytest.mark.parametrize("density", ["MATERIAL", "LINE_INTEGRALS"])
    def test_scaled_to_nothing_is_told(self, imported, tmp_path, density):
        imported.model.scale.z = 0
        with pytest.raises(RuntimeError, match="squeezes it flat") as told:
            bpy.ops.insideout.export_file(filepath=str(tmp_path / "out.ply"), density=density)
        assert "Traceback" not in str(told.value)
        assert not (tmp_path / "out.ply").exists()

    def test_damage_is_told_without_a_file(self, imported, tmp_path):
        data = imported.model.data
        data.attributes.remove(data.attributes["rotation"])
        with pytest.raises(RuntimeError, match="lost the attribute 'rotation'"):
            bpy.ops.insideout.export_file(filepath=str(tmp_path / "out.ply"))
        assert not (tmp_path / "out.ply").exists()

    @pytest.mark.parametrize("visible_only", [False, True])
    def test_ended_early_scene_and_file_are_as_they_were(self, imported, tmp_path, monkeypatch, visible_only):
        monkeypatch.setattr(ply, "_BLOCK", 4)
        path, cls = tmp_path / "out.ply", bpy.types.INSIDEOUT_OT_export_file
        path.write_bytes(b"older")
        pressed = SimpleNamespace(
            filepath=str(path), visible_only=visible_only, density="MATERIAL", report=lambda *_: None
        )
        things, files = sorted(bpy.data.objects.keys()), sorted(tmp_path.iterdir())
        for count in range(1, 100):
            steps = cls.steps(pressed, bpy.context)
            shares = []
            for _, share in zip(range(count), steps, strict=False):
                shares.append(share)
                assert sorted(bpy.data.objects.keys()) == things
            if len(shares) < count:
                break
            steps.close()
            assert (sorted(tmp_path.iterdir()), path.read_bytes()) == (files, b"older"), f"after {count} steps"
        assert count > 5
        assert shares == sorted(shares)
        assert len(GaussianSet.load(path)) > 0

    def test_a_model_that_is_taken_away_in_a_break_is_told_without_a_file(self, imported, tmp_path):
        told, path = [], tmp_path / "out.ply"
        pressed = SimpleNamespace(
            filepath=str(path), visible_only=False, density="MATERIAL", report=lambda _, text: told.append(text)
        )
        steps = bpy.types.INSIDEOUT_OT_export_file.steps(pressed, bpy.context)
        next(steps)
        data = bpy.context.scene.insideout.model.data
        bpy.data.objects.remove(bpy.context.scene.insideout.model)
        bpy.data.pointclouds.remove(data)
        list(steps)
        assert told == ["The model was edited or undone before it was exported; press the button again."]
        assert not path.exists()

    def test_splats_that_are_edited_meanwhile_are_not_mixed_with_those_before(self, imported, tmp_path, random_set):
        """In a second window, for instance; an object that is moved or shown otherwise is exported as it was."""
        told, path = [], tmp_path / "out.ply"
        pressed = SimpleNamespace(
            filepath=str(path), visible_only=False, density="MATERIAL", report=lambda _, text: told.append(text)
        )
        cls, model = bpy.types.INSIDEOUT_OT_export_file, bpy.context.scene.insideout.model
        steps = cls.steps(pressed, bpy.context)
        next(steps)
        model.location.x += 1
        model.update_tag()
        model.modifiers[0].show_viewport = False
        bpy.context.view_layer.update()
        list(steps)
        assert "saved as out.ply" in told.pop()
        model.location.x -= 1
        np.testing.assert_allclose(GaussianSet.load(path).means, random_set.means, atol=1e-4)
        path.unlink()
        steps = cls.steps(pressed, bpy.context)
        for _ in range(4):
            next(steps)
        model.data.attributes["scale"].data[0].vector.x *= 2
        model.data.update_tag()
        bpy.context.view_layer.update()
        list(steps)
        assert told == ["The model was edited or undone before it was exported; press the button again."]
        assert not path.exists()

    def test_a_place_that_cannot_be_written_is_told(self, imported, tmp_path):
        (tmp_path / "file").write_text("", "utf-8")
        with pytest.raises(RuntimeError, match="file"):
            bpy.ops.insideout.export_file(filepath=str(tmp_path / "file" / "out.ply"))

    def test_without_a_model_there_is_nothing_to_export(self, blender):
        assert not bpy.ops.insideout.export_file.poll()
        bpy.ops.mesh.primitive_cube_add()
        assert not bpy.ops.insideout.export_file.poll()


class TestRelink:
    """A run that is not where it was."""

    @pytest.fixture
    def moved(self, imported, tmp_path):
        forget()
        return (tmp_path / "run").rename(tmp_path / "archive")

    def test_the_panel_asks_for_it_only_then(self, draw_panels, imported, tmp_path):
        assert "Relink..." not in draw_panels()
        (tmp_path / "run").rename(tmp_path / "archive")
        forget()
        texts = draw_panels()
        assert "fused.ply is missing" in texts
        assert "Relink..." in texts
        assert bpy.ops.insideout.relink(filepath=str(tmp_path / "archive")) == {"FINISHED"}
        assert "Relink..." not in draw_panels()

    def test_the_run_of_the_panel_follows(self, imported, moved):
        bpy.ops.insideout.relink(filepath=str(moved / "fused.ply"))
        assert bpy.path.abspath(imported.run) == str(moved)

    def test_another_model_is_told_and_taken_only_if_asked(self, imported, moved, one_ball):
        one_ball.save(moved / "fused.ply")
        with pytest.raises(RuntimeError, match="another model than run fused: 1 splats, not 200"):
            bpy.ops.insideout.relink(filepath=str(moved))
        assert bpy.ops.insideout.relink(filepath=str(moved), other_model=True) == {"FINISHED"}

    def test_sections_of_a_ct_that_was_out_of_reach_are_drawn_again(self, imported, moved, monkeypatch):
        marked = []
        monkeypatch.setattr(relink.live, "mark", marked.append)
        bpy.ops.insideout.relink(filepath=str(moved))
        assert marked == [bpy.context.scene]

    @pytest.mark.parametrize("chosen", ["", "/no/such/place"])
    def test_nothing_chosen(self, imported, moved, chosen):
        with pytest.raises(RuntimeError, match="is not there"):
            bpy.ops.insideout.relink(filepath=chosen)

    def test_ended_between_any_two_steps_all_models_are_as_they_were(self, imported, moved, monkeypatch):
        monkeypatch.setattr(fingerprint, "_BLOCKS", 8)
        monkeypatch.setattr(fingerprint, "_BLOCK_BYTES", 256)
        cls, settings = bpy.types.INSIDEOUT_OT_relink, bpy.context.scene.insideout
        known = provenance.provenance_of(settings.model)
        known["file"]["fingerprint"] = fingerprint.fingerprint(moved / "fused.ply")
        provenance.keep_provenance(settings.model, known)
        other = settings.model.copy()
        other.name = "other"
        bpy.context.scene.collection.objects.link(other)
        pressed = SimpleNamespace(filepath=str(moved), other_model=False, report=lambda *_: None)

        def sources():
            return settings.run, [thing[SOURCE_KEY] for thing in (settings.model, other)]

        before = sources()
        for count in range(1, 1000):
            steps, shares = cls.steps(pressed, bpy.context), []
            for _, share in zip(range(count), steps, strict=False):
                shares.append(share)
            if len(shares) < count:
                break
            steps.close()
            assert sources() == before, f"after {count} steps"
        assert count > 8
        assert shares == sorted(shares)
        assert sources()[1] == [str(moved / "fused.ply")] * 2

    def test_a_model_that_is_taken_away_in_a_break_is_told(self, imported, moved):
        told = []
        pressed = SimpleNamespace(filepath=str(moved), other_model=False, report=lambda _, text: told.append(text))
        steps = bpy.types.INSIDEOUT_OT_relink.steps(pressed, bpy.context)
        next(steps)
        bpy.data.objects.remove(bpy.context.scene.insideout.model)
        list(steps)
        assert told == ["The model was undone before it was relinked; press the button again."]

    def test_without_a_model_there_is_nothing_to_relink(self, blender):
        assert not bpy.ops.insideout.relink.poll()


class TestApplyTransform:
    """Object > Apply > Transform to Splats."""

    def test_the_object_goes_back_and_the_splats_do_not(self, imported, random_set):
        model = imported.model
        model.location.x = 7
        assert bpy.ops.insideout.apply_transform() == {"FINISHED"}
        assert tuple(model.location) == (0, 0, 0)
        assert model.data.attributes["position"].data[0].vector.x == pytest.approx(random_set.means[0, 0] + 7, abs=1e-4)

    @pytest.mark.parametrize(("kept", "factor"), [("MATERIAL", 1.0), ("LINE_INTEGRALS", 0.5)])
    def test_a_scale_is_of_the_object_or_corrects_its_size(self, imported, random_set, kept, factor):
        before = {"density": random_set.density}
        bpy.ops.insideout.look_prepare()
        before[DENSITY_HERE] = read_values(imported.model, DENSITY_HERE)
        display = display_modifier(imported.model)
        set_modifier_input(display, "Minimum Density", 0.01)
        imported.model.scale = (2.0,) * 3
        assert bpy.ops.insideout.apply_transform(density=kept) == {"FINISHED"}
        for name, values in before.items():
            np.testing.assert_allclose(read_values(imported.model, name), factor * values, rtol=1e-4, atol=1e-6)
        assert modifier_input(display, "Minimum Density") == pytest.approx(0.01 * factor)

    @pytest.mark.parametrize("size", [1.0, 2.0])
    def test_it_is_asked_where_the_object_is_scaled(self, imported, monkeypatch, size):
        """With nothing to choose there is no dialog."""
        imported.model.scale = (size,) * 3
        manager, told = MagicMock(), SimpleNamespace(execute=lambda context: "done")
        manager.invoke_props_dialog.return_value = "asked"
        context = SimpleNamespace(view_layer=bpy.context.view_layer, window_manager=manager)
        asked = apply_transform.INSIDEOUT_OT_apply_transform.ask(told, context)
        assert asked == ("done" if size == 1.0 else "asked")

    def test_scaled_to_nothing_is_told(self, imported):
        imported.model.scale.y = 0
        with pytest.raises(RuntimeError, match="squeezes it flat"):
            bpy.ops.insideout.apply_transform()

    def test_it_is_for_splats(self, blender):
        bpy.ops.mesh.primitive_cube_add()
        assert not bpy.ops.insideout.apply_transform.poll()


def test_menus_have_lines_while_the_add_on_is_enabled(imported):
    lines = list(menus._lines())
    assert len(lines) == 3
    assert all(draw in menu._dyn_ui_initialize() for menu, draw in lines)
    insideout.unregister()
    try:
        assert not any(draw in menu._dyn_ui_initialize() for menu, draw in lines)
    finally:
        insideout.register()


def test_menus_draw(draw_panels, imported):
    classes = [
        type("Menu", (), {"draw": lambda self, context, draw=draw: draw(self, context)}) for _, draw in menus._lines()
    ]
    assert draw_panels(classes=classes) == [
        "Gaussian Splats (.ply)",
        "Gaussian Splats (.ply)",
        "InsideOut Assets (.blend)",
        "Transform to Splats...",
    ]
