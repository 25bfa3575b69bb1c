"""Measuring, as a script or a button does it."""

from __future__ import annotations

import csv
import math

import bpy
import numpy as np
import pytest
from mathutils import Matrix, Vector

from insideout.core.gaussians import GaussianSet, Modality
from insideout.insideout_addon.measure.probe_result import KEY, kept_probe
from insideout.insideout_addon.measure.rulers import AREA_KEY, LENGTH_KEY, POINTS_KEY, TEXT_KEY, rulers
from insideout.insideout_addon.measure.thickness_map import COLOR, FIGURE_KEY, VALUE, thickness_maps
from insideout.insideout_addon.scene.section import shown_plane
from insideout.insideout_addon.scene.splats import create_splats
from insideout.insideout_addon.scene.weighing import CENTER_NAME


def _points(*places):
    for thing in bpy.context.view_layer.objects:
        thing.select_set(False)
    for place in places:
        assert bpy.ops.insideout.point_add(location=place) == {"FINISHED"}


class TestPoints:
    def test_a_point_is_put_at_the_cursor_in_the_models_frame(self, model):
        model.matrix_world = Matrix.LocRotScale((5, 6, 7), Matrix.Rotation(0.7, 3, "X"), (0.001,) * 3)
        bpy.context.view_layer.update()
        bpy.context.scene.cursor.location = model.matrix_world @ Matrix.Translation((1, 2, 3)).translation
        bpy.ops.insideout.point_add()
        bpy.context.view_layer.update()
        point = bpy.data.objects["InsideOut Point"]
        assert tuple(point.location) == pytest.approx((1, 2, 3), abs=1e-3)
        assert (point.matrix_world.translation - bpy.context.scene.cursor.location).length < 1e-5

    def test_after_a_measurement_the_next_point_begins_another(self, model):
        _points((0, 0, 0), (3, 4, 12))
        bpy.ops.insideout.measure()
        for place in ((0, 0, 0), (0, 0, 5)):
            bpy.ops.insideout.point_add(location=place)
        bpy.ops.insideout.measure()
        assert sorted(ruler[TEXT_KEY] for ruler in rulers(bpy.context.scene)) == ["13.00 mm", "5.00 mm"]

    def test_points_that_were_measured_can_be_chosen_again_with_another(self, model):
        _points((3, 0, 0), (0, 0, 0))
        bpy.ops.insideout.measure()
        bpy.ops.insideout.point_add(location=(0, 4, 0))
        for point in bpy.context.scene.objects:
            point.select_set(point.type == "EMPTY")
        bpy.ops.insideout.measure()
        assert sorted(ruler[TEXT_KEY] for ruler in rulers(bpy.context.scene)) == ["3.00 mm", "90.0°, 6.00 mm²"]

    def test_a_distance_is_in_mm_whatever_the_models_scale(self, model):
        model.scale = (0.001,) * 3
        _points((0, 0, 0), (3, 4, 12))
        assert bpy.ops.insideout.measure() == {"FINISHED"}
        (ruler,) = rulers(bpy.context.scene)
        assert ruler[TEXT_KEY] == "13.00 mm"
        assert ruler[LENGTH_KEY] == pytest.approx(13.0, rel=1e-5)
        assert [child.data.body for child in ruler.children] == ["13.00 mm"]
        bpy.context.view_layer.update()
        ends = [(ruler.matrix_world @ point.co).to_3d() for point in ruler.data.splines[0].points]
        assert (ends[0] - ends[1]).length == pytest.approx(0.013, rel=1e-4)

    def test_three_points_have_an_angle_and_an_area(self, model):
        _points((4, 0, 0), (0, 0, 0), (0, 3, 0))
        bpy.ops.insideout.measure()
        (ruler,) = rulers(bpy.context.scene)
        assert ruler[TEXT_KEY] == "90.0°, 6.00 mm²"
        assert ruler[AREA_KEY] == pytest.approx(6.0)
        assert sorted(child.data.body for child in ruler.children) == ["6.00 mm²", "90.0°"]
        ends = [{tuple(point.co[:3]) for point in spline.points} for spline in ruler.data.splines]
        assert ends == [{(4, 0, 0), (0, 0, 0)}, {(0, 0, 0), (0, 3, 0)}, {(0, 3, 0), (4, 0, 0)}]

    def test_points_that_were_moved_are_measured_anew(self, model):
        _points((0, 0, 0), (3, 4, 0))
        bpy.ops.insideout.measure()
        bpy.data.objects["InsideOut Point.001"].location.z = 12
        bpy.ops.insideout.measure()
        (ruler,) = rulers(bpy.context.scene)
        assert ruler[TEXT_KEY] == "13.00 mm"
        assert ruler[POINTS_KEY].splitlines() == ["InsideOut Point", "InsideOut Point.001"]
        assert [thing.data.body for thing in bpy.data.objects if thing.type == "FONT"] == ["13.00 mm"] * 2

    def test_other_points_have_their_own_line(self, model):
        _points((0, 0, 0), (1, 0, 0))
        bpy.ops.insideout.measure()
        _points((0, 0, 0), (0, 2, 0))
        bpy.ops.insideout.measure()
        assert [ruler[TEXT_KEY] for ruler in rulers(bpy.context.scene)] == ["1.00 mm", "2.00 mm"]

    def test_new_points_by_the_names_of_deleted_ones_have_their_own_line(self, model):
        _points((0, 0, 0), (1, 0, 0))
        bpy.ops.insideout.measure()
        bpy.ops.object.delete()
        _points((0, 0, 0), (0, 2, 0))
        bpy.ops.insideout.measure()
        one, other = rulers(bpy.context.scene)
        assert one[POINTS_KEY] == other[POINTS_KEY], "Blender gives names again"
        assert [one[TEXT_KEY], other[TEXT_KEY]] == ["1.00 mm", "2.00 mm"]

    def test_points_are_measured_in_the_order_they_were_added(self, model):
        """The one that takes a deleted one's name is the last still."""
        _points((9, 9, 9), (4, 0, 0), (0, 0, 0))
        bpy.data.objects.remove(bpy.data.objects["InsideOut Point"])
        bpy.ops.insideout.point_add(location=(0, 3, 0))
        assert bpy.context.active_object.name == "InsideOut Point"
        bpy.ops.insideout.measure()
        assert [ruler[TEXT_KEY] for ruler in rulers(bpy.context.scene)] == ["90.0°, 6.00 mm²"]

    def test_points_that_were_renamed_are_the_same(self, model):
        _points((0, 0, 0), (3, 4, 0))
        bpy.ops.insideout.measure()
        bpy.data.objects["InsideOut Point"].name = "left"
        bpy.data.objects["InsideOut Point.001"].name = "a right one"
        bpy.ops.insideout.measure()
        (ruler,) = rulers(bpy.context.scene)
        assert ruler[POINTS_KEY].splitlines() == ["left", "a right one"]

    def test_points_that_were_duplicated_have_their_own_line(self, model):
        _points((0, 0, 0), (1, 0, 0))
        bpy.ops.insideout.measure()
        bpy.ops.object.duplicate()
        copies = sorted(bpy.context.selected_objects, key=lambda point: point.name)
        copies[1].location = (0, 2, 0)
        for _ in range(2):
            bpy.ops.insideout.measure()
            assert [ruler[TEXT_KEY] for ruler in rulers(bpy.context.scene)] == ["1.00 mm", "2.00 mm"]

    def test_points_of_older_files_are_known_by_their_names(self, model):
        _points((4, 0, 0), (0, 0, 0))
        bpy.ops.insideout.measure()
        (ruler,) = rulers(bpy.context.scene)
        del ruler["insideout_point_numbers"]
        for point in bpy.context.selected_objects:
            point["insideout_point"] = True
        bpy.data.objects["InsideOut Point"].location = (5, 0, 0)
        bpy.ops.insideout.measure()
        assert [ruler[TEXT_KEY] for ruler in rulers(bpy.context.scene)] == ["5.00 mm"]
        old = bpy.context.selected_objects
        bpy.ops.insideout.point_add(location=(0, 3, 0))
        for point in old:
            point.select_set(True)
        bpy.ops.insideout.measure()
        assert rulers(bpy.context.scene)[1][TEXT_KEY] == "90.0°, 7.50 mm²"

    def test_one_point_alone_cannot_be_measured(self, model):
        _points((0, 0, 0))
        assert not bpy.ops.insideout.measure.poll()

    def test_an_empty_that_is_no_point_is_not_measured(self, model):
        bpy.ops.insideout.weigh(calibration="WATER")
        bpy.ops.insideout.weigh_center()
        _points((0, 0, 0))
        marker = next(thing for thing in bpy.data.objects if thing.name == CENTER_NAME)
        marker.select_set(True)
        assert not bpy.ops.insideout.measure.poll()
        bpy.ops.insideout.point_add(location=(3, 4, 0))
        assert not marker.select_get()
        bpy.ops.insideout.measure()
        (ruler,) = rulers(bpy.context.scene)
        assert ruler[TEXT_KEY] == "5.00 mm"

    def test_points_may_be_called_something_else(self, model):
        _points((0, 0, 0), (3, 4, 0))
        for thing, name in zip(bpy.context.selected_objects, ("left", "right"), strict=True):
            thing.name = name
        bpy.ops.insideout.measure()
        assert [ruler[TEXT_KEY] for ruler in rulers(bpy.context.scene)] == ["5.00 mm"]

    def test_lengths_of_photos_alone_have_no_unit(self, blender, photo_run):
        bpy.ops.insideout.import_run(filepath=str(photo_run / "fused.ply"))
        _points((0, 0, 0), (3, 4, 0))
        bpy.ops.insideout.measure()
        assert rulers(bpy.context.scene)[0][TEXT_KEY] == "5.00", "their lengths have no unit"

    def test_points_are_measured_on_the_model_that_they_were_put_on(self, blender, photo_run, model, capfd):
        """Not in the unit, or at the scale, of the one that is shown by now."""
        bpy.ops.insideout.import_run(filepath=str(photo_run / "fused.ply"))
        photos = bpy.context.scene.insideout.model
        _points((0, 0, 0), (3, 4, 0))
        bpy.context.scene.insideout.model = model
        model.scale = (0.5,) * 3
        assert bpy.ops.insideout.measure() == {"FINISHED"}
        (ruler,) = rulers(bpy.context.scene, photos)
        assert ruler[TEXT_KEY] == "5.00"
        assert f"On {photos.name}: 5.00" in capfd.readouterr().out

    def test_between_models_there_is_no_length_where_one_has_no_unit(self, blender, photo_run, model):
        _points((0, 0, 0))
        bpy.ops.insideout.import_run(filepath=str(photo_run / "fused.ply"))
        bpy.ops.insideout.point_add(location=(1, 0, 0))
        for thing in bpy.context.scene.objects:
            thing.select_set(thing.type == "EMPTY")
        with pytest.raises(RuntimeError, match="on several models"):
            bpy.ops.insideout.measure()

    def test_another_models_points_are_not_measured_with_the_next(self, model):
        _points((0, 0, 0))
        other = model.copy()
        bpy.context.scene.collection.objects.link(other)
        bpy.context.scene.insideout.model = other
        bpy.ops.insideout.point_add(location=(1, 0, 0))
        assert [point.parent for point in bpy.context.selected_objects] == [other]

    def test_where_the_active_collection_takes_none_they_come_into_the_scene_s_own(self, linked_collection, model):
        _points((0, 0, 0), (3, 4, 0))
        for _ in range(2):
            assert bpy.ops.insideout.measure() == {"FINISHED"}
            (ruler,) = rulers(bpy.context.scene)
            assert (ruler.name, ruler[TEXT_KEY]) == ("InsideOut Measure", "5.00 mm")
        assert not linked_collection.objects

    def test_a_line_stays_where_its_points_cannot_be_measured_again(self, model):
        """As where an attribute of the splats, by whose extent lines are drawn, has become another one."""
        _points((0, 0, 0), (3, 4, 0))
        bpy.ops.insideout.measure()
        things = sorted(bpy.data.objects.keys())
        model.data.attributes.remove(model.data.attributes["density"])
        model.data.attributes.new("density", "FLOAT_VECTOR", "POINT")
        with pytest.raises(RuntimeError, match="'density' is of the type FLOAT_VECTOR"):
            bpy.ops.insideout.measure()
        with pytest.raises(RuntimeError, match="'density' is of the type FLOAT_VECTOR"):
            bpy.ops.insideout.point_add(location=(1, 1, 1))
        assert sorted(bpy.data.objects.keys()) == things
        assert bpy.data.objects["InsideOut Measure"][TEXT_KEY] == "5.00 mm"

    def test_without_a_model_there_is_nothing_to_measure(self, blender):
        assert not bpy.ops.insideout.point_add.poll()
        assert not bpy.ops.insideout.probe.poll()


