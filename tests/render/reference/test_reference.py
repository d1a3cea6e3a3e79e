"""Laws of the rasteriser's reference: every point is some face's and no other's, and areas come out
exactly.
"""

import math

import pytest
import torch
from torch.func import jacfwd

from habitus.mesh.shapes import cube, icosphere, torus
from habitus.render.frame import fragment_weights
from habitus.render.reference import faces as reference_faces
from habitus.render.reference.faces import drawn_faces
from habitus.render.reference.images import (
    barycentrics,
    compose,
    edge_fragments,
    interpolate,
    share_of_pixel,
    visible,
)
from habitus.render.reference.segments import shadow
from habitus.render.triangles import Triangles, Visibility, join

SEEDS = range(12)


def random(seed: int, *shape: int) -> torch.Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def flat(points, depth=2.0) -> torch.Tensor:
    points = torch.as_tensor(points, dtype=torch.float64)
    return torch.cat([points, torch.full_like(points[:, :1], depth)], 1)


def on_screen(vertices, focal=40.0, centre=(16.0, 12.0), distance=4.0) -> torch.Tensor:
    """Vertices (V, 3), y up, on the screen of a camera `distance` before the origin that looks at
    it.
    """
    x, y, z = vertices.unbind(-1)
    depth = distance - z
    return torch.stack([focal * x / depth + centre[0], -focal * y / depth + centre[1], depth], -1)


def turned(vertices, seed=0) -> torch.Tensor:
    q, r = torch.linalg.qr(random(seed, 3, 3) - 0.5)
    q = q * r.diagonal().sign()
    q[:, 0] *= torch.linalg.det(q)
    return vertices @ q.T


def clipped(polygon: list, box: list) -> list:
    """Sutherland and Hodgman: what of a polygon lies in a convex one that runs clockwise on the
    screen, v down.
    """
    for (px, py), (qx, qy) in zip(box, box[1:] + box[:1], strict=True):
        sides = [(qx - px) * (y - py) - (qy - py) * (x - px) for x, y in polygon]
        result = []
        for k, (a, b) in enumerate(zip(polygon, polygon[1:] + polygon[:1], strict=True)):
            s = sides[k]
            t = sides[(k + 1) % len(polygon)]
            if s >= 0:
                result.append(a)
            if s * t < 0:
                share = s / (s - t)
                result.append((a[0] + share * (b[0] - a[0]), a[1] + share * (b[1] - a[1])))
        polygon = result
    return polygon


def area(polygon: list) -> float:
    return (
        abs(
            sum(
                a[0] * b[1] - a[1] * b[0]
                for a, b in zip(polygon, polygon[1:] + polygon[:1], strict=True)
            )
        )
        / 2
    )


def clockwise(points: torch.Tensor) -> list:
    a, b, c = points[:, :2].tolist()
    positive = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]) > 0
    return [tuple(a), tuple(b), tuple(c)] if positive else [tuple(a), tuple(c), tuple(b)]


def pixel_areas(polygon: list, width: int, height: int) -> torch.Tensor:
    boxes = (
        [(c, r), (c + 1, r), (c + 1, r + 1), (c, r + 1)]
        for r in range(height)
        for c in range(width)
    )
    return torch.tensor(
        [area(clipped(polygon, box)) for box in boxes], dtype=torch.float64
    ).reshape(height, width)


def image(screen, triangles, colours, width, height, cull=False) -> torch.Tensor:
    """Averages over pixels of faces' constant colours; the last colour is the background's."""
    ids = visible(screen, triangles, width, height, cull)
    visibility = Visibility(ids, edge_fragments(screen, triangles, ids, cull))
    weights = fragment_weights(screen, visibility.fragments)
    return compose(
        colours[visibility.faces, None], colours[-1:, None], weights, visibility
    ).reshape(height, width)


