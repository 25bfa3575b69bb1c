"""What `surface` found of its photos is drawn by the stages after it, in whatever frame the splats are by then."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from insideout.core.effects import Defocus, Exposure, PhotoEffects, RollingShutter
from insideout.core.effects.kept import KeptEffects, keep_effects
from insideout.core.errors import RunFolderError
from insideout.core.evaluate.heldout import photo_figures
from insideout.core.pipeline import reconstruct
from insideout.core.render import splat
from insideout.core.run_folder import RunFolder
from insideout.core.similarity import Similarity
from insideout.core.stages.context import StageContext
from insideout.core.stages.photo_series import PhotoSeries

EFFECTS = (RollingShutter(), Defocus(), Exposure())


def draw(gaussians, camera, *_):
    return splat(gaussians, camera, torch.zeros(3))


@pytest.fixture
def learnt(walls):
    """Effects of four photos that have moved from where they began."""
    cameras = walls.cameras[:4]
    effects = PhotoEffects(EFFECTS, cameras, 150.0)
    with torch.no_grad():
        current = walls.set.to_torch() if not isinstance(walls.set.means, torch.Tensor) else walls.set
    for photo, camera in enumerate(cameras):
        for step in range(3):
            image = effects.render(photo, draw, current, camera)
            ((image.color - 0.3) ** 2).mean().backward()
            effects.step(photo, 0.5 + 0.1 * step)
    return effects, cameras, current


@pytest.fixture
def kept(learnt, tmp_path):
    effects, cameras, current = learnt
    names = [f"photo {index}.jpg" for index in range(len(cameras))]
    keep_effects(tmp_path / "effects.pt", effects, names, cameras)
    return tmp_path / "effects.pt", dict(zip(names, cameras, strict=True)), effects, current


def test_photos_are_drawn_as_they_were_when_training_ended(kept):
    path, cameras, effects, current = kept
    again = KeptEffects(path, EFFECTS, cameras)
    for photo, (name, camera) in enumerate(cameras.items()):
        with torch.no_grad():
            expected = effects.render(photo, draw, current, camera).color
            shown = again.render(name, draw, current, camera).color
            plain = draw(current, camera).color
        torch.testing.assert_close(shown, expected, rtol=0, atol=0)
        assert (shown - plain).abs().max() > 0.02


def test_in_millimetres_they_are_the_same_photos(kept):
    """A frame 2.5 times as large, turned and moved: cameras, splats and the extent with it."""
    path, cameras, effects, current = kept
    turn = Rotation.from_rotvec([0.3, -0.2, 0.9]).as_matrix()
    frame = Similarity(2.5, turn, np.array([10.0, -4.0, 7.0]))
    moved = {name: camera.transformed(frame) for name, camera in cameras.items()}
    again = KeptEffects(path, EFFECTS, moved, frame.scale)
    name = next(iter(cameras))
    with torch.no_grad():
        expected = effects.render(0, draw, current, cameras[name]).color
        shown = again.render(name, draw, current.to_numpy().transformed(frame).to_torch(), moved[name]).color
    assert (shown - expected).abs().mean() < 2e-3


def test_training_photos_are_compared_with_what_is_known_of_them(kept):
    """Fitted anew they would be as near as their fit is, and each comparison would take hundreds of steps."""
    path, cameras, effects, current = kept
    with torch.no_grad():
        images = [effects.render(photo, draw, current, camera).color for photo, camera in enumerate(cameras.values())]
    views = [(camera, image.clamp(0, 1).numpy()) for camera, image in zip(cameras.values(), images, strict=True)]
    again = KeptEffects(path, EFFECTS, cameras)
    shown = photo_figures(current.to_numpy(), views, None, "cpu", lambda: None, effects=again, names=list(cameras))
    assert shown["psnr"] > 90
    assert photo_figures(current.to_numpy(), views, None, "cpu", lambda: None)["psnr"] < 60


def test_they_are_not_learnt_any_more_but_splats_are(kept):
    path, cameras, _, current = kept
    again = KeptEffects(path, EFFECTS, cameras)
    name, camera = next(iter(cameras.items()))
    trained = replace(current, sh=current.sh.clone().requires_grad_(True))
    first = again.render(name, draw, trained, camera).color
    ((first - 0.7) ** 2).mean().backward()
    assert float(trained.sh.grad.abs().max()) > 0
    second = again.render(name, draw, trained, camera).color
    torch.testing.assert_close(second, first, rtol=0, atol=0)


def test_a_photo_that_was_not_trained_on_is_drawn_plainly(kept):
    path, cameras, _, current = kept
    camera = next(iter(cameras.values()))
    with torch.no_grad():
        shown = KeptEffects(path, EFFECTS, cameras).render("another.jpg", draw, current, camera).color
        torch.testing.assert_close(shown, draw(current, camera).color, rtol=0, atol=0)


def test_so_is_one_that_training_never_came_to(learnt, tmp_path):
    """Fewer steps than photos; a lens made up for it would be another one after each kill, by the splats of then."""
    _, cameras, current = learnt
    names = [f"{index}.jpg" for index in range(len(cameras))]
    keep_effects(tmp_path / "effects.pt", PhotoEffects(EFFECTS, cameras, 150.0), names, cameras)
    kept = KeptEffects(tmp_path / "effects.pt", EFFECTS, dict(zip(names, cameras, strict=True)))
    with torch.no_grad():
        shown = kept.render(names[0], draw, current, cameras[0]).color
        torch.testing.assert_close(shown, draw(current, cameras[0]).color, rtol=0, atol=0)


def test_capture_and_run_may_be_moved_together(learnt, tmp_path):
    effects, cameras, current = learnt
    places = [tmp_path / place for place in ("before", "after")]
    names = [[str(place / "capture" / f"{index}.jpg") for index in range(len(cameras))] for place in places]
    (places[0] / "run" / "surface").mkdir(parents=True)
    keep_effects(places[0] / "run" / "surface" / "effects.pt", effects, names[0], cameras)
    places[0].rename(places[1])
    again = KeptEffects(
        places[1] / "run" / "surface" / "effects.pt", EFFECTS, dict(zip(names[1], cameras, strict=True))
    )
    with torch.no_grad():
        expected = effects.render(1, draw, current, cameras[1]).color
        shown = again.render(names[1][1], draw, current, cameras[1]).color
    torch.testing.assert_close(shown, expected, rtol=0, atol=0)


def test_a_file_of_an_older_version_is_read(kept):
    """It has no relative paths."""
    path, cameras, effects, current = kept
    content = torch.load(path, weights_only=True)
    del content["relative"]
    torch.save(content, path)
    name, camera = list(cameras.items())[1]
    with torch.no_grad():
        shown = KeptEffects(path, EFFECTS, cameras).render(name, draw, current, camera).color
        torch.testing.assert_close(shown, effects.render(1, draw, current, camera).color, rtol=0, atol=0)


@pytest.mark.parametrize("damage", ["bytes", "effects", "photos"])
def test_what_cannot_be_read_is_named(kept, damage):
    path, cameras, *_ = kept
    if damage == "bytes":
        path.write_bytes(b"half a file")
    effects = EFFECTS[:1] if damage == "photos" else (*EFFECTS,)
    if damage == "effects":
        effects = (Defocus(start_radius_px=-1.0),)
    known = {} if damage == "photos" else cameras
    with pytest.raises(RunFolderError, match=r"effects\.pt: cannot be read .* run the stage surface again"):
        KeptEffects(path, effects, known)


def test_a_run_with_an_effect_draws_its_photos_with_it_to_the_end(tiny_capture, tiny_settings, tmp_path):
    surface = tiny_settings.stages["surface"]
    rgb = replace(surface.rgb, effects=(RollingShutter(least_bands=2),))
    settings = replace(tiny_settings, stages={**tiny_settings.stages, "surface": replace(surface, rgb=rgb)})
    report = reconstruct(tiny_capture, tmp_path / "run", settings=settings)
    assert (tmp_path / "run" / "surface" / "effects.pt").exists()
    assert report["heldout"]["photos"]["psnr"] > 10
    from insideout.core.capture.read import read_capture

    context = StageContext(read_capture(tiny_capture), RunFolder(tmp_path / "run"), photo_effects=rgb.effects)
    assert PhotoSeries(context, 48).effects is not None
    assert PhotoSeries(replace(context, photo_effects=()), 48).effects is None
