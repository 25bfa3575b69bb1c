"""Which sparse points tell of a lens that cameras' files do not tell of, and which do not."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from insideout.core.capture.model import Lens, Photo, Photos
from insideout.core.capture.photos import pinhole_for
from insideout.core.capture.tracks import Tracks
from insideout.core.effects import lens, rolling_shutter
from insideout.core.effects.choose import look_at_lens
from insideout.core.effects.look.lenses import distorted, fitted
from insideout.core.effects.photos import PhotoEvidence
from insideout.core.effects.request import parse_effects

SIZE, NOISE_PX = 240, 0.1
CORNER = np.hypot(SIZE, SIZE) / 2


@pytest.fixture(scope="module")
def points():
    """On both walls, and between them."""
    return np.random.default_rng(5).uniform([-32, -25, -26], [32, 25, 26], (900, 3))


def drawn(camera, points, bends=(0.0, 0.0, 0.0, 0.0)):
    """(P, 2) columns and rows of points through OpenCV's lens."""
    matrix = np.asarray(camera.world_to_camera)
    inner = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    turn, shift = cv2.Rodrigues(matrix[:3, :3])[0], matrix[:3, 3]
    return cv2.projectPoints(points, turn, shift, inner, np.array(bends))[0][:, 0]


def bends_for(camera, px):
    """k1 that moves the corner by so many px."""
    return (px / CORNER / ((0.5 * SIZE / camera.fx) ** 2 + (0.5 * SIZE / camera.fy) ** 2), 0.0, 0.0, 0.0)


@pytest.fixture
def seen_at(points, cameras, photographs, tmp_path):
    """What is looked at where points are seen at `shown` (N, P, 2) px, each by about half of the cameras."""

    def look(shown, seed=0, some=None, matched=None):
        rng = np.random.default_rng(100 + seed)
        some = slice(None) if some is None else some
        shown = np.array(shown) + NOISE_PX * rng.standard_normal((len(cameras), len(points), 2))
        seen = rng.random((len(points), len(cameras))) < 0.6
        seen = (seen if matched is None else seen & np.array(matched).T)[some]
        model = photographs.write_model(tmp_path / "model", cameras, points[some], seen, shown[:, some])
        photos = Photos([Photo(Path(f"{index}.png"), camera) for index, camera in enumerate(cameras)])
        return PhotoEvidence(photos, np.zeros((0, 3)), SIZE, model)

    return look


def looked(evidence):
    found = lens.look(evidence)
    return found.finding, found.numbers


def bent(cameras, points, px):
    return [drawn(camera, points, bends_for(camera, px)) for camera in cameras]


@pytest.mark.parametrize(("px", "found"), [(0.0, False), (0.1, False), (-1.5, True), (1.5, True), (-8.0, True)])
def test_found_from_half_a_pixel(px, found, cameras, points, seen_at):
    finding, numbers = looked(seen_at(bent(cameras, points, px)))
    assert finding.found is found
    assert finding.strength == pytest.approx(abs(px), abs=4 * finding.error)
    assert finding.error < 0.2
    assert finding.unit == "px"
    if found:
        assert {path.name for path in numbers} == {f"{index}.png" for index in range(len(cameras))}
        known = bends_for(cameras[0], px)[0]
        assert all(one[3] == pytest.approx(known, rel=0.15) for one in numbers.values())
        assert all((one[[0, 1, 2, 4, 5, 6]] == 0).all() for one in numbers.values()), "nothing asks for more than k1"


@pytest.mark.slow
@pytest.mark.parametrize(("px", "found"), [(0.0, False), (0.1, False), (-1.2, True), (1.2, True), (-6.0, True)])
def test_right_on_nearly_all_seeds(px, found, cameras, points, seen_at):
    right = [lens.detect(seen_at(bent(cameras, points, px), seed)).found is found for seed in range(20)]
    assert np.mean(right) >= 0.95


def test_a_lens_that_is_not_centred_is_found_too(cameras, points, seen_at):
    given = (-0.6, 0.0, 0.05, -0.06)
    finding, numbers = looked(seen_at([drawn(camera, points, given) for camera in cameras]))
    assert finding.found is True
    np.testing.assert_allclose(next(iter(numbers.values()))[3:], given, rtol=0.06, atol=0.002)


def test_where_a_lens_bends_otherwise_than_by_k1_points_are_where_it_shows_them(cameras, points, seen_at):
    """What points at the middle of the photos do not show is not guessed."""
    given = (-0.6, 20.0, 0.0, 0.0)
    finding, numbers = looked(seen_at([drawn(camera, points, given) for camera in cameras]))
    assert finding.found is not None
    found = next(iter(numbers.values()))
    at = np.linspace(-0.28, 0.28, 13) * SIZE / cameras[0].fx
    places = np.stack(np.meshgrid(at, at), axis=-1).reshape(-1, 2)
    off = cameras[0].fx * (distorted(places, np.array(given)) - distorted(places, found[3:]))
    # A focal length and a size of the object are one.
    off -= places * (off * places).sum() / (places**2).sum()
    assert np.abs(off).max() < 0.25


