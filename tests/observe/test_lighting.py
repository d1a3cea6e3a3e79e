import math

import pytest
import torch

from habitus.errors import HabitusError
from habitus.mesh.normals import vertex_normals
from habitus.observe.light import harmonics, harmonics_slope
from habitus.observe.lighting import ambient, point_light, spherical_harmonics
from habitus.rotations import matrix_from_rotvec


def random(seed: int, *shape: int) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def directions(count: int, seed: int = 0) -> torch.Tensor:
    return torch.nn.functional.normalize(random(seed, count, 3), dim=-1)


def light_from(towards: torch.Tensor, coefficients: torch.Tensor) -> torch.Tensor:
    """The light itself (before any surface): Y of each order, from the basis without the Lambertian
    factors.
    """
    kept = torch.tensor([math.pi] + [2 * math.pi / 3] * 3 + [math.pi / 4] * 5, dtype=torch.float64)
    return (harmonics(towards) / kept) @ coefficients


def even_directions(count: int) -> torch.Tensor:
    """A Fibonacci lattice on the sphere: integrals of smooth functions by it are good to about 1 /
    count.
    """
    k = torch.arange(count, dtype=torch.float64) + 0.5
    z = 1 - 2 * k / count
    angle = math.pi * (1 + math.sqrt(5)) * k
    r = (1 - z * z).sqrt()
    return torch.stack([r * angle.cos(), r * angle.sin(), z], -1)


def test_the_harmonics_are_orthonormal():
    towards = even_directions(20_000)
    values = light_from(towards, torch.eye(9, dtype=torch.float64))
    gram = 4 * math.pi / len(towards) * values.T @ values
    torch.testing.assert_close(gram, torch.eye(9, dtype=torch.float64), rtol=0, atol=1e-3)


@pytest.mark.parametrize("seed", range(3))
def test_brightness_is_the_integral_of_light_times_clamped_cosine(seed):
    towards = even_directions(100_000)
    normals = directions(20, seed)
    coefficients = random(seed, 9, 2)
    cosine = (normals @ towards.T).clamp(min=0)
    integral = 4 * math.pi / len(towards) * cosine @ light_from(towards, coefficients)
    torch.testing.assert_close(
        spherical_harmonics(normals, coefficients), integral, rtol=0, atol=1e-3
    )


@pytest.mark.parametrize("seed", range(3))
def test_turning_light_and_surface_together_changes_nothing(seed):
    turn = matrix_from_rotvec(random(seed, 3))
    towards = directions(500, seed)
    # The turned light L'(d) = L(R^T d), found by fitting its values.
    matrix = torch.linalg.lstsq(
        light_from(towards, torch.eye(9).double()),
        light_from(towards @ turn, torch.eye(9).double()),
    )
    turned = matrix.solution
    normals = directions(50, seed + 1)
    coefficients = random(seed, 9, 3)
    before = spherical_harmonics(normals, coefficients)
    after = spherical_harmonics(normals @ turn.T, turned @ coefficients)
    torch.testing.assert_close(after, before, rtol=0, atol=1e-10)
    torch.testing.assert_close(
        turned @ turned.T, torch.eye(9, dtype=torch.float64), rtol=0, atol=1e-10
    )


def test_the_first_coefficient_is_constant_light_and_the_next_three_are_y_z_x():
    normals = directions(10)
    first = torch.eye(9, dtype=torch.float64)[0]
    torch.testing.assert_close(
        spherical_harmonics(normals, first), torch.full((10, 1), math.sqrt(math.pi) / 2).double()
    )
    linear = torch.zeros(9, 3, dtype=torch.float64)
    linear[1:4] = torch.eye(3, dtype=torch.float64)
    brightness = spherical_harmonics(normals, linear)
    torch.testing.assert_close(
        brightness / brightness[:, :1], normals[:, [1, 2, 0]] / normals[:, [1]]
    )


def test_a_lamp_far_away_gives_the_cosine_and_nothing_behind():
    normals = directions(200)
    points = random(1, 200, 3)
    towards = directions(1, 5)[0]
    brightness = point_light(
        points, normals, 1e9 * towards, torch.tensor([2.0, 0.5], dtype=torch.float64)
    )
    cosine = (normals @ towards).clamp(min=0)
    torch.testing.assert_close(
        brightness, cosine[:, None] * torch.tensor([2.0, 0.5]).double(), rtol=0, atol=1e-7
    )
    assert (brightness == 0).any() and (brightness > 0).any()


