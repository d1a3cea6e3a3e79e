"""A cage brought from one person to another, so that it fits the other's skin and no tetrahedron is
inverted.
"""

import numpy as np
from jaxtyping import Float

from habitus.errors import HabitusError
from habitus_lab.population.flesh.cage import Cage, Embedding
from habitus_lab.population.flesh.flesh import make_flesh
from habitus_lab.population.flesh.newton import Goal, Solver, relax
from habitus_lab.population.flesh.skin import make_skin

FIRM = 20.0
"""m: how much a skin vertex counts against smoothness."""
FLATTEST = 0.2
"""Least J, from the first person's cage to the other's; each tetrahedron against the mean of all.
"""
PULL = 0.5
"""mu m: springs of skin vertices where the elastic energy warps."""
STEPS = 30


def warped(
    cage: Cage, points: Embedding, skin: Float[np.ndarray, "P 3"], flattest: float = FLATTEST
) -> Cage:
    """The cage with its embedded skin at `skin` (m): harmonic; elastic where that flattens
    tetrahedra.

    Raises HabitusError where some stay flatter than `flattest`.
    """
    moved = cage.spread(points, skin - points(cage.nodes), FIRM)
    nodes = cage.nodes + moved
    if _flattest(cage, nodes) < flattest:
        nodes = _elastic(cage, points, skin, nodes)
    if (worst := _flattest(cage, nodes)) < flattest:
        raise HabitusError(
            f"a tetrahedron of the warped cage keeps {worst:.2f} of its volume; expected "
            f"{flattest} or more: mesh the "
            f"person's own skin"
        )
    return cage.at(nodes)


def _flattest(cage: Cage, nodes: np.ndarray) -> float:
    corners = nodes[cage.tets]
    volumes = np.linalg.det(corners[:, 1:] - corners[:, :1]) / 6
    return float((volumes / cage.volumes).min() / min(1.0, volumes.sum() / cage.volumes.sum()))


def _elastic(cage: Cage, points: Embedding, skin: np.ndarray, nodes: np.ndarray) -> np.ndarray:
    """Rest of elastic flesh (volume may change) whose skin springs draw to its places."""
    none = make_skin(cage, points(cage.nodes), np.zeros((0, 3), np.int64), np.zeros(0, np.int64))
    flesh = make_flesh(cage, len(cage.nodes), points, np.full(len(skin), PULL), none, stiff=1.0)
    goal = Goal(skin, flesh.inverse)
    return relax(flesh, nodes, goal, Solver(tolerance=1e-2, gradients=200, step=0.1), STEPS, 1e-5)[
        0
    ]
