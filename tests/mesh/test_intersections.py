"""Where a mesh cuts itself, against every pair looked at one by one."""

import numpy as np
import trimesh

from habitus.mesh.intersections import intersecting_pairs

BALL = trimesh.creation.icosphere(1, 0.05)


def pair_of_balls(apart: float) -> tuple[np.ndarray, np.ndarray]:
    vertices = np.asarray(BALL.vertices)
    faces = np.asarray(BALL.faces)
    other = vertices + np.array([apart, 0.003, 0.001])
    return np.concatenate([vertices, other]), np.concatenate([faces, faces + len(vertices)])


def test_pairs_are_those_of_looking_at_every_pair():
    vertices, faces = pair_of_balls(0.06)
    found = {tuple(pair) for pair in intersecting_pairs(vertices, faces)}
    expected = set()
    for a in range(len(BALL.faces)):
        for b in range(len(BALL.faces), len(faces)):
            one = vertices[faces[a]]
            other = vertices[faces[b]]
            if edges_cross(one, other) or edges_cross(other, one):
                expected.add((a, b))
    assert found == expected and len(found) > 5


def edges_cross(one: np.ndarray, other: np.ndarray) -> bool:
    """Whether an edge of one triangle passes through the other."""
    for k in range(3):
        a = one[k]
        b = one[(k + 1) % 3]
        sides = np.stack([a - b, other[1] - other[0], other[2] - other[0]], 1)
        if abs(np.linalg.det(sides)) < 1e-18:
            continue
        along, u, v = np.linalg.solve(sides, a - other[0])
        if 0 <= along <= 1 and u >= 0 and v >= 0 and u + v <= 1:
            return True
    return False


def test_balls_that_are_apart_cut_nowhere():
    assert intersecting_pairs(*pair_of_balls(0.11)).shape == (0, 2)
