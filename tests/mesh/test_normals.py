import pytest
import torch
import trimesh

from habitus.mesh.array_normals import unit_sums
from habitus.mesh.normals import face_normals, vertex_normals
from habitus.rotations import matrix_from_rotvec


def ball():
    mesh = trimesh.creation.icosphere(3)
    return torch.tensor(mesh.vertices), torch.tensor(mesh.faces)


def test_a_balls_normals_point_outwards_and_turn_with_it():
    vertices, faces = ball()
    normals = vertex_normals(vertices, faces)
    assert ((normals * vertices).sum(-1) > 0.999).all()
    turn = matrix_from_rotvec(torch.tensor([0.4, 1.0, -2.0], dtype=torch.float64))
    both = vertex_normals(torch.stack([vertices, 3 * vertices @ turn.T + 5]), faces)
    assert torch.allclose(both[1], normals @ turn.T, atol=1e-13)
    assert torch.allclose(both.norm(dim=-1), torch.ones(2, len(vertices), dtype=torch.float64))
    assert torch.allclose(
        face_normals(vertices, faces).sum(0), torch.zeros(3, dtype=torch.float64), atol=1e-13
    )


def test_loose_and_flattened_vertices_have_no_normal_and_harmless_gradients():
    vertices = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [5, 5, 5]], requires_grad=True)
    faces = torch.tensor([[0, 1, 2], [0, 2, 1]])
    normals = vertex_normals(vertices, faces)
    assert torch.equal(normals, torch.zeros_like(normals))
    normals.sum().backward()
    assert torch.isfinite(vertices.grad).all()


def random_mesh(dtype=torch.float64):
    """A crumpled ball with a loose vertex, and a weight for each number of its normals."""
    vertices, faces = ball()
    random = torch.Generator().manual_seed(3)
    crumpled = vertices + 0.1 * torch.randn(vertices.shape, generator=random, dtype=vertices.dtype)
    crumpled = torch.cat([crumpled, crumpled.new_tensor([[9.0, 9.0, 9.0]])]).to(dtype)
    return crumpled, faces, torch.randn(crumpled.shape, generator=random, dtype=dtype)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_compiled_normals_are_those_of_array_operations(dtype):
    vertices, faces, weights = random_mesh(dtype)
    close = {"atol": 2e-5 if dtype == torch.float32 else 1e-12, "rtol": 0}
    torch.testing.assert_close(vertex_normals(vertices, faces), unit_sums(vertices, faces), **close)
    leaf = vertices.requires_grad_()
    found, expected = (
        torch.autograd.grad((f(leaf, faces) * weights).sum(), leaf)[0]
        for f in (vertex_normals, unit_sums)
    )
    torch.testing.assert_close(
        found, expected, atol=1e-3 if dtype == torch.float32 else 1e-10, rtol=0
    )


def test_they_can_be_derived_twice_forward_and_over_batches():
    vertices, faces, weights = random_mesh()
    step = weights.flip(0)

    def along(normals):
        loss = lambda moved: (normals(moved, faces) * weights).sum()  # noqa: E731
        return (
            torch.func.jvp(lambda moved: normals(moved, faces), (vertices,), (step,))[1],
            torch.func.jvp(torch.func.grad(loss), (vertices,), (step,))[1],
            torch.func.vmap(torch.func.grad(loss))(torch.stack([vertices, 2 * vertices])),
        )

    for found, expected in zip(along(vertex_normals), along(unit_sums), strict=True):
        torch.testing.assert_close(found, expected, atol=1e-9, rtol=1e-9)
    leaf = vertices.requires_grad_()
    (first,) = torch.autograd.grad(
        (vertex_normals(leaf, faces) * weights).sum(), leaf, create_graph=True
    )
    (again,) = torch.autograd.grad((first * step).sum(), leaf)
    torch.testing.assert_close(again, along(unit_sums)[1], atol=1e-9, rtol=1e-9)


def test_a_face_that_names_no_vertex_is_an_error():
    with pytest.raises(IndexError):
        vertex_normals(torch.eye(3), torch.tensor([[0, 1, 3]]))
