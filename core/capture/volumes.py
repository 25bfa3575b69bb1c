"""A CT volume as a scanner or a reconstruction program leaves it -> Volume in mm⁻¹, in the world frame."""

from __future__ import annotations

import zipfile
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..densities import PER_MM, Densities
from ..threshold import evenly, large_attenuation
from ..told import Told
from ..volume import ARCHIVE_ERRORS, Volume, told_water
from .dicom import LEAST_HU, find_series, read_series
from .findings import CaptureProblem, info, last_line, name_some, warning
from .listing import notes_path, shown_files, suffix_of
from .model import Finding
from .tiff import read_stack
from .values import number, numbers, positive, read_array, read_json
from .voxel_size import mm_of, size_in_header

if TYPE_CHECKING:
    import SimpleITK

MU_WATER_PER_MM = 0.0195
"""Attenuation of water in mm⁻¹ at about 69 keV, the effective energy of a 120 kV scan (NIST XCOM)."""

GREY_TO_PER_MM = 0.05
"""Attenuation that the brightest grey values stand for when a volume has no physical unit."""

RELATIVE = Told("densities are relative")
"""What the warning about such a volume says, by which the model of a run is known to have no unit of density."""

_ITK_SUFFIXES = (".nii.gz", ".nii", ".mha", ".mhd", ".nrrd", ".nhdr")
_ARRAY_SUFFIXES = (".npz", ".npy", ".tif", ".tiff")
# From 500 keV down to 25 (NIST XCOM).
_LIKELY_WATER = (0.01, 0.05)
_UNITS = ("HU", "1/mm", "1/cm", "grey")
# Air has as little, and some of it is in every scan: a single voxel is the overshoot of a filter.
_AIR_HU, _SOME_AIR = -500, 0.01
# Percent of voxels that stray below air; by how much of the larger values noise and overshoots go below 0.
_STRAY, _BELOW_ZERO = 0.1, 0.25
_SAY_UNIT = 'say "unit" ({units}) in {name} beside it'
_NO_SPACING = 'put a {name} beside it with {{"spacing_mm": [x, y, z]}}'


@dataclass
class VolumeFiles:
    """A volume, the files it came from, and what there is to say about it.

    Attributes:
        meaning: what its values were taken for.
        unit_known: whether the file or the user says what its values are, or Hounsfield units were recognised.
        densities: what the volume's are in.
        of_model: what those of a model are in that is fitted to projections beside it; None without those, for then
            it is made from the volume alone.
    """

    volume: Volume
    files: list[Path]
    meaning: Finding
    unit_known: bool
    findings: list[Finding] = field(default_factory=list)
    densities: Densities = PER_MM
    of_model: Densities | None = None


@dataclass
class _Grid:
    """Voxels as read: values [z, y, x], spacing x, y, z in mm, the file's own origin if it has one, its unit, the
    water that Hounsfield units had been converted with when a run left the file, and what there is to say; `of_size`
    is about the voxel size that the file tells."""

    values: np.ndarray
    spacing_mm: np.ndarray
    origin_mm: np.ndarray | None
    files: list[Path]
    unit: str | None = None
    mu_water: float = MU_WATER_PER_MM
    water_per_mm: float | None = None
    findings: list[Finding] = field(default_factory=list)
    of_size: list[Finding] = field(default_factory=list)
    origin_is_world: bool = False


