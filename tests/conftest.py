"""Fixtures of the add-on's tests: real bpy with the add-on registered, small models, a stand-in engine.

bpy is imported only by the fixture that needs it, for the engine's tests are faster without; where it is missing the
add-on's tests are left out.
"""

from __future__ import annotations

import dataclasses
import importlib.util
import json
import stat
import struct
import sys
import zlib
from pathlib import Path

import numpy as np
import pytest

import insideout
from insideout.core.gaussians import GaussianSet, Modality

if importlib.util.find_spec("bpy") is None:
    collect_ignore = ["insideout_addon", "operators", "panels", "examples"]


def _beside(name):
    """The module `name` beside this file."""
    spec = importlib.util.spec_from_file_location(name, Path(__file__).with_name(f"{name}.py"))
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="session")
def kept_groups(tmp_path_factory):
    return _beside("kept_groups").KeptGroups(tmp_path_factory.mktemp("groups"))


@pytest.fixture
def blender(request, kept_groups):
    """An empty file with the add-on registered; unregistered afterwards. What a test leaves goes with the next file.

    Node groups that another test has built come from a file, except for tests marked `builds_groups`.
    """
    import bpy

    # A patch of its own: what a test has patched is to be undone before the add-on is unregistered.
    with pytest.MonkeyPatch.context() as patch:
        if request.node.get_closest_marker("builds_groups") is None:
            kept_groups.in_place_of(patch)
        # Six times as fast as the factory's settings; a test that changes preferences puts them back.
        bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
        insideout.register()
        yield bpy
        insideout.unregister()


@pytest.fixture
def linked_collection(blender, tmp_path):
    """The active collection, one of another file, to which nothing can be added."""
    import bpy

    made = bpy.data.collections.new("Linked")
    bpy.data.libraries.write(str(tmp_path / "other.blend"), {made})
    bpy.data.collections.remove(made)
    with bpy.data.libraries.load(str(tmp_path / "other.blend"), link=True) as (_, wanted):
        wanted.collections = ["Linked"]
    bpy.context.scene.collection.children.link(wanted.collections[0])
    layer = bpy.context.view_layer
    layer.active_layer_collection = layer.layer_collection.children["Linked"]
    return wanted.collections[0]


@pytest.fixture
def draw_panels(blender):
    """`draw_panels(width, classes)`: the texts of the sidebar; fails on what this Blender does not know."""
    from insideout.panels import CLASSES

    drawing = _beside("panel_drawing")
    return lambda width=300, classes=CLASSES: drawing.draw_panels(classes, width)


@pytest.fixture
def no_engine(monkeypatch):
    """Nothing to be found as the engine: not this Python, not the checkout's, not one of the machine's user."""
    from insideout.insideout_addon.engine import environment

    monkeypatch.delenv("INSIDEOUT_ENGINE", raising=False)
    for name in ("preferred_python", "made_python", "running_python", "checkout_python"):
        monkeypatch.setattr(environment, name, lambda: "")


@pytest.fixture
def random_set():
    """200 splats of every kind, with degree-1 colours."""
    rng = np.random.default_rng(1)
    return GaussianSet.create(
        rng.uniform(-20, 20, (200, 3)),
        rng.uniform(0.5, 2.0, (200, 3)),
        quats=rng.normal(size=(200, 4)),
        opacities=rng.uniform(0.3, 1.0, 200),
        sh=rng.normal(0, 0.3, (200, 4, 3)),
        density=rng.uniform(0, 0.05, 200),
        modality=rng.integers(0, 3, 200),
    )


@pytest.fixture
def photo_run(tmp_path):
    """A finished run of photos alone: a sphere of radius 1 at (3, 1, -2) with floaters far behind, and a report."""
    rng = np.random.default_rng(2)
    directions = rng.normal(size=(1300, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    away = np.append(np.ones(1000), rng.uniform(5, 30, 300))[:, None]
    # Training leaves 1e-9 where there is no density.
    splats = GaussianSet.create([3.0, 1.0, -2.0] + away * directions, 0.02 * away, opacities=np.full(1300, 0.6))
    splats = dataclasses.replace(splats, density=np.full(1300, 1e-9, np.float32))
    run = tmp_path / "photos run"
    splats.save(run / "fused.ply")
    (run / "align").mkdir()
    (run / "align" / "report.json").write_text(json.dumps({"skipped": "there is no X-ray data"}), "utf-8")
    report = {"stages": {}, "warnings": ["photos: few photos", "initialize: 3 of 40 photos were left out"]}
    (run / "report.json").write_text(json.dumps(report), "utf-8")
    return run


@pytest.fixture
def one_ball():
    """One round splat of 5 mm standard deviation and 0.04 mm⁻¹ at its centre, off the origin."""
    return GaussianSet.create([[3.0, -2.0, 1.0]], 5.0, density=0.04, modality=Modality.XRAY)


@pytest.fixture
def read_png():
    """Reads what `write_png` writes: (pixels, pixels per metre, texts)."""

    def read(path: Path):
        content = path.read_bytes()
        assert content[:8] == b"\x89PNG\r\n\x1a\n"
        offset, chunks, texts = 8, {}, {}
        while offset < len(content):
            size, kind = struct.unpack(">I4s", content[offset : offset + 8])
            body = content[offset + 8 : offset + 8 + size]
            assert zlib.crc32(kind + body) == struct.unpack(">I", content[offset + 8 + size : offset + 12 + size])[0]
            if kind == b"tEXt":
                key, _, text = body.partition(b"\0")
                texts[key.decode()] = text.decode("latin-1")
            chunks[kind] = body
            offset += 12 + size
        width, height, depth, color = struct.unpack(">IIBB", chunks[b"IHDR"][:10])
        channels = {0: 1, 2: 3, 6: 4}[color]
        rows = np.frombuffer(zlib.decompress(chunks[b"IDAT"]), np.uint8).reshape(height, -1)
        assert not rows[:, 0].any(), "rows are stored unfiltered"
        pixels = np.ascontiguousarray(rows[:, 1:]).view(">u2" if depth == 16 else np.uint8)
        shape = (height, width) if channels == 1 else (height, width, channels)
        return pixels.reshape(shape), struct.unpack(">I", chunks[b"pHYs"][:4])[0], texts

    return read


@pytest.fixture
def make_engine(tmp_path, monkeypatch):
    """Puts a small program that speaks the engine's protocol in the engine's place.

    `make_engine(body)` writes it; `send(type, **content)` is there, and `arguments` after `-m insideout.core.worker`.
    """

    def make(body: str) -> Path:
        script, python = tmp_path / "engine.py", tmp_path / "engine-python"
        head = (
            "import json, sys, time\n"
            "arguments = sys.argv[3:]\n"
            "def send(type, /, **content): print(json.dumps({'type': type, **content}), flush=True)\n"
        )
        script.write_text(head + body, "utf-8")
        python.write_text(f'#!/bin/sh\nexec "{sys.executable}" "{script}" "$@"\n', "utf-8")
        python.chmod(python.stat().st_mode | stat.S_IXUSR)
        monkeypatch.setenv("INSIDEOUT_ENGINE", str(python))
        return python

    return make
