"""NAF: trilinear and differentiable features, right units, a ball from its projections, the same bits after a break."""

import itertools
from dataclasses import replace

import numba
import numpy as np
import pytest
import torch

from insideout.core.capture.detectors import CircularScan
from insideout.core.capture.model import Projections
from insideout.core.errors import Cancelled, SettingError
from insideout.core.naf.field import Field
from insideout.core.naf.hash_grid import HashGrid
from insideout.core.naf.rays import across_box, pixel_rays
from insideout.core.naf.timed import naf_within
from insideout.core.naf.train import BRIEF, NafSettings, NafTrainer, naf
from insideout.core.progress import Reporter

DENSE = HashGrid(levels=2, base=3, log2_entries=12)
HASHED = HashGrid(levels=3, base=4, log2_entries=6)
RADIUS, ATTENUATION = 11.0, 0.03
CENTER = np.array([3.0, -2.0, 2.0])
SMALL = NafSettings(
    iterations=120, rays=200, samples=24, rate=0.01, grid=HashGrid(levels=4, base=4, log2_entries=12), hidden=16
)


@pytest.fixture(autouse=True, scope="module")
def one_thread():
    """Steps this small are made many times faster by one thread than by several that wait for each other."""
    threads = numba.get_num_threads(), torch.get_num_threads()
    numba.set_num_threads(1)
    torch.set_num_threads(1)
    yield
    numba.set_num_threads(threads[0])
    torch.set_num_threads(threads[1])


def table_of(grid, seed=0, dtype=torch.float64):
    rows = np.random.default_rng(seed).normal(size=(grid.rows, grid.features))
    return torch.tensor(rows, dtype=dtype)


@pytest.fixture(scope="module")
def ball():
    """A ball off the axis, from 16 sides and two held-out ones."""
    angles = np.concatenate([np.arange(16) * 2 * np.pi / 16, [0.3, 2.0]])
    detectors = CircularScan(24, 24, (3.0, 3.0), 200.0, 300.0, offset_mm=(1.5, 0.0)).detectors(angles)
    images = []
    for detector in detectors:
        origins, directions = detector.rays()
        along = ((CENTER - origins) * directions).sum(-1)
        squared = RADIUS**2 - (((CENTER - origins) ** 2).sum(-1) - along**2)
        images.append(2 * ATTENUATION * np.sqrt(np.maximum(squared, 0)))
    box = np.array([[-18.0, -18.0, -15.0], [18.0, 18.0, 15.0]])
    return Projections(np.array(images, np.float32), detectors, np.arange(18) >= 16, angles, box, (24, 24, 20))


def test_published_sizes_are_the_defaults():
    grid, settings = HashGrid(), NafSettings()
    assert (grid.levels, grid.features, grid.base, grid.log2_entries) == (16, 2, 16, 19)
    assert grid.resolutions()[:3].tolist() == [16, 32, 64]
    assert np.diff(grid.starts())[:3].tolist() == [17**3, 33**3, 65**3]
    assert np.diff(grid.starts())[4:].tolist() == [2**19] * 12
    assert (settings.rays, settings.samples, settings.rate) == (1024, 192, 1e-3)
    assert (settings.layers, settings.hidden, settings.skips) == (4, 32, (2,))
    # Short of time it takes other steps with the same field.
    assert replace(BRIEF, rays=1024, samples=192, rate=1e-3, begins_at_mean=False) == settings
    parts = Field(replace(grid, levels=2), 4, 32, (2,), 0)._parts
    assert [tuple(part.shape) for part in parts[1:]] == [
        (32, 4),
        (32,),
        (32, 32),
        (32,),
        (32, 36),
        (32,),
        (1, 32),
        (1,),
    ]


def test_dense_levels_are_trilinear():
    table = table_of(DENSE)
    points = np.random.default_rng(1).random((40, 3))
    found = DENSE.encode(torch.tensor(points), table).numpy()
    for level, (start, cells) in enumerate(zip(DENSE.starts(), (3, 6), strict=False)):
        side = cells + 1
        nodes = table[start : start + side**3].numpy().reshape(side, side, side, 2)
        low = np.minimum((points * cells).astype(int), cells - 1)
        part = points * cells - low
        expected = np.zeros((40, 2))
        for corner in np.ndindex(2, 2, 2):
            weight = np.prod(np.where(corner, part, 1 - part), axis=1)
            x, y, z = (low + corner).T
            expected += weight[:, None] * nodes[z, y, x]
        assert found[:, 2 * level : 2 * level + 2] == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize("grid", [DENSE, HASHED])
def test_features_are_continuous_and_clamped(grid):
    table = table_of(grid)
    # Just before and just behind the faces of all cells of the last level.
    cells = grid.resolutions()[-1]
    faces = np.stack(np.meshgrid(*[np.arange(1, cells) / cells] * 3), -1).reshape(-1, 3)
    before, behind = (grid.encode(torch.tensor(faces + side * 1e-9), table) for side in (-1, 1))
    assert torch.allclose(before, behind, atol=1e-6)
    outside = torch.tensor([[-0.5, 0.3, 2.0]], dtype=torch.float64)
    assert torch.equal(grid.encode(outside, table), grid.encode(outside.clamp(0, 1), table))