def find_volume(folder: Path, lone_array: bool = False) -> Path | None:
    """The volume in a folder: a file named volume.*, else the only volume file, else a folder of DICOM slices.

    Args:
        lone_array: in the end also the only .tif, .npy or .npz, whatever it is called: for a folder that is for X-rays
            and has no projections.

    Raises:
        CaptureError: several files or folders of DICOM slices could be the volume.
    """
    files = [path for path in shown_files(folder) if suffix_of(path) in _ITK_SUFFIXES + _ARRAY_SUFFIXES]
    named = [path for path in files if path.name.lower().startswith("volume.")]
    if len(named) == 1:
        return named[0]
    # Projections, references and phantoms lie about as .npy and .tif: only a volume's own formats speak for themselves.
    plain = named or [p for p in files if suffix_of(p) in _ITK_SUFFIXES or _is_volume_archive(p)]
    if len(plain) > 1:
        raise CaptureProblem(
            folder,
            "holds several volumes: {names}",
            "keep one, or name it volume.*",
            names=name_some([p.name for p in plain]),
        )
    found = plain[0] if plain else find_series(folder)
    if found is not None or not lone_array:
        return found
    # What an archive lacks its reader tells.
    alone = array_files(folder) or [path for path in files if suffix_of(path) == ".npz"]
    return alone[0] if len(alone) == 1 else None


def array_files(folder: Path) -> list[Path]:
    """The files in a folder that may be a volume, a slice of one or a projection: .npy, .tif."""
    return [path for path in shown_files(folder) if suffix_of(path) in (".npy", ".tif", ".tiff")]


def read_volume(source: Path, box_mm: np.ndarray | None = None) -> VolumeFiles:
    """Reads .nii.gz, .mha, .nrrd, .npz, .npy, a .tif stack, or a folder of DICOM slices.

    A file `<name>.json` beside it may give `spacing_mm` [x, y, z], `origin_mm` (middle of the first voxel), `unit`
    ("HU", "1/mm", "1/cm" or "grey") and `mu_water_per_mm`. Hounsfield units become μ = μ_water·(1 + HU/1000), not
    below zero. Grey values without a unit are scaled so that `large_attenuation` of them is 0.05 mm⁻¹.

    Args:
        box_mm: (2, 3) the box of the projections. The file's own position is kept where it lines up with the box,
            and without projections where the user gave it as the world's (`origin_mm`, or `origin_mm_zyx` in an
            .npz); else the middle of the volume is put at that of the box, or at the world's origin.

    Raises:
        CaptureError: the file cannot be read, has no voxel size, or holds no finite values.
    """
    grid = _apply_notes(source, _read_grid(source))
    _check_grid(source, grid)
    unit = grid.unit or _guess_unit(grid.values)
    values, meaning = _to_attenuation(source, grid, unit)
    volume = Volume.centered(values, grid.spacing_mm)
    if box_mm is not None:
        volume = replace(volume, origin_mm=volume.origin_mm + np.mean(box_mm, axis=0))
    if grid.origin_mm is not None:
        physical = Volume(volume.values, volume.spacing_mm, np.asarray(grid.origin_mm, np.float64))
        if grid.origin_is_world if box_mm is None else _lines_up(physical.box_mm, box_mm):
            volume = physical
    findings = [*grid.findings, *grid.of_size]
    if box_mm is not None and not _lines_up(volume.box_mm, box_mm):
        findings.append(
            warning(
                source,
                "the volume is {size} mm but the projections' box is {box} mm",
                "check the voxel size, or take one of the two out of the capture if they are different scans",
                size=_size_text(volume.box_mm),
                box=_size_text(box_mm),
            )
        )
    known = unit == "HU" or grid.unit in ("1/mm", "1/cm")
    water = {"HU": grid.mu_water, "1/mm": grid.water_per_mm}.get(unit)
    return VolumeFiles(volume, grid.files, meaning, known, findings, Densities(unit == "grey", water))


def _read_grid(source: Path) -> _Grid:
    if source.is_dir():
        return _read_dicom(source)
    readers: dict[str, Callable[[Path], _Grid]] = {
        ".npz": _read_npz,
        ".npy": _read_npy,
        ".tif": _read_tif,
        ".tiff": _read_tif,
    }
    return readers.get(suffix_of(source), _read_itk)(source)


