"""Before anything is timed all that trainings take is compiled."""

from insideout.core.bench.compiling import compile_kernels
from insideout.core.capture.read import read_capture
from insideout.core.progress import Reporter
from insideout.core.settings import Settings
from insideout.core.stages.surface.rgb import RgbTrainer
from insideout.core.stages.surface.xray import XrayTrainer


def test_both_trainings_make_steps_before(tiny_capture, monkeypatch):
    made = []
    for trainer in (RgbTrainer, XrayTrainer):

        def step(self, iteration, usual=trainer.step, name=trainer.__name__):
            made.append(name)
            return usual(self, iteration)

        monkeypatch.setattr(trainer, "step", step)
    compile_kernels(read_capture(tiny_capture), Settings.of("draft"), Reporter())
    assert set(made) == {"RgbTrainer", "XrayTrainer"}
