"""A capture folder -> Capture."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TypeVar

from ..densities import PER_MM, Densities
from ..progress import Tick, unstopped
from ..told import Told
from ..volume import Volume
from .agreement import match_projections
from .colmap import read_colmap
from .describe import (
    describe_landmarks,
    describe_photos,
    describe_projections,
    describe_volume,
    grid_findings,
    unused_photos,
)
from .digest import capture_digest
from .findings import CaptureProblem, info, name_some
from .landmarks import read_landmarks
from .layout import find_colmap, find_parts, find_transforms, overlooked
from .model import Capture, Finding, Landmarks, Photo, Photos, Projections
from .photos import list_foreign_images, list_images, verify_images
from .projections import find_projections, read_projections
from .transforms import read_transforms
from .volumes import array_files, find_volume, read_volume

_LAYOUT = (
    "put photos into photos/, and projections (meta_data.json and proj_train/, or a Nikon .xtekct with its .tif) or a "
    "volume (.nii.gz, .mha, .nrrd, .npz, one file volume.tif or volume.npy, or DICOM slices) into xray/"
)

Part = TypeVar("Part")


def read_capture(path: Path, tick: Tick = unstopped) -> Capture:
    """Reads and checks a capture folder; nothing in it is changed.

    Photos lie in photos/ (or images/, or in the folder itself), X-rays in xray/ (or in the folder itself). Either
    may be missing.

    Args:
        tick: called between parts and photos; may raise to stop.

    Raises:
        CaptureError: the first thing that is wrong: the file, what is the matter, what to do.
    """
    capture, problems = examine(Path(path), tick)
    if problems:
        raise problems[0]
    return capture


def examine(path: Path, tick: Tick = unstopped) -> tuple[Capture, list[CaptureProblem]]:
    """What could be read of a capture folder, and every problem met; its findings hold both."""
    reading = _Reading(Path(path), tick)
    reading.attempt(reading.find_parts)
    photos = reading.attempt(reading.photos)
    projections = reading.attempt(reading.projections)
    volume = reading.attempt(lambda: reading.volume(projections))
    landmarks = reading.attempt(reading.landmarks)
    if not reading.problems and photos is None and projections is None and volume is None:
        reading.problems.append(CaptureProblem(path, "holds no photos and no X-rays", _LAYOUT))
    digest = "" if reading.problems else reading.attempt(lambda: capture_digest(reading.folder, reading.files)) or ""
    findings = [*reading.findings, *(problem.finding for problem in reading.problems)]
    in_what = reading.densities, reading.volume_densities
    capture = Capture(Path(path), photos, projections, volume, landmarks, digest, findings, *in_what)
    return capture, reading.problems


@dataclass
class _Reading:
    """One pass over a capture folder: what was found so far and what went wrong."""

    folder: Path
    tick: Tick
    photo_folder: Path | None = None
    xray_folder: Path | None = None
    files: list[Path] = field(default_factory=list)
    findings: list[Finding] = field(default_factory=list)
    problems: list[CaptureProblem] = field(default_factory=list)
    densities: Densities = PER_MM
    volume_densities: Densities = PER_MM

    def attempt(self, part: Callable[[], Part]) -> Part | None:
        """One part of the capture; a problem with it is noted and the others are still read."""
        self.tick()
        try:
            return part()
        except CaptureProblem as problem:
            self._note(problem)
        except MemoryError:
            self._note(
                CaptureProblem(
                    self.folder,
                    "does not fit into memory",
                    "make the scan smaller with insideout bin, or average the voxels of a volume",
                )
            )
        except OSError as error:
            subject = error.filename or self.folder
            self._note(
                CaptureProblem(
                    subject,
                    "cannot be read ({reason})",
                    "check the file and its permissions",
                    reason=error.strerror or error,
                )
            )
        return None

    def _note(self, problem: CaptureProblem) -> None:
        # Two parts may stumble over one and the same file.
        if str(problem) not in map(str, self.problems):
            self.problems.append(problem)

    def find_parts(self) -> None:
        if not self.folder.is_dir():
            raise CaptureProblem(
                self.folder,
                "is a file" if self.folder.exists() else "does not exist",
                "give the folder that holds photos/ and xray/",
            )
        self.photo_folder, self.xray_folder = find_parts(self.folder)
        self.findings += overlooked(self.folder, self.photo_folder, self.xray_folder)

    def photos(self) -> Photos | None:
        folder = self.photo_folder
        if folder is None:
            return None
        images = list_images(folder)
        if self.xray_folder is not None and not folder.is_relative_to(self.xray_folder):
            images = [image for image in images if not image.is_relative_to(self.xray_folder)]
        foreign = list_foreign_images(folder)
        if foreign:
            problem = CaptureProblem(
                folder,
                "holds photos in a format that cannot be read ({names})",
                "export them as .jpg, .png or .tif",
                names=name_some([path.name for path in foreign]),
            )
            if not images:
                raise problem
            found = problem.finding
            self.findings.append(
                replace(found, level="warning", message=Told("{told}; they are left out", told=found.message))
            )
        if not images:
            raise CaptureProblem(folder, "holds no images", "put .jpg or .png photos there, or remove the folder")
        damaged = verify_images(images, self.tick)
        if damaged:
            self.problems.extend(damaged[:-1])
            raise damaged[-1]
        photos, poses, extra = self._posed(folder, images)
        if len(photos.photos) < 2:
            raise CaptureProblem(
                photos.photos[0].path,
                "is the only photo",
                "take at least 20 photos all around the object, each overlapping the next",
            )
        self.files += [photo.path for photo in photos.photos] + extra
        self.findings += describe_photos(folder, photos, poses)
        if poses:
            self.findings += unused_photos(folder, images, photos)
        return photos

    def _posed(self, folder: Path, images: list[Path]) -> tuple[Photos, str, list[Path]]:
        """Photos with the cameras that the folder knows, where those are from, and the files that said so."""
        for place in dict.fromkeys((folder, self.folder)):
            transforms = find_transforms(place)
            if transforms:
                posed = read_transforms(transforms)
                return posed.photos, transforms[0].name, posed.files
            model = find_colmap(place)
            if model is not None:
                named = {image.relative_to(folder).as_posix(): image for image in images}
                posed, name = read_colmap(model, named), model.relative_to(place).as_posix()
                return posed.photos, Told("the COLMAP model in {folder}", folder=name), posed.files
        return Photos([Photo(image, None) for image in images]), "", []

    def projections(self) -> Projections | None:
        source = None if self.xray_folder is None else find_projections(self.xray_folder)
        if source is None:
            if self.xray_folder is not None and not self.volume_file():
                raise _no_xrays(self.xray_folder)
            return None
        read = read_projections(source)
        self.files += read.files
        self.findings += [*describe_projections(source, read.projections), *read.findings]
        if self.volume_file() is None:
            self.findings += grid_findings(source, read.projections.voxels)
        return read.projections

    def volume_file(self) -> Path | None:
        if self.xray_folder is None:
            return None
        own = self.xray_folder != self.folder and find_projections(self.xray_folder) is None
        return find_volume(self.xray_folder, lone_array=own)

    def volume(self, projections: Projections | None) -> Volume | None:
        source = self.volume_file()
        if source is None:
            return None
        read = read_volume(source, None if projections is None else projections.box_mm)
        if projections is not None:
            read = match_projections(source, read, projections)
            led = "sections are taken from it and not from the projections; without it all is fitted to the projections"
            outline = "the outline is taken from it, but no density; without it all is fitted to the projections"
            # Grey values that fit the projections are relative no more.
            self.findings.append(info(source, outline if read.densities.relative else led))
            if read.densities.relative:
                # A run measures its sections against their FDK then.
                self.findings += grid_findings(source, projections.voxels)
        self.files += read.files
        self.findings += [*describe_volume(source, read.volume, read.densities), read.meaning, *read.findings]
        self.volume_densities = read.densities
        self.densities = read.of_model or read.densities
        return read.volume

    def landmarks(self) -> Landmarks | None:
        path = self.folder / "landmarks.json"
        if not path.is_file():
            return None
        landmarks = read_landmarks(path)
        self.findings += describe_landmarks(path, landmarks)
        return landmarks


def _no_xrays(folder: Path) -> CaptureProblem:
    arrays = array_files(folder)
    if not arrays:
        return CaptureProblem(folder, "holds neither projections nor a volume", _LAYOUT)
    return CaptureProblem(
        folder,
        "holds neither a volume nor the geometry of projections (meta_data.json, .xtekct), but {count} "
        "images ({names})",
        "add the scanner's geometry file, or join slices into one file volume.tif",
        count=len(arrays),
        names=name_some([path.name for path in arrays], 2),
    )