def _read_npz(path: Path) -> _Grid:
    try:
        archive = np.load(path, allow_pickle=False)
        if isinstance(archive, np.ndarray):
            raise CaptureProblem(path, "is an .npy", "export it as .npz")
        with archive:
            content = {name: archive[name] for name in archive.files}
    except ARCHIVE_ERRORS as error:
        raise CaptureProblem(
            path, "is damaged: it cannot be read as .npz ({error})", "save it again", error=error
        ) from error
    if "volume" not in content:
        raise CaptureProblem(path, "lacks 'volume'", "save it with volume [z, y, x] and spacing_mm_zyx")
    if "spacing_mm_zyx" not in content and not notes_path(path).is_file():
        raise CaptureProblem(path, "has no voxel size", "save it again with spacing_mm_zyx in mm")
    spacing = content.get("spacing_mm_zyx", np.full(3, np.nan))
    origin = content.get("origin_mm_zyx")
    return _Grid(
        content["volume"],
        np.asarray(spacing, np.float64).ravel()[::-1].copy(),
        None if origin is None else np.asarray(origin, np.float64).ravel()[::-1].copy(),
        [path],
        unit=str(content["unit"]) if "unit" in content else None,
        water_per_mm=told_water(content.get("water_per_mm")),
        origin_is_world=origin is not None,
    )


def _read_npy(path: Path) -> _Grid:
    if not notes_path(path).is_file():
        raise CaptureProblem(path, "has no voxel size", _NO_SPACING, name=notes_path(path).name)
    return _Grid(read_array(path), np.full(3, np.nan), None, [path])


def _read_tif(path: Path) -> _Grid:
    stack = read_stack(path)
    if stack.spacing_mm is None and not notes_path(path).is_file():
        raise CaptureProblem(path, "has no voxel size", _NO_SPACING, name=notes_path(path).name)
    spacing = np.full(3, np.nan) if stack.spacing_mm is None else stack.spacing_mm
    return _Grid(stack.values, spacing, None, [path], findings=stack.findings, of_size=stack.of_size)


def _read_itk(path: Path) -> _Grid:
    import SimpleITK as sitk

    try:
        image = sitk.ReadImage(str(path))
    except RuntimeError as error:
        raise CaptureProblem(path, "cannot be read ({reason})", "export it again", reason=last_line(error)) from error
    noted, (told, unit) = notes_path(path).is_file(), size_in_header(path, suffix_of(path))
    in_mm = mm_of(unit or "mm")
    if not (told or noted):
        raise CaptureProblem(path, "has no voxel size", _NO_SPACING, name=notes_path(path).name)
    if in_mm is None and not noted:
        raise CaptureProblem(
            path,
            "has its voxel size in '{unit}', which is no length known here",
            _NO_SPACING,
            unit=unit,
            name=notes_path(path).name,
        )
    files = [path]
    if suffix_of(path) in (".mhd", ".nhdr"):
        files += [p for p in sorted(path.parent.glob(f"{path.stem}.*")) if p != path and p.suffix in (".raw", ".zraw")]
        files += [p for p in _named_in(path) if p not in files]
    grid = _from_itk(path, image, files)
    grid.spacing_mm = grid.spacing_mm * in_mm if told and in_mm is not None else np.full(3, np.nan)
    if grid.origin_mm is not None:
        grid.origin_mm = None if in_mm is None else grid.origin_mm * in_mm
    return grid


def _named_in(header: Path) -> list[Path]:
    """Files that a line of a MetaImage or NRRD header names: the voxels, whatever their file is called."""
    lines = header.read_text("utf-8", errors="replace").splitlines()
    said = {line.replace("=", ":", 1).partition(":")[2].strip() for line in lines} | {line.strip() for line in lines}
    return [header.parent / name for name in sorted(said) if 0 < len(name) < 256 and (header.parent / name).is_file()]


def _read_dicom(folder: Path) -> _Grid:
    series = read_series(folder)
    grid = _from_itk(folder, series.image, series.files)
    if not series.tells_size:
        if not notes_path(folder).is_file():
            raise CaptureProblem(folder, "has no voxel size", _NO_SPACING, name=notes_path(folder).name)
        grid.spacing_mm = np.full(3, np.nan)
    grid.unit = "HU" if series.in_hounsfield else None
    grid.findings += series.findings
    grid.of_size += series.of_size
    return grid


