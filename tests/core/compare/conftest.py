"""A comparison of some methods on the tiny capture, made once."""

import pytest

from insideout.core.compare.compare import compare
from insideout.core.compare.options import CompareSettings


@pytest.fixture(scope="session")
def compared(tiny_capture, tiny_settings, tmp_path_factory):
    """Folder, options and tables of a comparison; read only."""
    out = tmp_path_factory.mktemp("comparisons") / "out"
    options = CompareSettings(
        ("3dgs", "fdk", "additive", "gs2mesh", "insideout"),
        tiny_settings,
        starts=1,
        projections=(8,),
        ablation_rows=("none", "published_rates"),
    )
    with pytest.MonkeyPatch.context() as patch:
        # Loading ITK-RTK takes ten seconds; it stays for the whole comparison.
        for module in ("stages.initialize.stage", "compare.methods"):
            patch.setattr(f"insideout.core.{module}.end_fdk", lambda: None)
        return out, options, compare([tiny_capture], out, options)
