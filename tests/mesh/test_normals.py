import torch
import trimesh

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
    assert torch.allclose(face_normals(vertices, faces).sum(0), torch.zeros(3, dtype=torch.float64), atol=1e-13)


def test_loose_and_flattened_vertices_have_no_normal_and_harmless_gradients():
    vertices = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [5, 5, 5]], requires_grad=True)
    faces = torch.tensor([[0, 1, 2], [0, 2, 1]])
    normals = vertex_normals(vertices, faces)
    assert torch.equal(normals, torch.zeros_like(normals))
    normals.sum().backward()
    assert torch.isfinite(vertices.grad).all()