def fragments_of(screen, triangles, width=32, height=24):
    return edge_fragments(screen, triangles, visible(screen, triangles, width, height))


def silhouette(screen, triangles, width, height, cull=False) -> torch.Tensor:
    colours = torch.ones(len(triangles.faces) + 1, dtype=torch.float64)
    colours[-1] = 0
    return image(screen, triangles, colours, width, height, cull)


ONE = Triangles.of([[0, 1, 2]])
TWO = Triangles.of([[0, 1, 2], [3, 4, 5]])


@pytest.mark.parametrize("seed", SEEDS)
def test_a_triangles_coverage_is_exact(seed):
    points = random(seed, 3, 2) * 14 - 2
    found = silhouette(flat(points), ONE, 10, 9)
    torch.testing.assert_close(found, pixel_areas(clockwise(points), 10, 9), rtol=0, atol=1e-9)


@pytest.mark.parametrize("step", [0.5, 1.0])
@pytest.mark.parametrize("seed", SEEDS)
def test_coverage_is_exact_where_corners_and_edges_meet_centres_and_borders(seed, step):
    points = (random(seed, 3, 2) * 8 / step).round() * step
    found = silhouette(flat(points), ONE, 8, 8)
    torch.testing.assert_close(found, pixel_areas(clockwise(points), 8, 8), rtol=0, atol=1e-9)


@pytest.mark.parametrize("size", [8, 15.3, 901.7])
@pytest.mark.parametrize("seed", SEEDS)
def test_coverage_is_exact_around_a_corner_at_a_centre(seed, size):
    points = (random(seed, 3, 2) - 0.3) * size
    points[seed % 3] = torch.tensor([3.5, 4.5])
    found = silhouette(flat(points), ONE, 8, 8)
    torch.testing.assert_close(found, pixel_areas(clockwise(points), 8, 8), rtol=0, atol=1e-9)


@pytest.mark.parametrize("seed", SEEDS)
def test_what_shows_of_two_triangles_is_exact_but_where_edges_cross(seed):
    size = 12
    points = random(seed, 6, 2) * 12
    depth = torch.tensor([2.0, 2, 2, 3, 3, 3])
    colours = torch.tensor([3.0, -1.0, 0.5], dtype=torch.float64)
    near = clockwise(points[:3])
    far = clockwise(points[3:])
    both = (
        pixel_areas(clipped(far, near), size, size)
        if clipped(far, near)
        else torch.zeros(size, size).double()
    )
    a = pixel_areas(near, size, size)
    b = pixel_areas(far, size, size) - both
    exact = a * colours[0] + b * colours[1] + (1 - a - b) * colours[2]
    found = image(torch.cat([points, depth[:, None]], 1), TWO, colours, size, size)
    crossed = crossings(points[:3], points[3:], size)
    assert (exact - found)[~crossed].abs().max() < 1e-9
    assert (exact - found)[crossed].abs().le(3).all() and crossed.sum() <= 6


def crossings(p, q, size) -> torch.Tensor:
    """Pixels in which edges of two triangles cross."""
    found = torch.zeros(size, size, dtype=torch.bool)
    for a, b in zip(p, p.roll(-1, 0), strict=True):
        for c, d in zip(q, q.roll(-1, 0), strict=True):
            s, t = torch.linalg.solve(torch.stack([b - a, c - d], 1), c - a)
            if 0 <= s <= 1 and 0 <= t <= 1:
                u, v = (a + s * (b - a)).floor().long().tolist()
                found[v, u] = True
    return found


def test_a_part_hides_what_a_wedge_does():
    """Against midpoints of a fine grid of points that are hidden behind the part, as seen from the
    centre.
    """
    ends = random(5, 30, 2, 2) - 0.5
    side = torch.linspace(-0.5, 0.5, 301, dtype=torch.float64)[:-1] + 1 / 600
    q = torch.cartesian_prod(side, side)
    for (a, b), found in zip(ends, shadow(ends[:, 0], ends[:, 1]), strict=True):
        k = torch.linalg.solve(torch.stack([a, b], 1), q.T)
        assert found == pytest.approx(
            float(((k >= 0).all(0) & (k.sum(0) > 1)).double().mean()), abs=4e-3
        )


