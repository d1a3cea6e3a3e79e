"""Drawing: what images must be, whatever the mesh, and what bad input gets."""

import os
import subprocess
import sys

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import SCENES, camera, scene

from habitus.errors import HabitusError
from habitus.mesh.shapes import cube, icosphere, quadrilateral, sphere
from habitus.observe.camera import Camera
from habitus.render.draw import draw
from habitus.render.jacobians.images import textured_jacobian
from habitus.render.textures import Texture
from habitus.render.triangles import Triangles, join
from habitus.rotations import matrix_from_rotvec

CLOSE = {"rtol": 0, "atol": 1e-9}


def boxes(image, times):
    """Means over squares of pixels."""
    height = image.shape[0] // times
    width = image.shape[1] // times
    return image.unflatten(0, (height, times)).unflatten(2, (width, times)).mean((1, 3))


@pytest.mark.parametrize("name", SCENES)
def test_antialiasing_is_box_filtering(name):
    view, vertices, triangles = scene(name)
    colours = torch.rand(
        len(vertices), 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64
    )
    colours[:] = colours[:1] if name == "soup" else colours * 0.2 + 0.4
    image = draw(view, vertices, triangles).image(colours, 0.1)
    fine = boxes(draw(view.scaled(16), vertices, triangles, "none").image(colours, 0.1), 16)
    coarse = draw(view, vertices, triangles, "none").image(colours, 0.1)
    edge = draw(view, vertices, triangles).boundary
    wrong = (image - fine).abs()[edge].mean()
    before = (coarse - fine).abs()[edge].mean()
    assert wrong < 0.1 * before, (wrong, before)


def test_whole_coverage_is_the_area_on_the_screen():
    view = camera()
    ball = icosphere(3)
    frame = draw(view, ball.vertices * 0.7, ball.faces)
    outline = frame.visibility.fragments
    tail = frame.screen[outline.tail, :2]
    head = frame.screen[outline.head, :2]
    start, end = (tail + t[:, None] * (head - tail) for t in (outline.start, outline.end))
    area = (start[:, 0] * end[:, 1] - start[:, 1] * end[:, 0]) * outline.outward
    torch.testing.assert_close(frame.silhouette().sum(), area.sum().abs() / 2)


@pytest.mark.parametrize("boundary", ["antialias", "filter", "none"])
def test_seams_of_doubled_vertices_are_no_silhouettes(boundary):
    view = camera()
    ball = sphere(12, 20)
    doubled = draw(view, ball.vertices, ball.faces, boundary)
    _, first, inverse = np.unique(
        ball.vertices.numpy().round(12), axis=0, return_index=True, return_inverse=True
    )
    single = draw(
        view, ball.vertices[first], torch.from_numpy(inverse.reshape(-1))[ball.faces], boundary
    )
    colours = ball.vertices * 0.4 + 0.5
    assert torch.equal(doubled.boundary, single.boundary)
    torch.testing.assert_close(doubled.image(colours), single.image(colours[first]), **CLOSE)
    torch.testing.assert_close(doubled.silhouette(), single.silhouette(), **CLOSE)


def test_depth_is_where_rays_meet_the_plane():
    view = Camera.of(40, 30, 35.0, translation=[0.1, 0.0, 2.0], rotation=[0.4, -0.3, 0.1])
    sheet = quadrilateral()
    frame = draw(view, sheet.vertices * 3, sheet.faces, "none")
    depth = frame.depth()
    seen = frame.face_ids >= 0
    rows, columns = torch.meshgrid(torch.arange(30) + 0.5, torch.arange(40) + 0.5, indexing="ij")
    points = (
        view.rays(torch.stack([columns, rows], -1).double().flatten(0, 1))
        * depth.flatten()[:, None]
    )
    world = view.to_world(points[seen.flatten()])
    corners = sheet.vertices * 3
    normal = torch.linalg.cross(corners[1] - corners[0], corners[2] - corners[0])
    assert seen.sum() > 200 and ((world - corners[0]) @ normal).abs().max() < 1e-9
    assert depth[~seen].isinf().all()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_dtypes(dtype):
    view, vertices, triangles = scene("torus")
    frame = draw(view.to(dtype), vertices.to(dtype), triangles)
    exact = draw(view, vertices, triangles)
    for found, expected in (
        (frame.image(vertices.to(dtype)), exact.image(vertices)),
        (frame.silhouette(), exact.silhouette()),
        (frame.normals(vertices.to(dtype)), exact.normals(vertices)),
    ):
        assert found.dtype == dtype
        assert ((found - expected).abs() < 1e-3).double().mean() > 0.995


