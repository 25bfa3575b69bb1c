import numpy as np
import pytest

from insideout.core.threshold import _otsu, air_threshold


def mixed(noise: float = 0.002, **materials: tuple[int, float]) -> np.ndarray:
    """Values of 9,000 voxels of air and of materials (voxels, mm⁻¹), all with noise."""
    random = np.random.default_rng(0)
    parts = [np.zeros(9000), *(np.full(count, value) for count, value in materials.values())]
    return np.concatenate(parts) + random.normal(0, noise, 9000 + sum(count for count, _ in materials.values()))


def test_it_lies_between_air_and_a_single_material():
    assert 0.006 < air_threshold(mixed(wood=(3000, 0.05))) < 0.04


def test_a_little_steel_does_not_hide_the_bone():
    assert 0.006 < air_threshold(mixed(bone=(3000, 0.043), titanium=(150, 0.19), steel=(100, 0.45))) < 0.04


def test_gilding_and_bone_do_not_hide_linen_and_wood():
    values = mixed(0.001, linen=(1500, 0.012), wood=(1500, 0.014), bone=(500, 0.023), gold=(300, 0.094))
    assert 0.003 < air_threshold(values) < 0.012


def test_nor_do_they_in_the_noise_of_few_projections():
    """An FDK of the pharaoh: a third of what is not linen or wood is noise, bone or gold."""
    values = mixed(0.003, linen=(1500, 0.012), wood=(1500, 0.014), bone=(1500, 0.035), gold=(600, 0.06))
    assert 0.004 < air_threshold(values) < 0.012


def test_marrow_in_bone_is_no_air():
    """Otsu's threshold of bone and a little marrow lies a hair below the marrow: 0.019 of 0.0225 on the skull."""
    surfaces = np.random.default_rng(1).uniform(0.002, 0.042, 5000)
    values = np.concatenate([mixed(0.001, bone=(7000, 0.042), marrow=(1500, 0.0225), steel=(200, 0.4)), surfaces])
    assert air_threshold(values) == pytest.approx(0.0225 / 2, rel=0.15)


@pytest.mark.parametrize("noise", [0.0005, 0.002, 0.004])
def test_noise_and_blurred_surfaces_are_no_material(noise):
    """Thin plastic beside metal: half of what lies over a lower threshold lies between air and plastic."""
    blurred = np.random.default_rng(1).exponential(0.003, 4000)
    values = np.concatenate([mixed(noise, plastic=(2500, 0.019), metal=(150, 0.3)), blurred])
    assert 0.006 < air_threshold(values) < 0.016


@pytest.mark.parametrize("share", [0.2, 0.5])
def test_thin_gaps_that_a_voxel_half_fills_are_air(share):
    """Between the walls of nested shells many voxels hold a little wood."""
    random = np.random.default_rng(1)
    gaps = random.uniform(0, 0.015, int(share * 3000))
    values = np.concatenate([mixed(0.0005, wood=(3000, 0.015), heavy=(3000, 0.026)), gaps])
    assert 0.006 < air_threshold(values) < 0.015


@pytest.mark.parametrize("voxels", [90, 300, 700])
@pytest.mark.parametrize("noise", [0.001, 0.004])
def test_noise_of_much_air_beside_a_small_object_is_no_material(voxels, noise):
    assert 3 * noise < air_threshold(mixed(noise, wood=(voxels, 0.05))) < 0.035


def test_without_noise_it_lies_half_way():
    assert air_threshold(np.repeat([0.0, 0.3], [50, 20])) == pytest.approx(0.15)


def test_noise_below_zero_counts_as_air():
    """FDK undershoots beside metal by more than bone attenuates."""
    values = mixed(bone=(3000, 0.043), steel=(100, 0.45))
    values[:500] = -0.3
    assert 0.006 < air_threshold(values) < 0.04


def test_what_is_not_finite_is_left_out():
    values = mixed(wood=(3000, 0.05))
    assert air_threshold(np.concatenate([values, [np.nan, np.inf]])) == air_threshold(values)


def test_values_that_differ_in_their_last_bit_alone_are_parted():
    """Numpy 2, which Blender 5.2 has, makes no 512 bins of so few numbers."""
    air = np.float32(0.02)
    values = np.repeat(np.array([air, np.nextafter(air, np.float32(1)), 0.05], np.float32), [1000, 9, 100])
    assert 0 < air_threshold(values) < 0.05


@pytest.mark.parametrize("values", [np.zeros(5), np.full((8, 8), 0.3), np.zeros(0), np.full(3, -1.0)])
def test_what_is_the_same_everywhere_has_no_threshold(values):
    assert air_threshold(values) == np.inf


@pytest.mark.parametrize("seed", range(4))
def test_otsus_threshold_is_that_of_scikit_image_which_blender_does_not_have(seed):
    """Its values lie so densely that both sides of the threshold do not move it."""
    from skimage.filters import threshold_otsu

    random = np.random.default_rng(seed)
    values = np.concatenate([random.gamma(2, 0.002, 20000), random.normal(0.05, 0.01, 5000)]).astype(np.float32)
    step = (values.max() - values.min()) / 512
    assert _otsu(values) == pytest.approx(threshold_otsu(values, nbins=512), abs=0.5 * step)