def test_fragments_at_the_centre_are_finite_and_one_through_it_cuts_half():
    zero = torch.zeros(1, 2).double()
    right = torch.tensor([[0.5, 0.0]]).double()
    up = torch.tensor([[0.0, -0.5]]).double()
    assert shadow(-right, right).item() == shadow(up, -up).item() == 0.5
    assert shadow(zero, right).item() == 0.5 and shadow(-right, zero).item() == 0.0
    assert shadow(up, zero).item() == shadow(zero, -up).item() == 0.25


def grid(seed: int, size: int, snap: bool) -> tuple[torch.Tensor, torch.Tensor]:
    """A jittered grid of triangles with random diagonals and windings that covers the image of
    (size - 1) pixels.
    """
    line = torch.arange(size, dtype=torch.float64) * 2 - 1
    points = torch.cartesian_prod(line, line)
    jitter = (random(seed, *points.shape) - 0.5) * 0.9
    points = points + (jitter * 2).round() / 2 if snap else points + jitter
    k = (torch.arange(size - 1)[:, None] * size + torch.arange(size - 1)).flatten()
    cut = random(seed + 1, len(k)) > 0.5
    corner = torch.stack([k, k + 1, k + size + 1, k + size], 1)
    corner[cut] = corner[cut].roll(1, 1)
    faces = torch.cat([corner[:, [0, 1, 2]], corner[:, [0, 2, 3]]])
    flipped = random(seed + 2, len(faces)) > 0.5
    faces[flipped] = faces[flipped].flip(1)
    return points, faces


@pytest.mark.parametrize("snap", [False, True])
@pytest.mark.parametrize("seed", range(4))
def test_a_plane_mesh_has_no_holes_and_no_double_hits(seed, snap, monkeypatch):
    """Corners on pixel centres too (snap), and each face with its own copies of them."""
    points, faces = grid(seed, 12, snap)
    screen = flat(points[faces.flatten()])
    apart = torch.arange(faces.numel()).reshape(-1, 3)
    hits = torch.zeros(20, 20, dtype=torch.long)
    for face in apart:
        hits += visible(screen, Triangles.of(face[None], num_vertices=len(screen)), 20, 20) >= 0
    assert (hits == 1).all()
    whole = visible(screen, Triangles.of(apart), 20, 20)
    assert (whole >= 0).all()
    monkeypatch.setattr(reference_faces, "AT_ONCE", 7)
    assert (visible(screen, Triangles.of(apart), 20, 20) == whole).all()


def test_a_centre_on_an_edge_belongs_to_the_face_below_or_to_the_right():
    corners = flat([[0, 0], [3, 0], [3, 3], [0, 3]]) + torch.tensor([0.5, 0.5, 0])
    ids = visible(corners, Triangles.of([[0, 1, 2], [0, 2, 3]]), 5, 5)
    expected = torch.full((5, 5), -1)
    for row in range(3):
        expected[row, :3] = 1
        expected[row, row:3] = 0
    assert (ids == expected).all() and ids.dtype == torch.int32


@pytest.mark.parametrize("seed", range(6))
def test_the_nearest_face_shows_and_windings_do_not_matter(seed):
    points = random(seed, 30, 2) * 20
    depth = 1 + random(seed + 50, 30, 1)
    screen = torch.cat([points, depth], 1)
    faces = torch.arange(30).reshape(10, 3)
    ids = visible(screen, Triangles.of(faces), 20, 20)
    assert (ids == visible(screen, Triangles.of(faces.flip(1)), 20, 20)).all()
    row, column = (ids >= 0).nonzero().unbind(-1)
    centres = torch.stack([column, row], -1) + 0.5
    shares = torch.stack([barycentrics(screen, f.expand(len(centres), 3), centres) for f in faces])
    inside = (shares > 0).all(-1)
    z = (shares * screen[faces, 2][:, None]).sum(-1).masked_fill(~inside, math.inf)
    assert (z.argmin(0) == ids[row, column]).all() and inside.sum() > len(row)


