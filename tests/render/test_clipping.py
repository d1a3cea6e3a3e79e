import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from habitus.errors import HabitusError
from habitus.mesh.shapes import cube, icosphere, quadrilateral, sphere, torus
from habitus.render.clipping import clip_near
from habitus.render.triangles import Triangles, join

NEAR = 1.0
SCENES = [sphere(9, 14), torus(24, 11), icosphere(2), cube(), quadrilateral()]


def posed(shape, seed=0, distance=NEAR):
    """The shape turned at random, its middle about the near plane; and its triangles, welded as it
    was made.
    """
    generator = torch.Generator().manual_seed(seed)
    turn = torch.linalg.qr(torch.randn(3, 3, dtype=torch.float64, generator=generator))[0]
    turn = turn * torch.linalg.det(turn)
    shift = torch.tensor([0.3, -0.2, distance], dtype=torch.float64)
    return shape.vertices @ turn + shift, Triangles.of(shape.faces, shape.vertices)


def area_vectors(points, faces):
    a, b, c = points[faces].unbind(1)
    return torch.linalg.cross(b - a, c - a) / 2


def kept_share(z):
    """The share of each triangle's area with z >= NEAR, from its corners' z (F, 3): similar
    triangles.
    """
    low, middle, high = z.sort(1).values.unbind(1)
    tip = (high - NEAR) ** 2 / ((high - low) * (high - middle))
    stump = 1 - (low - NEAR) ** 2 / ((middle - low) * (high - low))
    share = torch.where(middle > NEAR, stump, tip)
    return torch.where(low >= NEAR, 1.0, torch.where(high <= NEAR, 0.0, share))


def assert_areas(points, triangles, clipped):
    """Each source keeps the part of its area in front, with its normal."""
    whole = area_vectors(points, triangles.faces)
    parts = area_vectors(clipped.points, clipped.triangles.faces)
    kept = torch.zeros_like(whole).index_add(0, clipped.source_face, parts)
    assert torch.allclose(
        kept, whole * kept_share(points[:, 2][triangles.faces])[:, None], rtol=1e-12, atol=1e-12
    )
    assert ((parts * whole[clipped.source_face]).sum(1) >= -1e-12).all()


@pytest.mark.parametrize("shape", SCENES)
@pytest.mark.parametrize("distance", [NEAR, NEAR + 0.37, NEAR - 0.37])
def test_what_is_kept_is_the_part_in_front(shape, distance):
    points, triangles = posed(shape, distance=distance)
    clipped = clip_near(points, triangles, NEAR)
    assert_areas(points, triangles, clipped)
    z = clipped.points[clipped.triangles.faces][..., 2]
    assert z.min() == NEAR and (clipped.points[:, 2] >= NEAR).all()
    assert (clipped.source_face.diff() >= 0).all()
    front = (points[:, 2][triangles.faces] >= NEAR).all(1)
    assert torch.equal(clipped.triangles.faces[front[clipped.source_face]], triangles.faces[front])


@pytest.mark.parametrize("shape", SCENES)
def test_values_that_are_linear_in_space_stay_so(shape):
    points, triangles = posed(shape)
    clipped = clip_near(points, triangles, NEAR)
    moved = clipped.extend(points)
    assert torch.equal(moved[: len(points)], points)
    assert torch.allclose(moved[len(points) :], clipped.points[len(points) :], rtol=0, atol=1e-12)
    weights = clipped.corner_weights
    assert torch.allclose(weights.sum(2), torch.ones(1, dtype=torch.float64)) and weights.min() >= 0
    corners = weights @ points[triangles.faces][clipped.source_face]
    assert torch.allclose(corners, clipped.points[clipped.triangles.faces], rtol=0, atol=1e-12)
    assert torch.equal(clipped.extend(points[:, 0]), moved[:, 0])
    assert clipped.extend(points.float()).dtype == torch.float32


@pytest.mark.parametrize("shape", SCENES[:4])
@pytest.mark.parametrize("seed", range(3))
def test_a_closed_mesh_opens_only_where_it_is_cut(shape, seed):
    points, triangles = posed(shape, seed)
    clipped = clip_near(points, triangles, NEAR)
    cut = clipped.triangles
    around = cut.edge_start.diff()
    tail = cut.faces[cut.edge_face, cut.edge_corner][cut.edge_start[:-1]]
    head = cut.faces[cut.edge_face, (cut.edge_corner + 1) % 3][cut.edge_start[:-1]]
    border = around == 1
    on_plane = (clipped.points[tail, 2] == NEAR) & (clipped.points[head, 2] == NEAR)
    assert border.sum() >= 3 and (around <= 2).all() and torch.equal(border, on_plane)
    turns = torch.bincount(cut.weld[torch.stack([tail, head])[:, border]].ravel())
    assert set(turns.tolist()) <= {0, 2}  # the borders are loops


