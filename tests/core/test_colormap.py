import numpy as np
import pytest

from insideout.core.colormap import COLOR_MAPS, DENSITY_COLORS, density_colors


def luminance(colors):
    linear = np.where(colors <= 0.04045, colors / 12.92, ((colors + 0.055) / 1.055) ** 2.4)
    return linear @ [0.2126, 0.7152, 0.0722]


UNSIGNED = [name for name in COLOR_MAPS if name != "difference"]


@pytest.mark.parametrize("colors", UNSIGNED)
def test_denser_is_brighter_everywhere(colors):
    assert np.all(np.diff(luminance(density_colors(np.linspace(0, 1, 200), high=1.0, colors=colors))) > 0)


def test_differences_are_brightest_at_zero_and_as_dark_on_both_sides():
    y = luminance(density_colors(np.linspace(-1, 1, 201), -1.0, 1.0, "difference"))
    assert y.argmax() == 100
    assert np.all(np.diff(y[:101]) > 0)
    assert np.all(np.diff(y[100:]) < 0)


@pytest.mark.parametrize("colors", UNSIGNED)
def test_steps_of_lightness_are_even(colors):
    y = luminance(density_colors(np.linspace(0, 1, 16), high=1.0, colors=colors))
    lightness = np.where(y > 0.008856, 116 * np.cbrt(y) - 16, 903.3 * y)
    steps = np.diff(lightness)
    assert steps.max() < 1.5 * steps.mean()


def test_ends_of_the_range():
    shown = density_colors(np.array([-1.0, 0.0, 0.5, 2.0, np.nan]), high=0.5)
    assert shown[0] == pytest.approx(DENSITY_COLORS[0])
    assert shown[1] == pytest.approx(DENSITY_COLORS[0])
    assert shown[2] == pytest.approx(DENSITY_COLORS[-1])
    assert shown[3] == pytest.approx(DENSITY_COLORS[-1])
    assert shown[4] == pytest.approx(DENSITY_COLORS[0])


@pytest.mark.parametrize("density", [np.zeros(4), np.zeros((0,)), np.full(3, -2.0)])
def test_no_material_is_dark_and_no_error(density):
    assert density_colors(density) == pytest.approx(np.broadcast_to(DENSITY_COLORS[0], (*density.shape, 3)))


@pytest.mark.parametrize(("colors", "error"), [("inferno", 0.025), ("viridis", 0.027), ("cividis", 0.039)])
def test_it_follows_the_full_table(colors, error):
    full = pytest.importorskip("matplotlib").colormaps[colors]
    x = np.linspace(0, 1, 256)
    assert np.abs(density_colors(x, high=1.0, colors=colors) - full(x)[:, :3]).max() < error