@pytest.mark.parametrize("changes", [{"fx": 1.02, "fy": 1.02}, {"cx": 1.01}])
def test_a_focal_length_or_principal_point_that_is_off_is_no_lens(changes, cameras, points, seen_at):
    others = [
        replace(camera, **{name: getattr(camera, name) * times for name, times in changes.items()})
        for camera in cameras
    ]
    finding, _ = looked(seen_at([drawn(camera, points) for camera in others]))
    assert finding.found is not True


def test_poses_that_are_a_little_off_are_no_lens(cameras, points, seen_at):
    rng = np.random.default_rng(0)
    for seed in range(3):
        shown = [drawn(camera, points) + 1.2 * rng.standard_normal(2) for camera in cameras]
        assert lens.detect(seen_at(shown, seed)).found is not True


def test_a_tenth_of_wrong_matches_is_no_lens(cameras, points, seen_at):
    rng, shown = np.random.default_rng(0), []
    for camera in cameras:
        where = drawn(camera, points)
        wrong = rng.random(len(points)) < 0.1
        where[wrong] += rng.normal(0, 3.0, (wrong.sum(), 2))
        shown.append(where)
    assert lens.detect(seen_at(shown)).found is False


def test_points_that_no_photo_shows_count_for_nothing(cameras, points):
    """A room's wrong matches, say: behind the cameras that are said to see them."""
    rng, photo, point, seen = np.random.default_rng(2), [], [], []
    for place, camera in enumerate(cameras):
        photo += [place] * (len(points) + 40)
        point += [*range(len(points)), *(len(points) + rng.integers(0, 80, 40))]
        seen += [drawn(camera, points, bends_for(camera, -6.0)), rng.uniform(0, SIZE, (40, 2))]
    behind = 2 * cameras[0].center + rng.normal(0, 20, (80, 3))
    tracks = Tracks(np.concatenate([points, behind]), np.array(photo), np.array(point), np.concatenate(seen))
    found = fitted(cameras, tracks, np.zeros(len(cameras), int), np.zeros((1, 7)), [0.4])
    assert found.numbers[0, 3] == pytest.approx(bends_for(cameras[0], -6.0)[0], rel=0.02)


def test_a_rolling_shutter_is_no_lens_and_a_lens_is_none(cameras, points, seen_at):
    """Rows farther down are seen later, while each camera moves its own way."""
    rng, shown = np.random.default_rng(1), []
    for camera in cameras:
        where = drawn(camera, points)
        shown.append(where + (where[:, 1:] / SIZE - 0.5) * 3.0 * rng.standard_normal(2))
    assert rolling_shutter.detect(seen_at(shown)).found is True
    assert lens.detect(seen_at(shown)).found is not True
    assert rolling_shutter.detect(seen_at(bent(cameras, points, -3.0))).found is False


def test_cannot_tell_where_a_rolling_shutter_moves_points_more_than_a_lens(cameras, points, seen_at):
    rng, shown = np.random.default_rng(1), []
    for where in bent(cameras, points, -12.0):
        shown.append(where + (where[:, 1:] / SIZE - 0.5) * 6.0 * rng.standard_normal(2))
    finding, numbers = looked(seen_at(shown))
    assert finding.found is None
    assert "moved while photos were read out" in finding.reason
    assert not numbers


