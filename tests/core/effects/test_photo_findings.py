"""Which effects photos are found to have, and which they are not."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from insideout.core.capture.model import Photos
from insideout.core.capture.tracks import Tracks
from insideout.core.effects import exposure, pixel_integration
from insideout.core.effects.choose import look_at_photos
from insideout.core.effects.look.colors import of_points
from insideout.core.effects.look.gains import photo_levels
from insideout.core.effects.photos import PhotoEvidence
from insideout.core.effects.request import parse_effects
from insideout.core.phantoms.photos import exposed
from insideout.core.render import splat

SIZE = 48


@pytest.fixture(scope="module")
def cameras(walls):
    """With the whole of the walls in the image."""
    return [replace(camera, fx=0.8 * camera.fx, fy=0.8 * camera.fy) for camera in walls.cameras]


@pytest.fixture(scope="module")
def plain(walls, cameras, optics):
    """Bytes of the walls' photos, all of one exposure."""
    return [np.round(255 * optics.pinhole(walls.set, camera)).astype(np.uint8) for camera in cameras]


@pytest.fixture(scope="module")
def model(walls, cameras, photographs, tmp_path_factory):
    """What structure from motion would leave of the patches that no other wall covers."""
    means = walls.truth.means.astype(np.float64)
    bare = (means[:, 1] < 0) | (means[:, 0] > 24)
    return photographs.write_model(tmp_path_factory.mktemp("model"), cameras, means[bare])


@pytest.fixture
def evidence(walls, cameras, photographs, tmp_path):
    def gather(images, model=None, cameras=cameras, long_side=SIZE):
        photos = photographs.saved(tmp_path, cameras, images)
        return PhotoEvidence(Photos(photos), walls.truth.means.astype(np.float64), long_side, model)

    return gather


def exposures(images, percent, seed=0):
    """The photos with gains of light whose deviation is `percent`, and a tenth of it in colour."""
    rng = np.random.default_rng(seed)
    gains = rng.standard_normal((len(images), 1)) + 0.1 * rng.standard_normal((len(images), 3))
    gains *= percent / 100 / np.sqrt(np.mean((gains - gains.mean(axis=0)) ** 2))
    return [exposed(image, tuple(np.exp(gain))) / 255 for image, gain in zip(images, gains, strict=True)]


def farther(camera, times):
    """The camera as many times as far from the middle."""
    pose = np.array(camera.world_to_camera)
    pose[2, 3] *= times
    return replace(camera, world_to_camera=pose)


class TestExposure:
    @pytest.mark.parametrize(("percent", "found"), [(0, False), (1.5, False), (6, True), (18, True)])
    @pytest.mark.parametrize("by_points", [True, False])
    def test_found_from_three_percent(self, percent, found, by_points, plain, model, evidence):
        finding = exposure.detect(evidence(exposures(plain, percent), model if by_points else None))
        assert finding.found is found
        assert finding.strength == pytest.approx(percent, rel=0.15, abs=3 * finding.error + 0.2)
        assert ("points that they share" in finding.reason) is by_points

    @pytest.mark.slow
    @pytest.mark.parametrize("by_points", [True, False])
    @pytest.mark.parametrize(("percent", "found"), [(0, False), (1.5, False), (6, True), (18, True)])
    def test_right_on_nearly_all_seeds(self, percent, found, by_points, plain, model, evidence):
        right = []
        for seed in range(20):
            images = exposures(plain, percent, seed)
            # Quantized and noisy as cameras have it: each seed is another clean capture, too.
            rng = np.random.default_rng(1000 + seed)
            noisy = [image + 0.01 * rng.standard_normal(image.shape) for image in images]
            right.append(exposure.detect(evidence(noisy, model if by_points else None)).found is found)
        assert np.mean(right) >= 0.95

    def test_a_wall_that_is_lit_unevenly_is_no_exposure(self, walls, cameras, optics, evidence):
        """Backgrounds differ by a tenth, the object does not."""
        rng, images = np.random.default_rng(0), []
        for camera in cameras:
            behind = optics.to_srgb(optics.to_linear(optics.background) * np.exp(0.1 * rng.standard_normal()))
            with torch.no_grad():
                shown = splat(walls.set, camera, torch.from_numpy(behind.clip(0, 1).astype(np.float32)))
            images.append(shown.color.numpy())
        finding = exposure.detect(evidence(images))
        assert finding.found is False
        assert "lit unevenly" in finding.reason

    def test_cannot_tell_without_points_and_before_a_wall_of_patches(self, plain, evidence):
        rng = np.random.default_rng(0)
        patched = [np.kron(rng.random((8, 8, 3)), np.ones((6, 6, 1))) for _ in plain]
        assert exposure.detect(evidence(patched)).found is None

    @pytest.mark.parametrize("color", [0.0, 1.0])
    def test_cannot_tell_where_the_background_is_black_or_white(self, color, walls, cameras, evidence):
        images = []
        for camera in cameras:
            with torch.no_grad():
                images.append(splat(walls.set, camera, torch.full((3,), color)).color.numpy())
        finding = exposure.detect(evidence(exposures([np.round(255 * i).clip(0, 255) for i in images], 18)))
        assert finding.found is None
        assert finding.strength is None

    def test_held_out_photos_have_no_say(self, plain, model, evidence):
        given = evidence(exposures(plain, 18), model)
        photos = [replace(photo, held_out=place >= 2) for place, photo in enumerate(given.photos.photos)]
        assert exposure.detect(replace(given, photos=Photos(photos))).found is None, "two are too few"

    def test_a_side_of_few_points_is_compared_beside_one_of_many(self, cameras):
        """Thousands of points that six photos see leave those that only four others do."""
        rng = np.random.default_rng(0)
        points = rng.uniform(-5, 5, (6200, 3))
        seen = [(place, point) for point in range(6000) for place in range(6)]
        seen += [(place, point) for point in range(6000, 6200) for place in range(5, 9)]
        photo, point = np.array(seen).T
        views = [(np.full((SIZE, SIZE, 3), 0.5), camera) for camera in cameras[:9]]
        colors = of_points(views, Tracks(points, photo, point, np.zeros((len(photo), 2))))
        assert np.bincount(colors.photo, minlength=9).min() >= 200


