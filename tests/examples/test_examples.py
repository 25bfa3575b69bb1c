"""The batch scripts, as their docstrings call them."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

bpy = pytest.importorskip("bpy")

# Without bpy these tests are skipped.
from insideout.core.gaussians import GaussianSet, Modality  # noqa: E402
from insideout.core.mesh.solids import is_closed, volume_and_centroid  # noqa: E402
from insideout.insideout_addon.physics.baking import is_baked  # noqa: E402
from insideout.insideout_addon.physics.breaking import pieces_of  # noqa: E402
from insideout.insideout_addon.physics.meshes import read_mesh  # noqa: E402
from insideout.insideout_addon.physics.world import bodies_of, is_simulated  # noqa: E402
from insideout.insideout_addon.scene.display import display_modifier  # noqa: E402
from insideout.insideout_addon.scene.node_tree import modifier_input  # noqa: E402

_ROOT = Path(__file__).resolve().parents[2]
_EXAMPLES = _ROOT / "examples"
_INSTALLED = """
import bpy, runpy, sys
bpy.ops.preferences.addon_enable(module="bl_ext.user_default.insideout")
bpy.context.preferences.addons["bl_ext.user_default.insideout"].preferences.engine_python = sys.argv.pop(1)
script = sys.argv.pop(1)
runpy.run_path(script, run_name="__main__")
"""


@pytest.fixture
def run(tmp_path):
    """A run folder that holds a ball of 50 X-ray splats."""
    rng = np.random.default_rng(0)
    splats = GaussianSet.create(rng.normal(0, 8, (50, 3)), 2.0, density=0.02, modality=Modality.XRAY)
    splats.save(tmp_path / "run" / "fused.ply")
    return tmp_path / "run"


@pytest.fixture
def engine(tmp_path):
    """`engine(body)`: a program in the engine's place; `out` is the run folder, `send` speaks the protocol."""

    def make(body):
        python, program = tmp_path / "engine", tmp_path / "program.py"
        head = (
            "import json, pathlib, shutil, sys\n"
            "def send(type, /, **content): print(json.dumps({'type': type, **content}), flush=True)\n"
            "out = pathlib.Path(sys.argv[sys.argv.index('--out') + 1]) if '--out' in sys.argv else None\n"
        )
        program.write_text(head + body, "utf-8")
        python.write_text(f'#!/bin/sh\nexec "{sys.executable}" "{program}" "$@"\n', "utf-8")
        python.chmod(0o755)
        return python

    return make


def _run(script, *arguments, encoding=None):
    command = [sys.executable, str(_EXAMPLES / script), "--", *map(str, arguments)]
    environment = {**os.environ, "PYTHONIOENCODING": encoding} if encoding else None
    return subprocess.run(command, capture_output=True, encoding=encoding or "utf-8", env=environment, check=False)


def _names(folder):
    return {path.name for path in folder.iterdir()}


def test_make_blend(tmp_path, run):
    answer = _run("make_blend.py", run, "--out", tmp_path / "demo", "--size", 48, "--samples", 1)
    assert answer.returncode == 0, answer.stderr
    assert (tmp_path / "demo" / "insideout.blend").stat().st_size > 10_000
    assert (tmp_path / "demo" / "insideout.png").stat().st_size > 500


def test_somebodys_work_on_the_blend_stays(run):
    (run / "insideout.blend").write_text("a day's work", "utf-8")
    (run / "insideout.blend1").write_text("of the day before", "utf-8")
    answer = _run("make_blend.py", run, "--out", run, "--no-render")
    assert answer.returncode == 0, answer.stderr
    assert (run / "insideout.blend").read_text("utf-8") == "a day's work"
    assert (run / "insideout.blend1").read_text("utf-8") == "of the day before"
    assert "insideout-2.blend" in answer.stdout
    assert _names(run) == {"fused.ply", "insideout.blend", "insideout.blend1", "insideout-2.blend"}


def test_make_blend_without_a_run(tmp_path):
    answer = _run("make_blend.py", tmp_path / "nowhere", "--out", tmp_path / "demo")
    assert answer.returncode == 2
    assert "nowhere" in answer.stderr
    assert "Traceback" not in answer.stderr


