"""Sheets of sections, histograms and tables as files, as a script or a button makes them."""

from __future__ import annotations

import csv
import math
from dataclasses import replace
from types import SimpleNamespace

import bpy
import numpy as np
import pytest

from insideout.insideout_addon.measure import of_scene
from insideout.insideout_addon.measure.of_scene import scene_look
from insideout.insideout_addon.measure.sheet import draw_sheet_in_steps


class TestSheet:
    @pytest.mark.parametrize(("count", "told"), [(1, "1 section saved as s.pdf"), (2, "2 sections saved as s.pdf")])
    def test_one_section_is_told_in_the_singular(self, shell, tmp_path, capfd, count, told):
        bpy.ops.insideout.section_sheet(filepath=str(tmp_path / "s.pdf"), count=count, dots_per_inch=50)
        assert told in capfd.readouterr().out

    def test_as_a_picture(self, shell, tmp_path, read_png):
        bpy.ops.insideout.section_sheet(filepath=str(tmp_path / "s.png"), axis="Z", count=4, dots_per_inch=50)
        pixels, per_metre, texts = read_png(tmp_path / "s.png")
        assert sorted(round(side / per_metre * 1000) for side in pixels.shape[:2]) == [210, 297]
        assert texts["Title"] == shell.model.name
        assert (pixels.min(axis=2) < 100).mean() > 0.01
        edges = np.concatenate([pixels[:20].ravel(), pixels[-20:].ravel(), pixels[:, -20:].ravel()])
        assert (edges == 255).all(), "margins stay white"

    @pytest.mark.parametrize("axis", ["X", "PLANE"])
    def test_as_pdf(self, shell, tmp_path, axis):
        bpy.ops.insideout.section_sheet(filepath=str(tmp_path / "s.pdf"), axis=axis, count=3, dots_per_inch=50)
        content = (tmp_path / "s.pdf").read_bytes()
        assert content.startswith(b"%PDF-1.7")
        # Overview, three sections, colour bar.
        assert content.count(b"/Subtype /Image") == 5

    def test_in_real_size(self, shell, tmp_path):
        bpy.ops.insideout.section_sheet(filepath=str(tmp_path / "s.pdf"), count=20, real_size=True, dots_per_inch=50)
        box = (tmp_path / "s.pdf").read_bytes().split(b"/MediaBox [0 0 ")[1].split(b"]")[0]
        assert sorted(round(float(side) / 72 * 25.4) for side in box.split()) == [297, 420]

    def test_parallel_to_a_flipped_plane_they_are_seen_as_its_face_is(self, shell, tmp_path, monkeypatch):
        drawn = []

        def draw(splats, series, *rest):
            drawn.append(series)
            return draw_sheet_in_steps(splats, series, *rest)

        monkeypatch.setattr(of_scene, "draw_sheet_in_steps", draw)
        for flip in (False, True):
            shell.sections[0].flip = flip
            bpy.ops.insideout.section_sheet(filepath=str(tmp_path / "s.png"), axis="PLANE", count=2, dots_per_inch=50)
        above, below = drawn
        np.testing.assert_allclose([below.right, below.down, below.along], [-above.right, above.down, -above.along])

    def test_parallel_to_the_plane_needs_one(self, model, tmp_path):
        with pytest.raises(RuntimeError, match="no section plane"):
            bpy.ops.insideout.section_sheet(filepath=str(tmp_path / "s.png"), axis="PLANE")

    def test_before_the_first_section_it_is_as_with_one(self, shell, tmp_path):
        bpy.ops.insideout.section_sheet(filepath=str(tmp_path / "with.png"), count=2, dots_per_inch=50)
        bpy.ops.insideout.section_remove()
        for name in ("low", "high"):
            shell.property_unset(name)
        bpy.ops.insideout.section_sheet(filepath=str(tmp_path / "without.png"), count=2, dots_per_inch=50)
        assert (tmp_path / "with.png").read_bytes() == (tmp_path / "without.png").read_bytes()
        assert not shell.is_property_set("high")

    def test_another_models_is_of_its_own_densities(self, shell, tmp_path, hollow_ball):
        """With the window of the one before it would be blank."""
        bpy.ops.insideout.section_remove()
        high = shell.high
        fainter = hollow_ball(20, 1500)
        replace(fainter, density=0.01 * fainter.density).save(tmp_path / "fainter.ply")
        bpy.ops.insideout.import_run(filepath=str(tmp_path / "fainter.ply"))
        assert scene_look(bpy.context.scene).window.high == pytest.approx(0.01 * high, rel=1e-3)
        shell.high = 0.5 * high
        assert scene_look(bpy.context.scene).window.high == shell.high, "the user's own"

    def test_other_kinds_of_files_are_refused(self, model, tmp_path):
        with pytest.raises(RuntimeError, match=r"\.pdf or \.png"):
            bpy.ops.insideout.section_sheet(filepath=str(tmp_path / "s.svg"))

    def test_the_file_is_as_it_was(self, shell, tmp_path):
        before = [len(bpy.data.objects), len(bpy.data.curves), len(bpy.data.meshes), len(bpy.data.images)]
        bpy.ops.insideout.section_sheet(filepath=str(tmp_path / "s.png"), count=2, dots_per_inch=50)
        assert [len(bpy.data.objects), len(bpy.data.curves), len(bpy.data.meshes), len(bpy.data.images)] == before


