"""Global fitting: the one similarity that lays the photo frame on the X-ray frame (paper, "Hierarchical Fitting")."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from ...capture.landmarks import on_a_line
from ...progress import Tick
from ...similarity import Similarity
from ...told import Told
from .icp import (
    Anchors,
    Fit,
    offset_surface,
    refine,
    tells_offset_from_scale,
    thinned_shell,
    thinned_surface,
    trimmed_mean,
    turn_between,
    two_way_score,
    umeyama,
    whole_score,
)
from .surfaces import OuterSurface, ShellPoints

# Fits that turn less than this from one another count as one.
_SAME_ROTATION_DEG = 12.0
# One more parameter always fits a little better; it has to earn its place.
_CLEARLY_BETTER = 0.97
# Picks by hand are a hundredth of the object off; two that changed places are off by as much as they are apart.
_CONTRADICTION = 0.04


@dataclass(frozen=True, eq=False)
class GlobalFit:
    """The best fit and the best one that is really another.

    Attributes:
        best: the fit chosen.
        runner_up: the best fit that is turned by more than 12° from it; None when every start led to the best.
        candidates: how many starts were refined.
        landmarks: the picked pairs that were used, to hold later refinements.
    """

    best: Fit
    runner_up: Fit | None
    candidates: int
    landmarks: Anchors | None = None

    def to_json(self) -> dict[str, Any]:
        return {
            "best": self.best.to_json(),
            "runner_up": None if self.runner_up is None else self.runner_up.to_json(),
            "candidates": self.candidates,
            "landmarks": None if self.landmarks is None else self.landmarks.to_json(),
        }

    @classmethod
    def from_json(cls, content: dict[str, Any]) -> GlobalFit:
        runner_up, landmarks = content["runner_up"], content["landmarks"]
        return cls(
            Fit.from_json(content["best"]),
            None if runner_up is None else Fit.from_json(runner_up),
            content["candidates"],
            None if landmarks is None else Anchors.from_json(landmarks),
        )


def uniform_rotations(count: int) -> np.ndarray:
    """(count, 3, 3) rotations spread evenly over SO(3): super-Fibonacci spirals (Alexa, CVPR 2022)."""
    s = np.arange(count) + 0.5
    inner, outer = np.sqrt(s / count), np.sqrt(1 - s / count)
    alpha, beta = 2 * np.pi * s / np.sqrt(2.0), 2 * np.pi * s / 1.533751168755204288118041
    quats = [inner * np.sin(alpha), inner * np.cos(alpha), outer * np.sin(beta), outer * np.cos(beta)]
    return Rotation.from_quat(np.stack(quats, axis=1)).as_matrix()


def cube_rotations() -> np.ndarray:
    """(24, 3, 3): the proper rotations that map the axes onto the axes; no reflections."""
    matrices = []
    for order in itertools.permutations(range(3)):
        for signs in itertools.product([1.0, -1.0], repeat=3):
            matrix = np.eye(3)[list(order)] * np.array(signs)[:, None]
            if np.linalg.det(matrix) > 0:
                matrices.append(matrix)
    return np.array(matrices)


def principal_axes(covariance: np.ndarray) -> np.ndarray:
    """Right-handed principal axes as columns (3, 3), largest variance first; finite for any covariance."""
    axes = np.linalg.eigh(np.nan_to_num(covariance))[1][:, ::-1].copy()
    if np.linalg.det(axes) < 0:
        axes[:, 2] = -axes[:, 2]
    return axes


def fit_globally(
    shell: ShellPoints,
    surface: OuterSurface,
    *,
    rotations: int = 576,
    on_iteration: Callable[[float], None] = lambda fraction: None,
) -> GlobalFit:
    """The best similarity by shape alone.

    PCA's 24 proper rotations and a uniform set of rotations, each at three scales, are scored by trimmed nearest
    distances of a few hundred points; the best of them are refined by trimmed ICP, coarse to fine.

    Args:
        rotations: size of the uniform set.
        on_iteration: called with the fraction done; may raise to stop.
    """
    starts = _starts(shell, surface, rotations, on_iteration)
    rough_shell, rough_surface = thinned_shell(shell, 500), thinned_surface(surface, 1500)
    rough = []
    for number, start in enumerate(starts):
        on_iteration(0.3 + 0.3 * number / len(starts))
        fit = refine(start, rough_shell, rough_surface, iterations=12, keep=0.75, to_planes=False)
        rough.append(refine(fit.similarity, rough_shell, rough_surface, iterations=12, keep=0.75))
    rough.sort(key=lambda fit: fit.score_mm)
    finalists = _distinct([fit.similarity for fit in rough])[:8]
    middle_shell, middle_surface = thinned_shell(shell, 1500), thinned_surface(surface, 4000)
    fits = []
    for number, start in enumerate(finalists):
        on_iteration(0.6 + 0.3 * number / len(finalists))
        fits.append(refine(start, middle_shell, middle_surface, iterations=25))
    fits.sort(key=lambda fit: _whole(fit, middle_shell, middle_surface))
    on_iteration(0.9)
    best, runner_up = _two_best(fits, shell, surface, partial(on_iteration, 0.95))
    return GlobalFit(best, runner_up, len(starts))


def _two_best(fits: list[Fit], shell: ShellPoints, surface: OuterSurface, tick: Tick) -> tuple[Fit, Fit | None]:
    """The best of some fits, refined, and the best one whose rotation is another, None if there is none.

    A start far from the best may slide into it: it has no rotation of its own then, and the next has a say.
    """
    best = _finish(fits[0], shell, surface, tick)
    for fit in fits[1:]:
        tick()
        if turn_between(fit.similarity, best.similarity) <= _SAME_ROTATION_DEG:
            continue
        other = _finish(fit, shell, surface, tick)
        better = _whole(other, shell, surface) < _whole(best, shell, surface)
        if turn_between(other.similarity, best.similarity) > _SAME_ROTATION_DEG:
            return (other, best) if better else (best, other)
        best = other if better else best
    return best, None


def fit_to_landmarks(
    shell: ShellPoints,
    surface: OuterSurface,
    source: np.ndarray,
    target: np.ndarray,
    on_iteration: Callable[[float], None] = lambda fraction: None,
) -> GlobalFit:
    """The similarity of picked pairs, then ICP with the pairs kept in the least squares.

    The shape averages down the noise of the picks; where the shape decides nothing (the turn of a body of
    revolution) the picks do.

    Args:
        source, target: (L, 3), L ≥ 3 and not on one line, photo frame and mm.
    """
    start = umeyama(source, target)
    errors = landmark_errors(source, target)
    freedom = max(1, 3 * len(source) - 7)
    noise = float(np.sqrt((errors**2).sum() / freedom))
    picked = Anchors(source, target, max(noise, 0.005 * surface.extent))
    tick = partial(on_iteration, 0.3)
    fit = refine(start, shell, surface, points=2000, iterations=20, landmarks=picked, tick=tick)
    fit = _finish(fit, shell, surface, partial(on_iteration, 0.6), picked)
    return GlobalFit(fit, None, 1, picked)


def landmark_errors(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """How far (L,) mm picked pairs (L, 3), photo frame and mm, lie from one another where they fit best."""
    return np.linalg.norm(umeyama(source, target).apply(source) - target, axis=1)


def landmarks_warning(source: np.ndarray, target: np.ndarray, extent: float) -> Told | None:
    """What to say of pairs that contradict one another, as in another order; None where they agree as well as picks by
    hand do. Those picked in the photo frame of another run agree: frames differ by a similarity.

    Args:
        source, target: (L, 3), photo frame and mm.
        extent: mm, of the object.
    """
    errors = landmark_errors(source, target)
    together = float(np.sqrt((errors**2).mean()))
    if together <= _CONTRADICTION * extent:
        return None
    return Told(
        "landmarks.json: its pairs lie {together:.1f} mm from one another where they fit best, pair {worst} "
        "{most:.1f} mm; check that both lists have the same points in the same order",
        together=together,
        worst=int(errors.argmax()) + 1,
        most=float(errors.max()),
    )


def landmarks_problem(source: np.ndarray, target: np.ndarray) -> Told | None:
    """Why picked pairs cannot fix a similarity, or None when they can."""
    if len(source) != len(target) or len(source) < 3:
        return Told("{count} landmarks are too few, three are needed", count=len(source))
    if on_a_line(source) or on_a_line(target):
        return Told("the landmarks lie on one line")
    return None


def _whole(fit: Fit, shell: ShellPoints, surface: OuterSurface) -> float:
    return whole_score(fit.similarity, shell, offset_surface(surface, fit.offset_mm))


def _finish(fit: Fit, shell: ShellPoints, surface: OuterSurface, tick: Tick, landmarks: Anchors | None = None) -> Fit:
    """The last refinement; with the splats' thickness, where the shape tells that from scale and it fits better."""
    close = refine(fit.similarity, shell, surface, points=8000, iterations=30, landmarks=landmarks, tick=tick)
    if not tells_offset_from_scale(surface):
        return close
    thick = refine(
        close.similarity,
        shell,
        surface,
        points=8000,
        iterations=40,
        landmarks=landmarks,
        offset_sigma_mm=expected_offset(close.similarity, shell, surface),
        tick=tick,
    )
    return thick if thick.score_mm < _CLEARLY_BETTER * close.score_mm else close


