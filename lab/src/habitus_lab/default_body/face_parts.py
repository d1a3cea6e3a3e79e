"""Teeth, tongue and lashes: MakeHuman's helper meshes, bound to the body's vertices.

Each vertex of a part is an affine combination of body vertices near it (weights of either sign that
sum to one), learned on random bodies, as joints are. So parts follow shapes, ages and faces at
rest; skinning carries them from there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse

from .regressor import weigh
from .rig import joint_weights
from .sliders import MorphSpace
from .sources import Source

# part -> helper groups; left ones first, as their mirror images follow
PARTS = {
    "upper_teeth": ("helper-upper-teeth",),
    "lower_teeth": ("helper-lower-teeth",),
    "tongue": ("helper-tongue",),
    "lashes": (
        "helper-l-eyelashes-1",
        "helper-l-eyelashes-2",
        "helper-r-eyelashes-1",
        "helper-r-eyelashes-2",
    ),
}
ANCHORS = 16  # body vertices that hold a vertex of a part
NEAR = 120  # out of so many nearest ones of each side
INFLUENCES = 4


@dataclass(frozen=True)
class Parts:
    """P vertices, numbered on from the body's V."""

    base: np.ndarray  # (P,) base vertices
    part: np.ndarray  # (P,) index in PARTS
    quads: np.ndarray  # (Q, 4) over V .. V+P-1
    uv: np.ndarray  # (T, 2)
    quad_uv: np.ndarray  # (Q, 4)
    mirror: np.ndarray  # (P,) over V .. V+P-1
    binding: sparse.csr_matrix  # (P, V) rows sum to one
    weights: np.ndarray  # (P, 55)


def face_parts(
    source: Source,
    morphs: MorphSpace,
    base: np.ndarray,
    mirror: np.ndarray,
    skin: np.ndarray,
    bodies: np.ndarray,
) -> Parts:
    """Parts of a mesh with base vertices (V,) and partners (V,).

    `skin` are the vertices that may hold them, `bodies` (N, W, 3) random ones over the base mesh.
    """
    groups = [(k, g) for k, names in enumerate(PARTS.values()) for g in names]
    corners = {name: source.helper_corners[name] for _, name in groups}
    used = [np.unique(corners[name][:, :, 0]) for _, name in groups]
    parts = np.concatenate(used)
    count = len(base)
    place = np.full(len(source.vertices), -1)
    place[parts] = count + np.arange(len(parts))
    quads = np.concatenate([corners[name] for _, name in groups])
    texture, packed = np.unique(quads[:, :, 1], return_inverse=True)
    twins = place[source.mirror[parts]]
    if (twins < 0).any():
        raise ValueError("a vertex of a part has its mirror image in none")
    everything = np.concatenate([base, parts])
    pairs = np.concatenate([mirror, twins])
    weights = joint_weights(source, everything, pairs)[count:]
    return Parts(
        base=parts,
        part=np.concatenate([np.full(len(u), k) for (k, _), u in zip(groups, used, strict=True)]),
        quads=place[quads[:, :, 0]],
        uv=source.uv[texture],
        quad_uv=packed.reshape(quads.shape[:2]),
        mirror=twins,
        binding=_binding(source, base, parts, twins - count, mirror, skin, bodies),
        weights=weights,
    )


def _binding(
    source: Source,
    base: np.ndarray,
    parts: np.ndarray,
    twins: np.ndarray,
    mirror: np.ndarray,
    skin: np.ndarray,
    bodies: np.ndarray,
) -> sparse.csr_matrix:
    """(P, V): as `Parts.binding`, exactly symmetric."""
    rest = bodies.mean(0)
    table = sparse.lil_matrix((len(parts), len(base)))
    for k, vertex in enumerate(parts.tolist()):
        if twins[k] < k:
            continue
        middle = twins[k] == k
        near = _spread_out(rest[base[skin]], rest[vertex])
        anchors = skin[near]
        if middle:
            anchors = np.union1d(anchors, mirror[anchors])
        start = np.full(len(anchors), 1 / len(anchors))
        value = weigh(bodies[:, base[anchors]], bodies[:, vertex], start)
        row = np.zeros(len(base))
        row[anchors] = value
        if middle:
            row = 0.5 * (row + row[mirror])
        table[k] = row
        table[twins[k]] = row[mirror]
    return sparse.csr_matrix(table)


def _spread_out(points: np.ndarray, goal: np.ndarray) -> np.ndarray:
    """Some of the points (S,3) nearest to a goal (3,), each far from those before it."""
    near = np.argsort(((points - goal) ** 2).sum(1))[:NEAR]
    found = [int(near[0])]
    gap = np.full(len(near), np.inf)
    while len(found) < ANCHORS:
        gap = np.minimum(gap, ((points[near] - points[found[-1]]) ** 2).sum(1))
        found.append(int(near[gap.argmax()]))
    return np.unique(found)


def part_arrays(parts: Parts) -> dict[str, np.ndarray]:
    """What the body's file holds of the parts."""
    index = np.argsort(-parts.weights, 1, kind="stable")[:, :INFLUENCES]
    value = np.take_along_axis(parts.weights, index, 1)
    triplets = parts.binding.tocoo()
    return {
        "part_names": np.array(list(PARTS)),
        "part_index": parts.part.astype(np.int32),
        "part_rows": triplets.row.astype(np.int32),
        "part_cols": triplets.col.astype(np.int32),
        "part_values": triplets.data.astype(np.float32),
        "part_skinning_index": index.astype(np.int32),
        "part_skinning_value": (value / value.sum(1, keepdims=True)).astype(np.float32),
        "part_quads": parts.quads.astype(np.int32),
        "part_uv": parts.uv.astype(np.float32),
        "part_quad_uv": parts.quad_uv.astype(np.int32),
        "part_mirror": parts.mirror.astype(np.int32),
        "part_base_vertices": parts.base.astype(np.int32),
    }