def _from_itk(source: Path, image: SimpleITK.Image, files: list[Path]) -> _Grid:
    """Turns the image so that its axes are the patient's x, y, z (LPS, z up), which keeps handedness."""
    import SimpleITK as sitk

    if image.GetDimension() == 4 and image.GetSize()[3] == 1:
        image = image[:, :, :, 0]
    if image.GetDimension() != 3 or image.GetNumberOfComponentsPerPixel() != 1:
        raise CaptureProblem(source, "has size {size}, not one 3D volume", "export one 3D volume", size=image.GetSize())
    image = sitk.DICOMOrient(image, "LPS")
    if not np.allclose(np.reshape(image.GetDirection(), (3, 3)), np.eye(3), atol=1e-3):
        image = _straightened(image)
    return _Grid(
        sitk.GetArrayFromImage(image),
        np.array(image.GetSpacing(), np.float64),
        np.array(image.GetOrigin(), np.float64),
        files,
    )


def _straightened(image: SimpleITK.Image) -> SimpleITK.Image:
    """An oblique volume resampled on a grid along the axes that holds all of it."""
    import SimpleITK as sitk

    size = np.array(image.GetSize())
    corners = [
        image.TransformContinuousIndexToPhysicalPoint([float(c[k] * (size[k] - 1)) for k in range(3)])
        for c in np.ndindex(2, 2, 2)
    ]
    low, high = np.min(corners, axis=0), np.max(corners, axis=0)
    spacing = np.array(image.GetSpacing())
    count = [int(n) for n in np.ceil((high - low) / spacing) + 1]
    lowest = float(sitk.GetArrayViewFromImage(image).min())
    return sitk.Resample(
        image,
        count,
        sitk.Transform(),
        sitk.sitkLinear,
        low.tolist(),
        spacing.tolist(),
        np.eye(3).ravel().tolist(),
        lowest,
    )


def _apply_notes(source: Path, grid: _Grid) -> _Grid:
    """What the user says in a .json beside the volume takes the place of what the file says."""
    path, unit_from = notes_path(source), source
    if path.is_file():
        notes = read_json(path)
        if not isinstance(notes, dict):
            raise CaptureProblem(path, "is not a JSON object", 'write {{"spacing_mm": [x, y, z]}}')
        if "spacing_mm" in notes:
            grid.spacing_mm, grid.of_size = numbers(path, notes, "spacing_mm", 3), []
        if "origin_mm" in notes:
            grid.origin_mm = numbers(path, notes, "origin_mm", 3)
            grid.origin_is_world = True
        if notes.get("unit") is not None:
            grid.unit, unit_from = notes["unit"], path
        grid.mu_water = number(path, notes, "mu_water_per_mm", MU_WATER_PER_MM)
        positive(path, "mu_water_per_mm", grid.mu_water)
        grid.findings += _odd_water(path, grid.mu_water)
        grid.files.append(path)
    if grid.unit is not None and grid.unit not in _UNITS:
        raise CaptureProblem(
            unit_from, "'unit' is {unit}", _SAY_UNIT, unit=repr(grid.unit), units=", ".join(_UNITS), name=path.name
        )
    return grid


def _odd_water(path: Path, water: float) -> list[Finding]:
    low, high = _LIKELY_WATER
    if low <= water <= high:
        return []
    return [
        warning(
            path,
            "'mu_water_per_mm' is {water:g} mm⁻¹, but water has {low:g} to {high:g} mm⁻¹ for X-rays of 25 to 500 keV",
            "check it; from a value in cm⁻¹ take a tenth",
            water=water,
            low=low,
            high=high,
        )
    ]