@pytest.mark.parametrize("shape", [sphere(9, 14), cube()])
def test_copies_of_a_vertex_are_cut_alike_and_stay_welded(shape):
    points, triangles = posed(shape)
    clipped = clip_near(points, triangles, NEAR)
    weld = clipped.triangles.weld
    assert torch.equal(clipped.points, clipped.points[weld])
    assert (weld[len(points) :] != torch.arange(len(points), len(weld))).any()
    by_place = Triangles.of(clipped.triangles.faces, clipped.points)
    assert torch.equal(by_place.edge_start, clipped.triangles.edge_start)
    assert by_place.edge_seam.sum() == clipped.triangles.edge_seam.sum() > 0


def test_meshes_that_touch_are_not_welded_by_a_cut():
    points, triangles = posed(cube(hard=False))
    both = join(triangles, triangles)
    clipped = clip_near(torch.cat([points, points]), both, NEAR)
    alone = clip_near(points, triangles, NEAR)
    assert len(clipped.triangles.edge_seam) == 2 * len(alone.triangles.edge_seam)


def test_nothing_to_do_and_nothing_left():
    points, triangles = posed(icosphere(1), distance=NEAR + 1)
    assert clip_near(points + torch.tensor([0.0, 0, 1e-9]), triangles, NEAR) is None
    clipped = clip_near(-points, triangles, NEAR)
    assert clipped.triangles.faces.shape == clipped.corner_weights.shape[:2] == (0, 3)
    assert clipped.extend(points).shape == points.shape and len(clipped.triangles.edge_seam) == 0
    empty = Triangles.of(np.zeros((0, 3), int))
    assert clip_near(torch.zeros(0, 3), empty, NEAR) is None


def test_vertices_behind_do_no_harm_to_a_projections_gradient():
    square = quadrilateral()
    points = torch.cat(
        [square.vertices + torch.tensor([0, 0, 2.0]), torch.zeros(1, 3, dtype=torch.float64)]
    )
    unused = Triangles.of(square.faces, num_vertices=5)
    for triangles in (unused, Triangles.of([[0, 1, 2], [0, 2, 3], [0, 4, 1]])):
        points = points.clone().requires_grad_()
        clipped = clip_near(points, triangles, NEAR)
        (clipped.points[:, :2] / clipped.points[:, 2:]).square().sum().backward()
        assert points.grad.isfinite().all() and (points.grad[:4] != 0).any()
        points = points.detach()
    assert clip_near(points, unused, NEAR).triangles is unused


def test_triangles_on_and_touching_the_plane():
    z = torch.tensor([1.0, 1, 1, 0, 2, 2])
    points = torch.stack(
        [torch.tensor([0.0, 1, 0, 1, 1, 0]), torch.tensor([0.0, 0, 1, 1, 2, 2]), z], 1
    )
    faces = [[0, 1, 2], [0, 1, 3], [0, 3, 3], [1, 2, 4], [3, 4, 1], [2, 4, 5]]
    clipped = clip_near(points, Triangles.of(faces), NEAR)
    assert clipped.source_face.tolist() == [0, 3, 4, 5]  # those that touch from behind are gone
    assert clipped.cut_ends.tolist() == [[3, 4]] and clipped.cut_fraction.tolist() == [0.5]
    assert clipped.triangles.faces[2].tolist() == [4, 1, 6] and clipped.points[6].tolist() == [
        1,
        1.5,
        1,
    ]