def expected_offset(similarity: Similarity, shell: ShellPoints, surface: OuterSurface) -> float:
    """How far (mm) splats' centres may well lie off the isosurface: their thickness and a part of a voxel."""
    return shell.thickness * similarity.scale + 0.3 * surface.voxel


def _starts(
    shell: ShellPoints, surface: OuterSurface, rotations: int, on_iteration: Callable[[float], None]
) -> list[Similarity]:
    """The best-scoring coarse similarities, well apart from one another."""
    goal = surface.points.mean(axis=0)
    goal_covariance = np.cov(surface.points.T)
    middle = shell.points.mean(axis=0)
    scale = float(np.sqrt(np.trace(goal_covariance) / max(np.trace(shell.covariance), 1e-30)))
    ours, theirs = principal_axes(shell.covariance), principal_axes(goal_covariance)
    turns = [theirs @ turn @ ours.T for turn in cube_rotations()] + list(uniform_rotations(rotations))
    some_shell, some_surface = thinned_shell(shell, 250), thinned_surface(surface, 250)
    scored = []
    for number, turn in enumerate(turns):
        if number % 16 == 0:
            on_iteration(0.3 * number / len(turns))
        for factor in (0.88, 1.0, 1.14):
            candidate = Similarity(scale * factor, turn, goal - scale * factor * turn @ middle)
            there = surface.tree.query(candidate.apply(some_shell.points))[0]
            back = shell.tree.query(candidate.inverse().apply(some_surface.points))[0] * candidate.scale
            scored.append((trimmed_mean(there, 0.75) + trimmed_mean(back, 0.75), candidate))
    order = sorted(range(len(scored)), key=lambda i: scored[i][0])
    return _distinct([scored[i][1] for i in order], limit=32)


