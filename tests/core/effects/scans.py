"""Exact scans of a few ellipsoids, without noise, for measuring what a scanner did to them."""

from dataclasses import dataclass, replace

import numpy as np

from insideout.core.capture.detectors import CircularScan
from insideout.core.capture.model import Projections
from insideout.core.effect_names import XRAY_EFFECTS
from insideout.core.effects.look.reproject import moved

DSO, DSD, BOX = 200.0, 300.0, 32.0


@dataclass(frozen=True)
class Ellipsoid:
    """Centre and semi axes in mm, turn about z in rad, attenuation in mm⁻¹ that it adds."""

    center: tuple
    axes: tuple
    turn: float
    value: float

    def chords(self, detector):
        """(height, width) mm that the detector's rays run inside."""
        cos, sin = np.cos(self.turn), np.sin(self.turn)
        to_ball = np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]]) / np.array(self.axes)[:, None]
        source, middle, u, v = (np.asarray(part) for part in (detector.source, detector.center, detector.u, detector.v))
        still = np.zeros((2, 3))
        if detector.parallel:
            start, way = np.stack([middle - self.center, u, v]), np.stack([source / np.linalg.norm(source), *still])
        else:
            start, way = np.stack([source - self.center, *still]), np.stack([middle - source, u, v])
        columns = np.arange(detector.width) + 0.5 - detector.width / 2
        rows = np.arange(detector.height)[:, None] + 0.5 - detector.height / 2
        first, along = start @ to_ball.T, way @ to_ball.T
        mixed, square = products(first, along, columns, rows), products(along, along, columns, rows)
        inside = np.maximum(mixed**2 - square * (products(first, first, columns, rows) - 1), 0)
        return 2 * np.sqrt(inside * products(way, way, columns, rows)) / square


def products(one, other, columns, rows):
    """Broadcasts to (height, width): dot products of two vectors `a + column * b + row * c`, given as (3, 3) abc.

    Many times as fast as with the vectors of all pixels.
    """
    factors = (np.ones(1), columns, rows)
    return sum(
        (a @ b) * (by * times)
        for a, by in zip(one, factors, strict=True)
        for b, times in zip(other, factors, strict=True)
        if a @ b != 0
    )


# One material: holes and lumps in a body that is nobody's sphere.
BODIES = (
    Ellipsoid((0, 0, 0), (12, 9, 13), 0.4, 0.05),
    Ellipsoid((4, 2, 3), (3, 4, 5), 0.0, -0.05),
    Ellipsoid((-5, -2, -4), (2.5, 2.5, 4), 0.0, -0.05),
    Ellipsoid((0, 9.5, -5), (2.5, 1.5, 2), 0.2, 0.05),
    Ellipsoid((-8, 5, 7), (1.2, 1.2, 1.2), 0.0, 0.05),
)
# A denser foot, for captures of two materials.
FOOT = Ellipsoid((2, -3, -9), (3, 2, 2), 0.0, 0.15)


def ellipsoid_scan(size=64, views=60, heldout=6, bodies=BODIES, true=None, supersampled=2):
    """Projections of the bodies: the detectors of the files, the images of those that truly were.

    Args:
        true: (detector, index) -> the detector as it truly stood; as in the files if None.
        supersampled: rays a pixel and side, so that a pixel is the mean over its area.
    """
    scan = CircularScan(size, size, (1.5 * BOX / size,) * 2, DSO, DSD)
    rng = np.random.default_rng(5)
    angles = np.concatenate([np.arange(views) * 2 * np.pi / views, np.sort(rng.uniform(0, 2 * np.pi, heldout))])
    detectors = scan.detectors(angles)
    images = [lines(bodies, one if true is None else true(one, i), supersampled) for i, one in enumerate(detectors)]
    return Projections(
        images=np.stack(images).astype(np.float32), detectors=detectors, held_out=np.arange(len(angles)) >= views,
        angles_rad=angles, box_mm=0.5 * BOX * np.array([[-1.0] * 3, [1.0] * 3]), voxels=(size, size, size),
        source_to_axis_mm=DSO, source_to_detector_mm=DSD,
    )  # fmt: skip


def lines(bodies, detector, supersampled=2):
    """(height, width) line integrals, pixels the mean of the transmission over their area."""
    fine = finer(detector, supersampled)
    total = sum(body.value * body.chords(fine) for body in bodies)
    arrives = np.exp(-np.maximum(total, 0))
    shape = (detector.height, supersampled, detector.width, supersampled)
    return -np.log(arrives.reshape(shape).mean(axis=(1, 3)))


def finer(detector, times):
    """The detector with `times` as many pixels a side."""
    return replace(
        detector, width=times * detector.width, height=times * detector.height,
        u=np.asarray(detector.u) / times, v=np.asarray(detector.v) / times,
    )  # fmt: skip


def true_volume(size, bodies=BODIES):
    """(z, y, x) mm⁻¹ of the bodies on the grid of a scan of that size, means of 27 points a voxel."""
    fine = (np.arange(3 * size) + 0.5) / (3 * size) * BOX - 0.5 * BOX
    points = np.stack(np.meshgrid(fine, fine, fine, indexing="ij")[::-1], axis=-1)
    total = np.zeros(points.shape[:3])
    for body in bodies:
        cos, sin = np.cos(body.turn), np.sin(body.turn)
        turn = np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]])
        inside = (((points - body.center) @ turn.T / body.axes) ** 2).sum(axis=-1) <= 1
        total += body.value * inside
    return total.reshape(size, 3, size, 3, size, 3).mean(axis=(1, 3, 5))


def auto_for(*names):
    """The request that looks for these effects of X-rays alone."""
    return ",".join(["auto", *(f"-{name}" for name in XRAY_EFFECTS if name not in names)])


def noisy(projections, photons=50_000, seed=3):
    """With counting noise of so many photons in air."""
    counts = np.random.default_rng(seed).poisson(photons * np.exp(-projections.images.astype(np.float64)))
    return replace(projections, images=-np.log(np.maximum(counts, 1) / photons).astype(np.float32))


def displaced_scan(pixels):
    """A small noisy scan whose detector stands so far to the right of where its files say."""

    def true(detector, index):
        return moved([detector], np.array([[pixels, 0.0]]) * np.linalg.norm(detector.u), np.zeros(1))[0]

    return noisy(ellipsoid_scan(32, 24, 4, true=true, supersampled=1))
