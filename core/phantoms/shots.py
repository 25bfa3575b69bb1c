"""What a photo is taken with: a camera, and where asked for a lens with an aperture, and a camera that moves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from ..similarity import Similarity
from ..views import Camera
from .room import room
from .settings import CaptureSettings

_LOWEST_DEGREES, _LOWEST_ON_TABLE, _HIGHEST_DEGREES = -40.0, 12.0, 72.0
_DISTANCE = 4.0
_FOCUS_SPREAD = 0.35


@dataclass(frozen=True, eq=False)
class Shot:
    """One photo to be taken, in the world frame, mm.

    Attributes:
        camera: its pose is the one in the middle of the readout; calibrations and transforms.json have this one.
        aperture_mm: diameter of the lens; 0 for a pinhole.
        focus_mm: distance along the viewing axis that is sharp. A point at depth z blurs to a disc of
            aperture · focal length in pixels · |1 / z - 1 / focus| pixels.
        ends: the poses (4, 4) world to camera when the first and the last row are read; None for a camera that stands
            still. Row j of H is read at j / (H - 1) of the way: the camera's centre moves along a line, its rotation
            along the shortest turn.
        open: the shutter is open all the way between the ends, and for all rows at once: the photo is the mean of the
            light on the way.
        gain: what light of red, green and blue is multiplied by before it is clipped; None for 1.
        backdrop: (height, width, 3) sRGB 0..1, what pixels show that miss the object; None for the plain background.
        lens: OpenCV's k1, k2, p1, p2 of what bends lines; None for a pinhole.
    """

    camera: Camera
    aperture_mm: float = 0.0
    focus_mm: float = 0.0
    ends: tuple[np.ndarray, np.ndarray] | None = None
    open: bool = False
    gain: tuple[float, float, float] | None = None
    backdrop: np.ndarray | None = None
    lens: tuple[float, float, float, float] | None = None

    def row_poses(self) -> tuple[np.ndarray, np.ndarray]:
        """Centres (height, 3) and rotations camera to world (height, 3, 3) while each row is read."""
        return self.poses_at(np.linspace(0, 1, self.camera.height))

    def poses_at(self, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Centres (T, 3) and rotations camera to world (T, 3, 3) at times (T,) of the way in 0..1."""
        if self.ends is None:
            turn = np.asarray(self.camera.world_to_camera)[:3, :3].T
            return np.tile(self.camera.center, (len(times), 1)), np.tile(turn, (len(times), 1, 1))
        time = times[:, None]
        first, last = (replace(self.camera, world_to_camera=end) for end in self.ends)
        start, stop = (Rotation.from_matrix(end[:3, :3].T) for end in self.ends)
        turn = (start.inv() * stop).as_rotvec()
        return (1 - time) * first.center + time * last.center, (start * Rotation.from_rotvec(time * turn)).as_matrix()


def opengl_camera_to_world(camera: Camera) -> np.ndarray:
    """The (4, 4) camera-to-world matrix with OpenGL camera axes (x right, y up, z backward)."""
    return np.linalg.inv(np.asarray(camera.world_to_camera, np.float64)) @ np.diag([1.0, -1.0, -1.0, 1.0])


def camera_ring(
    count: int,
    size_mm: float,
    width: int,
    height: int,
    rng: np.random.Generator,
    lowest_degrees: float = _LOWEST_DEGREES,
) -> list[Camera]:
    """Cameras on a sphere around the origin, from `lowest_degrees` to 72° above, evenly by the golden angle.

    Args:
        size_mm: the largest extent of the object; it fills about 80 % of the height of an image 3 : 4 or wider, which
            suits upright objects in 3 : 4 and all in a square.
    """
    low, high = np.sin(np.radians(lowest_degrees)), np.sin(np.radians(_HIGHEST_DEGREES))
    cameras = []
    for index in range(count):
        elevation = np.arcsin(low + (index + 0.5) / count * (high - low))
        azimuth = index * np.pi * (3 - np.sqrt(5)) + 0.1 * rng.standard_normal()
        farther, target = 1 + 0.03 * rng.standard_normal(), 0.02 * size_mm * rng.standard_normal(3)
        cameras.append(camera_at(azimuth, elevation, size_mm, width, height, farther, target))
    return cameras


