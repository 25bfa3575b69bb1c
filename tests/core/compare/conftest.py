"""A comparison of three methods on the tiny capture, made once."""

from dataclasses import replace

import pytest

from insideout.core.compare.compare import compare
from insideout.core.compare.options import CompareSettings
from insideout.core.settings import Settings


@pytest.fixture(scope="session")
def handful():
    """The draft preset with a handful of iterations in every stage."""
    settings = Settings.of("draft")
    stages = dict(settings.stages)
    stages["initialize"] = replace(stages["initialize"], hull_cells=24, most_rgb=1500, xray_splats=1500)
    surface = stages["surface"]
    stages["surface"] = replace(
        surface, rgb=replace(surface.rgb, iterations=60), xray=replace(surface.xray, iterations=40)
    )
    stages["internal"] = replace(stages["internal"], xray_iterations=8, display_iterations=8, rgb_iterations=8)
    stages["fuse"] = replace(stages["fuse"], iterations=8)
    return replace(settings, stages=stages)


@pytest.fixture(scope="session")
def compared(tiny_capture, handful, tmp_path_factory):
    """Folder, options and tables of a comparison; read only."""
    out = tmp_path_factory.mktemp("comparisons") / "out"
    options = CompareSettings(
        ("3dgs", "fdk", "additive", "insideout"), handful, starts=1, projections=(8,), ablation=False
    )
    with pytest.MonkeyPatch.context() as patch:
        # Loading ITK-RTK takes ten seconds; it stays for the whole comparison.
        for module in ("stages.initialize.stage", "compare.methods"):
            patch.setattr(f"insideout.core.{module}.end_fdk", lambda: None)
        return out, options, compare([tiny_capture], out, options)