class TestProbe:
    def test_at_a_given_place(self, model, center):
        assert bpy.ops.insideout.probe(point=(8, -2, 1)) == {"FINISHED"}
        kept = bpy.context.scene[KEY]
        assert kept["density"] == pytest.approx(0.04 * math.exp(-0.5), rel=1e-5)
        assert kept["distance_mm"] == pytest.approx(5.0, rel=1e-5)
        assert tuple(kept["center_mm"]) == pytest.approx(center)
        assert kept["modality"] == int(Modality.XRAY)

    def test_far_away_there_is_no_density(self, model, capfd):
        bpy.ops.insideout.probe(point=(1e5, -2, 1))
        assert bpy.context.scene[KEY]["density"] == 0.0
        assert "Density 0 mm⁻¹;" in capfd.readouterr().out

    def test_at_the_cursor_through_the_models_place(self, model):
        model.location, model.scale = (50, 0, 0), (2, 2, 2)
        bpy.context.view_layer.update()
        bpy.context.scene.cursor.location = (50 + 2 * 3, 2 * -2, 2 * (1 + 5))
        bpy.ops.insideout.probe()
        assert tuple(bpy.context.scene[KEY]["point_mm"]) == pytest.approx((3, -2, 6))
        assert bpy.context.scene[KEY]["density"] == pytest.approx(0.04 * math.exp(-0.5), rel=1e-4)

    def test_other_figures_of_edited_splats_are_not_told(self, shell):
        scene, model = bpy.context.scene, shell.model
        bpy.ops.insideout.probe(point=(23, -2, 1))
        found = kept_probe(scene, model)
        assert found.density > 0
        density = model.data.attributes["density"].data
        before = density[found.nearest].value
        density[found.nearest].value = 0.5
        assert kept_probe(scene, model) is None
        density[found.nearest].value = before
        assert kept_probe(scene, model) == found
        model.data.attributes["position"].data[found.nearest].vector.x += 1
        assert kept_probe(scene, model) is None

    @pytest.mark.parametrize("kind", ["FLOAT_VECTOR", None])
    def test_of_splats_without_densities_none_are_told(self, shell, kind):
        """The panel asks whenever it is drawn."""
        scene, model = bpy.context.scene, shell.model
        bpy.ops.insideout.probe(point=(23, -2, 1))
        model.data.attributes.remove(model.data.attributes["density"])
        if kind:
            model.data.attributes.new("density", kind, "POINT")
        assert kept_probe(scene, model) is None

    def test_figures_of_a_model_that_has_won_or_lost_splats_are_not_told(self, model, random_set):
        bpy.ops.insideout.probe(point=(8, -2, 1))
        one = model.data
        assert kept_probe(bpy.context.scene, model) is not None
        model.data = create_splats(random_set, "more", bpy.context).data
        assert kept_probe(bpy.context.scene, model) is None
        model.data = one
        assert kept_probe(bpy.context.scene, model) is not None

    def test_a_model_without_size_is_told(self, model):
        model.scale = (0, 0, 0)
        bpy.context.view_layer.update()
        with pytest.raises(RuntimeError, match="scaled to nothing"):
            bpy.ops.insideout.probe()