def _check_grid(source: Path, grid: _Grid) -> None:
    spacing = grid.spacing_mm
    if grid.values.ndim != 3 or min(grid.values.shape) < 2 or grid.values.dtype.kind not in "fiub":
        raise CaptureProblem(
            source,
            "has shape {shape} of {dtype}, not a 3D volume",
            "save [z, y, x] numbers",
            shape=grid.values.shape,
            dtype=grid.values.dtype,
        )
    if spacing.shape != (3,) or not np.isfinite(spacing).all() or np.any(spacing <= 0):
        raise CaptureProblem(
            source,
            "has voxel size {spacing}",
            _NO_SPACING,
            spacing=spacing.tolist(),
            name=notes_path(source).name,
        )
    if not np.isfinite(grid.values).all():
        raise CaptureProblem(source, "holds NaN or infinite values", "export it again, or set those voxels to air")
    if grid.values.min() == grid.values.max():
        raise CaptureProblem(source, "is {level} everywhere", "export it again", level=grid.values.min())


def _to_attenuation(source: Path, grid: _Grid, unit: str) -> tuple[np.ndarray, Finding]:
    values = np.asarray(grid.values, np.float32)
    if unit == "HU":
        meaning = info(source, "Hounsfield units, converted with μ_water = {water:g} mm⁻¹", water=grid.mu_water)
        return np.maximum(grid.mu_water * (1.0 + values / 1000.0), 0.0), meaning
    units, name = ", ".join(_UNITS), notes_path(source).name
    if unit == "1/mm":
        if grid.unit is None:
            return values, warning(
                source,
                "has no unit; its values up to {most:.3g} were taken for attenuation in mm⁻¹",
                _SAY_UNIT,
                most=values.max(),
                units=units,
                name=name,
            )
        return values, info(source, "the volume is attenuation in mm⁻¹")
    if unit == "1/cm":
        return values / 10.0, info(source, "the volume is attenuation in cm⁻¹, converted to mm⁻¹")
    low = _air_level(values)
    high = low + large_attenuation(evenly(values) - np.float32(low))
    scale = GREY_TO_PER_MM / (high - low)
    return np.maximum(values - np.float32(low), 0.0) * np.float32(scale), warning(
        source,
        "has gray values without a unit; {high:g} was taken for {attenuation} mm⁻¹, so {relative}",
        _SAY_UNIT,
        high=high,
        attenuation=GREY_TO_PER_MM,
        relative=RELATIVE,
        units=units,
        name=name,
    )


def _air_level(values: np.ndarray) -> float:
    """The grey value of air: the lowest but for a few stray voxels, or 0 where it is noise that goes below it."""
    low, high = np.percentile(evenly(values), [_STRAY, 100 - _STRAY], method="lower")
    return 0.0 if -_BELOW_ZERO * high <= low <= 0 else float(low)


def _guess_unit(values: np.ndarray) -> str:
    """HU when some of it is air near −1000; mm⁻¹ for small fractional numbers; else grey values."""
    low, high = float(values.min()), float(values.max())
    if LEAST_HU <= low <= _AIR_HU and 0 < high < 70000 and np.mean(evenly(values) <= _AIR_HU) >= _SOME_AIR:
        return "HU"
    if values.dtype.kind == "f" and low > -0.5 and high < 2.0:
        return "1/mm"
    return "grey"


def _lines_up(box: np.ndarray, other: np.ndarray) -> bool:
    """Whether two boxes have about one size and one place."""
    size, reference = box[1] - box[0], other[1] - other[0]
    shift = np.abs(box.mean(axis=0) - other.mean(axis=0))
    return bool(np.all(np.abs(size - reference) <= 0.25 * reference) and np.all(shift <= 0.1 * reference))


def _size_text(box: np.ndarray) -> str:
    return " x ".join(f"{length:.1f}" for length in box[1] - box[0])


def _is_volume_archive(path: Path) -> bool:
    """Whether a file is an .npz with an array called `volume`."""
    if suffix_of(path) != ".npz" or not zipfile.is_zipfile(path):
        return False
    with zipfile.ZipFile(path) as archive:
        return "volume.npy" in archive.namelist()
