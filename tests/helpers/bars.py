"""Bars of tetrahedra: the simplest flesh."""

import numpy as np

from habitus.rotations import matrix_from_rotvec
from habitus_lab.population.flesh.cage import Cage, Embedding, positive_cage
from habitus_lab.population.flesh.flesh import Flesh, held_last, make_flesh
from habitus_lab.population.flesh.newton import Goal
from habitus_lab.population.flesh.skin import make_skin

CUBE = np.array(
    [[0, 1, 3, 7], [0, 3, 2, 7], [0, 2, 6, 7], [0, 6, 4, 7], [0, 4, 5, 7], [0, 5, 1, 7]]
)


def bar(cells: tuple[int, int, int], size: tuple[float, float, float]) -> Cage:
    """A box of cells of six tetrahedra each, one corner at the origin."""
    lines = [np.linspace(0, length, count + 1) for count, length in zip(cells, size, strict=True)]
    nodes = np.stack(np.meshgrid(*lines, indexing="ij"), -1).reshape(-1, 3)
    number = np.arange(len(nodes)).reshape([count + 1 for count in cells])
    corners = np.stack(
        [
            number[i : cells[0] + i, j : cells[1] + j, k : cells[2] + k].ravel()
            for i, j, k in np.ndindex(2, 2, 2)
        ],
        1,
    )
    return positive_cage(nodes, corners[:, CUBE].reshape(-1, 4))


def surface(cage: Cage) -> np.ndarray:
    """Outward triangles of the cage's surface."""
    faces = np.concatenate(
        [cage.tets[:, order] for order in ([1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1])]
    )
    _, first, count = np.unique(np.sort(faces, 1), axis=0, return_index=True, return_counts=True)
    return faces[first[count == 1]]


class HingedBar:
    """A bar along x whose near half a joint in its middle holds, and whose far half it turns about
    z.
    """

    def __init__(
        self,
        cells: tuple[int, int, int] = (12, 2, 2),
        size: tuple[float, float, float] = (0.6, 0.1, 0.1),
    ):
        cage = bar(cells, size)
        far = cage.nodes[:, 0] / size[0]
        cage, order = held_last(cage, (far < 0.01) | (far > 0.99))
        far = far[order]
        self.free = int(((far >= 0.01) & (far <= 0.99)).sum())
        self.weights = np.stack([1 - np.clip(8 * far - 3.5, 0, 1), np.clip(8 * far - 3.5, 0, 1)], 1)
        self.middle = np.array([size[0] / 2, size[1] / 2, size[2] / 2])
        self.points = np.array(
            [
                [x * size[0], size[1] / 2, size[2] / 2]
                for x in (*np.linspace(0.05, 0.42, 9), *np.linspace(0.58, 0.95, 9))
            ]
        )
        self.moved = self.points[:, 0] > self.middle[0]
        faces = surface(cage)
        used, index = np.unique(faces, return_inverse=True)
        skin = make_skin(cage, cage.nodes[used], index.reshape(-1, 3), np.arange(len(used)))
        held, _ = cage.embed(self.points)
        self.flesh: Flesh = make_flesh(cage, self.free, held, np.full(len(self.points), 0.3), skin)

    def motions(self, pose: np.ndarray) -> np.ndarray:
        turn = matrix_from_rotvec(pose[1])
        shift = self.middle - turn @ self.middle
        still = np.concatenate([np.eye(3), np.zeros((3, 1))], 1)
        return np.stack([still, np.concatenate([turn, shift[:, None]], 1)])

    def goal(self, pose: np.ndarray) -> Goal:
        motion = self.motions(pose)[1]
        moved = self.points @ motion[:, :3].T + motion[:, 3]
        return Goal(np.where(self.moved[:, None], moved, self.points), self.flesh.inverse)


def bent(degrees: float) -> np.ndarray:
    """(2, 3) pose of a hinged bar."""
    return np.array([[0, 0, 0], [0, 0, np.radians(degrees)]])


__all__ = ["Embedding", "HingedBar", "bar", "bent", "surface"]
