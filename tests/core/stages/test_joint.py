"""Joint refinement: one set of Gaussians for photos, projections and sections, and the photo frame with it."""

import itertools
import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from insideout.core.errors import Cancelled
from insideout.core.evaluate import heldout
from insideout.core.files import write_json
from insideout.core.gaussians import Modality
from insideout.core.progress import Reporter
from insideout.core.render import splat
from insideout.core.report import write_report
from insideout.core.run_folder import RunFolder
from insideout.core.settings import Settings
from insideout.core.similarity import Similarity
from insideout.core.stages import fuse
from insideout.core.stages.context import StageContext
from insideout.core.stages.internal import InternalSettings, joint, run
from insideout.core.stages.internal.joint import JointTrainer, join
from insideout.core.stages.internal.joint_settings import JointSettings
from insideout.core.stages.internal.targets import SectionSeries
from insideout.core.stages.photo_series import PhotoSeries
from insideout.core.train.losses import image_loss
from insideout.core.train.schedule import Decay

JOINT = JointSettings(
    iterations=60,
    photo_size=48,
    smooth_voxels=16,
    means_rate=Decay(2e-4, 2e-5),
    scale_rate=Decay(2e-3, 2e-4),
    xray_means_rate=Decay(2e-4, 2e-5),
    xray_scale_rate=Decay(2e-3, 2e-4),
    density_rate=Decay(4e-3, 4e-4),
    photos_attenuate=True,
)
QUICK = InternalSettings(display_iterations=30, planes=("axial",), photo_size=48, joint=JOINT)


@pytest.fixture(scope="module")
def finished(shells_capture, tmp_path_factory):
    capture, path = shells_capture
    folder = tmp_path_factory.mktemp("joint") / "run"
    shutil.copytree(path, folder)
    context = StageContext(capture, RunFolder(folder), seed=0)
    report = run(context, QUICK)
    write_json(folder / "internal" / "report.json", report)
    return context, report


def trainer_of(context, settings=JOINT, rgb=None):
    rgb, xray = rgb or context.run.read_set("align", "rgb"), context.run.read_set("surface", "xray")
    start = join(rgb, xray, 0.01 * 0.08 if settings.photos_attenuate else 0.0)
    photos = PhotoSeries(context, settings.photo_size)
    series = SectionSeries(context.run.volume(), ("axial",))
    colored = np.arange(len(start)) >= len(xray)
    return JointTrainer(
        start, photos, context.capture.projections, series, settings, 0.08, colored, seed=0, kernel="cpu"
    )


def moved_against(gaussians, step, trainer):
    """The torch set moved by the inverse of a small step (7,) of the frame, to first order."""
    turn, grow, shift = step[:3], step[3], step[4:]
    offset = gaussians.means - torch.from_numpy(trainer._pivot)
    means = gaussians.means - grow * offset - torch.linalg.cross(turn.expand_as(offset), offset)
    w, vector = gaussians.quats[:, :1], gaussians.quats[:, 1:]
    axis = turn.expand_as(vector)
    turned = torch.cat([-(axis * vector).sum(-1, keepdim=True), w * axis + torch.linalg.cross(axis, vector)], dim=1)
    quats, scales = gaussians.quats - 0.5 * turned, gaussians.scales * (1 - grow)
    return replace(gaussians, means=means - trainer._unit * shift, quats=quats, scales=scales)