class TestLevels:
    def test_what_changes_slowly_around_the_object_is_seen_too(self):
        """Each thing is seen by three neighbours of forty photos: rounds of medians would need hundreds."""
        rng, photos, things = np.random.default_rng(0), 40, 2000
        truth = 0.1 * np.sin(2 * np.pi * np.arange(photos) / photos)
        photo = ((rng.integers(0, photos, things)[:, None] + np.arange(3)) % photos).ravel()
        thing = np.repeat(np.arange(things), 3)
        values = truth[photo] + rng.standard_normal(things)[thing] + 0.02 * rng.standard_normal(len(photo))
        levels, errors = photo_levels(photo, thing, values, photos)
        assert np.abs(levels - truth).max() < 0.02
        assert np.std(levels - truth) == pytest.approx(np.sqrt(np.mean(errors**2)), rel=0.5)

    def test_a_tenth_of_wrong_matches_does_not_matter(self):
        rng, photos, things = np.random.default_rng(0), 12, 300
        truth = rng.normal(0, 0.1, photos)
        photo, thing = np.tile(np.arange(photos), things), np.repeat(np.arange(things), photos)
        values = truth[photo] + rng.standard_normal(things)[thing] + 0.02 * rng.standard_normal(len(photo))
        wrong = rng.random(len(values)) < 0.1
        values[wrong] += rng.exponential(1.0, wrong.sum())
        levels, _ = photo_levels(photo, thing, values, photos)
        assert np.abs(levels - (truth - truth.mean())).max() < 0.01

    def test_a_photo_that_shares_nothing_has_none(self):
        levels, errors = photo_levels(np.array([0, 1, 2]), np.array([0, 0, 1]), np.array([1.0, 2.0, 9.0]), 4)
        np.testing.assert_allclose(levels, [-0.5, 0.5, 0, 0], atol=1e-9)
        assert np.isinf(errors).tolist() == [False, False, True, True]


