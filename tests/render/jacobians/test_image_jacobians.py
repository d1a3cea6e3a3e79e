"""Explicit Jacobians of images: what automatic differentiation gives, as matrices."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch
from scenes import HEIGHT, SCENES, WIDTH, camera, scene
from scipy import sparse

from habitus.errors import HabitusError
from habitus.mesh.shapes import cube, icosphere
from habitus.observe.camera import Camera
from habitus.render.draw import draw
from habitus.render.jacobians.images import (
    depth_jacobian,
    image_jacobian,
    mipmap_matrix,
    silhouette_jacobian,
    textured_jacobian,
)
from habitus.render.jacobians.screen import CAMERA_FIELDS
from habitus.render.textures import Texture
from habitus.render.triangles import Triangles
from habitus.solve import minimize

MODES = ("antialias", "filter", "none")
CUT = "two spheres, one in front and one through the near plane"
LENS = [-0.05, 0.02, 0.003, -0.002, 0.01, 0.01, -0.01, 0.005]


def random(seed: int, *shape: int) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


class World:
    """A scene whose every number is in `numbers`, a random direction for each, and its images as
    functions of them.
    """

    def __init__(self, name: str, mode: str, channels: int = 3, light_channels: int | None = None):
        found, vertices, self.triangles = scene(name)
        self.mode = mode
        self.camera = found.replace(distortion=torch.tensor(LENS, dtype=torch.float64))
        self.background = random(1, HEIGHT, WIDTH, max(channels, light_channels or 1))
        self.numbers = {
            "vertices": vertices,
            **{field: getattr(self.camera, field).clone() for field in CAMERA_FIELDS},
            "values": random(2, len(vertices), light_channels or channels),
            "uv": 0.5 + 0.4 * random(3, len(vertices), 2),
            "picture": random(4, 12, 9, channels),
        }
        self.steps = {
            name: random(5 + k, *value.shape)
            for k, (name, value) in enumerate(self.numbers.items())
        }
        self.frame = self.draw(**self.numbers)

    def draw(self, vertices, **numbers):
        return draw(self.looking(**numbers), vertices, self.triangles, self.mode)

    def looking(self, **numbers) -> Camera:
        return self.camera.replace(**{field: numbers[field] for field in CAMERA_FIELDS})

    def image(self, **numbers):
        return self.draw(**numbers).image(numbers["values"], self.background)

    def textured(self, values=None, uv_faces=None, mipmaps=True, **numbers):
        texture = Texture.of(numbers["picture"], mipmaps)
        return self.draw(**numbers).textured(
            texture, numbers["uv"], uv_faces, values, self.background
        )

    def changed(self, function, *names: str) -> torch.Tensor:
        """The change of an image, flat, as the numbers of these names move along their steps."""
        held = {name: value for name, value in self.numbers.items() if name not in names}

        def moved(*values: torch.Tensor) -> torch.Tensor:
            return function(**held, **dict(zip(names, values, strict=True)))

        given = [tuple(table[name] for name in names) for table in (self.numbers, self.steps)]
        return torch.func.jvp(moved, *given)[1].flatten()

    def geometry(self, jacobian) -> np.ndarray:
        """What a Jacobian says of the change as vertices and camera move along their steps."""
        vertices = self.numbers["vertices"]
        change = jacobian.to_vertices(self.camera, vertices) @ flat(self.steps["vertices"])
        for name, derivatives in jacobian.to_camera(self.camera, vertices).items():
            change = change + derivatives @ flat(self.steps[name])
        return change


GEOMETRY = ("vertices", *CAMERA_FIELDS)


def flat(tensor: torch.Tensor) -> np.ndarray:
    return tensor.detach().numpy().ravel()


def close(mine, expected, error: float = 1e-9):
    mine, expected = (
        np.asarray(x.detach() if isinstance(x, torch.Tensor) else x) for x in (mine, expected)
    )
    assert np.abs(expected).max() > 0
    np.testing.assert_allclose(mine, expected, rtol=0, atol=error * np.abs(expected).max())


def each_channel(matrix, channels: int):
    return sparse.kron(matrix, sparse.eye_array(channels))


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("name", SCENES)
def test_images_change_as_forward_differentiation_says(name, mode):
    world = World(name, mode)
    jacobian = image_jacobian(world.frame, world.numbers["values"], world.background)
    close(world.geometry(jacobian), world.changed(world.image, *GEOMETRY))
    by_values = each_channel(jacobian.values, 3) @ flat(world.steps["values"])
    close(by_values, world.changed(world.image, "values"))


@pytest.mark.parametrize("name", ["hard cube", CUT])
@pytest.mark.parametrize("field", GEOMETRY)
def test_each_of_the_cameras_numbers_by_itself(name, field):
    world = World(name, "antialias")
    jacobian = image_jacobian(world.frame, world.numbers["values"], world.background)
    view = world.camera, world.numbers["vertices"]
    if field == "vertices":
        mine = jacobian.to_vertices(*view)
    else:
        found = jacobian.to_camera(*view, [field])
        assert list(found) == [field]
        mine = found[field]
    close(mine @ flat(world.steps[field]), world.changed(world.image, field))


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize("behind", [torch.inf, 7.0, "image"])
def test_depth_and_silhouettes(name, mode, behind):
    world = World(name, mode)
    behind = 5 + world.background[..., 0] if behind == "image" else behind
    depth = depth_jacobian(world.frame, behind)
    close(
        world.geometry(depth),
        world.changed(lambda **all: world.draw(**all).depth(behind), *GEOMETRY),
    )
    if mode != "none":
        mine = world.geometry(silhouette_jacobian(world.frame))
        close(mine, world.changed(lambda **all: world.draw(**all).silhouette(), *GEOMETRY))


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("name", ["sphere with a seam", "hard cube", CUT])
@pytest.mark.parametrize("own_faces", [False, True], ids=["", "own faces"])
@pytest.mark.parametrize("lit, mipmaps", [(True, True), (True, False), (False, True)])
def test_textures(name, mode, own_faces, lit, mipmaps):
    world = World(name, mode)
    count = len(world.numbers["vertices"])
    kept = {
        "mipmaps": mipmaps,
        "uv_faces": (world.triangles.faces * 7 + 3) % count if own_faces else None,
    }
    names = [*GEOMETRY, "uv", "picture", *(["values"] if lit else [])]

    def image(values=None, **numbers):
        return world.textured(values if lit else None, **kept, **numbers)

    check_texture(world, image, names, mipmaps, kept["uv_faces"], lit)


@pytest.mark.parametrize("channels, light_channels", [(3, 1), (1, 3)])
def test_one_channel_of_light_or_texture_serves_all(channels, light_channels):
    world = World(CUT, "antialias", channels, light_channels)
    check_texture(world, world.textured, [*GEOMETRY, "uv", "picture", "values"], True, None, True)


def check_texture(world, image, names, mipmaps, uv_faces, lit):
    numbers = world.numbers
    steps = world.steps
    texture = Texture.of(numbers["picture"], mipmaps)
    values = numbers["values"] if lit else None
    jacobian = textured_jacobian(
        world.frame, texture, numbers["uv"], uv_faces, values, world.background
    )
    close(world.geometry(jacobian), world.changed(image, *GEOMETRY))
    close(jacobian.uv @ flat(steps["uv"]), world.changed(image, "uv"))
    texel_tangent = mipmap_matrix(texture) @ steps["picture"].flatten(0, 1).numpy()
    close(jacobian.texels @ texel_tangent.ravel(), world.changed(image, "picture"))
    if lit:
        close(jacobian.brightness @ flat(steps["values"]), world.changed(image, "values"))
    else:
        assert jacobian.brightness is None


@pytest.mark.parametrize("size", [(8, 8), (7, 12), (1, 5), (1, 1), (13, 11)])
def test_mipmaps_are_a_matrix(size):
    picture = random(1, *size, 2)
    texture = Texture.of(picture)
    close(mipmap_matrix(texture) @ picture.flatten(0, 1).numpy(), texture.texels, 1e-12)


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("name", ["torus", CUT])
def test_transposed_it_is_reverse_differentiation(name, mode):
    world = World(name, mode)
    leaves = {
        name: value.clone().requires_grad_()
        for name, value in world.numbers.items()
        if name not in ("uv", "picture")
    }
    frame = world.draw(**leaves)
    jacobian = image_jacobian(
        frame, leaves["values"], world.background
    )  # from a frame that is in the graph
    cotangent = random(9, HEIGHT, WIDTH, 3)
    image = frame.image(leaves["values"], world.background)
    expected = dict(
        zip(
            leaves,
            torch.autograd.grad((image * cotangent).sum(), list(leaves.values())),
            strict=True,
        )
    )
    view = world.looking(**leaves), leaves["vertices"]
    close(jacobian.to_vertices(*view).T @ flat(cotangent), flat(expected["vertices"]))
    close(jacobian.values.T @ cotangent.flatten(0, 1).numpy(), expected["values"])
    for field, matrix in jacobian.to_camera(*view).items():
        close(matrix.T @ flat(cotangent), expected[field])


@pytest.mark.parametrize("mode", MODES)
def test_a_row_knows_only_what_its_pixel_shows(mode):
    world = World("soup", mode)
    jacobian = image_jacobian(world.frame, world.numbers["values"])
    visibility = world.frame.visibility
    faces = world.triangles.faces.numpy()
    shown = [set() for _ in range(WIDTH * HEIGHT)]
    for pixel, face in zip(visibility.pixels.tolist(), visibility.faces.tolist(), strict=False):
        shown[pixel].update(faces[face].tolist())
    fragments = visibility.fragments
    if fragments is not None:
        for sides in (fragments.face, fragments.inner_face, fragments.outer_face):
            for pixel, face in zip(fragments.pixel.tolist(), sides.tolist(), strict=True):
                shown[pixel].update(faces[face].tolist() if face >= 0 else [])
    assert {len(some) for some in shown} >= {0, 3}
    screen = jacobian.screen
    to_vertices = jacobian.to_vertices(world.camera, world.numbers["vertices"])
    for matrix, rows, width in ((screen, 3, 3), (to_vertices, 3, 3), (jacobian.values, 1, 1)):
        for row, (begin, end) in enumerate(zip(matrix.indptr[:-1], matrix.indptr[1:], strict=True)):
            assert set((matrix.indices[begin:end] // width).tolist()) <= shown[row // rows]
    assert np.diff(jacobian.values.indptr)[[len(some) == 0 for some in shown]].max() == 0


def posed(pose: torch.Tensor, vertices: torch.Tensor) -> torch.Tensor:
    """A bend: no parameter of the camera."""
    return vertices * (1 + pose[0]) + torch.sin(2 * vertices.roll(1, -1) * pose[1:4] + pose[4])


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("name", ["torus", CUT])
@pytest.mark.parametrize("kind", [np.asarray, sparse.csr_array])
def test_chains_to_parameters_of_ones_own(name, mode, kind):
    world = World(name, mode)
    rest = world.numbers["vertices"]
    pose = 0.05 * random(8, 5)
    vertices = posed(pose, rest)
    frame = draw(world.camera, vertices, world.triangles, mode)

    def image(pose):
        moved = posed(pose, rest)
        return draw(world.camera, moved, world.triangles, mode).image(moved[:, :2] ** 2).flatten()

    expected = torch.func.jacfwd(image)(pose)
    derivatives = torch.func.jacfwd(posed)(pose, rest)
    jacobian = image_jacobian(frame, vertices[:, :2] ** 2)
    value_derivatives = (2 * vertices[:, :2, None] * derivatives[:, :2]).flatten(0, 1).numpy()
    by_values = jacobian.chain_values(kind(value_derivatives))
    by_vertices = jacobian.chain(world.camera, vertices, kind(derivatives.flatten(0, 1).numpy()))
    assert sparse.issparse(by_values) == sparse.issparse(by_vertices) == (kind is sparse.csr_array)
    close(
        (by_vertices + by_values).toarray()
        if kind is sparse.csr_array
        else by_vertices + by_values,
        expected,
    )
    if kind is np.asarray:
        close(jacobian.chain(world.camera, vertices, derivatives), by_vertices)


@pytest.mark.parametrize("mode", MODES)
def test_one_step_of_gauss_newton_is_that_of_autodiff(mode):
    shape = cube()
    view = camera()
    triangles = Triangles.of(shape.faces, shape.vertices)
    values = random(3, 24, 3)
    names = ["rotation", "translation"]
    start = torch.cat([view.rotation, view.translation])
    observed = draw(
        view.replace(translation=view.translation + 0.02), shape.vertices, triangles
    ).image(values)

    def residual(x):
        placed = view.replace(rotation=x[:3], translation=x[3:])
        return (draw(placed, shape.vertices, triangles, mode).image(values) - observed).flatten()

    frame = draw(view, shape.vertices, triangles, mode)
    found = image_jacobian(frame, values).to_camera(view, shape.vertices, names)
    mine = np.hstack([found[name] for name in names])
    expected = torch.func.jacfwd(residual)(start).numpy()
    close(mine, expected)
    right = residual(start).numpy()
    steps = [np.linalg.solve(matrix.T @ matrix, -matrix.T @ right) for matrix in (mine, expected)]
    close(*steps, 1e-6)


@pytest.mark.parametrize("method", ["dogleg", "levenberg", "lbfgs"])
def test_minimize_takes_them(method):
    """A camera's translation and a ball's height, by explicit Jacobians; they end where autodiff
    does.
    """
    ball = icosphere(2)
    view = camera()
    triangles = Triangles.of(ball.faces, ball.vertices)
    values = ball.vertices * 0.5 + 0.5
    upright = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
    start = {"translation": view.translation, "taller": torch.zeros(1, dtype=torch.float64)}
    truth = {name: value + 0.05 for name, value in start.items()}

    def picture(translation, taller):
        moved = view.replace(translation=translation)
        vertices = ball.vertices * (0.5 + taller * upright)
        return moved, vertices, draw(moved, vertices, triangles)

    observed = picture(**truth)[2].image(values)
    calls = []

    def by_autodiff(translation, taller):
        return picture(translation, taller)[2].image(values) - observed

    def explicitly(translation, taller):
        moved, vertices, frame = picture(translation, taller)

        def derivatives():
            calls.append(translation)
            jacobian = image_jacobian(frame, values)
            by_camera = jacobian.to_camera(moved, vertices, ["translation"])
            return {
                **by_camera,
                "taller": jacobian.chain(moved, vertices, (ball.vertices * upright)[..., None]),
            }

        return frame.image(values) - observed, derivatives

    mine, other = (minimize(term, start, method) for term in (explicitly, by_autodiff))
    assert calls
    for name, value in truth.items():
        torch.testing.assert_close(mine.values[name], other.values[name], rtol=0, atol=1e-5)
        torch.testing.assert_close(mine.values[name], value, rtol=0, atol=1e-5)


def test_threads_do_not_disturb_each_other():
    world = World("torus", "antialias")
    jacobian = image_jacobian(world.frame, world.numbers["values"], world.background)
    view = world.camera, world.numbers["vertices"]
    expected = jacobian.to_vertices(*view)
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda _: jacobian.to_vertices(*view), range(40)))
    for each in found:
        assert np.array_equal(each.data, expected.data)


def test_in_single_precision_they_are_nearly_the_same():
    exact, (view, vertices, triangles) = World("torus", "antialias"), scene("torus")
    values = exact.numbers["values"]
    rows = []
    for dtype in (torch.float64, torch.float32):
        drawn = view.to(dtype), vertices.to(dtype)
        jacobian = image_jacobian(draw(*drawn, triangles), values.to(dtype))
        rows.append(jacobian.to_vertices(*drawn).T @ np.ones(WIDTH * HEIGHT * 3))
        assert rows[-1].dtype == np.float64
    close(rows[1], rows[0], 1e-3)


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("faces", [torch.zeros(0, 3, dtype=torch.long), torch.tensor([[0, 1, 2]])])
def test_where_nothing_shows_nothing_changes(mode, faces):
    view = camera()
    vertices = view.to_world(torch.eye(3, dtype=torch.float64) - 5)  # behind it
    frame = draw(view, vertices, Triangles.of(faces, num_vertices=3), mode)
    texture = Texture.of(random(1, 4, 4, 3))
    found = image_jacobian(frame, vertices), depth_jacobian(frame), silhouette_jacobian(frame)
    for jacobian in (*found, textured_jacobian(frame, texture, vertices[:, :2], None, vertices)):
        assert jacobian.to_vertices(view, vertices).nnz == 0
        for matrix in jacobian.to_camera(view, vertices).values():
            assert not matrix.any()
    assert found[0].values.nnz == 0 and found[0].values.shape == (WIDTH * HEIGHT, 3)


@pytest.mark.wrong_shapes
def test_what_does_not_fit_is_said():
    world = World("torus", "antialias")
    frame = world.frame
    vertices = world.numbers["vertices"]
    values = world.numbers["values"]
    jacobian = image_jacobian(frame, values)
    for wrong in (
        lambda: image_jacobian(frame, values[1:]),
        lambda: image_jacobian(frame, values, torch.zeros(2)),
        lambda: image_jacobian(frame, values, torch.tensor([torch.inf, 0.0, 0.0])),
        lambda: jacobian.to_vertices(world.camera, vertices[1:]),
        lambda: jacobian.to_vertices(world.camera, vertices + 0.1),
        lambda: jacobian.to_camera(
            world.camera.replace(translation=torch.ones(3).double()), vertices
        ),
        lambda: jacobian.to_camera(world.camera, vertices, ["zoom"]),
        lambda: jacobian.chain(world.camera, vertices, np.zeros((5, 2))),
        lambda: jacobian.chain_values(np.zeros(3 * len(vertices))),
    ):
        with pytest.raises(HabitusError) as error:
            wrong()
        assert "\n" not in str(error.value)
    assert jacobian.to_camera(world.camera, vertices, []) == {}
