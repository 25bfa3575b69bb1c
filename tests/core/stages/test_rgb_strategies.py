"""The photo trainer with each strategy and effect: it fits, it ends with the same bits when broken off, it is measured
as it was trained."""

import subprocess
import sys
from dataclasses import replace

import numba
import numpy as np
import pytest
import torch

from insideout.core.errors import Cancelled
from insideout.core.evaluate.heldout import photo_figures
from insideout.core.files import write_json
from insideout.core.progress import Reporter
from insideout.core.render import splat
from insideout.core.render.options import SplatOptions
from insideout.core.run_folder import RunFolder
from insideout.core.stages.surface.photos import TrainingPhotos
from insideout.core.stages.surface.rgb import RgbSettings, RgbTrainer
from insideout.core.train.loop import Task, optimise
from insideout.core.train.mask import MaskStrategy
from insideout.core.train.mcmc import McmcStrategy
from insideout.core.train.schedule import Decay
from insideout.core.train.strategy import DefaultStrategy

WHITE = np.ones(3, np.float32)
STEPS = 60
DEFAULT = DefaultStrategy(start=0.1, stop=0.8, every=15, most=700)
STRATEGIES = {
    "default": DEFAULT,
    "mcmc": McmcStrategy(start=0.05, stop=0.9, every=9, most=700, dead=0.02),
    "mask": MaskStrategy(densify=DEFAULT, rate=0.3, every=13),
}
SETTINGS = RgbSettings(
    iterations=STEPS, long_side=40, means_rate=Decay(1e-3, 1e-4), sh_rate=0.02, scale_rate=0.02, degree=1
)


@pytest.fixture(scope="module", autouse=True)
def one_thread():
    """Pictures so small are done before a second thread is awake."""
    before = numba.get_num_threads()
    numba.set_num_threads(1)
    yield
    numba.set_num_threads(before)


@pytest.fixture(scope="module")
def splits(shells_capture):
    photos = shells_capture[0].photos.photos
    return tuple(TrainingPhotos([p for p in photos if p.held_out is held], 40, WHITE) for held in (False, True))


@pytest.fixture
def make_trainer(shells_capture, splits):
    """Trainers that begin with half of the shell's splats, out of place and grey."""
    shell = RunFolder(shells_capture[1]).read_set("surface", "rgb").select(np.arange(0, 900, 2))
    shift = 0.05 * np.random.default_rng(0).normal(size=shell.means.shape)
    start = replace(shell, means=(shell.means + shift).astype(np.float32), sh=0 * shell.sh)

    def make(**changes):
        settings = replace(SETTINGS, **changes)
        return RgbTrainer(start, *splits, WHITE, settings, seed=0, kernel="cpu")

    return make


def finished(trainer, checkpoint=None, break_after=None):
    count = iter(range(10**6))
    reporter = Reporter(is_cancelled=lambda: break_after is not None and next(count) >= break_after)
    return optimise(trainer, Task("surface", "rgb", STEPS, checkpoint=checkpoint), reporter)


def test_each_strategy_shows_held_out_photos_better_than_at_the_start(make_trainer):
    for name, strategy in STRATEGIES.items():
        trainer = make_trainer(strategy=strategy)
        before = trainer.measure()["photos"]
        history = finished(trainer)
        assert trainer.measure()["photos"] > before + 3, name
        assert history["skipped_steps"] == 0
        assert 0 < len(trainer) <= 700, name