@pytest.mark.parametrize("seed", range(2))
def test_derivatives_agree_with_finite_differences_forwards_and_backwards(seed):
    points, triangles = posed(icosphere(1), seed)
    values = torch.randn(
        len(points), 2, dtype=torch.float64, generator=torch.Generator().manual_seed(seed)
    )
    corners = values[triangles.faces]

    def results(points, values):
        clipped = clip_near(points, triangles, NEAR)
        weighted = clipped.corner_weights @ corners[clipped.source_face]
        return torch.cat([clipped.extend(values).ravel(), clipped.points.ravel(), weighted.ravel()])

    forwards = torch.func.jacfwd(results, (0, 1))(points, values)
    backwards = torch.autograd.functional.jacobian(results, (points, values))
    h = 1e-6
    for k, argument in enumerate((points, values)):
        columns = []
        for step in h * torch.eye(argument.numel(), dtype=torch.float64).reshape(
            -1, *argument.shape
        ):
            low, high = (
                [a + s * step if j == k else a for j, a in enumerate((points, values))]
                for s in (-1, 1)
            )
            columns.append((results(*high) - results(*low)) / (2 * h))
        differences = torch.stack(columns, 1).reshape(forwards[k].shape)
        assert torch.allclose(
            forwards[k], differences, rtol=1e-6, atol=1e-6 * differences.abs().max()
        )
        assert torch.allclose(forwards[k], backwards[k], rtol=1e-12, atol=1e-12)


def test_single_precision():
    points, triangles = posed(torus(24, 11))
    clipped = clip_near(points.float(), triangles, 0.9)
    exact = clip_near(points, triangles, 0.9)
    assert clipped.points.dtype == clipped.corner_weights.dtype == torch.float32
    assert torch.equal(clipped.triangles.faces, exact.triangles.faces)
    assert torch.allclose(clipped.points.double(), exact.points, atol=1e-6)


NUMBERS = st.one_of(
    st.integers(-2, 3).map(float), st.floats(-3, 3), st.floats(1 - 1e-14, 1 + 1e-14)
)


@settings(deadline=None)
@given(
    st.lists(st.tuples(st.integers(-2, 2), st.integers(-2, 2), NUMBERS), min_size=9, max_size=9),
    st.lists(st.tuples(*[st.integers(0, 8)] * 3), max_size=12),
)
def test_any_soup_of_triangles_is_cut(points, faces):
    points = torch.tensor(points, dtype=torch.float64)
    triangles = Triangles.of(np.array(faces, int).reshape(-1, 3), points)
    clipped = clip_near(points, triangles, NEAR)
    if clipped is None:
        assert (points[:, 2] >= NEAR).all()
        return
    whole = area_vectors(points, triangles.faces)
    parts = area_vectors(clipped.points, clipped.triangles.faces)
    z = points[:, 2][triangles.faces]
    kept = torch.zeros_like(whole).index_add(0, clipped.source_face, parts)
    share = kept_share(z).nan_to_num(0.0)[:, None]
    grazing = ((z - NEAR).abs() < 1e-13) & (z != NEAR)  # the share of these is ill-conditioned
    assert torch.allclose(torch.where(grazing.any(1, True), kept, whole * share), kept, atol=1e-11)
    assert (clipped.points[:, 2] >= NEAR).all() and clipped.points.isfinite().all()
    assert (
        clipped.cut_fraction.min() >= 0 and clipped.cut_fraction.max() <= 1
        if len(clipped.cut_fraction)
        else True
    )
    own = clipped.corner_weights @ points[triangles.faces][clipped.source_face]
    assert torch.allclose(own, clipped.points[clipped.triangles.faces], atol=1e-12)


@pytest.mark.parametrize(
    ("points", "near", "message"),
    [
        (torch.zeros(3, 3), 0.0, "near=0.0"),
        (torch.zeros(3, 3), float("nan"), "near=nan"),
        (torch.zeros(4, 3), NEAR, r"points of shape \(4, 3\); expected \(3, 3\)"),
        (torch.eye(3).log(), NEAR, "Vertex 0 is at"),
        (torch.tensor([[0, 0, 2.0], [0, float("nan"), 2], [0, 1, 2]]), NEAR, "Vertex 1 is at"),
    ],
)
def test_bad_input_is_one_clear_line(points, near, message):
    with pytest.raises(HabitusError, match=message):
        clip_near(points, Triangles.of([[0, 1, 2]]), near)


def test_values_must_match():
    points, triangles = posed(cube())
    with pytest.raises(HabitusError, match="a row for each of 24 vertices"):
        clip_near(points, triangles, NEAR).extend(points[:5])
    with pytest.raises(HabitusError, match="leading batch axes"):
        torch.func.vmap(lambda batch: clip_near(batch, triangles, NEAR).points)(
            torch.stack([points, points])
        )
