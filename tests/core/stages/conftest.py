"""A small object of two shells, photographed and X-rayed, up to the end of `align`."""

import shutil

import cv2
import numpy as np
import pytest
import torch

from insideout.core.capture.model import Capture, Photo, Photos, Projections
from insideout.core.capture.registered import save_photos
from insideout.core.files import write_json
from insideout.core.gaussians import GaussianSet, Modality
from insideout.core.progress import Progress, Reporter
from insideout.core.render import splat
from insideout.core.rotations import normalize_quats, quats_to_matrices
from insideout.core.run_folder import RunFolder
from insideout.core.similarity import Similarity
from insideout.core.spherical_harmonics import rgb_to_sh
from insideout.core.stages.context import StageContext
from insideout.core.views import Camera, Detector
from insideout.core.volume import Volume

OUTER_MM, INNER_MM, THICKNESS_MM = 18.0, 8.0, 3.0


def sphere_points(count):
    index = np.arange(count) + 0.5
    z = 1 - 2 * index / count
    angle = np.pi * (1 + 5**0.5) * index
    return np.stack([np.sqrt(1 - z * z) * np.cos(angle), np.sqrt(1 - z * z) * np.sin(angle), z], -1)


def shells_volume(voxels=36, side_mm=48.0):
    step = side_mm / voxels
    axis = (np.arange(voxels) + 0.5) * step - side_mm / 2
    radius = np.sqrt(axis[:, None, None] ** 2 + axis[None, :, None] ** 2 + axis[None, None, :] ** 2)

    def shell(outside):
        inside = np.clip((outside - radius) / step + 0.5, 0, 1)
        return inside - np.clip((outside - THICKNESS_MM - radius) / step + 0.5, 0, 1)

    return Volume.centered(0.05 * shell(OUTER_MM) + 0.08 * shell(INNER_MM), np.full(3, step))


def blurred_xray(volume, count=1500):
    """Splats too wide for the shells they lie in."""
    random = np.random.default_rng(1)
    z, y, x = np.nonzero(volume.values > 0.02)
    chosen = random.choice(len(x), count, replace=False)
    points = volume.origin_mm + np.stack([x, y, z], -1)[chosen] * volume.spacing_mm
    density = volume.values[z[chosen], y[chosen], x[chosen]]
    # As much attenuation in all as the object has: projections fit, sections are blurred.
    mass = density.sum() * (np.sqrt(2 * np.pi) * 1.6) ** 3
    density = density * volume.values.sum() * np.prod(volume.spacing_mm) / mass
    return GaussianSet.create(points, 1.6, density=density, opacities=0.1, modality=Modality.XRAY)


def outside_rgb(count=900):
    normals = sphere_points(count)
    turn = np.concatenate([1 + normals[:, 2:], -normals[:, 1:2], normals[:, :1], np.zeros((count, 1))], 1)
    scales = np.tile([1.2, 1.2, 0.3], (count, 1))
    colors = 0.5 + 0.4 * np.sin(normals * [5.0, 4.0, 6.0])
    sh = np.zeros((count, 4, 3), np.float32)
    sh[:, 0] = rgb_to_sh(colors)
    sh[:, 1:] = np.random.default_rng(2).normal(0, 0.02, (count, 3, 3))
    return GaussianSet.create(
        (OUTER_MM - 0.3) * normals, scales, quats=normalize_quats(turn), opacities=0.95, sh=sh, modality=Modality.RGB
    )


def cameras(count, size=48, distance=80.0):
    views = []
    for direction in sphere_points(count):
        forward = -direction
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        rotation = np.stack([right, np.cross(forward, right), forward])
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation, -rotation @ (direction * distance)
        views.append(Camera(size, size, 1.6 * size, 1.6 * size, size / 2, size / 2, pose))
    return views


def projections_of(volume, count=20, size=36):
    detectors, images = [], []
    for angle in 2 * np.pi * np.arange(count) / count:
        c, s = np.cos(angle), np.sin(angle)
        detector = Detector(
            size, size, np.array([120 * c, 120 * s, 0]), -60 * np.array([c, s, 0]), 2.0 * np.array([-s, c, 0]),
            np.array([0, 0, -2.0]),
        )  # fmt: skip
        origins, directions = detector.rays()
        steps = np.linspace(70, 170, 161)
        points = origins[..., None, :] + steps[:, None] * directions[..., None, :]
        images.append(volume.sample(points).sum(-1) * (steps[1] - steps[0]))
        detectors.append(detector)
    return Projections(
        images=np.stack(images).astype(np.float32),
        detectors=detectors,
        held_out=np.arange(count) % 5 == 2,
        angles_rad=2 * np.pi * np.arange(count) / count,
        box_mm=volume.box_mm,
        voxels=volume.values.shape[::-1],
    )


@pytest.fixture(scope="session")
def shells_capture(tmp_path_factory):
    """(capture, run folder up to align) of the two shells; copy the folder before writing to it."""
    folder = tmp_path_factory.mktemp("two_shells")
    run = RunFolder(folder / "run")
    volume = shells_volume()
    run.stage("initialize")
    volume.save(run.path / "initialize" / "volume.npz")
    rgb = outside_rgb()
    quats = normalize_quats(np.array([[0.8, 0.2, -0.5, 0.1]]))
    similarity = Similarity(20.0, quats_to_matrices(quats)[0], np.array([3.0, -2.0, 5.0]))
    background = torch.tensor([1.0, 1.0, 1.0])
    photos = []
    for index, camera in enumerate(cameras(10)):
        image = splat(rgb.to_torch(), camera, background).color.numpy()
        path = folder / "photos" / f"{index:02d}.png"
        path.parent.mkdir(exist_ok=True)
        cv2.imwrite(str(path), np.round(255 * np.clip(image[..., ::-1], 0, 1)).astype(np.uint8))
        photos.append(Photo(path, camera.transformed(similarity.inverse()), held_out=index % 5 == 2))
    save_photos(run.path / "initialize" / "photos.json", Photos(photos))
    run.write_set("surface", "rgb", rgb.transformed(similarity.inverse()))
    run.write_set("surface", "xray", blurred_xray(volume))
    random = np.random.default_rng(3)
    loose = 0.95 * rgb.means + random.normal(0, 0.15, rgb.means.shape)
    run.write_set("align", "rgb", GaussianSet(**{**vars(rgb), "means": loose.astype(np.float32)}))
    for stage in ("initialize", "surface"):
        write_json(run.path / stage / "report.json", {})
    write_json(run.path / "align" / "report.json", {"similarity": similarity.to_json()})
    capture = Capture(path=folder, photos=Photos(photos), projections=projections_of(volume))
    return capture, run.path


@pytest.fixture
def shells_context(shells_capture, tmp_path):
    """A context whose run folder may be written to."""
    capture, path = shells_capture
    shutil.copytree(path, tmp_path / "run")
    return StageContext(capture, RunFolder(tmp_path / "run"), seed=0)


@pytest.fixture
def stopping_in():
    """Makes a reporter by which the user asks to stop when a part has made its first step."""

    def reporter(part: str) -> Reporter:
        asked = False

        def listen(progress: Progress) -> None:
            nonlocal asked
            asked = asked or (progress.part == part and progress.iteration > 0)

        return Reporter(listen, lambda: asked)

    return reporter
