"""On a capture that shows no effect a run is the same, bit for bit, whether they are looked for, not, or not there."""

import json
import pickle
import subprocess
import sys
from dataclasses import replace

import pytest

from insideout.core.effect_names import PHOTO_EFFECTS, XRAY_EFFECTS
from insideout.core.pipeline import reconstruct

MADE = ("fused.ply", "rgb.ply", "xray.ply", "volume.npz", "mesh.glb")
# A run in a process in which nothing of an effect can be imported.
WITHOUT_EFFECTS = """
import pickle, sys
from pathlib import Path

class Missing:
    def find_spec(self, name, path=None, target=None):
        if name.startswith("insideout.core.effects"):
            raise ModuleNotFoundError(f"No module named {name!r}: the test took it away", name=name)

sys.meta_path.insert(0, Missing())
from insideout.core.pipeline import reconstruct
capture, run, settings = map(Path, sys.argv[1:])
reconstruct(capture, run, settings=pickle.loads(settings.read_bytes()))
"""


def bits(run):
    return {name: (run / name).read_bytes() for name in MADE}


@pytest.fixture(scope="module")
def looked_for(tiny_capture, tiny_settings, tmp_path_factory):
    """A run that looks for all effects, and its report."""
    run = tmp_path_factory.mktemp("clean") / "auto"
    return run, reconstruct(tiny_capture, run, settings=replace(tiny_settings, effects="auto"))


def test_all_effects_were_looked_for_and_none_is_used(looked_for):
    rows = {row["name"]: row for row in looked_for[1]["effects"]}
    assert set(rows) == {*PHOTO_EFFECTS, *XRAY_EFFECTS}
    assert not any(row["found"] or row["used"] for row in rows.values())


def test_where_they_cannot_be_imported_a_run_without_effects_ends_the_same(
    looked_for, tiny_capture, tiny_settings, tmp_path
):
    (tmp_path / "settings").write_bytes(pickle.dumps(replace(tiny_settings, effects="none")))
    given = [str(path) for path in (tiny_capture, tmp_path / "run", tmp_path / "settings")]
    subprocess.run([sys.executable, "-c", WITHOUT_EFFECTS, *given], check=True)
    assert bits(tmp_path / "run") == bits(looked_for[0])
    assert json.loads((tmp_path / "run" / "report.json").read_text())["effects"] == []


@pytest.mark.parametrize("name", ["defocus", "beam_hardening"])
def test_one_that_is_left_out_changes_nothing(looked_for, tiny_capture, tiny_settings, tmp_path, name):
    report = reconstruct(tiny_capture, tmp_path / "run", settings=replace(tiny_settings, effects=f"auto,-{name}"))
    assert bits(tmp_path / "run") == bits(looked_for[0])
    assert name not in {row["name"] for row in report["effects"]}
