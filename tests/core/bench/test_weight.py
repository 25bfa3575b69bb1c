"""`insideout bench weight`: masses, centres, inertia and cavities beside the truth."""

import json

import numpy as np
import pytest
from typer.testing import CliRunner

from insideout.core.bench import weight
from insideout.core.bench.bodies import BODIES, weight_by_formula
from insideout.core.bench.tables import weights_table
from insideout.core.bench.weight import curve_of_phantom, measure_weights
from insideout.core.cli import app
from insideout.core.errors import SettingError
from insideout.core.phantoms.materials import Material
from insideout.core.phantoms.model import Part, Phantom
from insideout.core.phantoms.shapes import sphere


def test_a_ball_off_the_middle_has_steiners_inertia():
    """A ball of PMMA of 9 mm, of 1.18 g/cm³, with a hollow of 4 mm at (2, 0, 1) from its middle."""
    found = weight_by_formula(BODIES["ball with its hollow off the middle"])

    full, hollow = (4 / 3 * np.pi * radius**3 * 1.18e-3 for radius in (9.0, 4.0))
    away = np.array([2.0, 0.0, 1.0])
    shift = -hollow * away / (full - hollow)
    assert found.properties.mass_g == pytest.approx(full - hollow)
    np.testing.assert_allclose(found.properties.center_mm, np.add([3.0, -2.0, 1.0], shift))
    about_middle = 0.4 * (full * 81 - hollow * 16) - hollow * (away @ away - away[0] ** 2)
    about_center = about_middle - (full - hollow) * (shift @ shift - shift[0] ** 2)
    assert found.properties.inertia_g_mm2[0, 0] == pytest.approx(about_center)
    (cavity,) = found.cavities
    assert cavity.volume_mm3 == pytest.approx(4 / 3 * np.pi * 64)
    np.testing.assert_allclose(cavity.center_mm, [5.0, -2.0, 2.0])


def test_a_hollow_is_less_what_lies_in_it():
    outer, inner = weight_by_formula(BODIES["nested shells"]).cavities
    assert outer.volume_mm3 == pytest.approx(4 / 3 * np.pi * (9**3 - 7**3))
    assert inner.volume_mm3 == pytest.approx(4 / 3 * np.pi * 5**3)
    np.testing.assert_allclose(outer.center_mm, [3.0, -2.0, 1.0])


@pytest.fixture
def small_phantom(monkeypatch):
    """A steel ball in a hollow wooden one, in place of the phantoms, which take minutes."""

    def ball(center, radius):
        return lambda points: sphere(points, np.array(center), radius)

    parts = (
        Part("shell", ball([1.0, 0.0, 0.0], 10.0), Material("wood", "C6H10O5", 0.7)),
        Part("hollow", ball([1.0, 0.0, 0.0], 6.0), None),
        Part("core", ball([1.0, 0.0, -3.0], 3.0), Material("steel", "Fe", 7.8)),
    )
    phantom = Phantom("small", parts, parts[0].distance, lambda points, _: points, (24.0, 24.0, 24.0), 60.0)
    monkeypatch.setattr(weight, "PHANTOMS", {"small": lambda: phantom})
    monkeypatch.setattr(weight, "_CLOSED", ("small",))
    return phantom


@pytest.fixture
def one_body(monkeypatch):
    monkeypatch.setattr(weight, "BODIES", {"hollow ball": BODIES["hollow ball"]})


def test_a_body_and_a_phantom_beside_their_truth(small_phantom, one_body):
    voxels, splats, finer, phantom = measure_weights(["small"])

    for row in (voxels, splats, finer, phantom):
        assert row["off"] == pytest.approx(row["found_g"] / row["mass_g"] - 1)
        assert abs(row["off"]) < 0.02
        assert row["center_off_mm"] < 0.05
        assert abs(row["cavity_off"]) < 0.03
    assert (voxels["body"], voxels["weighed"]) == ("hollow ball", "voxels of 0.4 mm")
    assert (splats["weighed"], finer["weighed"]) == ("splats of 0.5 mm", "splats of 0.25 mm")
    assert finer["inertia_off"] == pytest.approx(splats["inertia_off"] / 4, rel=0.1), "blur goes by its square"
    for row in (voxels, finer):
        assert max(abs(row[figure]) for figure in ("off", "inertia_off", "cavity_off")) < 0.01
    assert voxels["mass_g"] == pytest.approx(4 / 3 * np.pi * (9**3 - 6**3) * 1.18e-3)
    wood, steel = (4 / 3 * np.pi * volume * density * 1e-3 for volume, density in ((10**3 - 6**3, 0.7), (27, 7.8)))
    # A core of 3 mm is half a percent thinner in tables of 0.4 mm.
    assert phantom["mass_g"] == pytest.approx(wood + steel, rel=6e-3)
    assert phantom["cavities_mm3"] == pytest.approx([4 / 3 * np.pi * (6**3 - 27)], rel=6e-3)


def test_hollows_that_may_be_open_are_not_compared(small_phantom, one_body, monkeypatch):
    monkeypatch.setattr(weight, "_CLOSED", ())
    *_, phantom = measure_weights(["small"])
    assert phantom["cavities_found_mm3"] is None
    assert phantom["cavity_off"] is None


def test_a_phantoms_curve_goes_through_its_materials(small_phantom):
    curve = curve_of_phantom(small_phantom)
    for part in small_phantom.parts:
        if part.material is not None:
            assert curve(part.material.attenuation(60.0)) == pytest.approx(part.material.density_g_cm3)
    assert curve(0.0) == 0.0


def test_a_cavity_that_was_missed_shows_in_the_table_as_a_number_alone():
    row = {"body": "b", "weighed": "voxels", "cavities_mm3": [900.0, 100.0], "cavities_found_mm3": [905.0]}
    (cells,) = weights_table([row]).cells()
    assert "1,000 in 2" in cells
    assert "905" in cells
    assert not any("%" in cell for cell in cells)


def test_the_command_prints_and_saves_a_row_for_each_way_to_weigh(tmp_path, small_phantom, one_body):
    path = tmp_path / "rows.json"
    done = CliRunner().invoke(app, ["bench", "weight", "--markdown", "--json", str(path)])
    assert done.exit_code == 0, done.output
    assert done.output.count("| hollow ball |") == 3
    assert done.output.count("| small |") == 1
    assert [row["body"] for row in json.loads(path.read_text())] == ["hollow ball"] * 3 + ["small"]


def test_quick_leaves_the_phantoms_out(small_phantom, one_body):
    done = CliRunner().invoke(app, ["bench", "weight", "--quick", "--markdown"])
    assert "| hollow ball |" in done.output
    assert "| small |" not in done.output


def test_an_unknown_phantom_is_refused():
    done = CliRunner().invoke(app, ["bench", "weight", "--phantom", "teapot"])
    assert isinstance(done.exception, SettingError)
    assert "choose among matryoshka, skull" in str(done.exception)


def test_scans_without_voxels_are_refused(small_phantom):
    done = CliRunner().invoke(app, ["bench", "weight", "--voxel-mm", "0"])
    assert isinstance(done.exception, SettingError)
    assert "--voxel-mm is 0; give more than 0, and 5 at most" in str(done.exception)