class TestPixelIntegration:
    @pytest.fixture
    def at_distances(self, cameras, plain, evidence):
        """Half of the cameras stand `times` as far away as the others."""

        def look(times, **options):
            moved = [farther(camera, times if index % 2 else 1.0) for index, camera in enumerate(cameras)]
            return pixel_integration.detect(evidence([image / 255 for image in plain], None, moved, **options))

        return look

    @pytest.mark.parametrize(("times", "found"), [(1.0, False), (1.22, False), (2.25, True), (11.0, True)])
    def test_found_from_half_as_far_again(self, times, found, at_distances):
        finding = at_distances(times)
        assert finding.found is found
        assert finding.strength == pytest.approx(times, rel=0.1)

    @pytest.mark.parametrize(("long_side", "found"), [(400, False), (40, False), (24, True)])
    def test_found_where_photos_are_much_larger_than_they_are_trained(self, long_side, found, at_distances):
        assert at_distances(1.0, long_side=long_side).found is found

    def test_splats_that_become_fainter_as_they_are_widened_do_not_need_it(self, cameras, plain, evidence):
        moved = [farther(camera, 11.0 if index % 2 else 1.0) for index, camera in enumerate(cameras)]
        given = replace(evidence([image / 255 for image in plain], None, moved), mip_filter=True)
        finding = pixel_integration.detect(given)
        assert (finding.found, finding.strength) == (False, pytest.approx(11.0, rel=0.1))
        assert str(finding.reason).endswith("do without.")
        assert pixel_integration.detect(replace(given, points=np.zeros((0, 3)))).found is False

    def test_a_lens_of_half_the_focal_length_is_twice_as_far(self, cameras, plain, evidence):
        wide = [
            replace(camera, fx=camera.fx / 2, fy=camera.fy / 2) if index % 2 else camera
            for index, camera in enumerate(cameras)
        ]
        finding = pixel_integration.detect(evidence([image / 255 for image in plain], None, wide))
        assert finding.strength == pytest.approx(2.0, rel=0.05)

    @pytest.mark.slow
    @pytest.mark.parametrize(("times", "found"), [(1.22, False), (2.25, True), (11.0, True)])
    def test_right_on_nearly_all_seeds(self, times, found, cameras, plain, evidence):
        right = []
        for seed in range(20):
            # Distances that differ by chance: by 95 over 5 percent they are exp(1.8 spread) apart.
            ways = np.exp(np.log(times) / 1.8 * np.random.default_rng(seed).uniform(-1, 1, len(cameras)))
            moved = [farther(camera, way) for camera, way in zip(cameras, ways, strict=True)]
            images = [image / 255 for image in plain]
            right.append(pixel_integration.detect(evidence(images, None, moved)).found is found)
        assert np.mean(right) >= 0.95

    def test_cannot_tell_without_points(self, plain, evidence):
        given = evidence([image / 255 for image in plain])
        assert pixel_integration.detect(replace(given, points=np.zeros((0, 3)))).found is None


class TestChoice:
    def test_auto_uses_what_is_found_and_nothing_that_cannot_be_told(self, plain, model, evidence):
        choice = look_at_photos(parse_effects("auto"), evidence(exposures(plain, 18), model))
        assert {row["name"]: row["used"] for row in choice.rows} == {
            "exposure": True, "rolling_shutter": False, "defocus": False, "motion_blur": False,
            "pixel_integration": False,
        }  # fmt: skip
        assert choice.rows[0]["chosen_by"] == "auto"
        assert choice.rows[0]["half"] == "photos"
        unknown = replace(evidence([image / 255 for image in plain], model), points=np.zeros((0, 3)))
        rows = {row["name"]: row for row in look_at_photos(parse_effects("auto"), unknown).rows}
        assert rows["pixel_integration"]["found"] is None
        assert not rows["pixel_integration"]["used"]

    def test_what_is_asked_for_is_used_whatever_is_found(self, plain, model, evidence):
        given = evidence([image / 255 for image in plain], model)
        rows = {row["name"]: row for row in look_at_photos(parse_effects("exposure,defocus"), given).rows}
        assert list(rows) == ["exposure", "defocus"]
        assert rows["exposure"]["found"] is False
        assert rows["exposure"]["reason"].endswith("because you asked for it.")
        assert rows["defocus"]["found"] is None
        assert all(row["used"] and row["chosen_by"] == "user" for row in rows.values())

    def test_what_a_script_gives_itself_leaves_no_effect_to_learn(self, plain, model, evidence):
        given = evidence(exposures(plain, 18), model, long_side=24)
        request = parse_effects("auto,defocus")
        rows = {row["name"]: row for row in look_at_photos(request, given, given=True).rows}
        assert rows["exposure"]["found"] is True
        assert {name: row["used"] for name, row in rows.items()} == {
            "exposure": False, "rolling_shutter": False, "defocus": False, "motion_blur": False,
            "pixel_integration": True,
        }  # fmt: skip
        assert rows["exposure"]["reason"].endswith("the script gives the effects to learn itself.")
        assert "you asked" not in rows["defocus"]["reason"]
        assert rows["pixel_integration"]["reason"].endswith("such a model bolder.")

    def test_looking_can_be_stopped(self, plain, evidence):
        class StoppedError(Exception):
            pass

        ticks = iter(range(5))

        def tick():
            if next(ticks) == 4:
                raise StoppedError

        with pytest.raises(StoppedError):
            look_at_photos(parse_effects("auto"), replace(evidence([i / 255 for i in plain]), tick=tick))
