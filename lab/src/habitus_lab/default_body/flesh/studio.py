"""The cage of a mean body and what is known of it: meshing, weights of its nodes, which of them
skinning holds.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from habitus import load_body
from habitus.body.model import BodyModel
from habitus_lab.population.flesh.cage import Cage, positive_cage
from habitus_lab.population.flesh.flesh import held_last

from .bones import Bones, draw_bones
from .meshing import FINE, SKIN, MeshRule, mesh_cage

FIRM = 0.02  # m: how much a skin vertex counts against smoothness when its weights are spread
HELD = 0.9  # share of one hand, foot or head from which nodes go where skinning takes them
ENDS = ("left_wrist", "right_wrist", "left_ankle", "right_ankle", "head")


@dataclass(frozen=True, eq=False)
class Studio:
    """A mean body with its cage, whose first `free` nodes move; node weights (N, J) and bones."""

    body: BodyModel
    cage: Cage
    free: int
    weights: np.ndarray
    bones: Bones

    @cached_property
    def joints(self) -> np.ndarray:
        """(J, 3) at rest."""
        return self.body.rest_joints()

    @cached_property
    def faces(self) -> np.ndarray:
        """(F, 3) of the skin, without eyeballs."""
        return self.body.faces[(self.body.faces < SKIN).all(1)]

    @cached_property
    def hidden(self) -> np.ndarray:
        """(SKIN,) True for the linings of mouth and eye sockets."""
        mesh = self.body.mesh
        assert mesh is not None
        quads = np.asarray(mesh.quads)
        inner = np.asarray(mesh.hidden)
        only = np.setdiff1d(quads[inner], quads[~inner])
        return np.isin(np.arange(SKIN), only)

    @cached_property
    def skin_weights(self) -> np.ndarray:
        """(V, J)."""
        return dense_weights(self.body)


def dense_weights(body: BodyModel) -> np.ndarray:
    """(V, J)."""
    weights = np.zeros((body.num_vertices, len(body.joint_names)))
    np.put_along_axis(weights, body.skinning_index, body.skinning_value, 1)
    return weights


def open_studio(sex: str, folder: Path, rule: MeshRule = FINE) -> Studio:
    """The studio of a sex; its cage is meshed once, by the rule, and kept in the folder."""
    body = load_body(sex, detail="full", joints="smplx")
    path = folder / f"cage_{sex}.npz"
    if not path.exists():
        nodes, tets = mesh_cage(body, rule)
        folder.mkdir(parents=True, exist_ok=True)
        part = path.with_suffix(".part.npz")
        np.savez(part, nodes=nodes, tets=tets)
        part.replace(path)
    with np.load(path) as found:
        cage = positive_cage(found["nodes"], found["tets"])
    weights = _node_weights(body, cage)
    cage, order = held_last(cage, _held(weights, body))
    free = int((~_held(weights, body)).sum())
    return Studio(body, cage, free, weights[order], draw_bones(body))


def _node_weights(body: BodyModel, cage: Cage) -> np.ndarray:
    weights = dense_weights(body)[:SKIN]
    points, _ = cage.embed(body.v_template[:SKIN])
    spread = np.clip(cage.spread(points, weights, FIRM), 0, None)
    return spread / spread.sum(1, keepdims=True)


def below(body: BodyModel, name: str) -> list[int]:
    """The joint and all that hang from it."""
    found = [body.joint_names.index(name)]
    for k, parent in enumerate(body.parents):
        if parent in found:
            found.append(k)
    return found


def _held(weights: np.ndarray, body: BodyModel) -> np.ndarray:
    groups = [weights[:, below(body, name)].sum(1) for name in ENDS]
    return np.max(groups, axis=0) > HELD