def test_of_equally_near_faces_the_first_shows():
    square = flat([[0.2, 0.1], [7.7, 0.3], [7.9, 7.1], [0.3, 7.6]], 1 / 0.3)
    faces = torch.tensor([[1, 2, 3], [0, 1, 2], [0, 2, 3], [1, 2, 0], [3, 1, 0]])
    for order in torch.stack(
        [torch.randperm(5, generator=torch.Generator().manual_seed(k)) for k in range(10)]
    ):
        ids = visible(square, Triangles.of(faces[order]), 8, 8)
        each = torch.stack(
            [
                visible(square, Triangles.of(f[None], num_vertices=4), 8, 8) >= 0
                for f in faces[order]
            ]
        )
        assert (ids == torch.where(each.any(0), each.byte().argmax(0), -1)).all()


@pytest.mark.parametrize("seed", range(4))
def test_fronts_are_what_normals_say_and_culling_leaves_them(seed):
    shape = icosphere(1)
    vertices = turned(shape.vertices, seed)
    screen = on_screen(vertices)
    triangles = Triangles.of(shape.faces)
    a, b, c = vertices[shape.faces].unbind(1)
    fronts = (
        (torch.linalg.cross(b - a, c - a) * (vertices.new_tensor([0, 0, 4]) - a)).sum(-1) > 0
    ).nonzero()[:, 0]
    assert drawn_faces(screen, triangles, cull=True).face.equal(fronts)
    assert visible(screen, triangles, 32, 24, cull=True).equal(visible(screen, triangles, 32, 24))
    assert (
        visible(screen, Triangles.of(shape.faces.flip(1)), 32, 24, cull=True)
        != visible(screen, triangles, 32, 24)
    ).any()
    torch.testing.assert_close(
        silhouette(screen, triangles, 32, 24, cull=True),
        silhouette(screen, triangles, 32, 24),
        rtol=0,
        atol=1e-12,
    )


@pytest.mark.parametrize("seed", range(4))
def test_the_silhouette_of_a_convex_body_is_its_outline(seed):
    from scipy.spatial import ConvexHull

    screen = on_screen(turned(icosphere(2).vertices, seed))
    found = silhouette(screen, Triangles.of(icosphere(2).faces), 32, 24)
    hull = ConvexHull(screen[:, :2].numpy())
    assert float(found.sum()) == pytest.approx(hull.volume, abs=1e-8)
    outline = [tuple(screen[k, :2].tolist()) for k in hull.vertices]
    torch.testing.assert_close(found, pixel_areas(outline, 32, 24), rtol=0, atol=1e-9)


@pytest.mark.parametrize("seed", range(6))
def test_fragments_show_as_far_as_nothing_hides_them(seed):
    """A wide triangle behind one with an upright edge: from there on, it shows."""
    edge = 2 + 4 * float(random(seed, 1))
    screen = torch.cat(
        [
            flat([[edge, -90], [edge, 90], [-90, 0]], 2.0),
            flat([[-50, 3.3], [50, 4.1], [0, 90]], 3.0),
        ]
    )
    found = fragments_of(screen, TWO, 8, 8)
    upper = (found.face == 1) & (found.start < found.end)
    first = float((found.start[upper] * 100 - 50).min())
    assert first == pytest.approx(edge, abs=1e-4)
    assert (
        len(fragments_of(screen, Triangles.of([[0, 1, 2]], num_vertices=6), 8, 8).pixel)
        == (found.face == 0).sum()
        == 8
    )
    hidden = torch.cat([flat([[-90, -90], [90, -90], [0, 200]], 2.0), screen[3:]])
    assert len(fragments_of(hidden, TWO, 8, 8).pixel) == 0


