"""The skin that a cage carries, and where it meets itself: contact told through the rest shape."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from habitus_lab.population.flesh.cage import Cage, Embedding
from habitus_lab.population.flesh.contact_kernels import (
    closest_around,
    embed,
    fill_grid,
    foreign,
    vertex_normals,
)

NEIGHBOURS = 64
"""Skin vertices nearest to a place among which one that faces the other way is looked for."""
OPPOSED = -0.2
"""Cosine of two normals below which skin faces skin."""
CELL = 0.03
"""Side (m) of the cells in which tetrahedra are looked up."""


@dataclass(frozen=True)
class ContactRule:
    """Distances (m) of contact: a vertex is probed `reach` before it, parts nearer than `far` at
    rest are no partners.

    Springs of `stiffness` (mu m) keep `gap` between vertex and partner; pairs further apart than
    `wide`, deeper in each other than `deep`, or displaced by more than `aside`, are none.
    """

    reach: float = 0.006
    far: float = 0.015
    near: float = 0.012
    gap: float = 0.003
    wide: float = 0.010
    aside: float = 0.030
    stiffness: float = 1.0
    deep: float = float("inf")


@dataclass(frozen=True)
class Contacts:
    """Unilateral springs: distances along `normals` (K, 3) of points given by coefficients of 8
    nodes each.
    """

    corners: Int[np.ndarray, "K 8"]
    coefficients: Float[np.ndarray, "K 8"]
    normals: Float[np.ndarray, "K 3"]
    stiffness: float
    gap: float
    active: Bool[np.ndarray, " K"]


@dataclass(frozen=True, eq=False)
class Skin:
    """V vertices in the cage, their triangles, and the `probes` (vertex numbers) that look for
    contact.

    `hats` are gradients of the weights in each vertex' tetrahedron.
    """

    rest: Float[np.ndarray, "V 3"]
    faces: Int[np.ndarray, "F 3"]
    embedding: Embedding
    hats: Float[np.ndarray, "V 4 3"]
    probes: Int[np.ndarray, " P"]

    @cached_property
    def tree(self) -> KDTree:
        """Of the probes at rest."""
        return KDTree(self.rest[self.probes])

    @cached_property
    def around(self) -> tuple[np.ndarray, np.ndarray]:
        """Triangles around every vertex: starts, and the lists."""
        corners = self.faces.ravel()
        order = np.argsort(corners, kind="stable")
        return np.searchsorted(corners[order], np.arange(len(self.rest) + 1)), order // 3

    def posed(self, nodes: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "V 3"]:
        """The vertices where the cage's nodes are these."""
        out = np.empty_like(self.rest)
        embed(nodes, self.embedding.corners, self.embedding.weights, out)
        return out

    def normals(self, vertices: Float[np.ndarray, "V 3"]) -> Float[np.ndarray, "V 3"]:
        """Unit normals."""
        out = np.empty_like(vertices)
        vertex_normals(vertices, self.faces, out)
        return out


def make_skin(
    cage: Cage, rest: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"], probes: np.ndarray
) -> Skin:
    """A skin at rest in a cage; vertices may stick out of it."""
    embedding, tets = cage.embed(rest)
    return Skin(
        rest, np.ascontiguousarray(faces), embedding, cage.gradients[tets], np.asarray(probes)
    )


def find_contacts(
    skin: Skin, cage: Cage, free: int, nodes: Float[np.ndarray, "N 3"], rule: ContactRule
) -> Contacts:
    """Where the skin is about to enter, or has entered, another part of the body.

    A probe before a vertex that lies in a tetrahedron of another part is mapped to that part's rest
    place; the closest rest skin there, carried back, is the partner, and its normal the direction
    in which both part.
    """
    vertices = skin.posed(nodes)
    normals = skin.normals(vertices)
    probes = np.ascontiguousarray(vertices[skin.probes] + rule.reach * normals[skin.probes])
    held = (skin.embedding.corners[skin.probes] >= free).all(1)
    low = nodes.min(0)
    size = (np.ceil((nodes.max(0) - low) / CELL) + 1).astype(np.int64)
    grid = (*fill_grid(nodes, cage.tets, low, CELL, size), low, CELL, size)
    where = np.empty_like(probes)
    homes = skin.rest[skin.probes]
    held_tets = (cage.tets >= free).all(1)
    hit = foreign(
        nodes,
        cage.nodes,
        cage.tets,
        cage.centres,
        grid,
        probes,
        homes,
        held,
        held_tets,
        rule.far,
        where,
    )
    return _partners(skin, nodes, skin.probes[hit], where[hit], vertices, normals, rule)


def _partners(
    skin: Skin,
    nodes: np.ndarray,
    mine: np.ndarray,
    where: np.ndarray,
    vertices: np.ndarray,
    normals: np.ndarray,
    rule: ContactRule,
) -> Contacts:
    nearest, faced = _facing(skin, mine, where, normals)
    mine = mine[faced]
    where = where[faced]
    place = np.empty_like(where)
    closest_around(where, nearest, skin.rest, skin.faces, *skin.around, place)
    foot = _in_tets_of(skin, nearest, place)
    normal = normals[nearest]
    offsets = vertices[mine] - foot(nodes)
    along = (offsets * normal).sum(1)
    aside = np.linalg.norm(offsets - along[:, None] * normal, axis=1)
    other = np.linalg.norm(place - skin.rest[mine], axis=1) >= rule.near
    keep = other & (along < rule.wide) & (along > -rule.deep) & (aside < rule.aside)
    own = skin.embedding.of(mine[keep])
    foot = foot.of(keep)
    return Contacts(
        np.concatenate([own.corners, foot.corners], 1),
        np.concatenate([own.weights, -foot.weights], 1),
        normal[keep],
        rule.stiffness,
        rule.gap,
        np.zeros(keep.sum(), bool),
    )


def _facing(
    skin: Skin, mine: np.ndarray, where: np.ndarray, normals: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """For those (True) that have one, the nearest skin vertex at rest that now faces a vertex.

    The nearest of all may lie on the far side of a thin limb: a deep vertex would leave through it.
    """
    if len(mine) == 0:
        return np.zeros(0, np.int64), np.zeros(0, bool)
    around = skin.probes[
        skin.tree.query(where, k=min(NEIGHBOURS, len(skin.probes)))[1].reshape(len(mine), -1)
    ]
    facing = np.einsum("pc,pkc->pk", normals[mine], normals[around]) < OPPOSED
    faced = facing.any(1)
    return around[np.arange(len(mine)), facing.argmax(1)][faced], faced


def _in_tets_of(skin: Skin, vertices: np.ndarray, points: np.ndarray) -> Embedding:
    """Rest points in the tetrahedra that hold these vertices."""
    corners = skin.embedding.corners[vertices]
    weights = skin.embedding.weights[vertices]
    return Embedding(
        corners,
        weights + np.einsum("pac,pc->pa", skin.hats[vertices], points - skin.rest[vertices]),
    )
