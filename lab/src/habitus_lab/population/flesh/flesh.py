"""Elastic flesh of one person: a cage with held nodes, soft bones as springs, and the skin that it
carries.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from habitus_lab.population.flesh.assembly_kernels import add_springs
from habitus_lab.population.flesh.cage import Cage, Embedding
from habitus_lab.population.flesh.pattern import Pattern, pattern_of
from habitus_lab.population.flesh.skin import Skin

INCOMPRESSIBLE = 40.0
"""lambda in units of mu."""


@dataclass(frozen=True, eq=False)
class Flesh:
    """What a simulation of one person needs. Nodes that move come first; energies are in units of
    mu times m^3.

    `tets` are those with a node that moves, with their rest volumes and stiffnesses (mu, lam),
    `inverse` those of their rest edges. Bones are points `bones` in tetrahedra that springs of
    `stiffness` (mu m) draw to their places.
    """

    cage: Cage
    free: int
    tets: Int[np.ndarray, "T 4"]
    inverse: Float[np.ndarray, "T 3 3"]
    volume: Float[np.ndarray, " T"]
    mu: Float[np.ndarray, " T"]
    lam: Float[np.ndarray, " T"]
    slots: Int[np.ndarray, "T 16"]
    pattern: Pattern
    bones: Embedding
    stiffness: Float[np.ndarray, " S"]
    springs: Float[np.ndarray, "K 3 3"]
    skin: Skin
    mass: Float[np.ndarray, " N"]

    @property
    def held_tets(self) -> Bool[np.ndarray, " A"]:
        """Of the cage's tetrahedra, those none of whose nodes move."""
        return np.asarray((self.cage.tets >= self.free).all(1))


def held_last(cage: Cage, held: Bool[np.ndarray, " N"]) -> tuple[Cage, Int[np.ndarray, " N"]]:
    """The cage with its held nodes at the end, and the old numbers of its nodes."""
    order = np.argsort(held, kind="stable")
    place = np.empty(len(order), np.int64)
    place[order] = np.arange(len(order))
    return Cage(cage.nodes[order], place[cage.tets]), order


def make_flesh(
    cage: Cage,
    free: int,
    bones: Embedding,
    stiffness: Float[np.ndarray, " S"],
    skin: Skin,
    mu: Float[np.ndarray, " A"] | float = 1.0,
    stiff: float = INCOMPRESSIBLE,
) -> Flesh:
    """Flesh over a cage whose first `free` nodes move; mu of every tetrahedron, and lambda over
    mu.
    """
    moving = (cage.tets < free).any(1)
    tets = cage.tets[moving]
    pattern = pattern_of(tets, free)
    springs = np.zeros((len(pattern.columns), 3, 3))
    add_springs(bones.corners, bones.weights, stiffness, pattern.slots(bones.corners), springs)
    shear = np.broadcast_to(np.asarray(mu, float), len(cage.tets))[moving].copy()
    mass = np.zeros(len(cage.nodes))
    np.add.at(mass, cage.tets.ravel(), np.repeat(cage.volumes / 4, 4))
    return Flesh(
        cage=cage,
        free=free,
        tets=tets,
        inverse=np.linalg.inv(cage.edges[moving]),
        volume=cage.volumes[moving],
        mu=shear,
        lam=stiff * shear,
        slots=pattern.slots(tets),
        pattern=pattern,
        bones=bones,
        stiffness=np.asarray(stiffness, float),
        springs=springs,
        skin=skin,
        mass=mass,
    )