def camera_at(
    azimuth: float,
    elevation: float,
    size_mm: float,
    width: int,
    height: int,
    farther: float = 1.0,
    target: Sequence[float] | np.ndarray = (0.0, 0.0, 0.0),
) -> Camera:
    """A camera four sizes away from the origin, upright.

    Args:
        azimuth, elevation: where it stands, radians; azimuth 0 is +x, π/2 is +y.
        size_mm: as for `camera_ring`.
        farther: its distance is multiplied by this.
        target: (3,) mm, what is in the middle of the image.
    """
    distance = _DISTANCE * size_mm
    focal = 0.86 * min(height, 4 * width / 3) * distance / (1.12 * size_mm)
    toward = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    pose = _look_at(farther * distance * toward, np.asarray(target))
    return Camera(width, height, focal, focal, width / 2, height / 2, pose)


def plan_shots(size_mm: float, settings: CaptureSettings, rng: np.random.Generator) -> list[Shot]:
    """The capture's photos: a ring of cameras, or on a table a dome of them, with the effects that are chosen.

    With "defocus" each photo is sharp at another depth, up to a third of the object before or behind its middle. With
    "rolling_shutter" each camera moves its own way, and turns about its viewing axis by as much; with "motion_blur" it
    does so across its viewing axis while its shutter is open. With "exposure" each photo has an exposure and a white
    balance of its own. With "moving_background" all photos show the same room behind the object. With "lens" one lens
    bends them all.

    Args:
        size_mm: the object's largest extent.
    """
    lowest = _LOWEST_ON_TABLE if "table" in settings.effects else _LOWEST_DEGREES
    width, height = settings.photo_width, settings.photo_height
    shots = [Shot(camera) for camera in camera_ring(settings.photos, size_mm, width, height, rng, lowest)]
    if "defocus" in settings.effects:
        aperture = settings.aperture_share * size_mm
        shots = [
            replace(shot, aperture_mm=aperture, focus_mm=_depth(shot) + size_mm * rng.uniform(-1, 1) * _FOCUS_SPREAD)
            for shot in shots
        ]
    if "rolling_shutter" in settings.effects:
        shots = [replace(shot, ends=_readout(shot.camera, settings.shutter_share, size_mm, rng)) for shot in shots]
    # Of their own, so that all else is the same without them.
    light = rng.spawn(1)[0]
    way = light.spawn(1)[0]
    if "exposure" in settings.effects:
        shots = [replace(shot, gain=_gain(settings.exposure_stops, light)) for shot in shots]
    if "motion_blur" in settings.effects:
        shots = [
            replace(shot, ends=_swept(shot.camera, settings.blur_share * size_mm, way), open=True) for shot in shots
        ]
    if "moving_background" in settings.effects:
        behind = room(width, height, settings.room_contrast, way.spawn(1)[0])
        shots = [replace(shot, backdrop=behind) for shot in shots]
    if "lens" in settings.effects:
        shots = [replace(shot, lens=(_bend(shot.camera, settings.lens_share), 0.0, 0.0, 0.0)) for shot in shots]
    return shots


def shot_truth(shots: list[Shot], to_photo: Similarity) -> dict[str, Any]:
    """For truth.npz: of a lens `aperture_mm` and `focus_mm` (N,), of moving cameras `shutter_poses` (N, 2, 4, 4), the
    camera-to-world matrices of the first and last row, or when the shutter opened and closed, in OpenGL axes in the
    photo frame, of exposures `exposure_gain`
    (N, 3), of a lens that bends lines `lens` (N, 4): k1, k2, p1, p2; nothing where none is."""
    found: dict[str, Any] = {}
    if any(shot.aperture_mm for shot in shots):
        found["aperture_mm"] = np.array([shot.aperture_mm for shot in shots])
        found["focus_mm"] = np.array([shot.focus_mm for shot in shots])
    if any(shot.ends for shot in shots):
        found["shutter_poses"] = np.array(
            [
                [
                    opengl_camera_to_world(replace(shot.camera, world_to_camera=end).transformed(to_photo))
                    for end in shot.ends or ()
                ]
                for shot in shots
            ]
        )
    if any(shot.gain for shot in shots):
        found["exposure_gain"] = np.array([shot.gain or (1.0, 1.0, 1.0) for shot in shots])
    if any(shot.lens for shot in shots):
        found["lens"] = np.array([shot.lens or (0.0, 0.0, 0.0, 0.0) for shot in shots])
    return found