def test_make_blend_into_a_file(tmp_path, run):
    (tmp_path / "file").write_text("", "utf-8")
    answer = _run("make_blend.py", run, "--out", tmp_path / "file")
    assert answer.returncode == 2
    assert "Traceback" not in answer.stderr
    assert str(tmp_path / "file") in answer.stderr


def test_an_error_of_the_program_is_no_success():
    """Blender ends with 0 after a script's traceback."""
    code = (
        f"import sys; sys.path.insert(0, {str(_EXAMPLES)!r})\n"
        "from load_insideout import run_script\n"
        "run_script(lambda package: 1 // 0)\n"
        "print('went on')\n"
    )
    answer = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert answer.returncode == 1
    assert "ZeroDivisionError" in answer.stderr
    assert "went on" not in answer.stdout


def test_batch_reconstruct_makes_a_run_and_shows_it(tmp_path, run, engine):
    python = engine(
        "assert sys.argv[sys.argv.index('--preset') + 1] == 'standard', sys.argv\n"
        "assert sys.argv[sys.argv.index('--stage') + 1] == 'fuse', sys.argv\n"
        "send('stage', stage='fuse', state='started')\n"
        "send('progress', stage='fuse', fraction=0.25)\n"
        "import time; time.sleep(0.3)\n"
        f"out.mkdir(); shutil.copy({str(run / 'fused.ply')!r}, out / 'fused.ply')\n"
        "send('stage', stage='fuse', state='done', seconds=75, reason='as dense as 0.02 mm⁻¹')\n"
        "send('done', run=str(out))\n"
    )
    wanted = ("--preset", "standard", "--stage", "fuse")
    answer = _run("batch_reconstruct.py", tmp_path, "--out", tmp_path / "new", "--engine", python, *wanted)
    assert answer.returncode == 0, answer.stdout + answer.stderr
    told = answer.stdout.splitlines()
    lines = ("Fuse started", "Fuse (5 of 5)  25 %", "Fuse done in 1 min 15 s: as dense as 0.02 mm⁻¹")
    assert [line for line in told if line.startswith("Fuse")] == list(lines)
    assert _names(tmp_path / "new") == {"fused.ply", "insideout.blend", "section.png", "section.svg"}


def test_batch_reconstruct_in_a_blender_with_the_extension(tmp_path, run, engine):
    """The extension is used, with the engine of its preferences."""
    extensions = tmp_path / "user" / "extensions" / "user_default"
    extensions.mkdir(parents=True)
    (extensions / "insideout").symlink_to(_ROOT)
    python = engine(
        f"out.mkdir(); shutil.copy({str(run / 'fused.ply')!r}, out / 'fused.ply')\nsend('done', run=str(out))\n"
    )
    environment = {name: value for name, value in os.environ.items() if name != "INSIDEOUT_ENGINE"}
    script = str(_EXAMPLES / "batch_reconstruct.py")
    answer = subprocess.run(
        [sys.executable, "-c", _INSTALLED, str(python), script, "--", str(tmp_path), "--out", str(tmp_path / "new")],
        env={**environment, "BLENDER_USER_RESOURCES": str(tmp_path / "user")},
        capture_output=True,
        text=True,
        check=False,
    )
    assert answer.returncode == 0, answer.stdout + answer.stderr
    assert "insideout.blend" in _names(tmp_path / "new")
    assert "Traceback" not in answer.stderr


def test_photos_alone_have_no_section(photo_run):
    answer = _run("batch_reconstruct.py", "--out", photo_run)
    assert answer.returncode == 0, answer.stderr
    assert "no section to save" in answer.stdout
    assert "insideout.blend" in _names(photo_run)
    assert not {"section.png", "section.svg"} & _names(photo_run)
    assert _run("batch_reconstruct.py", "--out", photo_run, "--section", photo_run / "s.png").returncode == 2


def test_the_running_python_is_the_engine_where_it_can_be(tmp_path):
    """A Python with Blender and the engine in it, as `make demo` installs one."""
    pytest.importorskip("torch")
    environment = {name: value for name, value in os.environ.items() if name != "INSIDEOUT_ENGINE"}
    command = [sys.executable, str(_EXAMPLES / "batch_reconstruct.py"), "--", str(tmp_path), "--check"]
    environment["BLENDER_USER_RESOURCES"] = str(tmp_path / "user")
    answer = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    assert answer.returncode == 2
    assert "No engine found" not in answer.stderr
    assert f"{tmp_path}" in answer.stdout + answer.stderr


