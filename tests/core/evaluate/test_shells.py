"""Which splats the distance of a run's halves is measured between."""

from __future__ import annotations

import numpy as np
import pytest

from insideout.core.evaluate.shells import shell_distance, shell_distances
from insideout.core.files import write_json
from insideout.core.gaussians import GaussianSet, Modality
from insideout.core.run_folder import RunFolder
from insideout.core.similarity import Similarity


def ball(count, radius, seed):
    points = np.random.default_rng(seed).normal(size=(count, 3))
    return radius * points / np.linalg.norm(points, axis=1, keepdims=True)


@pytest.fixture
def run(tmp_path):
    """A run whose alignment tells no threshold."""
    folder = RunFolder(tmp_path / "run")
    write_json(folder.stage("align") / "report.json", {"similarity": Similarity().to_json()})
    return folder


def photo_splats(density):
    """Opaque ones on a ball of 20 mm, and a haze of hardly visible ones on one of 30 mm."""
    points = np.concatenate([ball(2000, 20.0, 0), ball(2000, 30.0, 1)])
    return GaussianSet.create(points, 0.5, opacities=np.repeat([0.9, 0.05], 2000), density=density)


def radiative_splats():
    """Dense ones on that ball, and thin ones about it that even out noise."""
    points = np.concatenate([ball(2000, 20.0, 2), ball(2000, 30.0, 3)])
    density = np.repeat([0.02, 0.0005], 2000)
    # A display opacity says nothing of how dense a splat is.
    return GaussianSet.create(points, 0.5, opacities=0.9, density=density, modality=Modality.XRAY)


def test_faint_photo_splats_do_not_count_whatever_density_was_noted_of_them(run):
    """Trained ones came back with about 1e-9 mm⁻¹, and counted by that."""
    plain, noted = (
        shell_distance(run, photo_splats(density), radiative_splats(), 0) for density in (0.0, np.full(4000, 1e-9))
    )
    assert noted == plain
    assert plain["mm"] < 1


def test_of_each_step_the_halves_as_they_were_after_it(run):
    photos, xray = photo_splats(0.0), radiative_splats()
    aside = photos.transformed(Similarity(1.0, np.eye(3), np.array([9.0, 0.0, 0.0])))
    write_json(run.stage("surface") / "report.json", {})
    run.write_set("surface", "rgb", aside)
    run.write_set("surface", "xray", xray)
    run.write_set("align", "rgb", photos)
    asked = []
    found = shell_distances(run, 0, lambda: asked.append(True))
    assert set(found) == {"none", "align"}
    assert found["align"]["mm"] + 1 < found["none"]["mm"]
    assert len(asked) == 2
    write_json(run.stage("internal") / "report.json", {})
    run.write_set("internal", "rgb", photos)
    run.write_set("internal", "xray", GaussianSet.concatenate([xray, aside]))
    assert shell_distances(run, 0)["internal"]["mm"] == pytest.approx(found["align"]["mm"], rel=0.05)


def test_a_run_of_one_half_has_no_distance(run):
    write_json(run.stage("surface") / "report.json", {})
    run.write_set("surface", "xray", radiative_splats())
    assert shell_distances(run, 0) is None