class TestThickness:
    def test_a_hollow_ball_is_equally_thick(self, shell, half_of_the_top):
        """Across the wall the density is nearly a Gaussian of σ 1.5 mm: half of its top is 3.53 mm apart."""
        shell.level = half_of_the_top()
        assert bpy.ops.insideout.thickness() == {"FINISHED"}
        (drawn,) = thickness_maps(bpy.context.scene)
        assert drawn[FIGURE_KEY + "median_mm"] == pytest.approx(2 * 1.5 * math.sqrt(2 * math.log(2)), rel=0.06)
        assert drawn[FIGURE_KEY + "measured"] > 0.9

    def test_the_map_is_a_mesh_in_the_colours_of_the_thickness(self, shell, center):
        bpy.ops.insideout.thickness()
        (drawn,) = thickness_maps(bpy.context.scene)
        mesh = drawn.data
        thickness = np.empty(len(mesh.vertices), np.float32)
        mesh.attributes[VALUE].data.foreach_get("value", thickness)
        color = np.empty(4 * len(mesh.vertices), np.float32)
        mesh.attributes[COLOR].data.foreach_get("color", color)
        brightness = color.reshape(-1, 4)[:, :3].sum(axis=1)
        assert brightness[thickness.argmax()] < brightness[np.where(thickness > 0, thickness, np.inf).argmin()]
        assert drawn.parent == shell.model
        places = np.array([vertex.co for vertex in mesh.vertices])
        radius = np.linalg.norm(places - center, axis=1)
        assert 15 < np.percentile(radius, 1) < np.percentile(radius, 99) < 25
        legend = [child.data.body for child in drawn.children if child.type == "FONT"]
        assert "mm" in legend
        assert float(legend[0]) == pytest.approx(drawn[FIGURE_KEY + "least_mm"], rel=0.02)

    def test_the_legend_says_that_thicker_walls_have_its_last_colour_too(
        self, shell, tmp_path, hollow_ball, cut_through_its_middle, center
    ):
        bpy.ops.insideout.thickness()
        assert float(self._legend()[4]) == pytest.approx(self._figure("most_mm"), abs=0.01), "nearly of one thickness"
        lump = GaussianSet.create([np.add(center, (0, 0, 40))], 4.0, density=0.1, modality=Modality.XRAY)
        cut_through_its_middle(GaussianSet.concatenate([hollow_ball(40, 6000), lump]), tmp_path / "lumpy.ply")
        bpy.ops.insideout.thickness()
        assert self._figure("most_mm") > 1.5 * self._figure("p95_mm")
        least, *between, most = self._legend()[:5]
        assert most.startswith("≥ ")
        assert float(most[2:]) == pytest.approx(self._figure("p95_mm"), abs=0.01)
        assert float(least) == pytest.approx(self._figure("least_mm"), abs=0.01)
        assert not any("≥" in text for text in between)

    def _legend(self):
        return [child.data.body for child in thickness_maps(bpy.context.scene)[-1].children if child.type == "FONT"]

    def _figure(self, name):
        return thickness_maps(bpy.context.scene)[-1][FIGURE_KEY + name]

    def test_its_legend_is_light_with_a_dark_rim(self, shell):
        bpy.ops.insideout.thickness()
        (drawn,) = thickness_maps(bpy.context.scene)
        labels = [child for child in drawn.children if child.type == "FONT"]
        assert len(labels) > 2
        for label in labels:
            (casing,) = label.children
            assert casing.data.body == label.data.body
            assert min(label.data.materials[0].diffuse_color[:3]) > 0.9
            assert max(casing.data.materials[0].diffuse_color[:3]) < 0.1
            height = (shown_plane(bpy.context.scene).matrix_world.inverted() @ casing.matrix_world.translation).z
            assert height > casing.data.bevel_depth, "above the section's picture"

    def test_the_next_map_takes_its_place(self, shell):
        bpy.ops.insideout.thickness()
        objects = len(bpy.data.objects)
        shown_plane(bpy.context.scene).location.y += 4
        bpy.context.view_layer.update()
        bpy.ops.insideout.thickness()
        assert len(thickness_maps(bpy.context.scene)) == 1
        assert len(bpy.data.objects) == objects

    def test_what_a_user_parented_to_a_map_stays_with_the_next(self, shell):
        bpy.ops.insideout.thickness()
        (drawn,) = thickness_maps(bpy.context.scene)
        strip = next(child for child in drawn.children if child.type == "MESH")
        mesh = bpy.data.meshes.new("InsideOut Copy")
        for parent in (drawn, strip):
            thing = bpy.data.objects.new(f"My {parent.name}", mesh)
            bpy.context.scene.collection.objects.link(thing)
            thing.parent, thing.location = parent, (1, 2, 3)
        bpy.context.view_layer.update()
        mine = [thing for thing in bpy.data.objects if thing.data == mesh]
        places = [thing.matrix_world.copy() for thing in mine]
        bpy.ops.insideout.thickness()
        bpy.context.view_layer.update()
        (drawn,) = thickness_maps(bpy.context.scene)
        assert [thing.parent for thing in mine] == [drawn] * 2
        np.testing.assert_allclose([thing.matrix_world for thing in mine], places, rtol=1e-5, atol=1e-5)

    def test_where_the_active_collection_takes_none_it_comes_into_the_scene_s_own(self, shell, linked_collection):
        for _ in range(2):
            assert bpy.ops.insideout.thickness() == {"FINISHED"}
            (drawn,) = thickness_maps(bpy.context.scene)
            assert drawn.name == "InsideOut Thickness"
        assert not linked_collection.objects

    def test_as_a_table(self, shell, tmp_path):
        assert bpy.ops.insideout.thickness_save(filepath=str(tmp_path / "walls.csv")) == {"FINISHED"}
        bpy.ops.insideout.contours_save(filepath=str(tmp_path / "contours.csv"))
        with open(tmp_path / "walls.csv", encoding="utf-8") as stream:
            walls = list(csv.DictReader(stream))
        with open(tmp_path / "contours.csv", encoding="utf-8") as stream:
            contours = list(csv.DictReader(stream))
        thickness = [row.pop("thickness_mm") for row in walls]
        assert walls == contours
        known = [float(value) for value in thickness if value]
        assert len(known) > 0.8 * len(thickness)
        assert 2 < np.median(known) < 6

    def test_no_edge_is_told(self, shell, tmp_path):
        shell.level = 10.0
        with pytest.raises(RuntimeError, match="meets no edge"):
            bpy.ops.insideout.thickness()
        with pytest.raises(RuntimeError, match="meets no edge"):
            bpy.ops.insideout.thickness_save(filepath=str(tmp_path / "walls.csv"))

    def test_it_needs_a_section(self, model):
        assert not bpy.ops.insideout.thickness.poll()


