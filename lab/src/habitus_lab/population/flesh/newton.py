"""Projected Newton steps to where flesh comes to rest, or to where it is a moment later."""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from habitus_lab.population.flesh.assembly_kernels import (
    add_contact_diagonal,
    add_elastic,
    conjugate_gradients,
    contact_energy,
    invert_blocks,
    multiply,
    spring_energy,
    total_energy,
)
from habitus_lab.population.flesh.flesh import Flesh
from habitus_lab.population.flesh.skin import ContactRule, Contacts, find_contacts

ARMIJO = 1e-4
HALVINGS = 8


@dataclass(frozen=True)
class Solver:
    """How far each step is solved: conjugate gradients' tolerance and number; no node moves by more
    than `step` (m).
    """

    tolerance: float = 0.1
    gradients: int = 80
    step: float = 0.03
    contact: ContactRule = field(default_factory=ContactRule)


@dataclass(frozen=True, eq=False)
class Goal:
    """What flesh is drawn to: bones' places (S, 3), and rest edges stretched by active muscles (T,
    3, 3), inverted.
    """

    bones: Float[np.ndarray, "S 3"]
    inverse: Float[np.ndarray, "T 3 3"]


@dataclass(frozen=True, eq=False)
class Inertia:
    """Pull towards the places (N, 3) that nodes would move on to, mass / h^2 each, in units of mu
    m.

    `damping` (beta / h of Rayleigh's stiffness damping) resists motion from where the bones alone
    would carry nodes.
    """

    places: Float[np.ndarray, "N 3"]
    weight: Float[np.ndarray, " N"]
    carried: Float[np.ndarray, "N 3"]
    damping: float


def newton_step(
    flesh: Flesh,
    nodes: Float[np.ndarray, "N 3"],
    goal: Goal,
    solver: Solver,
    inertia: Inertia | None = None,
) -> tuple[Float[np.ndarray, "N 3"], float]:
    """Nodes after one step, and how far (m) the furthest moved. Held nodes stay where they are."""
    contacts = find_contacts(flesh.skin, flesh.cage, flesh.free, nodes, solver.contact)
    gradient = np.zeros_like(nodes)
    energy = _energy(flesh, nodes, goal, contacts, inertia, gradient)
    blocks = flesh.springs.copy()
    elastic = flesh.tets, goal.inverse, flesh.volume, flesh.mu, flesh.lam, flesh.slots
    add_elastic(nodes, *elastic, gradient, blocks)
    if inertia is not None:
        _add_inertia(flesh, nodes, inertia, blocks, gradient)
    move = _solve(flesh, blocks, gradient[: flesh.free], contacts, solver)
    longest = np.sqrt((move**2).sum(1).max())
    if longest > solver.step:
        move *= solver.step / longest
    slope = (move * gradient[: flesh.free]).sum()
    trial = nodes.copy()
    scrap = np.empty_like(nodes)
    share = 1.0
    for _ in range(HALVINGS):
        trial[: flesh.free] = nodes[: flesh.free] + share * move
        if _energy(flesh, trial, goal, contacts, inertia, scrap) <= energy + ARMIJO * share * slope:
            break
        share /= 2
    else:
        return nodes, 0.0
    return trial, share * min(longest, solver.step)


def _energy(
    flesh: Flesh,
    nodes: np.ndarray,
    goal: Goal,
    contacts: Contacts,
    inertia: Inertia | None,
    gradient: np.ndarray,
) -> float:
    """Everything but the damping; adds forces of springs and contacts to the gradient and marks
    active contacts.
    """
    total = total_energy(nodes, flesh.tets, goal.inverse, flesh.volume, flesh.mu, flesh.lam)
    total += spring_energy(
        nodes, flesh.bones.corners, flesh.bones.weights, flesh.stiffness, goal.bones, gradient
    )
    rule = contacts.stiffness, contacts.gap, contacts.active
    total += contact_energy(
        nodes, contacts.corners, contacts.coefficients, contacts.normals, *rule, gradient
    )
    if inertia is not None:
        off = nodes[: flesh.free] - inertia.places[: flesh.free]
        total += 0.5 * float((inertia.weight[: flesh.free, None] * off**2).sum())
    return total


def _add_inertia(
    flesh: Flesh, nodes: np.ndarray, inertia: Inertia, blocks: np.ndarray, gradient: np.ndarray
) -> None:
    free = flesh.free
    pattern = flesh.pattern
    if inertia.damping:
        off = nodes[:free] - inertia.carried[:free]
        force = np.empty((free, 3))
        multiply(pattern.starts, pattern.columns, blocks, off, force)
        gradient[:free] += inertia.damping * force
        blocks *= 1 + inertia.damping
    weight = inertia.weight[:free, None]
    gradient[:free] += weight * (nodes[:free] - inertia.places[:free])
    for c in range(3):
        blocks[pattern.diagonal, c, c] += weight[:, 0]


def _solve(
    flesh: Flesh, blocks: np.ndarray, gradient: np.ndarray, contacts: Contacts, solver: Solver
) -> np.ndarray:
    pattern = flesh.pattern
    diagonal = blocks[pattern.diagonal]
    springs = contacts.corners, contacts.coefficients, contacts.normals
    add_contact_diagonal(*springs, contacts.stiffness, contacts.active, diagonal)
    invert_blocks(diagonal)
    move = np.empty_like(gradient)
    matrix = pattern.starts, pattern.columns, blocks, diagonal
    active = contacts.active.copy()
    limits = solver.tolerance, solver.gradients
    conjugate_gradients(*matrix, (*springs, active), contacts.stiffness, -gradient, move, *limits)
    return move


def relax(
    flesh: Flesh,
    nodes: Float[np.ndarray, "N 3"],
    goal: Goal,
    solver: Solver,
    most: int,
    tolerance: float,
) -> tuple[Float[np.ndarray, "N 3"], int]:
    """Newton steps until no node moves by more than `tolerance` (m), `most` at most; and how many
    were taken.
    """
    for done in range(1, most + 1):
        nodes, moved = newton_step(flesh, nodes, goal, solver)
        if moved <= tolerance:
            return nodes, done
    return nodes, most
