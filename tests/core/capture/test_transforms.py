"""Known poses from transforms.json, as instant-ngp, nerfstudio and NeRF's synthetic scenes write it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from insideout.core.capture.layout import find_transforms
from insideout.core.capture.transforms import read_transforms
from insideout.core.errors import CaptureError


@pytest.fixture
def folder(tmp_path, write_corner_photos, write_transforms):
    write_transforms(tmp_path, write_corner_photos(tmp_path, 9))
    return tmp_path


def edit(folder, change):
    path = folder / "transforms.json"
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


def read(folder):
    return read_transforms(find_transforms(folder)).photos.photos


def test_opengl_matrices_become_opencv_cameras(folder, write_corner_photos):
    truth = write_corner_photos(folder, 9)
    for photo, camera in zip(read(folder), truth, strict=True):
        assert np.allclose(photo.camera.world_to_camera, camera.world_to_camera, atol=1e-9)
        assert (photo.camera.fx, photo.camera.cx, photo.camera.width) == (330, 160, 320)


def test_every_eighth_photo_is_held_out(folder):
    assert [photo.held_out for photo in read(folder)] == [True] + [False] * 7 + [True]


def test_named_test_images_are_held_out_instead(folder):
    edit(folder, lambda c: c.update(test_filenames=["03.png"], train_filenames=["00.png"]))
    assert [photo.held_out for photo in read(folder)].index(True) == 3
    assert sum(photo.held_out for photo in read(folder)) == 1


@pytest.mark.parametrize("name", ["03.png", "./03.png", "03", "images/03.png"])
def test_held_out_images_may_be_named_in_any_way_that_frames_may(folder, name):
    edit(folder, lambda c: [c["frames"][3].update(file_path="./03.png"), c.update(test_filenames=[name])])
    assert [photo.path.name for photo in read(folder) if photo.held_out] == ["03.png"]


def test_an_image_in_two_frames_is_named(folder):
    edit(folder, lambda c: c["frames"][5].update(file_path="./03.png"))
    with pytest.raises(CaptureError, match=r"transforms\.json: names 1 images that have a frame already: 03\.png"):
        read(folder)


def test_images_that_are_learnt_from_and_held_out_are_named(folder):
    """Of a copy, or of frames by folder whose images lie in one: figures would be of what was learnt."""
    (folder / "transforms.json").rename(folder / "transforms_train.json")
    for name in ("{}", "./test/{}"):
        content = json.loads((folder / "transforms_train.json").read_text())
        for frame in content["frames"]:
            frame["file_path"] = name.format(Path(frame["file_path"]).name)
        (folder / "transforms_test.json").write_text(json.dumps(content))
        with pytest.raises(CaptureError, match=r"transforms_test\.json: names 9 images that have a frame already"):
            read(folder)


def test_files_that_were_split_may_keep_the_whole_s_names(folder):
    content = json.loads((folder / "transforms.json").read_text())
    for part, frames in (("train", content["frames"][2:]), ("test", content["frames"][:2])):
        whole = {**content, "frames": frames, "test_filenames": ["00.png", "01.png"]}
        (folder / f"transforms_{part}.json").write_text(json.dumps(whole))
    (folder / "transforms.json").unlink()
    assert [photo.path.name for photo in read(folder) if photo.held_out] == ["00.png", "01.png"]


def test_field_of_view_instead_of_focal_length_and_no_size(folder):
    def change(content):
        for key in ("fl_x", "fl_y", "w", "h", "cx", "cy"):
            del content[key]
        content["camera_angle_x"] = 2 * np.arctan(160 / 330)

    edit(folder, change)
    camera = read(folder)[0].camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == pytest.approx((330, 330, 160, 120))


def test_a_frames_own_intrinsics_come_first(folder):
    edit(folder, lambda c: c["frames"][2].update(fl_x=300.0, fl_y=310.0))
    assert (read(folder)[2].camera.fx, read(folder)[2].camera.fy) == (300, 310)
    assert read(folder)[3].camera.fx == 330


def test_distortion_gives_a_lens_and_an_undistorted_camera(folder):
    edit(folder, lambda c: c.update(k1=-0.1, k2=0.02, p1=0.001, p2=0.0))
    photo = read(folder)[0]
    assert photo.lens.coefficients[:4] == (-0.1, 0.02, 0.001, 0.0)
    assert photo.camera.fx != 330


def test_nerf_synthetic_scenes_have_a_file_for_each_split(tmp_path, write_corner_photos, write_transforms):
    cameras = write_corner_photos(tmp_path, 8)
    write_transforms(tmp_path, cameras).rename(tmp_path / "transforms_train.json")
    content = json.loads((tmp_path / "transforms_train.json").read_text())
    for part, frames in (("test", content["frames"][6:]), ("train", content["frames"][:6])):
        for frame in frames:
            frame["file_path"] = "./" + frame["file_path"].removesuffix(".png")
        (tmp_path / f"transforms_{part}.json").write_text(json.dumps({**content, "frames": frames}))
    assert [photo.held_out for photo in read(tmp_path)] == [False] * 6 + [True] * 2


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda c: c["frames"][1].update(file_path="gone.png"), r"names 1 of 9 images that are missing: gone\.png"),
        (lambda c: c.update(frames=[]), "lists no 'frames'"),
        (lambda c: c["frames"][1].pop("file_path"), "frame 1 has no 'file_path'"),
        (lambda c: c["frames"][1].update(file_path="/"), "frame 1 has no 'file_path'"),
        (lambda c: c["frames"][1].pop("transform_matrix"), r"'transform_matrix' of 01\.png is not a finite"),
        (lambda c: c["frames"][1].update(transform_matrix=np.diag([2.0, 2, 2, 1]).tolist()), "is not a rotation"),
        (lambda c: c["frames"][1].update(transform_matrix=np.diag([1.0, 1, -1, 1]).tolist()), "is not a rotation"),
        (lambda c: c.pop("fl_x"), "lacks 'fl_x'"),
        (lambda c: c.update(fl_x=-3), "focal length of -3"),
        (lambda c: c.update(camera_model="EQUIRECTANGULAR"), "EQUIRECTANGULAR is not supported"),
        (lambda c: c.update(w=100, h=100), "but its camera is for 100 x 100"),
        (lambda c: c.update(w=0, h=0), r"'w, h' is \[0 0\]; give a value above zero"),
        (lambda c: [c.pop("fl_x"), c.pop("fl_y"), c.update(camera_angle_x=0)], "'camera_angle_x' is 0; give radians"),
        (lambda c: c.update(test_filenames=5), "'test_filenames' is 5; make it a list"),
        (lambda c: c.update(test_filenames=[f"{i:02d}.png" for i in range(9)]), "holds out 9 of 9 photos"),
        (lambda c: c.update(test_filenames=["03.png", "33.png"]), r"holds out 33\.png, of which no frame has the pose"),
    ],
)
def test_what_is_wrong_is_named(folder, change, says):
    edit(folder, change)
    with pytest.raises(CaptureError, match=says):
        read(folder)


def test_broken_json_is_located(folder):
    (folder / "transforms.json").write_text('{"frames": [\n{]}')
    with pytest.raises(CaptureError, match=r"transforms\.json: is not valid JSON at line 2"):
        read(folder)