def test_batches_are_single_drawings_side_by_side():
    view, vertices, triangles = scene("torus")
    turns = matrix_from_rotvec(
        torch.randn(2, 1, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    )
    meshes = vertices @ turns
    cameras = view.replace(
        translation=view.translation + torch.tensor([[0.0, 0, 0], [0.1, 0, 0], [0, 0, 0.5]])
    )
    colours = torch.rand(2, 1, len(vertices), 3, dtype=torch.float64)
    frames = draw(cameras, meshes, triangles)
    image = frames.image(colours)
    depth = frames.depth()
    assert image.shape == (2, 3, view.height, view.width, 3) and depth.shape == image.shape[:-1]
    one = draw(view.replace(translation=cameras.translation[1]), meshes[1, 0], triangles)
    torch.testing.assert_close(image[1, 1], one.image(colours[1, 0]))
    torch.testing.assert_close(depth[1, 1], one.depth())
    assert torch.equal(frames.face_ids[1, 1], one.face_ids) and torch.equal(
        frames.boundary[1, 1], one.boundary
    )


def test_several_meshes_hide_each_other():
    view = camera()
    ball = icosphere(2)
    back = ball.vertices * 0.6
    front = ball.vertices * 0.2 + torch.tensor([0.2, 0.65, 1.05], dtype=torch.float64)
    parts = Triangles.of(ball.faces, ball.vertices)
    both = draw(view, torch.cat([back, front]), join(parts, parts))
    alone = draw(view, front, parts)
    count = len(ball.faces)
    assert (
        torch.equal(both.face_ids >= count, alone.face_ids >= 0) and (both.face_ids < count).any()
    )
    colours = torch.cat([torch.zeros_like(back), torch.ones_like(front)])
    torch.testing.assert_close(both.image(colours)[..., 0], alone.silhouette(), **CLOSE)


def test_drawing_does_not_depend_on_threads(monkeypatch):
    view, vertices, triangles = scene("soup")
    images = []
    for threads in ("1", "2", "5"):
        monkeypatch.setenv("NUMBA_NUM_THREADS", threads)
        images.append(draw(view.scaled(6), vertices, triangles).image(vertices))
    assert torch.equal(images[0], images[1]) and torch.equal(images[0], images[2])


def test_culling_leaves_out_backs():
    view = camera()
    ball = icosphere(2)
    out = draw(view, ball.vertices, ball.faces, cull=True)
    inside_out = draw(view, ball.vertices, ball.faces.flip(1), cull=True)
    assert torch.equal(out.face_ids, draw(view, ball.vertices, ball.faces).face_ids)
    assert torch.equal(out.face_ids >= 0, inside_out.face_ids >= 0)
    assert (
        out.depth()[out.face_ids >= 0] < inside_out.depth()[out.face_ids >= 0]
    ).double().mean() > 0.99


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10_000), st.sampled_from(["antialias", "filter", "none"]))
def test_colours_stay_between_those_of_surfaces_and_background(seed, boundary):
    generator = torch.Generator().manual_seed(seed)
    view = camera(20, 16)
    points = torch.randn(18, 3, generator=generator, dtype=torch.float64)
    points[:, 2] = 2.0 + 0.1 * torch.randperm(6, generator=generator).repeat_interleave(
        3
    )  # no two triangles cross
    frame = draw(view, view.to_world(points), torch.arange(18).reshape(-1, 3), boundary)
    image = frame.image(torch.ones(18, 1).double() * 0.7, 0.2)
    coverage = frame.silhouette()
    beyond = ((image - 0.45).abs() - 0.25).clamp(
        min=0
    )  # where edges end on others, one value stands for two areas
    assert beyond.max() < 0.2 and beyond.mean() < 1e-3
    torch.testing.assert_close(image[..., 0], 0.2 + 0.5 * coverage, **CLOSE)