@pytest.mark.parametrize("log2_entries", [6, 3])
def test_gradient_by_the_table(log2_entries):
    """27 and 64 corners a level, with a row each or sharing 8."""
    grid = HashGrid(levels=2, base=2, growth=1.5, log2_entries=log2_entries)
    points = torch.tensor(np.random.default_rng(2).random((6, 3)))
    small = table_of(grid).requires_grad_(True)
    assert torch.autograd.gradcheck(lambda table: grid.encode(points, table), (small,))


def test_any_number_of_threads_gives_the_same_bits_and_both_precisions_agree():
    points = np.random.default_rng(3).random((9000, 3))
    found = {}
    for threads in (numba.config.NUMBA_NUM_THREADS, 1):
        numba.set_num_threads(threads)
        for kind in (torch.float64, torch.float32):
            table = table_of(HASHED, dtype=kind).requires_grad_(True)
            features = HASHED.encode(torch.tensor(points, dtype=kind), table)
            features.square().sum().backward()
            found[threads, kind] = features.detach(), table.grad
    many, one = ([*found[n, torch.float32]] for n in (numba.config.NUMBA_NUM_THREADS, 1))
    assert all(torch.equal(a, b) for a, b in zip(many, one, strict=True))
    assert torch.allclose(found[1, torch.float64][0], one[0].double(), atol=1e-4)


def test_lines_cross_the_box_where_they_should(ball):
    detector = ball.detectors[3]
    origins, directions = pixel_rays(detector, np.arange(24 * 24))
    whole = detector.rays()
    assert origins == pytest.approx(whole[0].reshape(-1, 3))
    assert directions == pytest.approx(whole[1].reshape(-1, 3))
    near, far = across_box(origins, directions, ball.box_mm)
    inside = ball.box_mm.mean(axis=0) + 0.5 * np.diff(ball.box_mm, axis=0)[0] * (1 + 1e-9)
    for distance in (near[far > near], far[far > near]):
        ends = origins[far > near] + distance[:, None] * directions[far > near]
        assert (np.abs(ends) <= inside).all()
        assert np.isclose(np.abs(ends), inside).any(axis=1).all()
    assert across_box(np.array([[0.0, 99, 0]]), np.array([[1.0, 0, 0]]), ball.box_mm) == (0.0, 0.0)
    assert across_box(np.array([[0.0, 18, 0]]), np.array([[1.0, 0, 0]]), ball.box_mm) == (-18.0, 18.0)


def test_a_ball_is_found_in_its_projections_in_mm(ball):
    heard = []
    volume, history = naf(ball, ATTENUATION, SMALL, reporter=Reporter(heard.append))
    assert volume.values.shape == (20, 24, 24)
    assert volume.box_mm == pytest.approx(ball.box_mm)
    axes = [volume.origin_mm[k] + volume.spacing_mm[k] * np.arange(n) for k, n in enumerate((24, 24, 20))]
    z, y, x = np.meshgrid(*axes[::-1], indexing="ij")
    distance = np.sqrt((x - CENTER[0]) ** 2 + (y - CENTER[1]) ** 2 + (z - CENTER[2]) ** 2)
    assert volume.values[distance < RADIUS - 3].mean() == pytest.approx(ATTENUATION, rel=0.05)
    assert volume.values[distance > RADIUS + 3].mean() < 0.1 * ATTENUATION
    error = np.mean((volume.values - ATTENUATION * (distance < RADIUS)) ** 2)
    assert 10 * np.log10(ATTENUATION**2 / error) > 18
    first, last = history["heldout"][0], history["heldout"][-1]
    assert last["projections"] > max(30, first["projections"])
    assert {progress.part for progress in heard} == {"naf"}


def test_it_begins_where_the_projections_are_on_average(ball):
    """The ball is 5571 of the box's 38,880 mm³; rays see the middle of the box more often than its corners."""
    trainer = NafTrainer(ball, 20 * ATTENUATION, replace(SMALL, begins_at_mean=True), 0)
    mean = float(trainer.volume().values.mean())
    assert 0.14 * ATTENUATION < mean < 0.3 * ATTENUATION
    published = NafTrainer(ball, 20 * ATTENUATION, SMALL, 0)
    assert float(published.volume().values.mean()) == pytest.approx(0.5 * 1.5 * 20 * ATTENUATION, rel=0.2)