def _distinct(similarities: list[Similarity], limit: int = 1000) -> list[Similarity]:
    """The first of each group of similarities that turn less than 12° from one another."""
    kept: list[Similarity] = []
    for candidate in similarities:
        if all(turn_between(candidate, other) > _SAME_ROTATION_DEG for other in kept):
            kept.append(candidate)
            if len(kept) == limit:
                break
    return kept


def describe_ambiguity(fit: GlobalFit, shell: ShellPoints, surface: OuterSurface, decided: bool) -> dict[str, object]:
    """Whether the shape alone decides the rotation.

    Continuous: the shell turned about some axis by any angle lies on the surface about as well (a body of
    revolution). Discrete: the runner-up does. The axis tried is the one along which the surface's points hold
    a turn least (slippage analysis, Gelfand and Guibas, SGP 2004).

    Args:
        decided: landmarks were given, so that it does not matter.

    Returns:
        {"kind": "none" | "discrete" | "continuous", "message", "decided_by_landmarks", ...}; for continuous the
        axis in mm; the ratios of the trimmed and of the whole scores to the best fit's.
    """
    thin_shell = thinned_shell(shell, 1500)
    thin_surface = offset_surface(thinned_surface(surface, 4000), fit.best.offset_mm)
    floor = 0.0005 * surface.extent

    def scores(similarity: Similarity) -> np.ndarray:
        trimmed = two_way_score(similarity, thin_shell, thin_surface)[0]
        return np.array([trimmed, whole_score(similarity, thin_shell, thin_surface)]) + floor

    best = scores(fit.best.similarity)
    axis, middle = _slippery_axis(surface)
    turned = []
    for angle in np.arange(30.0, 331.0, 30.0):
        rotation = Rotation.from_rotvec(np.radians(angle) * axis).as_matrix()
        about = Similarity(1.0, rotation, middle - rotation @ middle)
        turned.append(scores(about.after(fit.best.similarity)) / best)
    spin = np.percentile(turned, 75, axis=0)
    other = None if fit.runner_up is None else scores(fit.runner_up.similarity) / best
    kind, message = "none", Told("the shape decides the rotation")
    # A turned Matryoshka has 1.29 and 1.27, from one of twenty starts over 1.3; the other phantoms 2.1 and more.
    if spin[0] < 1.6 and spin[1] < 1.5:
        kind = "continuous"
        message = Told("undecidable by shape (a body of revolution); give landmarks.json, see docs/captures.md")
    elif other is not None and other[0] < 1.25 and other[1] < 1.1:
        kind = "discrete"
        message = Told("another rotation fits about as well (see runner_up); give landmarks.json, see docs/captures.md")
    if decided and kind != "none":
        message = Told("the shape leaves the rotation open; the landmarks decided it")
    return {
        "kind": kind,
        "message": message,
        "decided_by_landmarks": decided,
        "axis": axis.tolist() if kind == "continuous" else None,
        "score_ratio_turned": spin.tolist(),
        "score_ratio_runner_up": None if other is None else other.tolist(),
    }


def _slippery_axis(surface: OuterSurface) -> tuple[np.ndarray, np.ndarray]:
    """The axis (unit, 3) and a point on it about which the surface can turn with least motion along its normals."""
    middle = surface.points.mean(axis=0)
    arm = (surface.points - middle) / surface.extent
    rows = np.concatenate([np.cross(arm, surface.normals), surface.normals], axis=1)
    hessian = rows.T @ rows / len(rows)
    turn, mixed, shift = hessian[:3, :3], hessian[:3, 3:], hessian[3:, 3:]
    inverse = np.linalg.pinv(shift, rcond=1e-6)
    axis = np.linalg.eigh(turn - mixed @ inverse @ mixed.T)[1][:, 0]
    drift = -inverse @ mixed.T @ axis * surface.extent
    return axis, middle + np.cross(axis, drift)
