import time

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from habitus.errors import HabitusError
from habitus.mesh.shapes import cube, icosphere, quadrilateral, sphere, torus
from habitus.render.transforms import outside
from habitus.render.triangles import Triangles, join, welded


def slow_edges(faces, positions):
    """{ends: [(face, corner), ...]} by dictionaries, and the set of ends that are seams."""
    first = {}
    weld = [
        first.setdefault(tuple(float(x) + 0.0 for x in point), k)
        for k, point in enumerate(positions)
    ]
    around = {}
    names = {}
    for f, face in enumerate(faces):
        for c in range(3):
            a = int(face[c])
            b = int(face[(c + 1) % 3])
            if weld[a] != weld[b]:
                ends = frozenset((weld[a], weld[b]))
                around.setdefault(ends, []).append((f, c))
                names.setdefault(ends, set()).add(frozenset((a, b)))
    return weld, around, {ends for ends, ids in names.items() if len(ids) > 1}


def fast_edges(triangles, weld):
    around = {}
    seams = set()
    for e in range(len(triangles.edge_seam)):
        span = slice(int(triangles.edge_start[e]), int(triangles.edge_start[e + 1]))
        sides = list(
            zip(
                triangles.edge_face[span].tolist(),
                triangles.edge_corner[span].tolist(),
                strict=True,
            )
        )
        ends = {
            frozenset(weld[int(triangles.faces[f, (c + k) % 3])] for k in (0, 1)) for f, c in sides
        }
        assert len(ends) == 1 and not ends & around.keys()
        around[ends.copy().pop()] = sides
        if triangles.edge_seam[e]:
            seams |= ends
    return around, seams


@given(
    st.lists(st.tuples(*[st.integers(0, 7)] * 3), max_size=12),
    st.lists(st.integers(0, 1), min_size=24, max_size=24),
)
def test_edges_are_those_of_the_slow_twin_for_any_triangles(faces, bits):
    positions = np.array(bits, float).reshape(8, 3) * np.where(np.arange(8) % 2, 1.0, -1.0)[
        :, None
    ].clip(0)
    faces = np.array(faces, int).reshape(-1, 3)
    triangles = Triangles.of(faces, positions)
    weld, around, seams = slow_edges(faces, positions)
    assert weld == triangles.weld.tolist()
    assert fast_edges(triangles, weld) == (around, seams)
    alone = Triangles.of(faces, num_vertices=8)
    assert (
        fast_edges(alone, range(8))[0] == slow_edges(faces, np.eye(8))[1]
        and not alone.edge_seam.any()
    )


def test_both_zeros_are_one_place():
    assert welded(np.array([[0.0, 1, 2], [-0.0, 1, 2], [0, 1, 2.5]])).tolist() == [0, 0, 2]


def test_seams_are_found_and_are_no_borders():
    shape = sphere(6, 8)
    apart = Triangles.of(shape.faces)
    whole = Triangles.of(shape.faces, shape.vertices)
    assert (apart.edge_start.diff() == 1).sum() == 2 * 4 + 4 * 8 and (
        whole.edge_start.diff() == 2
    ).all()
    assert (
        whole.edge_seam.sum() == 4 + 2 * 8
    )  # the meridian, and between the triangles at each pole
    hard = cube()
    assert Triangles.of(hard.faces, hard.vertices).edge_seam.sum() == 12
    square = Triangles.of(quadrilateral().faces)
    assert square.edge_start.diff().tolist().count(1) == 4 and not square.edge_seam.any()


