"""Flesh along a path of poses: bones carry it a little way, then it comes to rest, and so on (the
path matters).
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from jaxtyping import Float

from habitus.rotations import matrix_from_rotvec, rotvec_from_matrix
from habitus_lab.population.flesh.flesh import Flesh
from habitus_lab.population.flesh.newton import Goal, Solver, relax


class Skeleton(Protocol):
    """What drives flesh: rigid motions of joints, and the goal that a pose (J, 3) sets."""

    @property
    def weights(self) -> Float[np.ndarray, "N J"]:
        """Which joints carry which nodes; held nodes go exactly where these take them."""
        ...

    def motions(self, pose: Float[np.ndarray, "J 3"]) -> Float[np.ndarray, "J 3 4"]:
        """Motions that take rest places along with the joints."""
        ...

    def goal(self, pose: Float[np.ndarray, "J 3"]) -> Goal:
        """Where bones are in a pose, and what muscles do."""
        ...


@dataclass(frozen=True)
class Walk:
    """How a path is walked: steps of at most `angle` (rad) a joint, `steps` Newton steps after
    each.

    A stop is relaxed with up to `most` steps, until no node moves by more than `tolerance` (m).
    """

    angle: float = float(np.radians(15.0))
    steps: int = 3
    most: int = 25
    tolerance: float = 0.0002
    solver: Solver = field(default_factory=Solver)


@dataclass(frozen=True, eq=False)
class Stop:
    """Flesh at rest in a pose: its nodes (m), and how many Newton steps the last relaxation
    took.
    """

    pose: Float[np.ndarray, "J 3"]
    nodes: Float[np.ndarray, "N 3"]
    steps: int


def walk(
    flesh: Flesh,
    skeleton: Skeleton,
    poses: Sequence[Float[np.ndarray, "J 3"]],
    way: Walk,
    start: Stop | None = None,
) -> Iterator[Stop]:
    """The flesh at rest in each of the poses, reached one after the other from the first shape."""
    if start is None:
        start = Stop(np.zeros_like(poses[0]), flesh.cage.nodes, 0)
    here = start.pose
    nodes = start.nodes
    for pose in poses:
        for between in _between(here, pose, way.angle):
            nodes = carried(skeleton, flesh, nodes, here, between)
            nodes, _ = relax(flesh, nodes, skeleton.goal(between), way.solver, way.steps, 0.0)
            here = between
        nodes, count = relax(flesh, nodes, skeleton.goal(pose), way.solver, way.most, way.tolerance)
        here = pose
        yield Stop(pose, nodes, count)


def carried(
    skeleton: Skeleton,
    flesh: Flesh,
    nodes: Float[np.ndarray, "N 3"],
    old: np.ndarray,
    new: np.ndarray,
) -> Float[np.ndarray, "N 3"]:
    """Nodes moved as joints move from one pose (J, 3) to another; held ones are where skinning
    takes them from rest.
    """
    before = skeleton.motions(old)
    after = skeleton.motions(new)
    turn = after[:, :, :3] @ before[:, :, :3].swapaxes(1, 2)
    shift = after[:, :, 3:] - turn @ before[:, :, 3:]
    moved = _blend(skeleton.weights, np.concatenate([turn, shift], 2), nodes)
    held = slice(flesh.free, None)
    moved[held] = _blend(skeleton.weights[held], after, flesh.cage.nodes[held])
    return moved


def _blend(weights: np.ndarray, motions: np.ndarray, nodes: np.ndarray) -> np.ndarray:
    mixed = (weights @ motions.reshape(len(motions), 12)).reshape(-1, 3, 4)
    return np.einsum("nij,nj->ni", mixed[:, :, :3], nodes) + mixed[:, :, 3]


def _between(old: np.ndarray, new: np.ndarray, angle: float) -> Iterator[np.ndarray]:
    """Poses on the way, the last one the new one; every joint turns about one axis."""
    first = matrix_from_rotvec(old)
    last = matrix_from_rotvec(new)
    turn = rotvec_from_matrix(first.swapaxes(-1, -2) @ last)
    count = int(np.ceil(np.linalg.norm(turn, axis=1).max() / angle - 1e-9))
    for k in range(1, count + 1):
        yield (
            new if k == count else rotvec_from_matrix(first @ matrix_from_rotvec(k / count * turn))
        )
