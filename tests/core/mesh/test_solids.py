"""Solids of a triangle mesh: volume, closedness, and cavities that belong to what is around them."""

from __future__ import annotations

import numpy as np
import pytest

from insideout.core.mesh.solids import is_closed, solid_labels, surface_labels, volume_and_centroid

CUBE = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
SQUARES = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
TRIANGLES = np.array([t for a, b, c, d in SQUARES for t in ((a, b, c), (a, c, d))])


def cubes(*described):
    """Cubes of (side, centre), cavities with a negative side, as one mesh."""
    vertices = np.concatenate([abs(side) * CUBE + center for side, center in described])
    faces = [TRIANGLES[:, :: -1 if side < 0 else 1] + 8 * k for k, (side, _) in enumerate(described)]
    return vertices, np.concatenate(faces)


def test_volume_and_centroid_far_from_the_origin():
    volume, centroid = volume_and_centroid(*cubes((2.0, [1000.0, -500.0, 30.0])))
    assert volume == pytest.approx(8.0, rel=1e-9)
    np.testing.assert_allclose(centroid, [1000, -500, 30], atol=1e-9)


def test_a_cavity_is_taken_off():
    volume, centroid = volume_and_centroid(*cubes((4.0, [0, 0, 0]), (-2.0, [1, 0, 0])))
    assert volume == pytest.approx(56.0)
    np.testing.assert_allclose(centroid, [-8 / 56, 0, 0], atol=1e-12)


def test_closed_means_two_triangles_at_each_edge():
    assert is_closed(TRIANGLES)
    assert not is_closed(TRIANGLES[1:])
    turned = TRIANGLES.copy()
    turned[0] = turned[0, ::-1]
    assert not is_closed(turned)
    assert not is_closed(np.concatenate([TRIANGLES, TRIANGLES]))
    assert not is_closed(np.zeros((0, 3), int))


def test_surfaces_are_counted():
    _, faces = cubes(*((1.0, [3 * k, 0, 0]) for k in range(5)))
    shuffled = np.random.default_rng(0).permutation(len(faces))
    labels = surface_labels(faces[shuffled])
    assert labels.max() == 4
    for surface in range(5):
        assert len(np.unique(faces[shuffled][labels == surface] // 8)) == 1


def test_nested_shells_are_solids_with_their_own_cavities():
    """Like a matryoshka: a shell in a shell around a full core, and a block beside them."""
    mesh = cubes((10, [0, 0, 0]), (-8, [0, 0, 0]), (6, [0, 0, 0]), (-4, [0, 0, 0]), (2, [0, 0, 0]), (3, [20, 0, 0]))
    labels = solid_labels(*mesh)
    volumes = [volume_and_centroid(mesh[0], mesh[1][labels == solid])[0] for solid in range(labels.max() + 1)]
    # From the largest outline to the smallest.
    assert volumes == pytest.approx([1000 - 512, 216 - 64, 27, 8])


def test_pores_belong_to_the_wall_that_they_are_in():
    mesh = cubes((10, [0, 0, 0]), (-8, [0, 0, 0]), (6, [0, 0, 0]), (-0.5, [4.5, 0, 0]), (-1, [2, 0, 0]))
    labels = solid_labels(*mesh)
    volumes = [volume_and_centroid(mesh[0], mesh[1][labels == solid])[0] for solid in range(2)]
    assert volumes == pytest.approx([1000 - 512 - 0.125, 216 - 1])


def test_a_surface_inside_out_by_itself_stays_with_the_largest():
    labels = solid_labels(*cubes((2, [0, 0, 0]), (-1, [9, 0, 0]), (3, [20, 0, 0])))
    assert (labels.reshape(3, 12) == [[1], [0], [0]]).all()


@pytest.mark.filterwarnings("error")
def test_nothing_has_no_solids():
    """As where a cell of a break holds nothing of the model."""
    assert solid_labels(np.zeros((0, 3)), np.zeros((0, 3), np.int64)).shape == (0,)