def test_batch_reconstruct_does_what_the_panel_does(blender, tmp_path, run, read_png):
    answer = _run(
        "batch_reconstruct.py",
        *("--out", run, "--which", "fused", "--display", "points", "--view-dependent"),
        *("--position", 1, 2, 3, "--normal", 0, -3, 4, "--flip", "--slab", 6, "--no-density"),
        *("--window", 0.001, 0.03, "--pixels", 90, "--level", 0.004),
        *("--section", tmp_path / "s.png", "--values", tmp_path / "v.png", "--contours", tmp_path / "c.csv", "--curve"),
    )
    assert answer.returncode == 0, answer.stderr
    bpy.ops.wm.open_mainfile(filepath=str(run / "insideout.blend"))
    settings = bpy.context.scene.insideout
    matrix = np.array(settings.sections[0].object.matrix_world)
    np.testing.assert_allclose(matrix[:3, 3], [1, 2, 3], atol=1e-5)
    np.testing.assert_allclose(matrix[:3, 2], [0, -0.6, 0.8], atol=1e-5)
    assert matrix[2, 1] > 0, "up stays up on the plane"
    assert (settings.sections[0].flip, settings.sections[0].cut, settings.sections[0].show_density) == (
        True,
        True,
        False,
    )
    assert settings.display == "POINTS"
    assert not modifier_input(display_modifier(settings.model), "Ellipsoids")
    assert "InsideOut Contours" in bpy.data.objects
    assert settings.sections[0].slab_mm == pytest.approx(6)
    assert (settings.low, settings.high, settings.level) == pytest.approx((0.001, 0.03, 0.004))
    assert Path(bpy.path.abspath(settings.run)).resolve() == run
    pixels, _, texts = read_png(tmp_path / "v.png")
    assert pixels.shape == (90, 90)
    assert float(texts["Density high (1/mm)"]) == pytest.approx(0.03)
    assert read_png(tmp_path / "s.png")[0].ndim == 3
    assert (tmp_path / "c.csv").read_text("utf-8").count("\n") > 20


def test_batch_reconstruct_checks_a_capture(tmp_path, engine):
    python = engine(
        "assert sys.argv[3] == 'check', sys.argv\n"
        "send('finding', level='warning', subject='xray', message='few angles.', advice='Scan more.')\n"
        "send('done', errors=0)\n"
    )
    answer = _run("batch_reconstruct.py", tmp_path, "--check", "--engine", python)
    assert answer.returncode == 0, answer.stderr
    assert "xray: few angles. Scan more." in answer.stdout


def test_an_error_of_the_capture_is_a_failure_and_readable_anywhere(tmp_path, engine):
    python = engine("send('finding', level='error', subject='xray', message='above 9 mm⁻¹'); send('done', errors=1)\n")
    answer = _run("batch_reconstruct.py", tmp_path, "--check", "--engine", python, encoding="ascii")
    assert answer.returncode == 2
    assert "above 9 mm??" in answer.stdout


@pytest.mark.parametrize(
    ("wrong", "told"),
    [
        (("--stage", "bogus"), "invalid choice: 'bogus'"),
        (("--window", "1", "1"), "LOW has to be below HIGH"),
        (("--normal", "0", "0", "0"), "give it a direction"),
        (("--which", "rgb"), "holds no rgb splats"),
        (("--level", "9", "--no-density"), "meets no edge"),
    ],
)
def test_batch_reconstruct_tells_what_cannot_be(run, wrong, told):
    answer = _run("batch_reconstruct.py", "--out", run, *wrong)
    assert answer.returncode == 2
    assert told in answer.stdout + answer.stderr
    assert "Traceback" not in answer.stderr


def test_a_damaged_file_is_told(run):
    (run / "fused.ply").write_bytes((run / "fused.ply").read_bytes()[:-40])
    answer = _run("batch_reconstruct.py", "--out", run)
    assert answer.returncode == 2
    assert "fused.ply" in answer.stderr
    assert "Traceback" not in answer.stderr


def test_batch_reconstruct_tells_what_went_wrong(tmp_path, engine):
    python = engine("print('no torch here', file=sys.stderr); sys.exit(1)\n")
    answer = _run("batch_reconstruct.py", tmp_path, "--out", tmp_path / "run", "--engine", python)
    assert answer.returncode == 2
    assert "no torch here" in answer.stderr