def test_a_texture_shows_where_its_places_lie():
    view = Camera.of(64, 48, 60.0, translation=[0, 0, 2.0], rotation=[np.pi, 0, 0])
    sheet = quadrilateral()
    v, u = torch.meshgrid(
        1 - (torch.arange(32) + 0.5) / 32, (torch.arange(32) + 0.5) / 32, indexing="ij"
    )
    texture = Texture.of(torch.stack([u, v], -1).double(), mipmaps=False, wrap=("clamp", "clamp"))
    frame = draw(view, sheet.vertices, sheet.faces, "none")
    inside = frame.image(sheet.uv.double())
    inner = (inside > 0.05).all(-1) & (inside < 0.95).all(-1)
    image = frame.textured(texture, sheet.uv)
    assert inner.sum() > 300
    torch.testing.assert_close(image[inner], inside[inner], rtol=0, atol=1e-6)
    bright = frame.textured(texture, sheet.uv, brightness=torch.full((4, 1), 0.5).double())
    torch.testing.assert_close(bright, image * 0.5)
    corners = torch.randperm(4, generator=torch.Generator().manual_seed(0))
    rows = torch.argsort(corners)
    torch.testing.assert_close(frame.textured(texture, sheet.uv[corners], rows[sheet.faces]), image)


@pytest.mark.parametrize("boundary", ["antialias", "filter", "none"])
def test_what_is_drawn_of_nothing(boundary):
    view = camera(7, 5)
    nothing = torch.zeros(0, 3, dtype=torch.float64)
    behind = torch.tensor(
        [[0.0, 0, 0], [1, 0, 0], [0, 1, 0]], dtype=torch.float64
    ) + 10 * view.to_world(torch.tensor([[0.0, 0, -1]], dtype=torch.float64))
    flat = torch.tensor([[0.0, 0, 0], [0.1, 0, 0], [0.2, 0, 0]], dtype=torch.float64)
    for vertices, faces in (
        (nothing, torch.zeros(0, 3).long()),
        (behind, [[0, 1, 2]]),
        (flat, [[0, 1, 2], [0, 0, 1]]),
    ):
        frame = draw(view, vertices.clone().requires_grad_(), faces, boundary)
        assert (frame.face_ids == -1).all() and frame.depth().isinf().all()
        image = frame.image(torch.ones(len(vertices), 2).double(), 0.25)
        assert (image == 0.25).all() and (frame.silhouette() == 0).all()
        (image.sum() + frame.silhouette().sum()).backward() if image.requires_grad else None


def test_one_pixel():
    view = camera(1, 1)
    ball = icosphere(1)
    vertices = (0.2 * ball.vertices).requires_grad_()
    frame = draw(view, vertices, ball.faces)
    coverage = frame.silhouette()
    coverage.sum().backward()
    assert coverage.shape == (1, 1) and 0 < coverage < 1 and vertices.grad.abs().sum() > 0


def test_bad_input_is_one_clear_line():
    view = camera()
    ball = icosphere(1)
    good = ball.vertices
    broken = good.clone()
    broken[3, 1] = np.nan
    cases = [
        (lambda: draw(view, good[:, :2], ball.faces), r"vertices are \(42, 2\)"),
        (lambda: draw(view, broken, ball.faces), "ertex 3 is at"),
        (lambda: draw(view, broken, Triangles.of(ball.faces, good)), "ertex 3 is at"),
        (lambda: draw(view, good, ball.faces + 30), "names vertex"),
        (lambda: draw(view, good, -ball.faces), "names vertex"),
        (lambda: draw(view, good, ball.faces.double()), "type"),
        (lambda: draw(view, good[:-1], Triangles.of(ball.faces, good)), "41 vertices; expected 42"),
        (lambda: draw(view, good, ball.faces, "smooth"), "boundary is 'smooth'"),
        (lambda: draw(view, good.float(), ball.faces), "float32"),
        (
            lambda: draw(view, good, ball.faces).image(good[:5]),
            r"values are \(5, 3\); expected \(42",
        ),
        (lambda: draw(view, good, ball.faces).image(good, torch.zeros(4, 4, 3)), "background is"),
        (
            lambda: draw(view, good.expand(3, 42, 3), ball.faces).image(good.expand(2, 42, 3)),
            "leading axes",
        ),
    ]
    for call, words in cases:
        with pytest.raises(HabitusError, match=words) as caught:
            call()
        assert "\n" not in str(caught.value)