class TestAfterATransform:
    """*Apply Transform to Splats* changes the frame in which everything was measured."""

    @pytest.fixture
    def apply(self):
        def apply(model, matrix):
            bpy.context.view_layer.objects.active = model
            model.matrix_world = matrix
            assert bpy.ops.insideout.apply_transform() == {"FINISHED"}
            bpy.context.view_layer.update()

        return apply

    def test_lines_are_measured_again_where_they_are(self, model, apply):
        _points((3, 0, 0), (0, 0, 0), (0, 4, 0))
        bpy.ops.insideout.measure()
        (ruler,) = rulers(bpy.context.scene)
        turn = Matrix.LocRotScale((5, 6, 7), Matrix.Rotation(0.7, 3, "X"), (2, 2, 2))
        expected = [turn @ Vector(place) for place in ((3, 0, 0), (0, 0, 0), (0, 4, 0))]
        apply(model, turn)
        assert rulers(bpy.context.scene) == [ruler]
        assert ruler[TEXT_KEY] == "90.0°, 24.00 mm²"
        assert ruler[AREA_KEY] == pytest.approx(24.0, rel=1e-5)
        assert sorted(child.data.body for child in ruler.children) == ["24.00 mm²", "90.0°"]
        ends = [(ruler.matrix_world @ spline.points[0].co).to_3d() for spline in ruler.data.splines]
        np.testing.assert_allclose(ends, expected, atol=1e-4)
        before = ruler[TEXT_KEY]
        bpy.ops.object.select_all(action="DESELECT")
        for thing in bpy.data.objects:
            thing.select_set(thing.type == "EMPTY")
        bpy.ops.insideout.measure()
        assert [other[TEXT_KEY] for other in rulers(bpy.context.scene)] == [before], "its points give the same"

    def test_an_uneven_scale_is_one_too(self, model, apply):
        _points((0, 0, 0), (3, 4, 0))
        bpy.ops.insideout.measure()
        apply(model, Matrix.Diagonal((2, 1, 1, 1)))
        (ruler,) = rulers(bpy.context.scene)
        assert ruler[LENGTH_KEY] == pytest.approx(math.hypot(6, 4), rel=1e-5)

    def test_walls_are_to_be_measured_again_where_their_thickness_has_changed(self, shell, apply, capsys):
        bpy.ops.insideout.thickness()
        apply(shell.model, Matrix.Diagonal((2, 2, 2, 1)))
        assert thickness_maps(bpy.context.scene) == []
        assert "press Wall Thickness again" in capsys.readouterr().out

    def test_walls_that_were_only_moved_keep_their_thickness(self, shell, apply):
        bpy.ops.insideout.thickness()
        (drawn,) = thickness_maps(bpy.context.scene)
        least, thinnest = drawn[FIGURE_KEY + "least_mm"], Vector(drawn[FIGURE_KEY + "thinnest_mm"])
        turn = Matrix.LocRotScale((5, 6, 7), Matrix.Rotation(0.7, 3, "X"), None)
        apply(shell.model, turn)
        assert thickness_maps(bpy.context.scene) == [drawn]
        assert drawn[FIGURE_KEY + "least_mm"] == least
        np.testing.assert_allclose(drawn[FIGURE_KEY + "thinnest_mm"], turn @ thinnest, atol=1e-4)

    def test_the_last_probe_is_forgotten(self, model, apply):
        bpy.ops.insideout.probe(point=(1, 2, 3))
        apply(model, Matrix.Translation((1, 0, 0)))
        assert KEY not in bpy.context.scene
