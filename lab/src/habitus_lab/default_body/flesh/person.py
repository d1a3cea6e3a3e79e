"""One person's flesh: the mean cage warped to their skin, their bones, their muscles."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse

from habitus_lab.population.flesh.flesh import Flesh, make_flesh
from habitus_lab.population.flesh.newton import Goal
from habitus_lab.population.flesh.refine import refined
from habitus_lab.population.flesh.skin import make_skin
from habitus_lab.population.flesh.warp import warped

from .bones import Bones, under_skin
from .frames import Frames
from .muscles import Muscles, draw_muscles
from .studio import SKIN, Studio

FELT = 0.018  # m: longest edge of the skin that feels contact


@dataclass(frozen=True, eq=False)
class Person:
    """A person's flesh, and the skeleton that drives it."""

    studio: Studio
    flesh: Flesh
    rest: np.ndarray  # (V, 3) skin and eyeballs
    frames: Frames
    bones: Bones
    points: np.ndarray  # (S, 3) bones at rest
    muscles: Muscles
    smooth: sparse.csr_matrix  # (SKIN, N)
    moving: np.ndarray  # (SKIN,) False where skinning alone carries the skin

    @property
    def weights(self) -> np.ndarray:
        """(N, J) of nodes."""
        return self.studio.weights

    def motions(self, pose: np.ndarray) -> np.ndarray:
        """(J, 3, 4)."""
        return self.frames.motions(pose)

    def goal(self, pose: np.ndarray) -> Goal:
        """Where bones are in a pose, and what muscles do."""
        places = self.bones.places(self.points, self.frames.all(pose))
        return Goal(places, self.muscles.contract(self.flesh.inverse, pose))

    def skinned(self, pose: np.ndarray) -> np.ndarray:
        """(V, 3) by linear blend skinning alone."""
        motions = self.motions(pose)
        mixed = (self.studio.skin_weights @ motions.reshape(-1, 12)).reshape(-1, 3, 4)
        return np.einsum("vij,vj->vi", mixed[:, :, :3], self.rest) + mixed[:, :, 3]

    def surface(self, pose: np.ndarray, nodes: np.ndarray) -> np.ndarray:
        """(V, 3) of the simulated skin; what lies in held tetrahedra, linings and eyeballs follow
        skinning.
        """
        vertices = self.skinned(pose)
        vertices[:SKIN][self.moving] = (self.smooth @ nodes)[self.moving]
        return vertices

    def bone_errors(self, pose: np.ndarray, nodes: np.ndarray) -> np.ndarray:
        """(S,) metres between bones and their places."""
        return np.linalg.norm(self.flesh.bones(nodes) - self.goal(pose).bones, axis=1)


def make_person(
    studio: Studio, rest: np.ndarray, joints: np.ndarray, felt_edge: float = FELT, every: int = 1
) -> Person:
    """The flesh of a person with a skin (V, 3) and joints (J, 3) at rest; `every` so manieth vertex
    looks for contact.

    Raises HabitusError where no cage fits.
    """
    skin_rest = rest[:SKIN]
    points, _ = studio.cage.embed(studio.body.v_template[:SKIN])
    cage = warped(studio.cage, points, skin_rest)
    names = studio.body.joint_names
    frames = Frames(names, studio.body.parents, joints)
    bones = studio.bones
    places = under_skin(bones.points(joints, studio.joints, names), skin_rest, studio.faces)
    held, _ = cage.embed(places)
    own, _ = cage.embed(skin_rest)
    moving = (own.corners < studio.free).any(1)
    felt, faces = refined(skin_rest, studio.faces, felt_edge)
    probes = np.union1d(np.flatnonzero(~studio.hidden), np.arange(SKIN, len(felt)))
    skin = make_skin(cage, felt, faces, probes[::every])
    flesh = make_flesh(cage, studio.free, held, bones.stiffness, skin)
    smooth = cage.smooth(own, skin_rest)
    return Person(
        studio, flesh, rest, frames, bones, places, draw_muscles(flesh, frames), smooth, moving
    )