@pytest.mark.parametrize("begins_at_mean", [True, False])
def test_metal_that_sets_the_scale_does_not_leave_it_at_nothing(ball, begins_at_mean):
    """Fourteen times as dense as the ball; from half of that the ball is not found in as many steps."""
    settings = replace(SMALL, iterations=240, rate=BRIEF.rate, begins_at_mean=begins_at_mean)
    found = naf(ball, 14 * ATTENUATION, settings)[0]
    axes = [found.origin_mm[k] + found.spacing_mm[k] * np.arange(n) for k, n in ((2, 20), (1, 24), (0, 24))]
    z, y, x = np.meshgrid(*axes, indexing="ij")
    inside = (x - CENTER[0]) ** 2 + (y - CENTER[1]) ** 2 + (z - CENTER[2]) ** 2 < (RADIUS - 3) ** 2
    mean = found.values[inside].mean()
    assert (mean == pytest.approx(ATTENUATION, rel=0.25)) == begins_at_mean


def test_the_image_is_the_volume_s_line_integrals(ball):
    trainer = NafTrainer(ball, ATTENUATION, SMALL, 0)
    found = trainer._line_integrals(17, np.arange(24 * 24))
    near, far = across_box(*pixel_rays(ball.detectors[17], np.arange(24 * 24)), ball.box_mm)
    # Nothing is trained yet: the field is nearly the same everywhere.
    level = trainer.volume().values.mean()
    assert found == pytest.approx(level * (far - near), rel=0.02, abs=1e-5)


def test_voxels_are_averages_or_values_at_their_centres(ball):
    trainer = NafTrainer(ball, ATTENUATION, SMALL, 0)
    for iteration in range(20):
        trainer.step(iteration)
    averages, centers = trainer.volume(), trainer.volume(at_centers=True)
    x, y, z = (averages.origin_mm[k] + averages.spacing_mm[k] * n for k, n in enumerate((5, 7, 3)))
    low, high = ball.box_mm
    unit = (np.array([[x, y, z]]) - low) / (high - low)
    assert centers.values[3, 7, 5] == pytest.approx(trainer._scale * trainer._values(unit)[0], rel=1e-4)
    around = np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)]) * 0.25 * averages.spacing_mm
    near = (np.array([x, y, z]) + around - low) / (high - low)
    assert averages.values[3, 7, 5] == pytest.approx(trainer._scale * trainer._values(near).mean(), rel=1e-4)


def test_broken_off_it_goes_on_bit_for_bit(ball, tmp_path):
    settings = replace(SMALL, iterations=24)
    whole, _ = naf(ball, ATTENUATION, settings, seed=4)

    def stop(progress):
        if progress.iteration >= 10:
            raise Cancelled

    reporter = Reporter(stop)
    # Every step is heard, however fast it was.
    reporter.update = stop
    with pytest.raises(Cancelled):
        naf(ball, ATTENUATION, settings, seed=4, reporter=reporter, checkpoint=tmp_path / "naf.pt")
    again, history = naf(ball, ATTENUATION, settings, seed=4, checkpoint=tmp_path / "naf.pt")
    assert history["iterations"] == 24
    assert np.array_equal(whole.values, again.values)
    other, _ = naf(ball, ATTENUATION, settings, seed=5)
    assert not np.array_equal(whole.values, other.values)


def test_within_a_time_it_makes_what_fits_and_leaves_the_last_try(ball, tmp_path, monkeypatch):
    """A step takes a second by the clock of this test."""
    settings, asked = replace(SMALL, iterations=5000), []
    clock = itertools.count()
    monkeypatch.setattr("insideout.core.naf.timed.work_clock", lambda: 13.0 * next(clock))

    def made(projections, attenuation, chosen, *rest):
        asked.append(chosen.iterations)
        volume, history = naf(projections, attenuation, replace(chosen, iterations=chosen.iterations // 10), *rest)
        # The first guess was too high: a step takes two seconds after all. It then aims at 105 % of the time.
        return volume, {**history, "seconds": 2.0 * chosen.iterations}

    monkeypatch.setattr("insideout.core.naf.timed.naf", made)
    first, budget = naf_within(400.0, ball, ATTENUATION, tmp_path, settings)
    assert budget == {"iterations": 210, "seconds": 400.0, "tries": [[400, 800.0], [210, 420.0]]}
    assert asked == [400, 210, 210]
    assert np.array_equal(first.values, naf(ball, ATTENUATION, replace(SMALL, iterations=21))[0].values)
    # Finished already: read from the checkpoint.
    again, known = naf_within(400.0, ball, ATTENUATION, tmp_path, settings)
    assert (asked, known) == ([400, 210, 210, 210], budget)
    assert np.array_equal(first.values, again.values)


def test_held_out_projections_are_not_used(ball):
    spoilt = replace(ball, images=np.where(ball.held_out[:, None, None], np.float32(7), ball.images))
    settings = replace(SMALL, iterations=10)
    assert np.array_equal(naf(ball, ATTENUATION, settings)[0].values, naf(spoilt, ATTENUATION, settings)[0].values)


def test_mistakes_are_named(ball):
    with pytest.raises(SettingError, match="rays of NAF is 0"):
        NafSettings(rays=0)
    with pytest.raises(SettingError, match="layers of NAF is 1"):
        NafSettings(layers=1)
    with pytest.raises(SettingError, match="above 0"):
        NafTrainer(ball, 0.0, SMALL, 0)