def test_blender_speed_measures_an_import_and_a_moving_section():
    answer = _run("blender_speed.py", "--splats", 500, "--cut-splats", 300)
    assert answer.returncode == 0, answer.stderr
    assert "Import of 500 splats" in answer.stdout
    assert "the 2.5 s of the bar" in answer.stdout
    assert "Section of 300 splats while its plane moves: Blender's cut" in answer.stdout
    assert _run("blender_speed.py", "--splats", 0).returncode == 2


_SMALL = ("--size", 32, "--frames", 4)
_FOUND = {
    *("section.png", "contours.svg", "walls.csv", "distances.txt", "sheet.pdf", "densities.png"),
    *("apart.png", "peeled.png", "weight.csv", "model.ply", "session.blend"),
}


def test_a_whole_session_without_the_mouse(blender, tmp_path, run):
    answer = _run("look_inside.py", run, "--out", tmp_path / "found", *_SMALL)
    assert answer.returncode == 0, answer.stderr
    assert _names(tmp_path / "found") == _FOUND
    assert all(path.stat().st_size > 100 for path in (tmp_path / "found").iterdir() if path.suffix != ".txt")
    assert "The section is at y = " in answer.stdout
    distance, triangle = (tmp_path / "found" / "distances.txt").read_text("utf-8").splitlines()
    assert distance.endswith(" mm")
    assert "°, " in triangle
    assert triangle.endswith(" mm²")
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "found" / "session.blend"))
    settings = bpy.context.scene.insideout
    assert [entry.object.name for entry in settings.sections] == ["Half way", "Corner"]
    assert all(entry.cut and entry.show_density for entry in settings.sections)
    assert (settings.color_by, settings.peel_mm, settings.sections[0].apart_mm) == ("PHOTOS", 0.0, 0.0)
    assert not [thing for thing in bpy.data.objects if thing.type in ("CAMERA", "LIGHT")]
    again = _run("look_inside.py", run, "--out", tmp_path / "found", *_SMALL)
    assert again.returncode == 0, again.stderr
    assert (tmp_path / "found" / "session-2.blend").exists(), "what is there may hold somebody's work"


@pytest.fixture
def ball_run(tmp_path):
    """A run with a mesh: a ball of radius 10 mm that 250 grey splats of X-rays fill."""
    path = _ROOT / "tests" / "insideout_addon" / "physics" / "conftest.py"
    spec = importlib.util.spec_from_file_location("bodies_of_known_volume", path)
    bodies = sys.modules[spec.name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(bodies)
    (tmp_path / "ball").mkdir()
    splats = bodies.filling(lambda points: np.linalg.norm(points, axis=1) < 9.5, 10.0, spacing=2.5)
    bodies.write_run(tmp_path / "ball", bodies.ball(10.0, subdivisions=3), splats)
    return tmp_path / "ball"


def _moved(thing, scene):
    """How far keyframes move something from the first to the last frame."""
    assert thing.rigid_body is None
    assert is_baked(thing)
    scene.frame_set(scene.frame_start)
    start = thing.matrix_world.translation.copy()
    scene.frame_set(scene.frame_end)
    return (thing.matrix_world.translation - start).length


def test_a_session_breaks_the_model_into_closed_pieces_that_fall_by_keyframes(blender, tmp_path, ball_run):
    answer = _run("look_inside.py", ball_run, "--out", tmp_path / "found", "--pieces", 3, *_SMALL)
    assert answer.returncode == 0, answer.stderr
    assert "stays whole" not in answer.stdout
    assert _names(tmp_path / "found") == _FOUND | {"fallen.png"}
    # Cells of the ball on the floor, in the light of density on their broken faces.
    assert _colourful(tmp_path / "found" / "fallen.png") > 10
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "found" / "session.blend"))
    scene = bpy.context.scene
    pieces = pieces_of(scene, scene.insideout.model)
    assert len(pieces) == 3
    assert (scene.frame_start, scene.frame_end) == (1, 5)
    assert min(_moved(piece, scene) for piece in pieces) > 1
    meshes = [read_mesh(piece.data) for piece in pieces]
    assert all(is_closed(mesh.faces) for mesh in meshes)
    volume = sum(volume_and_centroid(mesh.vertices, mesh.faces)[0] for mesh in meshes)
    # Corners of the mesh lie on the ball, its faces a little inside.
    assert volume == pytest.approx(4 / 3 * np.pi * 10**3, rel=0.05)