def test_seams_are_no_silhouettes():
    soft = cube(hard=False)
    hard = cube(hard=True)
    for seed in range(4):
        a = on_screen(turned(soft.vertices, seed))
        b = on_screen(turned(hard.vertices, seed))
        closed = fragments_of(a, Triangles.of(soft.faces))
        seams = fragments_of(b, Triangles.of(hard.faces, positions=hard.vertices))
        assert not closed.seam.any() and 0 < seams.seam.sum() < len(seams.seam)
        inner = seams.seam & ((seams.end - seams.start) > 1e-3)  # but for the ends of hidden ones
        assert (closed.outer_face < 0).all() and (seams.outer_face[inner] >= 0).all()
        torch.testing.assert_close(closed.weight.sum(), seams.weight[~seams.seam].sum())
        moved = b + 1e-12 * random(seed, len(b), 3)  # copies of a vertex differ by rounding
        again = fragments_of(moved, Triangles.of(hard.faces, positions=hard.vertices))
        assert (
            again.face.sort()[0].equal(seams.face.sort()[0])
            and again.seam.sum() == seams.seam.sum()
        )


def test_colours_of_a_cubes_sides_are_averaged_exactly():
    shape = cube(hard=True)
    triangles = Triangles.of(shape.faces, positions=shape.vertices)
    screen = on_screen(turned(shape.vertices, 2), focal=60.0)
    sides = torch.cat([random(0, 6), torch.zeros(1)])
    colours = torch.cat([sides[:6].repeat_interleave(2), sides[6:]])
    fronts = drawn_faces(screen, triangles, cull=True).face
    exact = sum(pixel_areas(clockwise(screen[shape.faces[f]]), 32, 24) * colours[f] for f in fronts)
    torch.testing.assert_close(image(screen, triangles, colours, 32, 24), exact, rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    "shape, error",
    [(icosphere(1), 1e-6), (torus(12, 8), 1e-6), (cube(), 1e-3)],
    ids=["sphere", "torus", "cube with seams"],
)
def test_coverage_changes_as_weights_say(shape, error):
    """Total coverage is piecewise quadratic: central differences are exact. Copies of a vertex move
    together.

    So near to a corner that shows, a hidden seam is as near as what hides it: 1e-4 pixels of it
    count as visible.
    """
    triangles = Triangles.of(shape.faces, positions=shape.vertices)
    screen = on_screen(turned(shape.vertices, 3)).requires_grad_()
    gradient = torch.autograd.grad(silhouette(screen, triangles, 32, 24).sum(), screen)[0]
    assert (gradient[:, 2] == 0).all() and (gradient != 0).any(1).sum() >= 6
    points, point = torch.unique(shape.vertices, dim=0, return_inverse=True)
    for seed in range(10):
        step = (random(seed, *points.shape) - 0.5)[point]
        if seed < 5:  # one vertex alone, at the border
            at = point[(gradient != 0).any(1).nonzero()[seed, 0]]
            step = step * (point == at)[:, None]
        with torch.no_grad():
            change = (
                sum(
                    s * silhouette(screen + s * 1e-5 * step, triangles, 32, 24).sum()
                    for s in (1, -1)
                )
                / 2e-5
            )
        assert float((gradient * step).sum()) == pytest.approx(float(change), abs=error)