def test_a_size_of_training_has_its_own_pixels(cameras, points, seen_at):
    given = seen_at(bent(cameras, points, -1.2))
    whole, half = (lens.detect(one) for one in (given, replace(given, long_side=SIZE // 4)))
    assert half.strength == pytest.approx(whole.strength / 4, rel=0.05)
    assert (whole.found, half.found) == (True, False)


def test_photos_of_two_lenses_have_one_each(cameras, points, seen_at):
    """Every other one is of a longer lens, which is straight."""
    long = [replace(camera, fx=1.3 * camera.fx, fy=1.3 * camera.fy) for camera in cameras]
    mixed = [long[index] if index % 2 else camera for index, camera in enumerate(cameras)]
    shown = [drawn(c, points, bends_for(c, 0.0 if index % 2 else -4.0)) for index, c in enumerate(mixed)]
    # The model that the helper writes knows the first camera alone.
    shown = [(where - SIZE / 2) * cameras[0].fx / c.fx + SIZE / 2 for where, c in zip(shown, mixed, strict=True)]
    model = seen_at(shown)
    photos = [Photo(Path(f"{index}.png"), camera) for index, camera in enumerate(mixed)]
    finding, numbers = looked(replace(model, photos=Photos(photos)))
    assert finding.found is True
    assert "the most of 2 lenses" in finding.reason
    assert {path.name for path in numbers} == {f"{index}.png" for index in range(0, len(mixed), 2)}


def test_held_out_photos_have_no_say_and_get_the_lens_all_the_same(cameras, points, seen_at):
    shown = bent(cameras, points, -4.0)
    shown[3] = bent(cameras[3:4], points, 30.0)[0]
    given = seen_at(shown)
    photos = [replace(photo, held_out=place == 3) for place, photo in enumerate(given.photos.photos)]
    finding, numbers = looked(replace(given, photos=Photos(photos)))
    assert finding.strength == pytest.approx(4.0, abs=0.3)
    assert photos[3].path in numbers
    few = [replace(photo, held_out=place >= 2) for place, photo in enumerate(given.photos.photos)]
    assert lens.detect(replace(given, photos=Photos(few))).found is None, "two are too few"


def test_cannot_tell_without_points_or_with_too_few(cameras, points, seen_at):
    given = seen_at(bent(cameras, points, -4.0))
    assert lens.detect(replace(given, model=None)).found is None
    few, numbers = looked(seen_at(bent(cameras, points, -4.0), some=slice(0, 30)))
    assert few.found is None
    assert few.strength is None
    assert not numbers


def test_what_a_file_tells_is_not_looked_for(cameras, points, seen_at):
    given = seen_at(bent(cameras, points, -4.0))
    told = Lens(SIZE, SIZE, *(getattr(cameras[0], name) for name in ("fx", "fy", "cx", "cy")), (-0.1, 0.0, 0.0, 0.0))
    photos = [replace(photo, lens=told) for photo in given.photos.photos]
    finding, numbers = looked(replace(given, photos=Photos(photos)))
    assert finding.found is False
    assert "file tells of the lens" in finding.reason
    assert not numbers


class TestTakingOut:
    @pytest.fixture
    def rounds(self, cameras, points, seen_at):
        """Looks; points that are off by more than `most` px have no matches, as structure from motion has it."""

        def look(px, effects, most=np.inf):
            asked = []

            def evidence(photos):
                shown, matched = [], []
                for camera, photo in zip(cameras, photos, strict=True):
                    ideal = drawn(camera, points)
                    raw = drawn(camera, points, bends_for(camera, px))
                    if photo.lens is not None:
                        own = photo.lens
                        inner = np.array([[own.fx, 0, own.cx], [0, own.fy, own.cy], [0, 0, 1]])
                        straight = cv2.undistortPoints(
                            raw[:, None], inner, np.array(own.coefficients), None, None,
                            np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]]),
                        )[:, 0]  # fmt: skip
                    else:
                        straight = raw
                    matched.append(np.linalg.norm(straight - ideal, axis=1) < most)
                    shown.append(straight)
                return seen_at(shown, matched=matched)

            def again(photos):
                asked.append(photos)
                return evidence(photos.photos).model

            given = evidence([Photo(Path(f"{index}.png"), camera) for index, camera in enumerate(cameras)])
            choice, photos = look_at_lens(parse_effects(effects), given, again)
            return choice.rows[0], photos, asked, given

        return look

    def test_photos_get_the_lens_and_the_camera_that_fits_it(self, rounds, cameras):
        row, photos, asked, given = rounds(-6.0, "auto")
        assert (row["name"], row["half"], row["used"], row["chosen_by"]) == ("lens", "photos", True, "auto")
        assert photos.points is None
        for camera, photo in zip(cameras, photos.photos, strict=True):
            assert photo.lens.coefficients[0] == pytest.approx(bends_for(camera, -6.0)[0], rel=0.05)
            assert (photo.lens.fx, photo.lens.cx) == (camera.fx, camera.cx)
            fits = pinhole_for(photo.lens, camera.world_to_camera)
            assert (photo.camera.fx, photo.camera.cx) == (fits.fx, fits.cx)
        assert 1 <= len(asked) <= 3
        assert all(photo.lens is None for photo in given.photos.photos)

    def test_one_without_is_left_as_it_is_and_asks_for_no_more_points(self, rounds):
        row, photos, asked, given = rounds(0.0, "auto")
        assert (row["found"], row["used"]) == (False, False)
        assert photos is given.photos
        assert not asked

    def test_one_that_is_asked_for_is_taken_out_however_small(self, rounds):
        row, photos, _, _ = rounds(0.2, "lens")
        assert (row["found"] is not True, row["used"], row["chosen_by"]) == (True, True, "user")
        assert all(photo.lens is not None for photo in photos.photos)

    def test_a_lens_so_strong_that_few_points_survive_it_is_found(self, rounds, cameras):
        """Those that it moves by more than 1.5 px, in the corner 24, have no match until it is taken out."""
        row, photos, asked, _ = rounds(-24.0, "auto", most=1.5)
        assert row["used"]
        assert len(asked) >= 1
        assert photos.photos[0].lens.coefficients[0] == pytest.approx(bends_for(cameras[0], -24.0)[0], rel=0.03)
