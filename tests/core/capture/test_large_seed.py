"""Seeds that COLMAP has no room for: its are 32 bits with a sign, those of a run any whole number from 0 on."""

from __future__ import annotations

import pycolmap
import pytest

from insideout.core.capture.sfm import _pipeline_options
from insideout.core.capture.sfm_steps import colmap_seed, match_pairs
from insideout.core.progress import Reporter
from insideout.core.settings import Settings


@pytest.mark.parametrize("seed", [0, 1, 20_240_131, 2**31 - 1])
def test_a_seed_that_fits_stays_as_it_is(seed):
    assert colmap_seed(seed) == seed


@pytest.mark.parametrize("seed", [2**31, 2**32 + 5, 10**30])
def test_colmap_takes_every_seed_that_a_run_takes(seed, tmp_path):
    assert Settings.of("draft", seed).seed == seed
    options = _pipeline_options(seed)
    # COLMAP takes -1 for one of its own choice.
    assert options.random_seed == options.mapper.random_seed == options.triangulation.random_seed == seed % 2**31
    pycolmap.Database.open(tmp_path / "database.db").close()
    match_pairs(tmp_path / "database.db", [], tmp_path / "pairs.txt", seed, Reporter(), (0.0, 1.0))