@pytest.mark.parametrize("seed", range(3))
def test_each_pixels_coverage_has_its_own_derivative(seed):
    screen = flat(random(seed, 3, 2) * 6)
    forward = jacfwd(lambda s: silhouette(s, ONE, 6, 6))(screen)
    leaf = screen.clone().requires_grad_()
    found = silhouette(leaf, ONE, 6, 6)
    backward = torch.stack(
        [torch.autograd.grad(p, leaf, retain_graph=True)[0] for p in found.flatten()]
    )
    torch.testing.assert_close(forward, backward.reshape(6, 6, 3, 3))
    for vertex in range(3):
        for axis in (0, 1):
            step = torch.zeros_like(screen)
            step[vertex, axis] = 1e-6
            ahead, behind = (pixel_areas(clockwise(screen + s * step), 6, 6) for s in (1, -1))
            torch.testing.assert_close(
                (ahead - behind) / 2e-6, forward[..., vertex, axis], rtol=0, atol=1e-5
            )


def test_barycentrics_are_where_the_camera_ray_meets_the_face():
    vertices = turned(icosphere(1).vertices, 1)
    faces = icosphere(1).faces
    screen = on_screen(vertices)
    ids = visible(screen, Triangles.of(faces), 32, 24)
    row, column = (ids >= 0).nonzero().unbind(-1)
    centres = torch.stack([column, row], -1) + 0.5
    corners = faces[ids[row, column].long()]
    shares = barycentrics(screen, corners, centres)
    assert (shares > 0).all()
    torch.testing.assert_close(shares.sum(-1), torch.ones(len(shares), dtype=torch.float64))
    torch.testing.assert_close(
        on_screen(interpolate(vertices, corners, shares))[:, :2], centres.double()
    )
    low = barycentrics(screen.float(), corners, centres)
    assert low.dtype == torch.float32
    torch.testing.assert_close(low.double(), shares, rtol=0, atol=1e-4)


def test_barycentrics_and_values_have_their_derivatives():
    points = torch.tensor(
        [[0.3, 0.2], [4.1, 0.9], [1.2, 3.7], [5.2, 4.4], [-2.3, 6.1]], dtype=torch.float64
    )
    screen = torch.cat([2 * points, 1 + random(1, 5, 1)], 1).requires_grad_()
    values = random(2, 5, 2).requires_grad_()
    corners = torch.tensor([[0, 1, 2], [2, 3, 4], [4, 1, 0]])
    points = screen.detach()[corners, :2].mean(1)
    assert torch.autograd.gradcheck(
        lambda s, v: interpolate(v, corners, barycentrics(s, corners, points)),
        (screen, values),
        check_forward_ad=True,
    )


@pytest.mark.parametrize(
    "triangle, share",
    [
        ([[0, 0], [9, 0], [4, 2]], 1.0),  # as high as a pixel and more
        ([[0, 0], [9, 0], [4, 0.3]], 0.2),  # three tenths of a pixel high, of one and a half
        ([[0, 0], [0.1, 0], [0, 0.1]], 1.0),  # small, but no sliver
        ([[0, 0], [0.1, 0], [0.05, 0.01]], 0.2),
    ],
)
def test_slivers_speak_for_what_they_cover(triangle, share):
    corners = torch.tensor(triangle, dtype=torch.float64)
    assert share_of_pixel(corners[None]).item() == pytest.approx(share)
    screen = torch.cat([corners, torch.tensor([[1.0], [1.3], [0.8]]).double()], 1)
    point = corners.mean(0)

    def coordinates(screen):
        return barycentrics(screen, torch.tensor([[0, 1, 2]]), point[None])

    jacobian = torch.func.jacfwd(coordinates)(screen)
    by_point = [
        barycentrics(
            screen - torch.tensor([*step, 0.0]).double(), torch.tensor([[0, 1, 2]]), point[None]
        )
        for step in ([1e-6, 0.0], [-1e-6, 0.0], [0.0, 1e-6], [0.0, -1e-6])
    ]
    for axis in range(2):  # the whole triangle moves
        expected = share * (by_point[2 * axis + 1] - by_point[2 * axis]) / 2e-6
        torch.testing.assert_close(jacobian[..., axis].sum(-1), expected, rtol=1e-5, atol=1e-5)