def _colourful(picture):
    """How many pixels in the middle of a picture have a colour."""
    image = bpy.data.images.load(str(picture))
    assert tuple(image.size) == (32, 32)
    pixels = np.array(image.pixels[:]).reshape(32, 32, 4)[8:24, 8:24, :3]
    return np.count_nonzero(np.ptp(pixels, axis=2) > 0.15)


@pytest.mark.parametrize("way", ["--rigid", "--soft"])
def test_a_session_lets_the_model_fall_whole_or_bend(blender, tmp_path, ball_run, way):
    answer = _run("look_inside.py", ball_run, "--out", tmp_path / "found", way, *_SMALL)
    assert answer.returncode == 0, answer.stderr
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "found" / "session.blend"))
    # Grey splats of X-rays in halves, and coloured by density.
    apart, peeled = (_colourful(tmp_path / "found" / f"{name}.png") for name in ("apart", "peeled"))
    assert peeled > 1.5 * apart
    assert sum(map(is_baked, bodies_of(bpy.context.scene))) == 1
    assert not any(map(is_simulated, bodies_of(bpy.context.scene)))


@pytest.mark.parametrize("count", [1, -3, 501, "some"])
def test_a_session_breaks_at_two_places_or_more(tmp_path, ball_run, count):
    answer = _run("look_inside.py", ball_run, "--out", tmp_path / "found", f"--pieces={count}")
    assert answer.returncode == 2
    assert "--pieces" in answer.stderr
    assert not (tmp_path / "found").exists()


@pytest.mark.parametrize("script", ["look_inside.py", "make_blend.py", "asset_pictures.py"])
def test_a_file_is_no_folder_to_write_into(tmp_path, run, script):
    (tmp_path / "found").write_text("somebody's")
    answer = _run(script, *([run] if script != "asset_pictures.py" else []), "--out", tmp_path / "found")
    assert answer.returncode == 2
    assert "found: is a file, not a folder; choose another file or folder." in answer.stderr
    assert (tmp_path / "found").read_text() == "somebody's"


def test_a_session_moves_the_model_in_one_way(tmp_path, ball_run):
    answer = _run("look_inside.py", ball_run, "--out", tmp_path / "found", "--rigid", "--soft")
    assert answer.returncode == 2
    assert "not allowed with" in answer.stderr


def test_a_model_that_cannot_be_broken_is_told_at_the_start_and_looked_at_all_the_same(tmp_path, run):
    answer = _run("look_inside.py", run, "--out", tmp_path / "found", "--pieces", 4, *_SMALL)
    assert answer.returncode == 0, answer.stderr
    assert "The model stays whole: " in answer.stdout
    assert "mesh.glb: is not there; finish the run" in answer.stdout
    assert answer.stdout.index("stays whole") < answer.stdout.index("section.png")
    assert (tmp_path / "found" / "session.blend").is_file()


def test_a_model_that_is_empty_in_the_middle_is_looked_at_all_the_same(tmp_path):
    """Eight lumps at the corners of a cube, as of a stool: planes through its middle pass between them."""
    corners = np.stack(np.meshgrid([-40, 40], [-40, 40], [-40, 40]), axis=-1).reshape(-1, 3)
    points = np.concatenate([corner + np.random.default_rng(0).normal(0, 3, (20, 3)) for corner in corners])
    splats = GaussianSet.create(points, 2.0, density=0.02, modality=Modality.XRAY)
    splats.save(tmp_path / "run" / "fused.ply")
    answer = _run("look_inside.py", tmp_path / "run", "--out", tmp_path / "found", *_SMALL)
    assert answer.returncode == 0, answer.stderr
    assert "meets no material" in answer.stdout
    assert {"weight.csv", "model.ply", "session.blend"} <= _names(tmp_path / "found")
    assert not {"contours.svg", "walls.csv", "distances.txt"} & _names(tmp_path / "found")


def test_a_session_on_nothing_is_told(tmp_path):
    answer = _run("look_inside.py", tmp_path / "nothing", "--out", tmp_path / "found")
    assert answer.returncode == 2
    assert "Traceback" not in answer.stderr
    assert "nothing: there is no such folder; choose the folder of a run." in answer.stderr
    assert not (tmp_path / "found").exists()