@pytest.mark.parametrize("name", ["mcmc", "mask"])
def test_broken_off_and_resumed_it_ends_with_the_same_bits(make_trainer, tmp_path, name):
    whole = make_trainer(strategy=STRATEGIES[name])
    finished(whole)
    with pytest.raises(Cancelled):
        finished(make_trainer(strategy=STRATEGIES[name]), tmp_path / "c.pt", 37)
    resumed = make_trainer(strategy=STRATEGIES[name])
    finished(resumed, tmp_path / "c.pt")
    for one, other in zip(
        vars(whole.parameters.to_set()).values(), vars(resumed.parameters.to_set()).values(), strict=True
    ):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize(
    ("decay_iterations", "first", "last"),
    [(STEPS, 2.0, 0.2), (2 * STEPS, 2.0**0.5, 0.2**0.5), (STEPS // 2, 2.0, 0.2)],
    ids=["as many as it is made for", "half as many", "twice as many"],
)
def test_all_rates_but_that_of_means_fall(make_trainer, monkeypatch, decay_iterations, first, last):
    def taken(**changes):
        trainer, steps = make_trainer(strategy=DefaultStrategy(start=1.0, stop=0.0), **changes), []
        step = trainer.parameters.step
        monkeypatch.setattr(trainer.parameters, "step", lambda rates: steps.append(dict(rates)) or step(rates))
        finished(trainer)
        assert len(steps) == STEPS
        return steps[0], steps[-1]

    stay, fall = taken(), taken(decay=Decay(2.0, 0.2), decay_iterations=decay_iterations)
    for before, now, share in zip(stay, fall, (first, Decay(first, last).at(1 - 1 / STEPS)), strict=True):
        expected = {name: rate if name == "means" else share * rate for name, rate in before.items()}
        assert len(expected) == 6
        assert now == pytest.approx(expected)


def test_masks_that_drop_most_leave_a_set_that_goes_on(make_trainer):
    """All splats are as good as absent, and pruned but for a few."""
    still = DefaultStrategy(start=1.0, stop=0.0)
    trainer = make_trainer(strategy=MaskStrategy(densify=still, start=(-4.0, 0.0), rate=0.001, every=13))
    start = len(trainer)
    history = finished(trainer)
    assert len(trainer) < 0.1 * start
    assert history["skipped_steps"] == 0


@pytest.mark.parametrize(
    "drawn", [{"pixel_integration": True}, {"low_pass": 0.01}, {"low_pass": 1 / 12, "mip_filter": True}]
)
def test_a_model_is_trained_and_measured_as_it_is_drawn(make_trainer, splits, drawn):
    trainer = make_trainer(strategy=DEFAULT, **drawn)
    before = trainer.measure()["photos"]
    finished(trainer)
    assert trainer.measure()["photos"] > before + 3
    model, options = trainer.parameters.to_set(), trainer.options
    assert options == SplatOptions(**drawn)
    views = [(camera, photo.numpy()) for camera, photo, _ in (splits[1].read(i) for i in range(len(splits[1])))]
    figures = photo_figures(model, views, WHITE, "cpu", lambda: None, options)
    assert figures["psnr"] == pytest.approx(trainer.measure()["photos"], abs=1e-3)
    plainly = photo_figures(model, views, WHITE, "cpu", lambda: None)
    assert abs(figures["psnr"] - plainly["psnr"]) > 0.1
    camera = views[0][0]
    image = splat(model.to_torch(), camera, WHITE, **drawn).color
    assert torch.equal(image, splat(model.to_torch(), camera, WHITE, **vars(options)).color)


@pytest.mark.parametrize("drawn", [{}, {"pixel_integration": True}, {"low_pass": 0.1, "mip_filter": True}])
def test_a_runs_report_draws_the_photo_splats_as_they_were_fitted(tmp_path, drawn):
    run = RunFolder(tmp_path / "run")
    assert SplatOptions.of(run) == SplatOptions()
    settings = replace(SETTINGS, **drawn)
    write_json(run.stage("surface") / "report.json", {"rgb": {"options": vars(settings.options)}})
    assert SplatOptions.of(run) == settings.options


def test_a_run_of_before_there_was_a_choice_is_drawn_as_by_3dgs(tmp_path):
    run = RunFolder(tmp_path / "run")
    write_json(run.stage("surface") / "report.json", {"rgb": {"options": {"pixel_integration": False}}})
    assert SplatOptions.of(run).low_pass == 0.3


def test_the_user_hears_of_the_kernels_that_a_setting_takes():
    assert SETTINGS.renderers == replace(SETTINGS, strategy=STRATEGIES["mcmc"]).renderers == ("splat",)
    for changes in ({"strategy": STRATEGIES["mask"]}, {"pixel_integration": True}):
        assert "splat_effects" in replace(SETTINGS, **changes).renderers


def test_both_effects_at_once(make_trainer):
    trainer = make_trainer(strategy=STRATEGIES["mask"], pixel_integration=True)
    before = trainer.measure()["photos"]
    assert finished(trainer)["skipped_steps"] == 0
    assert trainer.measure()["photos"] > before + 3


def test_without_them_the_kernels_of_effects_are_not_even_imported():
    code = (
        "import sys, numpy as np, insideout.core.stages.surface.rgb as rgb\n"
        "from insideout.core.gaussians import GaussianSet\n"
        "from insideout.core.render import splat\n"
        "from insideout.core.views import Camera\n"
        "splat(GaussianSet.create(np.array([[0., 0, 2]]), .1).to_torch(), Camera(4, 4, 4., 4., 2., 2., np.eye(4)))\n"
        "ours = [name for name in sys.modules if name.startswith('insideout')]\n"
        "kernels = [name for name in ours if '.kernels.' in name and '_effects' in name]\n"
        "looking = [name for name in ours if '.effects.look' in name]\n"
        "print(kernels + looking + [name for name in ours if name.endswith(('.mcmc', '.mask'))])"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert out.strip() == "[]"