def test_joined_meshes_keep_their_edges():
    parts = [(sphere(4, 5), True), (cube(), False), (icosphere(0), True)]
    each = [Triangles.of(shape.faces, shape.vertices if weld else None) for shape, weld in parts]
    empty = Triangles.of(np.zeros((0, 3), int), num_vertices=4)
    joined = join(each[0], empty, each[1], each[2])
    assert joined.num_vertices == sum(part.num_vertices for part in each) + 4
    shift_v = 0
    shift_f = 0
    e = 0
    for part in (each[0], empty, each[1], each[2]):
        own = slice(shift_f, shift_f + len(part.faces))
        assert torch.equal(joined.faces[own], part.faces + shift_v)
        for k in range(len(part.edge_seam)):
            span = slice(*part.edge_start[k : k + 2].tolist())
            there = slice(*joined.edge_start[e : e + 2].tolist())
            assert torch.equal(joined.edge_face[there], part.edge_face[span] + shift_f)
            assert torch.equal(joined.edge_corner[there], part.edge_corner[span])
            assert joined.edge_seam[e] == part.edge_seam[k]
            e += 1
        shift_v = shift_v + part.num_vertices
        shift_f = shift_f + len(part.faces)
    assert torch.equal(joined.weld[-12:], each[2].weld + 4 + len(parts[0][0].vertices) + 24)
    assert e == len(joined.edge_seam) == len(joined.edge_start) - 1
    alone = join(each[0])
    assert torch.equal(alone.edge_start, each[0].edge_start) and torch.equal(
        alone.faces, each[0].faces
    )


def test_nothing_is_a_mesh_too():
    for empty in (
        Triangles.of(np.zeros((0, 3), int)),
        Triangles.of(torch.zeros(0, 3, dtype=torch.int32), np.eye(3)),
    ):
        assert (
            empty.faces.shape == (0, 3)
            and empty.edge_start.tolist() == [0]
            and len(empty.edge_seam) == 0
        )
    assert empty.num_vertices == 3 and join(empty, empty).num_vertices == 6
    assert empty.to("cpu").faces.dtype == torch.int64 and empty.device.type == "cpu"


@pytest.mark.parametrize(
    ("faces", "positions", "message"),
    [
        ([[0, 1]], None, r"faces of shape \(1, 2\)"),
        ([[0, 1, 2], [0]], None, "faces that are no array"),
        ([0, 1, 2], None, r"faces of shape \(3,\)"),
        ([[0.0, 1, 2]], None, "faces of type torch.float64"),
        (torch.ones(2, 3, dtype=torch.bool), None, "faces of type torch.bool"),
        ([[0, 1, 2], [0, -1, 2]], None, "Face 1 names vertex -1; expected 0 to 2"),
        ([[0, 1, 2], [0, 3, 2]], np.eye(3), "Face 1 names vertex 3; expected 0 to 2"),
        ([[0, 1, 2]], np.zeros((3, 2)), r"positions of shape \(3, 2\)"),
        ([[0, 1, 2]], np.eye(3) == 1, "positions of type torch.bool"),
        (
            [[0, 1, 2]],
            np.diag([1, np.nan, np.inf]),
            r"Vertex 1 is at \(0.0, nan, 0.0\).*2 vertices have others",
        ),
    ],
)
def test_bad_input_is_one_clear_line(faces, positions, message):
    with pytest.raises(HabitusError, match=message) as error:
        Triangles.of(faces, positions)
    assert "\n" not in str(error.value)


def test_contradicting_counts_and_empty_joins_are_refused():
    with pytest.raises(HabitusError, match="expected the same number"):
        Triangles.of([[0, 1, 2]], np.eye(3), num_vertices=4)
    with pytest.raises(HabitusError, match="at least one mesh"):
        join()


def test_topology_is_plain_inside_torch_func():
    shape = icosphere(0)
    seen = []

    def scale(points):
        triangles = Triangles.of(shape.faces, points)
        seen.append(triangles)
        return points[triangles.faces].sum()

    derivative = torch.func.jacfwd(scale)(shape.vertices)
    assert (
        torch.allclose(derivative, torch.full_like(derivative, 5))
        and len(seen[0].edge_face.numpy()) == 60
    )
    torch.func.grad(scale)(shape.vertices)
    with pytest.raises(HabitusError, match="leading batch axes"):
        torch.func.vmap(lambda points: outside(len, points))(shape.vertices)


def test_large_meshes_take_no_longer_than_they_should():
    shape = torus(600, 170)
    start = time.perf_counter()
    triangles = Triangles.of(shape.faces, shape.vertices)
    assert time.perf_counter() - start < 3  # 0.1 s as a rule
    assert len(triangles.edge_seam) * 2 == len(shape.faces) * 3