class TestOneSet:
    def test_training_views_of_both_kinds_get_better(self, finished):
        _, report = finished
        before, after = report["joint"]["before"], report["joint"]["after"]
        assert after["training_photos_psnr"] > before["training_photos_psnr"] + 1.0
        assert after["training_projections_psnr"] > before["training_projections_psnr"]

    def test_every_splat_stays_in_one_set_with_its_origin(self, finished):
        context, report = finished
        together = context.run.read_set("internal", "joint")
        assert set(np.unique(together.modality)) == {Modality.RGB, Modality.XRAY}
        assert report["splats"]["joint"] == len(together)

    def test_the_photo_splats_by_themselves_are_those_of_the_alignment_in_the_refined_frame(self, finished):
        context, report = finished
        aligned, alone = context.run.read_set("align", "rgb"), context.run.read_set("internal", "rgb")
        before = Similarity.from_json(context.run.report("align")["similarity"])
        moved = Similarity.from_json(report["similarity"]).after(before.inverse())
        np.testing.assert_allclose(alone.means, moved.apply(aligned.means), atol=1e-4)
        np.testing.assert_array_equal(alone.opacities, aligned.opacities)

    def test_photo_splats_learn_to_attenuate(self, finished):
        context, _ = finished
        together = context.run.read_set("internal", "joint")
        density = together.density[together.modality == Modality.RGB]
        start = 0.01 * np.percentile(context.run.volume().values, 99.9)
        assert np.mean(np.abs(density / start - 1) > 0.02) > 0.5

    def test_unless_they_are_not_to(self, shells_context):
        trainer = trainer_of(shells_context, replace(JOINT, photos_attenuate=False))
        before = trainer.parameters.to_set().density
        for iteration in range(5):
            trainer.step(iteration)
        after, radiative = trainer.parameters.to_set().density, before > 1e-6
        assert (after[~radiative] == before[~radiative]).all()
        assert after[~radiative].max() < 1e-8
        assert not np.array_equal(after[radiative], before[radiative])

    def test_radiative_splats_stay_as_thick_as_a_part_of_a_pixel(self, shells_context):
        thinnest = 1.5 * shells_context.capture.projections.pixel_mm
        assert shells_context.run.read_set("surface", "xray").scales.min() < thinnest
        trainer = trainer_of(shells_context, replace(JOINT, least_pixels=1.5))
        for iteration in range(5):
            trainer.step(iteration)
            result = trainer.parameters.to_set()
            radiative = result.modality == Modality.XRAY
            assert result.scales[radiative].min() == pytest.approx(thinnest, rel=1e-5)
            assert result.scales[~radiative].min() < thinnest

    def test_projections_take_turns_and_photos_alone_say_nothing_of_densities(self, shells_context, monkeypatch):
        trainer, shown = trainer_of(shells_context, replace(JOINT, xray_every=3)), []
        count = int((~shells_context.capture.projections.held_out).sum())
        plain = joint.shuffled
        monkeypatch.setattr(joint, "shuffled", lambda *told: shown.append(plain(*told)) or shown[-1])
        trainer.step(1)
        fresh = trainer.parameters.to_set()
        np.testing.assert_array_equal(fresh.density, trainer_of(shells_context).parameters.to_set().density)
        trainer.step(3)
        assert not np.array_equal(trainer.parameters.to_set().density, fresh.density)
        assert not np.array_equal(trainer.parameters.to_set().opacities, fresh.opacities)
        for iteration in range(6, 3 * count + 3, 3):
            trainer.step(iteration)
        # One after the other, and each once before the first is shown again.
        assert len(shown) == count
        assert len(set(shown)) >= count - 1

    def test_between_two_projections_radiative_splats_keep_their_shape(self, shells_context):
        """Not even momentum moves them; their display opacities follow the photos."""
        trainer = trainer_of(shells_context, replace(JOINT, photos_attenuate=False, xray_every=3))
        trainer.step(0)
        before = trainer.parameters.to_set()
        trainer.step(1)
        after, radiative = trainer.parameters.to_set(), before.modality == Modality.XRAY
        for name in ("means", "scales", "quats", "density"):
            np.testing.assert_array_equal(getattr(after, name)[radiative], getattr(before, name)[radiative])
        assert not np.array_equal(after.means[~radiative], before.means[~radiative])
        assert not np.array_equal(after.opacities[radiative], before.opacities[radiative])

    def test_sections_take_turns_of_their_own(self, shells_context, monkeypatch):
        shown = []
        trainer = trainer_of(shells_context, replace(JOINT, xray_every=3, section_every=2))
        view = trainer._series.view
        monkeypatch.setattr(trainer._series, "view", lambda turn: shown.append(turn) or view(turn))
        for iteration in range(6):
            trainer.step(iteration)
        assert shown == [0, 1, 2]

    def test_photos_have_the_end_to_themselves(self, shells_context, monkeypatch):
        shown = []
        trainer = trainer_of(shells_context, replace(JOINT, iterations=8, section_every=2, section_until=0.5))
        view = trainer._series.view
        monkeypatch.setattr(trainer._series, "view", lambda turn: shown.append(turn) or view(turn))
        for iteration in range(8):
            trainer.step(iteration)
        assert shown == [0, 1]

    def test_sections_leave_the_skin_to_photos(self, shells_context, monkeypatch):
        def pulls():
            """Of the section through the middle, on radiative splats at the outer surface and on those of the core."""
            trainer = trainer_of(shells_context, replace(JOINT, structure_weight=0.0))
            series, rows = trainer._series, trainer._rows
            middle = min(series.held_out, key=lambda view: abs(view.position_mm))
            monkeypatch.setattr(series, "view", lambda turn: middle)
            trainer._step_section(0)
            pulled = trainer.parameters.gradient("opacities")[:rows].ravel()
            radius = np.linalg.norm(trainer.parameters.to_set().means[:rows], axis=1)
            return -pulled[radius > 17.0].sum(), -pulled[radius < 9.0].sum()

        outer, core = pulls()
        found = SectionSeries.skin
        monkeypatch.setattr(SectionSeries, "skin", lambda series, view: torch.zeros_like(found(series, view)))
        outer_without, core_without = pulls()
        assert core == pytest.approx(core_without, rel=1e-3)
        assert core > 0
        assert outer < 0.5 * outer_without

    @pytest.mark.parametrize("pause", ["section_every", "xray_every", "smooth_every"])
    def test_what_is_shown_seldom_weighs_as_much_more(self, shells_context, pause):
        def pull(every):
            settings = replace(
                JOINT, **{pause: every}, **({"projection_weight": 0.0} if pause == "smooth_every" else {})
            )
            trainer = trainer_of(shells_context, settings)
            if pause == "section_every":
                trainer._step_section(0)
                return trainer.parameters.gradient("opacities").copy()
            trainer._step_projection(0)
            return trainer.parameters.gradient("density").copy()

        once = pull(1)
        assert np.abs(once).max() > 0
        np.testing.assert_allclose(pull(3), 3 * once, rtol=1e-4, atol=1e-5 * np.abs(once).max())

    def test_what_no_photo_sees_keeps_its_colour(self, shells_context):
        trainer = trainer_of(shells_context)
        before = trainer.parameters.raw["sh_dc"].detach().clone()
        for iteration in range(5):
            trainer.step(iteration)
        after = trainer.parameters.raw["sh_dc"].detach()
        hidden = len(shells_context.run.read_set("surface", "xray"))
        torch.testing.assert_close(after[:hidden], before[:hidden], rtol=0, atol=0)
        assert not torch.equal(after[hidden:], before[hidden:])

    def test_the_fused_model_is_that_set(self, finished):
        context, _ = finished
        report = fuse.run(context, fuse.PRESETS["draft"])
        fused, together = context.run.read_set("fuse", "fused"), context.run.read_set("internal", "joint")
        assert report["mode"] == "joint"
        np.testing.assert_array_equal(fused.density, together.density)

    def test_its_radiographs_show_photo_splats_that_attenuate(self, finished):
        context, _ = finished
        together, projections = context.run.read_set("internal", "xray"), context.capture.projections
        whole = heldout.projection_figures(together, projections, "cpu", lambda: None)["psnr"]
        body = together.select(together.modality == Modality.XRAY)
        assert whole > heldout.projection_figures(body, projections, "cpu", lambda: None)["psnr"]

    def test_splats_that_do_not_attenuate_are_in_the_model_and_not_in_the_x_rays(self, shells_capture, tmp_path):
        capture, path = shells_capture
        shutil.copytree(path, tmp_path / "run")
        context = StageContext(capture, RunFolder(tmp_path / "run"), seed=0)
        report = run(context, replace(QUICK, joint=replace(JOINT, iterations=2, photos_attenuate=False)))
        write_json(tmp_path / "run" / "internal" / "report.json", report)
        fuse.run(context, fuse.PRESETS["draft"])
        xray, fused = context.run.read_set("internal", "xray"), context.run.read_set("fuse", "fused")
        assert (xray.modality == Modality.XRAY).all()
        photo_splats = fused.select(fused.modality == Modality.RGB)
        assert len(fused) == len(xray) + len(photo_splats) == report["splats"]["joint"]
        assert (photo_splats.density == 0).all()
        assert len(photo_splats) > 0

    def test_projections_do_not_move_photo_splats_that_do_not_attenuate(self, shells_context):
        rgb = shells_context.run.read_set("align", "rgb")
        # In the middle, where every ray of a projection passes, and too faint for photos to tell.
        first = np.arange(len(rgb)) == 0
        hidden = replace(
            rgb,
            means=np.where(first[:, None], np.zeros(3, np.float32), rgb.means),
            opacities=np.where(first, np.float32(1e-4), rgb.opacities),
        )
        trainer = trainer_of(shells_context, replace(JOINT, photos_attenuate=False), hidden)
        start = len(shells_context.run.read_set("surface", "xray"))
        before = trainer.parameters.to_set().select([start, start + 1])
        for iteration in range(5):
            trainer.step(iteration)
        after = trainer.parameters.to_set().select([start, start + 1])
        for name in ("means", "scales", "quats"):
            np.testing.assert_array_equal(getattr(after, name)[0], getattr(before, name)[0])
        assert not np.array_equal(after.means[1], before.means[1])

    def test_x_rays_alone_are_refined_on_a_projection_in_each_iteration(self, shells_capture, tmp_path, monkeypatch):
        capture, path = shells_capture
        for stage in ("initialize", "surface"):
            shutil.copytree(path / stage, tmp_path / "run" / stage)
        context = StageContext(capture, RunFolder(tmp_path / "run"), seed=0)
        shown, cut, plain = [], [], joint.shuffled
        monkeypatch.setattr(joint, "shuffled", lambda *told: shown.append(told) or plain(*told))
        monkeypatch.setattr(joint, "section", lambda *told: cut.append(told))
        report = run(context, replace(QUICK, joint=replace(JOINT, xray_every=4)))
        assert len(shown) == report["joint"]["iterations"]
        # Display opacities are learnt afterwards.
        assert not cut
        assert "undecided" not in report["joint"]
        assert 0 <= report["display"]["undecided"] < 0.5
        before, after = report["joint"]["before"], report["joint"]["after"]
        assert after["training_projections_psnr"] > before["training_projections_psnr"]
        assert set(report["splats"]) == {"xray"}
        assert "similarity" not in report
        assert 0 < report["joint"]["xray_seconds"] == report["joint"]["seconds"]
        assert report["joint"]["iterations"] == -(-JOINT.iterations // 3)
        write_json(tmp_path / "run" / "internal" / "report.json", report)
        fused = fuse.run(context, fuse.PRESETS["draft"])
        assert fused["mode"] == "xray only: coloured by density"

    def test_of_x_rays_alone_splats_without_density_are_dropped(self, shells_capture, tmp_path):
        capture, path = shells_capture
        for stage in ("initialize", "surface"):
            shutil.copytree(path / stage, tmp_path / "run" / stage)
        context = StageContext(capture, RunFolder(tmp_path / "run"), seed=0)
        start = context.run.read_set("surface", "xray")
        empty = np.arange(len(start)) < 10
        context.run.write_set("surface", "xray", replace(start, density=np.where(empty, np.float32(0), start.density)))
        report = run(context, replace(QUICK, joint=replace(JOINT, iterations=3)))
        assert report["splats"]["xray"] == len(start) - 10

    def test_the_frame_keeps_its_size_unless_asked(self, shells_context):
        trainer = trainer_of(shells_context, replace(JOINT, similarity_rate=Decay(1e-3)))
        for iteration in range(5):
            trainer.step(iteration)
        assert trainer.moved()["scale"] == pytest.approx(1.0, abs=1e-12)
        assert trainer.moved()["turn_deg"] > 0

    def test_photos_none_of_which_is_trained_on_leave_x_rays_alone(self, shells_capture, tmp_path):
        capture, path = shells_capture
        shutil.copytree(path, tmp_path / "run")
        kept = tmp_path / "run" / "initialize" / "photos.json"
        content = json.loads(kept.read_text())
        for photo in content["photos"]:
            photo["held_out"] = True
        kept.write_text(json.dumps(content))
        (tmp_path / "run" / "internal").mkdir()
        shutil.copy(path / "align" / "rgb.ply", tmp_path / "run" / "internal" / "rgb.ply")
        context = StageContext(capture, RunFolder(tmp_path / "run"), seed=0)
        report = run(context, replace(QUICK, joint=replace(JOINT, iterations=2)))
        assert set(report["splats"]) == {"xray"}
        assert not context.run.has_set("internal", "rgb")

    def test_a_volume_of_the_user_s_own_is_followed(self, shells_context):
        capture = replace(shells_context.capture, volume=shells_context.run.volume())
        context = replace(shells_context, capture=capture)
        report = run(context, replace(QUICK, xray_iterations=2, rgb_iterations=2, display_iterations=2))
        assert report["mode"] == "apart"

    def test_without_projections_it_is_the_paper_s_route(self, shells_context):
        capture = replace(shells_context.capture, projections=None)
        context = replace(shells_context, capture=capture)
        report = run(context, replace(QUICK, xray_iterations=2, rgb_iterations=2, display_iterations=2))
        assert report["mode"] == "apart"
        assert "xray" in report


class TestPhotoFrame:
    def test_its_pull_is_the_gradient_of_the_photo_s_loss(self, shells_context):
        # Without colour functions, which turn with the camera, too, and which the pull leaves out.
        rgb = shells_context.run.read_set("align", "rgb").with_sh_coefficients(1)
        trainer = trainer_of(shells_context, rgb=rgb)
        trainer._step_photo(trainer._photos, 0)
        pull = trainer._pull_on_frame()
        _, camera, photo = trainer._photos.training(0)
        step = torch.zeros(7, dtype=torch.float64, requires_grad=True)
        moved = moved_against(trainer.parameters.to_set().to_torch(torch.float64), step, trainer)
        shown = splat(moved, camera, trainer._photos.background.double(), kernel="reference").color
        image_loss(shown, photo.double(), JOINT.structure_weight).backward()
        np.testing.assert_allclose(pull, step.grad.numpy(), rtol=1e-2, atol=2e-3 * np.abs(pull).max())

    def test_a_frame_that_is_off_is_mended(self, shells_capture, tmp_path):
        capture, path = shells_capture
        shutil.copytree(path, tmp_path / "run")
        report = tmp_path / "run" / "align" / "report.json"
        truth = RunFolder(tmp_path / "run").similarity()
        off = Similarity(1.004, Rotation.from_rotvec([0.0, 0.012, -0.01]).as_matrix(), np.array([0.25, -0.2, 0.1]))
        write_json(report, {"similarity": off.after(truth).to_json()})
        context = StageContext(capture, RunFolder(tmp_path / "run"), seed=0)
        # The splats lie where the photos showed them in the true frame: only the frame has to move.
        still = Decay(0.0)
        settings = replace(
            JOINT,
            iterations=150,
            means_rate=still,
            rotation_rate=still,
            scale_rate=still,
            opacity_rate=still,
            color_rate=still,
            xray_means_rate=still,
            xray_rotation_rate=still,
            xray_scale_rate=still,
            density_rate=still,
            similarity_rate=Decay(5e-4, 5e-5),
            frame_grows=True,
        )
        trainer = trainer_of(context, settings, context.run.read_set("surface", "rgb").transformed(truth))
        # Radiative splats that shine through would make the object look larger.
        radiative = len(trainer) - len(context.run.read_set("surface", "rgb"))
        trainer.parameters.set_opacities(np.where(np.arange(len(trainer)) < radiative, 1e-4, 0.95))
        points = np.random.default_rng(0).normal(size=(100, 3)) * 10

        def error():
            left = trainer.correction.after(off)
            return np.linalg.norm(left.apply(points) - points, axis=1).mean()

        before = error()
        for iteration in range(settings.iterations):
            trainer.step(iteration)
        assert error() < 0.05 * before

    def test_later_stages_use_the_refined_frame(self, finished):
        context, report = finished
        assert context.run.similarity().to_json() == report["similarity"]

    def test_the_run_s_report_tells_the_refined_frame(self, finished):
        context, report = finished
        write_json(context.run.path / "fuse" / "report.json", fuse.run(context, fuse.PRESETS["draft"]))
        told = write_report(context, Settings.of("draft"))["similarity"]
        assert told == report["similarity"]
        assert told != context.run.report("align")["similarity"]


class TestBreaks:
    def test_broken_off_it_goes_on_to_the_same_result(self, shells_capture, tmp_path, monkeypatch):
        """By the clock of this test projections and sections take a second in each step."""
        monkeypatch.setattr(joint, "work_clock", map(float, itertools.count()).__next__)
        capture, path = shells_capture
        for name in ("whole", "run"):
            shutil.copytree(path, tmp_path / name)
        # Photos, projections and sections in turns of their own, as in the presets.
        turns = replace(JOINT, photos_attenuate=False, xray_every=3, section_every=2, smooth_every=2)
        settings = replace(QUICK, joint=turns)
        unbroken = StageContext(capture, RunFolder(tmp_path / "whole"), seed=0)
        whole = run(unbroken, settings)
        started, asked = [], []

        def cancelled():
            # Asked at least once in each iteration; progress is told ten times a second at most.
            asked.extend(started[:1])
            return len(asked) > 20

        reporter = Reporter(lambda progress: started.append(1) if progress.part == "joint" else None, cancelled)
        context = StageContext(capture, RunFolder(tmp_path / "run"), seed=0, reporter=reporter)
        with pytest.raises(Cancelled):
            run(context, settings)
        told = []
        listen = Reporter(lambda progress: told.append(progress.iteration) if progress.part == "joint" else None)
        report = run(replace(context, reporter=listen), settings)
        assert min(iteration for iteration in told if iteration) > 5
        assert report["similarity"] == whole["similarity"]
        assert report["joint"]["xray_seconds"] == whole["joint"]["xray_seconds"] == report["joint"]["iterations"]
        found, wanted = (c.run.read_set("internal", "joint") for c in (context, unbroken))
        for name, value in vars(wanted).items():
            np.testing.assert_array_equal(getattr(found, name), value, name)

    def test_photo_splats_larger_than_the_x_rays_box_stay_as_they_are(self, shells_context):
        rgb = shells_context.run.read_set("align", "rgb")
        wall = rgb.scales.copy()
        wall[0] = 500.0
        trainer = trainer_of(shells_context, rgb=replace(rgb, scales=wall))
        assert trainer.parameters.to_set().scales.max() == pytest.approx(500.0, rel=1e-5)

    def test_its_curve_has_both_parts_all_the_time(self, shells_context):
        """Else photos alone and photos with the rest would take turns."""
        trainer = trainer_of(shells_context, replace(JOINT, xray_every=3))
        losses = [trainer.step(iteration) for iteration in range(3)]
        rest = sum(trainer._rest.values())
        assert min(trainer._rest.values()) > 0
        assert all(loss > rest for loss in losses)
        assert np.ptp(losses) < 0.5 * rest
        again = trainer_of(shells_context, replace(JOINT, xray_every=3))
        again.restore(trainer.state())
        assert again._rest == trainer._rest

    def test_photo_splats_are_drawn_as_they_were_fitted(self, shells_capture, tmp_path):
        """Fitted with integrated pixels, they would be too thin or too thick for plain ones."""
        capture, path = shells_capture
        shutil.copytree(path, tmp_path / "run")
        run_folder = RunFolder(tmp_path / "run")
        report = {"rgb": {"options": {"pixel_integration": True}}}
        write_json(run_folder.path / "surface" / "report.json", report)
        photos = PhotoSeries(StageContext(capture, run_folder, seed=0), 48)
        camera, _ = photos.read_training(0)
        rgb = run_folder.read_set("align", "rgb").to_torch()
        shown = photos.draw(rgb, camera, "cpu").color
        plain, integrated = (
            splat(rgb, camera, photos.background, kernel="cpu", pixel_integration=on).color for on in (False, True)
        )
        assert torch.equal(shown, integrated)
        assert not torch.equal(shown, plain)

    def test_a_projection_with_holes_ruins_nothing_but_its_own_steps(self, shells_context):
        projections = shells_context.capture.projections
        first = int(np.flatnonzero(~projections.held_out)[0])
        images = projections.images.copy()
        images[first, 3, 3] = np.nan
        capture = replace(shells_context.capture, projections=replace(projections, images=images))
        trainer = trainer_of(replace(shells_context, capture=capture), replace(JOINT, xray_every=3))
        losses = np.array([trainer.step(iteration) for iteration in range(3 * len(trainer._training))])
        assert np.isnan(losses).sum() == 1

    def test_a_broken_photo_ruins_nothing(self, shells_context):
        trainer = trainer_of(shells_context)
        before = trainer.parameters.raw["means"].detach().clone()
        camera, _ = trainer._photos.read_training(0)
        trainer._photos.training = lambda _: (0, camera, torch.full((48, 48, 3), torch.nan))
        loss = trainer.step(0)
        assert not np.isfinite(loss)
        after = trainer.parameters.raw["means"].detach()
        radiative = np.arange(len(after)) < len(shells_context.run.read_set("surface", "xray"))
        torch.testing.assert_close(after[~radiative], before[~radiative], rtol=0, atol=0)
        # The projection was whole.
        assert not torch.equal(after[radiative], before[radiative])
        assert all(torch.isfinite(values).all() for values in trainer.parameters.raw.values())
        assert np.isfinite(trainer.correction.translation).all()