def transforms(cameras: list[Camera], names: list[str], to_photo: Similarity) -> dict[str, object]:
    """Content of transforms.json: cameras moved from the world to the photo frame by `to_photo`."""
    first = cameras[0]
    frames = [
        {"file_path": name, "transform_matrix": opengl_camera_to_world(camera.transformed(to_photo)).tolist()}
        for name, camera in zip(names, cameras, strict=True)
    ]
    return {
        "camera_model": "PINHOLE",
        "w": first.width,
        "h": first.height,
        "fl_x": first.fx,
        "fl_y": first.fy,
        "cx": first.cx,
        "cy": first.cy,
        "frames": frames,
    }


def _depth(shot: Shot) -> float:
    """Of the origin, along the viewing axis."""
    return float(np.asarray(shot.camera.world_to_camera)[2, 3])


def _bend(camera: Camera, share: float) -> float:
    """k1 of a lens that shows the corners by a share of their distance from the middle farther out."""
    return share / ((0.5 * camera.width / camera.fx) ** 2 + (0.5 * camera.height / camera.fy) ** 2)


def _readout(camera: Camera, share: float, size_mm: float, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Poses half a readout before and after the camera's own."""
    way = rng.standard_normal(3)
    way *= 0.5 * share * size_mm / np.linalg.norm(way)
    turn = 0.5 * share * rng.choice([-1.0, 1.0])
    pose = np.linalg.inv(np.asarray(camera.world_to_camera, np.float64))
    ends = []
    for side in (-1.0, 1.0):
        moved = pose.copy()
        moved[:3, :3] = pose[:3, :3] @ Rotation.from_rotvec([0, 0, side * turn]).as_matrix()
        moved[:3, 3] += side * way
        ends.append(np.linalg.inv(moved))
    return ends[0], ends[1]


def _swept(camera: Camera, way_mm: float, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Poses when the shutter opens and closes: what the camera looks at moves across the image by half to one and a
    half times as far as `way_mm` does; half of that is a turn, half a shift. It rolls, too, by up to half of that at
    the object's rim."""
    angle, far = rng.uniform(0, 2 * np.pi), way_mm * rng.uniform(0.5, 1.5)
    across = np.array([np.cos(angle), np.sin(angle), 0.0])
    pose = np.linalg.inv(np.asarray(camera.world_to_camera, np.float64))
    distance = float(np.asarray(camera.world_to_camera)[2, 3])
    turn = 0.5 * far / distance * np.array([-across[1], across[0], 0.0])
    turn[2] = rng.uniform(-1, 1) * far * _DISTANCE / distance
    ends = []
    for side in (-0.5, 0.5):
        moved = pose.copy()
        moved[:3, :3] = pose[:3, :3] @ Rotation.from_rotvec(side * turn).as_matrix()
        moved[:3, 3] += side * 0.5 * far * pose[:3, :3] @ across
        ends.append(np.linalg.inv(moved))
    return ends[0], ends[1]


def _gain(stops: float, rng: np.random.Generator) -> tuple[float, float, float]:
    """An exposure, and a white balance that is a tenth as far off."""
    red, green, blue = np.exp2(stops * (rng.standard_normal() + 0.1 * rng.standard_normal(3))).tolist()
    return red, green, blue


def _look_at(position: np.ndarray, target: np.ndarray) -> np.ndarray:
    forward = (target - position) / np.linalg.norm(target - position)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, -rotation @ position
    return matrix
