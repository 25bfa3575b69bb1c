"""The batch scripts, as their docstrings call them."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("bpy")

from insideout.core.gaussians import GaussianSet, Modality

_EXAMPLES = Path(__file__).resolve().parents[2] / "examples"


@pytest.fixture
def ball(tmp_path):
    path = tmp_path / "made.ply"
    rng = np.random.default_rng(0)
    GaussianSet.create(rng.normal(0, 8, (50, 3)), 2.0, density=0.02, modality=Modality.XRAY).save(path)
    return path


def _run(script, *arguments):
    command = [sys.executable, str(_EXAMPLES / script), "--", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def test_make_blend(tmp_path, ball):
    run = tmp_path / "run"
    run.mkdir()
    ball.rename(run / "fused.ply")
    answer = _run("make_blend.py", run, "--out", tmp_path / "demo", "--size", 48, "--samples", 1)
    assert answer.returncode == 0, answer.stderr
    assert (tmp_path / "demo" / "insideout.blend").stat().st_size > 10_000
    assert (tmp_path / "demo" / "insideout.png").stat().st_size > 500


def test_make_blend_without_a_run(tmp_path):
    answer = _run("make_blend.py", tmp_path / "nowhere", "--out", tmp_path / "demo")
    assert answer.returncode == 2
    assert "nowhere" in answer.stderr


def test_batch_reconstruct_does_what_the_panel_does(tmp_path, ball):
    engine, program = tmp_path / "engine", tmp_path / "program.py"
    program.write_text(
        "import json, pathlib, shutil, sys\n"
        "out = pathlib.Path(sys.argv[sys.argv.index('--out') + 1]); out.mkdir()\n"
        f"shutil.copy({str(ball)!r}, out / 'fused.ply')\n"
        "print(json.dumps({'type': 'done', 'run': str(out)}))\n",
        "utf-8",
    )
    engine.write_text(f'#!/bin/sh\nexec "{sys.executable}" "{program}" "$@"\n', "utf-8")
    engine.chmod(0o755)
    answer = _run("batch_reconstruct.py", tmp_path, "--out", tmp_path / "run", "--engine", engine)
    assert answer.returncode == 0, answer.stderr
    assert {"insideout.blend", "section.png", "section.svg"} <= {p.name for p in (tmp_path / "run").iterdir()}


def test_batch_reconstruct_tells_what_went_wrong(tmp_path):
    engine = tmp_path / "engine"
    engine.write_text("#!/bin/sh\necho 'no torch here' >&2\nexit 1\n", "utf-8")
    engine.chmod(0o755)
    answer = _run("batch_reconstruct.py", tmp_path, "--out", tmp_path / "run", "--engine", engine)
    assert answer.returncode == 2
    assert "no torch here" in answer.stderr
