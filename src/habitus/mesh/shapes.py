"""Simple meshes to render: spheres, a torus, polyhedra. Faces run counter-clockwise seen from
outside; y is up.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from habitus.errors import HabitusError


@dataclass(frozen=True, eq=False)
class Shape:
    """A mesh: vertices in metres, triangles, and texture coordinates where it has them ((0, 0) is
    bottom left).
    """

    vertices: Float[Tensor, "V 3"]
    faces: Int[Tensor, "F 3"]
    uv: Float[Tensor, "V 2"] | None = None


def sphere(rings: int = 16, segments: int = 32) -> Shape:
    """The unit sphere as a globe of `rings` bands and `segments` meridians, 2 * (rings - 1) *
    segments triangles.

    A map of the world on its texture is seen unmirrored from outside, north (v = 1) at +y, its
    middle at +z. The vertices of the meridian at -z are there twice and those of the poles once a
    segment, for the texture's sake.
    """
    _at_least("rings", rings, 2)
    _at_least("segments", segments, 3)
    row = np.arange(rings + 1)
    column = np.arange(segments + 1)
    latitude = np.pi * (row / rings - 0.5)
    radius = np.cos(latitude)
    height = np.sin(latitude)
    radius[[0, -1]] = 0.0  # exactly, so that copies of a pole are equal
    longitude = 2 * np.pi * (column % segments / segments) - np.pi
    x = radius[:, None] * np.sin(longitude)
    z = radius[:, None] * np.cos(longitude)
    u, v = np.meshgrid(column / segments, row / rings)
    u[[0, -1]] += 0.5 / segments
    bands = _grid(rings, segments, row[:, None] * (segments + 1) + column)
    south = bands[:segments, 1]
    north = np.column_stack([bands[-segments:, 0, :2], bands[-segments:, 1, 2]])
    faces = np.concatenate([south, bands[segments:-segments].reshape(-1, 3), north])
    vertices = np.stack([x, np.broadcast_to(height[:, None], x.shape), z], -1).reshape(-1, 3)
    unused = [segments, len(vertices) - 1]  # each pole's last copy
    uv = np.stack([u, v], -1).reshape(-1, 2)
    return _shape(
        np.delete(vertices, unused, 0), faces - (faces > segments), np.delete(uv, unused, 0)
    )


def torus(around: int = 84, across: int = 82, tube: float = 0.4) -> Shape:
    """A ring about the y axis, its middle circle of radius 1 m, its tube of `tube`: 2 * around *
    across triangles.
    """
    _at_least("around", around, 3)
    _at_least("across", across, 3)
    i = np.arange(around + 1) % around
    j = np.arange(across + 1) % across
    turn, roll = np.meshgrid(
        2 * np.pi * np.arange(around) / around, 2 * np.pi * np.arange(across) / across
    )
    radius = 1.0 + tube * np.cos(roll)
    vertices = np.stack(
        [radius * np.sin(turn), tube * np.sin(roll), radius * np.cos(turn)], -1
    ).reshape(-1, 3)
    return _shape(vertices, _grid(across, around, j[:, None] * around + i).reshape(-1, 3))


def icosphere(subdivisions: int = 3) -> Shape:
    """The unit sphere as an icosahedron, each triangle split in four `subdivisions` times: 20 * 4^n
    triangles.
    """
    _at_least("subdivisions", subdivisions, 0)
    golden = (1 + 5**0.5) / 2
    a = np.array([1.0, 1, -1, -1])
    b = np.array([golden, -golden, golden, -golden])
    none = np.zeros(4)
    vertices = np.concatenate([np.stack(p, 1) for p in ((none, a, b), (a, b, none), (b, none, a))])
    vertices /= np.hypot(1, golden)
    near = np.linalg.norm(vertices[:, None] - vertices, axis=-1) < 1.1  # edges are 1.0515 long
    i, j, k = np.nonzero(near[:, :, None] & near[:, None] & near[None])
    faces = np.stack([i, j, k], 1)[(i < j) & (j < k)]
    inward = (
        np.einsum(
            "fi,fi->f",
            vertices[faces[:, 0]],
            np.cross(vertices[faces[:, 1]], vertices[faces[:, 2]]),
        )
        < 0
    )
    faces[inward] = faces[inward][:, ::-1]
    for _ in range(subdivisions):
        vertices, faces = _split(vertices, faces)
        vertices = vertices / np.linalg.norm(vertices, axis=1, keepdims=True)
    return _shape(vertices, faces)


def tetrahedron(subdivisions: int = 0) -> Shape:
    """The regular tetrahedron in the unit sphere, each triangle split in four `subdivisions` times,
    sides left flat.
    """
    _at_least("subdivisions", subdivisions, 0)
    vertices = np.array([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) / 3**0.5
    faces = np.array([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]])
    for _ in range(subdivisions):
        vertices, faces = _split(vertices, faces)
    return _shape(vertices, faces)


def cube(hard: bool = True) -> Shape:
    """The cube of side 1 m about the origin: 24 vertices, the whole texture on each side, or (not
    hard) 8 vertices.
    """
    corners = np.stack(
        np.meshgrid([-0.5, 0.5], [-0.5, 0.5], [-0.5, 0.5], indexing="ij"), -1
    ).reshape(-1, 3)
    sides = np.array(
        [[1, 5, 7, 3], [5, 4, 6, 7], [4, 0, 2, 6], [0, 1, 3, 2], [3, 7, 6, 2], [0, 4, 5, 1]]
    )
    if not hard:
        return _shape(corners, sides[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3))
    faces = 4 * np.arange(6)[:, None] + np.array([0, 1, 2, 0, 2, 3])
    return _shape(corners[sides.ravel()], faces.reshape(-1, 3), np.tile(_SQUARE, (6, 1)))


def quadrilateral() -> Shape:
    """The square of side 1 m about the origin in the plane z = 0, facing +z, with the whole texture
    on it.
    """
    vertices = np.concatenate([_SQUARE - 0.5, np.zeros((4, 1))], 1)
    return _shape(vertices, np.array([[0, 1, 2], [0, 2, 3]]), _SQUARE)


_SQUARE = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])


def _grid(rows: int, columns: int, index: np.ndarray) -> np.ndarray:
    """Two triangles a cell (rows * columns, 2, 3) of a grid of vertices, rows running up, columns
    to the right.
    """
    a = index[:-1, :-1]
    b = index[:-1, 1:]
    c = index[1:, 1:]
    d = index[1:, :-1]
    return np.stack([a, b, c, a, c, d], -1).reshape(rows * columns, 2, 3)


def _split(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Each triangle in four at the middles of its edges, which neighbours share."""
    edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), 1)
    edges, where = np.unique(edges, axis=0, return_inverse=True)
    a, b, c = faces.T
    ab, bc, ca = len(vertices) + where.reshape(-1, 3).T
    parts = np.stack([a, ab, ca, ab, b, bc, ca, bc, c, ab, bc, ca], 1).reshape(-1, 3)
    return np.concatenate([vertices, vertices[edges].mean(1)]), parts


def _shape(vertices: np.ndarray, faces: np.ndarray, uv: np.ndarray | None = None) -> Shape:
    return Shape(
        torch.tensor(vertices), torch.tensor(faces), None if uv is None else torch.tensor(uv)
    )


def _at_least(name: str, got: int, least: int) -> None:
    if got < least:
        raise HabitusError(f"Got {name}={got}; expected at least {least}")
