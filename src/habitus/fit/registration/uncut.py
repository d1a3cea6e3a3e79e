"""A free surface that cuts itself nowhere that its model does not: at lips, toes and armpits, where
skin meets skin.
"""

import numpy as np
from jaxtyping import Float, Int

from habitus.fit.registration.nearest import Topology
from habitus.mesh.intersections import intersecting_pairs

BACK = 0.7
"""How much of an offset is left, each time, where the surface cuts itself."""
RINGS = 1
"""Vertices around these go back with them, half as far."""
ROUNDS = 20


def new_cuts(
    topology: Topology, model: Float[np.ndarray, "V 3"], surface: Float[np.ndarray, "V 3"]
) -> int:
    """How many more pairs of triangles cut each other in a surface (m) than in its model."""
    faces = topology.faces[np.isin(topology.faces, topology.whole).all(1)]
    return max(0, len(intersecting_pairs(surface, faces)) - len(intersecting_pairs(model, faces)))


def uncut(
    topology: Topology, model: Float[np.ndarray, "V 3"], surface: Float[np.ndarray, "V 3"]
) -> Float[np.ndarray, "V 3"]:
    """The surface (m), drawn back towards its model around pairs of triangles that cut each other
    in it alone.
    """
    faces = topology.faces[np.isin(topology.faces, topology.whole).all(1)]
    before = _keys(intersecting_pairs(model, faces), len(faces))
    offset = surface - model
    for _ in range(ROUNDS):
        pairs = intersecting_pairs(model + offset, faces)
        new = pairs[~np.isin(_keys(pairs, len(faces)), before)]
        if len(new) == 0:
            break
        near = _around(topology.faces, np.unique(faces[new]), len(model))
        offset = offset * (1.0 - (1.0 - BACK) * near)[:, None]
    return model + offset


def _keys(pairs: Int[np.ndarray, "K 2"], count: int) -> Int[np.ndarray, " K"]:
    return pairs[:, 0] * count + pairs[:, 1]


def _around(
    faces: Int[np.ndarray, "F 3"], vertices: Int[np.ndarray, " n"], count: int
) -> Float[np.ndarray, " V"]:
    """1 at some vertices and less from ring to ring around them, 0 further off."""
    near = np.zeros(count)
    near[vertices] = 1.0
    for k in range(RINGS):
        ring = np.unique(faces[(near[faces] > 0.0).any(1)])
        near[ring] = np.maximum(near[ring], 1.0 - (k + 1.0) / (RINGS + 1.0))
    return near
