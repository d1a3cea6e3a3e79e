"""Colours tell of places along the skin: what geometry cannot see is put right, whatever the
light.
"""

import numpy as np
import pytest
import trimesh

from habitus.errors import HabitusError
from habitus.fit.points.correspondences import Topology
from habitus.fit.points.scan import Cloud, Scan
from habitus.fit.points.scan_colours import check_colours, colour_difference, shared_skin, slid
from habitus.fit.points.skin_colours import ColourCloud, Places, colour_matches
from habitus.fit.points.skin_grid import SkinGrid
from habitus.mesh.normals import face_normals
from habitus.rotations import matrix_from_rotvec

BALL = trimesh.creation.icosphere(3, 0.2)
VERTICES = np.asarray(BALL.vertices)
FACES = np.asarray(BALL.faces)
TOPOLOGY = Topology.of(FACES, len(VERTICES))
GRID = SkinGrid.of(FACES, 4)
TURN = matrix_from_rotvec(np.array([0.0, 0.02, 0.0]))  # 4 mm at the equator


def on_faces(count: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(3)
    return rng.integers(0, len(FACES), count), rng.dirichlet((1.0, 1.0, 1.0), count)


def painted(points: np.ndarray) -> np.ndarray:
    waves = np.random.default_rng(1).normal(size=(3, 40)) * 60.0
    pattern = (
        np.cos(points @ waves + np.arange(40)) @ np.random.default_rng(2).normal(size=(40, 3)) / 6.0
    )
    return 0.3 * np.exp(0.4 * pattern)


def scanned(
    seed: int, light: tuple[float, float, float] = (0.0, 0.0, 0.0)
) -> tuple[Cloud, ColourCloud]:
    points = np.random.default_rng(seed).normal(size=(60_000, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    colours = painted(0.2 * points) * (1.0 + points @ np.array(light))[:, None]
    return Cloud(0.2 * points[:5000], points[:5000]), ColourCloud.of(0.2 * points, points, colours)


def test_nodes_are_shared_and_values_go_straight_between_them():
    edges = len(BALL.edges_unique)
    assert GRID.size == len(VERTICES) + 3 * edges + 3 * len(FACES)
    assert len(GRID.triangles) == 16 * len(FACES)
    face, share = on_faces(2000)
    places = np.einsum("nk,nkc->nc", share, VERTICES[FACES[face]])
    np.testing.assert_allclose(
        GRID.weights(face, share) @ GRID.placed(VERTICES), places, atol=1e-12
    )
    area = np.linalg.norm(face_normals(GRID.placed(VERTICES), GRID.triangles), axis=1).sum()
    assert area == pytest.approx(np.linalg.norm(face_normals(VERTICES, FACES), axis=1).sum())


def test_slopes_are_the_differences_of_values():
    face, share = on_faces(2000)
    values = painted(GRID.placed(VERTICES))
    aside = np.random.default_rng(4).dirichlet((1.0, 1.0, 1.0), len(face)) - share
    step = 1e-7
    change = (GRID.weights(face, share + step * aside) - GRID.weights(face, share)) @ values / step
    moved = np.einsum("nk,nkc->nc", aside, VERTICES[FACES[face]])
    found = np.einsum("ncd,nd->nc", GRID.slopes(values, VERTICES, face, share), moved)
    assert (np.abs(found - change) < 1e-5).mean() > 0.999  # a few cross into the next piece


@pytest.mark.parametrize("light", [(0.0, 0.0, 0.0), (0.3, -0.2, 0.3)])
def test_a_slide_along_the_skin_is_put_right_by_colours_in_any_light(light):
    scans = [scanned(5), scanned(6, light)]
    base = [VERTICES, VERTICES @ TURN.T]  # the second lies as well on its scan, 4 mm to the side
    places = Places.of(VERTICES, FACES, 20_000)
    now = base
    apart = [np.linalg.norm(now[0] - now[1], axis=1).mean()]
    skin = shared_skin(TOPOLOGY, GRID, now, [colours for _, colours in scans])
    before = colour_difference(skin, 0)
    for _ in range(3):
        skin = shared_skin(TOPOLOGY, GRID, now, [colours for _, colours in scans])
        along = [colour_matches(skin, k, places, now[k], 0.002) for k in range(2)]
        now = [slid(TOPOLOGY, base[k], scans[k][0], along[k]) for k in range(2)]
        apart.append(np.linalg.norm(now[0] - now[1], axis=1).mean())
    assert skin.status in ("converged", "iterations")
    assert apart[0] > 0.003 and apart[-1] < 0.25 * apart[0]
    assert (
        colour_difference(shared_skin(TOPOLOGY, GRID, now, [one for _, one in scans]), 0)
        < 0.7 * before
    )
    for surface in now:  # still on the scan
        assert np.abs(np.linalg.norm(surface, axis=1) - 0.2).max() < 0.001


def test_skin_of_one_colour_moves_nothing():
    scans = [scanned(5), scanned(6)]
    plain = [
        ColourCloud.of(one.points, one.normals, np.full_like(one.points, 0.4)) for _, one in scans
    ]
    base = [VERTICES, VERTICES @ TURN.T]
    skin = shared_skin(TOPOLOGY, GRID, base, plain)
    along = colour_matches(skin, 1, Places.of(VERTICES, FACES, 20_000), base[1], 0.002)
    moved = slid(TOPOLOGY, base[1], scans[1][0], along)
    side = moved - base[1]
    side -= (side * base[1]).sum(1, keepdims=True) * base[1] / 0.2**2
    assert np.linalg.norm(side, axis=1).mean() < 0.0002


def test_directions_of_colours_lie_along_the_skin():
    scans = [scanned(5), scanned(6)]
    skin = shared_skin(TOPOLOGY, GRID, [VERTICES, VERTICES], [one for _, one in scans])
    places = Places.of(VERTICES, FACES, 2000)
    along = colour_matches(skin, 0, places, VERTICES)
    normal = face_normals(VERTICES, FACES)[along.face]
    size = np.linalg.norm(along.directions, axis=2) * np.linalg.norm(normal, axis=1)[:, None]
    assert (np.abs(np.einsum("pdc,pc->pd", along.directions, normal)) <= 1e-6 * size + 1e-12).all()


def test_colours_that_cannot_be_compared_are_refused():
    one = Scan("anna", VERTICES, colours=np.ones_like(VERTICES))
    with pytest.raises(HabitusError, match="expected two"):
        check_colours([one])
    with pytest.raises(HabitusError, match="ben: no colours"):
        check_colours([one, Scan("ben", VERTICES)])