def test_a_lamp_moves_and_scales_with_its_scene():
    normals = directions(50)
    points = random(1, 50, 3)
    position = random(2, 3)
    colour = random(3, 3).abs()
    turn = matrix_from_rotvec(random(4, 3))
    move = random(5, 3)
    before = point_light(points, normals, position, colour)
    after = point_light(
        3 * points @ turn.T + move, normals @ turn.T, 3 * turn @ position + move, colour
    )
    torch.testing.assert_close(after, before)


def test_a_lamp_on_a_point_leaves_everything_finite():
    points = torch.zeros(2, 3, dtype=torch.float64)
    points[1, 0] = 1.0
    points.requires_grad_()
    position = torch.zeros(3, dtype=torch.float64, requires_grad=True)
    brightness = point_light(points, directions(2), position, torch.ones(1).double())
    assert brightness[0] == 0
    assert all(
        slope.isfinite().all()
        for slope in torch.autograd.grad(brightness.sum(), [points, position])
    )


def test_batches_are_loops_and_lights_add():
    points = random(0, 4, 20, 3)
    normals = directions(80).reshape(4, 20, 3)
    position = random(1, 4, 3)
    colour = random(2, 4, 2)
    coefficients = random(3, 4, 9, 2)

    def lit(points, normals, position, colour, coefficients):
        return (
            ambient(points, colour)
            + point_light(points, normals, position, colour)
            + spherical_harmonics(normals, coefficients)
        )

    together = lit(points, normals, position, colour, coefficients)
    assert together.shape == (4, 20, 2)
    for k in range(4):
        torch.testing.assert_close(
            together[k], lit(points[k], normals[k], position[k], colour[k], coefficients[k])
        )
    one_surface = lit(points[0], normals[0], position, colour, coefficients)
    torch.testing.assert_close(
        one_surface[2], lit(points[0], normals[0], position[2], colour[2], coefficients[2])
    )
    assert ambient(points[0], colour).shape == (4, 20, 2)


def test_derivatives_reach_vertices_lights_and_albedo():
    faces = torch.tensor([[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]])
    inputs = [
        random(0, 4, 3),
        random(1, 9, 2),
        3 * random(2, 3),
        random(3, 2).abs(),
        random(4, 2),
        random(5, 4, 2),
    ]

    def drawn(vertices, coefficients, position, colour, everywhere, albedo):
        normals = vertex_normals(vertices, faces)
        lamp = point_light(vertices, normals, position, colour)
        return albedo * (
            spherical_harmonics(normals, coefficients) + lamp + ambient(vertices, everywhere)
        )

    assert torch.autograd.gradcheck(drawn, [value.requires_grad_() for value in inputs])
    inputs = [value.detach() for value in inputs]
    every = tuple(range(6))
    forward, backward = (
        way(drawn, argnums=every)(*inputs) for way in (torch.func.jacfwd, torch.func.jacrev)
    )
    for a, b in zip(forward, backward, strict=True):
        torch.testing.assert_close(a, b)


@pytest.mark.wrong_shapes
def test_bad_light_is_one_clear_line():
    normals = directions(5)
    lamp = torch.zeros(3).double()
    colour = torch.ones(1).double()
    uses = [
        (lambda: spherical_harmonics(normals, torch.zeros(8).double()), r"coefficients are \(8,\)"),
        (
            lambda: spherical_harmonics(normals, torch.zeros(3, 9).double()),
            r"coefficients are \(3, 9\)",
        ),
        (lambda: spherical_harmonics(normals, torch.zeros(9)), "float32"),
        (
            lambda: spherical_harmonics(normals[:, :2], torch.zeros(9).double()),
            r"normals are \(5, 2\)",
        ),
        (lambda: point_light(normals[0], normals, lamp, colour), r"points are \(3,\)"),
        (lambda: point_light(normals, normals, lamp[:2], colour), r"position is \(2,\)"),
        (lambda: point_light(normals, normals, lamp, colour[0]), "colour is one number"),
        (lambda: ambient(normals, colour[0]), "colour is one number"),
    ]
    for use, words in uses:
        with pytest.raises(HabitusError, match=words):
            use()


def test_the_slope_of_harmonics_is_what_autodiff_gives():
    normals = torch.randn(7, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(3))
    each = torch.func.vmap(torch.func.jacrev(lambda normal: harmonics(normal[None])[0]))(normals)
    torch.testing.assert_close(harmonics_slope(normals), each)