def test_it_works_in_the_workers_of_a_loader_that_forks():
    code = """
import torch
from torch.utils.data import DataLoader
from habitus.render.draw import draw
from habitus.mesh.shapes import cube
from habitus.observe.camera import Camera

class Views(torch.utils.data.Dataset):
    def __len__(self):
        return 2
    def __getitem__(self, index):
        view, box = Camera.of(300, 200, 300.0, translation=[0.0, 0.0, 3.0]), cube()
        vertices = box.vertices.clone().requires_grad_()
        image = draw(view, vertices, box.faces).image(vertices)
        image.sum().backward()
        return image.detach(), vertices.grad

before = Views()[0]
for image, derivative in DataLoader(Views(), batch_size=None, num_workers=2, multiprocessing_context="fork"):
    print(torch.equal(image, before[0]), torch.allclose(derivative, before[1]))
"""
    environment = {**os.environ, "NUMBA_NUM_THREADS": "2"}
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=120, env=environment
    )
    assert done.stdout.split() == ["True"] * 4, done.stderr


def test_a_hard_cube_keeps_its_colours():
    view = camera()
    box = cube()
    frame = draw(view, box.vertices, box.faces)
    colours = torch.arange(6).repeat_interleave(4)[:, None].double()
    whole = ~frame.boundary & (frame.face_ids >= 0)
    seam = torch.zeros_like(whole).flatten()
    seam[frame.visibility.fragments.pixel] = True
    image = frame.image(colours)[..., 0]
    inside = whole & ~seam.view_as(whole)
    expected = colours[box.faces[frame.face_ids[inside].long(), 0], 0]
    torch.testing.assert_close(image[inside], expected)
    assert inside.sum() > 100
    mixed = whole & seam.view_as(whole)
    assert mixed.any() and ((image[mixed] % 1) != 0).double().mean() > 0.9


@pytest.mark.parametrize("near", [0.01, 3.0])
def test_texture_coordinates_that_do_not_fit_the_mesh_are_refused(near):
    box = cube()
    texture = Texture.of(torch.ones(4, 4, 3, dtype=torch.float64))
    view = Camera.of(30, 20, 30.0, translation=[0.0, 0.0, 3.0], near=near)
    frame = draw(view, box.vertices, box.faces)
    corners = box.faces
    assert (frame.clipped is not None) == (near == 3.0)
    far = corners.clone()
    behind = corners.clone()
    row = len(corners) - 1
    far[row, 2], behind[row, 1] = 24, -1
    for uv, uv_faces, message in (
        (box.uv[:, :1], None, r"expected \(U, 2\)"),
        (box.uv.long(), None, r"expected \(U, 2\)"),
        (box.uv, corners.double(), r"expected \(12, 3\) whole"),
    ):
        with pytest.raises(HabitusError, match=message):
            frame.check_uv(uv, uv_faces)
    for uv, uv_faces, message in (
        (box.uv[:-1], None, "uv has 23 rows; expected 24"),
        (box.uv, corners[:-1], r"expected \(12, 3\)"),
        (box.uv, far, r"uv_faces\[11, 2\] is 24; expected 0 to 23"),
        (box.uv, behind, r"uv_faces\[11, 1\] is -1; expected 0 to 23"),
        (box.uv[:0], corners, r"uv_faces\[0, 0\]"),
    ):
        with pytest.raises(HabitusError, match=message):
            frame.textured(texture, uv, uv_faces)
        with pytest.raises(HabitusError, match=message):
            textured_jacobian(frame, texture, uv, uv_faces)
    torch.testing.assert_close(
        frame.textured(texture, box.uv, corners), frame.textured(texture, box.uv)
    )