def test_faces_without_area_or_not_in_front_are_not_there():
    good = flat([[1, 1], [6, 1], [3, 6]])
    bad = torch.tensor(
        [[2, 2, math.nan], [math.inf, 2, 1], [2, 2, 0], [2, 2, -1], [1e200, 1, 1], [-1e200, 7, 1]]
    )
    screen = torch.cat([good, bad.double()])
    faces = torch.tensor(
        [[0, 1, 2], [3, 1, 2], [4, 1, 2], [5, 1, 2], [6, 1, 2], [0, 1, 1], [7, 8, 2]]
    )
    triangles = Triangles.of(faces)
    alone = Triangles.of(faces[:1], num_vertices=len(screen))
    assert visible(screen, triangles, 8, 8).equal(visible(screen, alone, 8, 8))
    assert silhouette(screen, triangles, 8, 8).equal(silhouette(screen, alone, 8, 8))
    assert silhouette(screen, triangles, 8, 8).sum().item() == pytest.approx(12.5)


@pytest.mark.parametrize(
    "screen, faces",
    [
        (torch.zeros(0, 3), torch.zeros(0, 3, dtype=torch.long)),
        (flat([[50, 1], [60, 1], [50, 9]]), [[0, 1, 2]]),
        (flat([[-9, -5], [-1, -5], [-3, 1e7]]), [[0, 1, 2]]),
        (flat([[1, 1], [6, 1], [3, 6]], -1.0), [[0, 1, 2]]),
    ],
    ids=["no triangles", "to the right", "to the left", "behind"],
)
def test_where_nothing_shows_there_is_background_only(screen, faces):
    triangles = Triangles.of(faces, num_vertices=len(screen))
    assert (visible(screen, triangles, 8, 7) == torch.full((7, 8), -1)).all()
    assert len(fragments_of(screen, triangles, 8, 7).pixel) == 0
    colours = torch.ones(len(triangles.faces) + 1, dtype=torch.float64)
    assert image(screen.double(), triangles, colours, 8, 7).equal(torch.ones(7, 8).double())
    assert barycentrics(screen, torch.zeros(0, 3, dtype=torch.long), torch.zeros(0, 2)).shape == (
        0,
        3,
    )


def test_an_image_of_one_pixel():
    assert silhouette(flat([[0, 0], [1, 0], [0, 1]]), ONE, 1, 1).item() == pytest.approx(0.5)
    assert silhouette(flat([[-9, -9], [30, -9], [-9, 30]]), ONE, 1, 1).item() == 1
    assert silhouette(
        flat([[0.1, 0.1], [0.3, 0.1], [0.1, 0.4]]), ONE, 1, 1
    ).item() == pytest.approx(0.03)


def test_all_tensors_are_made_where_the_input_lies():
    """With another default device, a tensor made without naming one would meet the input and
    fail.
    """
    shape = cube(hard=True)
    one = Triangles.of(shape.faces, positions=shape.vertices)
    triangles = join(one, one)
    screen = on_screen(torch.cat([turned(shape.vertices, s) + s for s in (0, 1)]))
    colours = random(2, len(triangles.faces) + 1)
    here = image(screen, triangles, colours, 32, 24)
    with torch.device("meta"):
        there = image(screen, triangles, colours, 32, 24)
        values = interpolate(
            screen,
            triangles.faces,
            barycentrics(screen, triangles.faces, screen[triangles.faces[:, 0], :2]),
        )
    assert there.equal(here) and values.device == screen.device


def test_nothing_is_mixed_with_an_infinitely_distant_background():
    screen = flat([[1, 1], [6, 1], [3, 6]])
    colours = torch.tensor([2.0, math.inf], dtype=torch.float64)
    found = image(screen, ONE, colours, 8, 8)
    assert found.equal(colours[visible(screen, ONE, 8, 8).long()])