class TestHistogram:
    def test_relative_densities_claim_no_unit(self, shell, tmp_path):
        shell.model["insideout_warnings"] = "volume.tif: so densities are relative"
        bpy.ops.insideout.histogram_save(filepath=str(tmp_path / "h.csv"), of="MODEL")
        assert "per_mm" not in (tmp_path / "h.csv").read_text("utf-8")

    def test_of_the_model(self, shell, tmp_path, half_of_the_top):
        bpy.ops.insideout.histogram_save(filepath=str(tmp_path / "h.csv"), of="MODEL")
        with open(tmp_path / "h.csv", encoding="utf-8") as stream:
            rows = list(csv.DictReader(stream))
        # The box of what has a quarter of the top: √(2 ln 4) σ around 20 mm, and half a cell.
        side = 2 * (20 + 1.5 * math.sqrt(2 * math.log(4)) + 0.4)
        assert sum(float(row["volume_mm3"]) for row in rows) == pytest.approx(side**3, rel=0.05)
        half = half_of_the_top()
        dense = sum(float(row["volume_mm3"]) for row in rows if float(row["density_from_per_mm"]) > half)
        inner, outer = (20 + way * 1.5 * math.sqrt(2 * math.log(2)) for way in (-1, 1))
        assert dense == pytest.approx(4 / 3 * math.pi * (outer**3 - inner**3), rel=0.06)

    def test_of_the_section_as_a_picture(self, shell, tmp_path, read_png):
        bpy.ops.insideout.histogram_save(filepath=str(tmp_path / "h.png"), of="SECTION")
        pixels, per_metre, _ = read_png(tmp_path / "h.png")
        assert pixels.shape[1] / per_metre * 1000 == pytest.approx(180, abs=0.5)
        bpy.ops.insideout.histogram_save(filepath=str(tmp_path / "h.pdf"), of="SECTION")
        assert (tmp_path / "h.pdf").read_bytes().startswith(b"%PDF")

    def test_of_the_section_needs_one(self, model, tmp_path):
        with pytest.raises(RuntimeError, match="Add Section Plane"):
            bpy.ops.insideout.histogram_save(filepath=str(tmp_path / "h.png"), of="SECTION")

    def test_photos_alone_have_none(self, blender, photo_run):
        bpy.ops.insideout.import_run(filepath=str(photo_run / "fused.ply"))
        assert not bpy.ops.insideout.histogram_save.poll()
        assert not bpy.ops.insideout.section_sheet.poll()

    def test_other_kinds_of_files_are_refused(self, model, tmp_path):
        with pytest.raises(RuntimeError, match=r"\.png, \.pdf or \.csv"):
            bpy.ops.insideout.histogram_save(filepath=str(tmp_path / "h.txt"))


class TestStopping:
    """Files that take long to make, ended between their steps."""

    SHEET = {"axis": "Z", "count": 3, "real_size": False, "dots_per_inch": 100.0}  # noqa: RUF012

    @pytest.fixture(params=["sheet.pdf", "sheet.png", "histogram.png", "walls.csv", "outlines.csv", "outlines.svg"])
    def work(self, request, shell, tmp_path):
        """Begins it with an operator's settings, where there is a file of that name already."""
        path = tmp_path / request.param
        path.write_bytes(b"older")
        kinds = {"histogram": "histogram_save", "walls": "thickness_save", "outlines": "contours_save"}
        kind = kinds.get(path.stem, "section_sheet")
        settings = {"section_sheet": self.SHEET, "histogram_save": {"of": "MODEL"}}.get(kind, {})
        cls = getattr(bpy.types, f"INSIDEOUT_OT_{kind}")
        pressed = SimpleNamespace(filepath=str(path), report=lambda *_: None, **settings)
        return path, lambda: cls.steps(pressed, bpy.context)

    def _facts(self, folder):
        kinds = ("objects", "curves", "meshes", "images", "materials", "fonts")
        blocks = {kind: sorted(block.name for block in getattr(bpy.data, kind)) for kind in kinds}
        return blocks, {path.name: path.read_bytes() for path in folder.iterdir()}

    def test_ended_early_the_scene_and_the_disk_are_as_before(self, work):
        path, begin = work
        before = self._facts(path.parent)
        for count in (1, 2, 20, 60, 66, 70, 75, 80):
            steps, shares = begin(), []
            for _, share in zip(range(count), steps, strict=False):
                shares.append(share)
            if len(shares) < count:
                break
            steps.close()
            assert self._facts(path.parent) == before, f"after {count} steps"
        assert count > 2

    def test_the_file_is_written_at_the_very_end(self, work):
        path, begin = work
        disk, shares = self._facts(path.parent)[1], []
        for share in begin():
            shares.append(share)
            # While a slow disk is waited for, what was written lies beside it under a name of its own.
            lying = [one for one in path.parent.iterdir() if one.suffix != ".tmp"]
            assert {one.name: one.read_bytes() for one in lying} == disk
        assert shares == sorted(shares)
        assert 0 <= shares[0] <= shares[-1] <= 1
        assert len(shares) > 10
        assert path.read_bytes() != b"older"
