"""What the SIMD kernels need to know of a rig beforehand: which unknowns move which marker, and
how.

Unknowns come in blocks of three: block 0 is trans, block 1 + j is joint j, and the betas follow,
padded to full blocks. A slot is a pair of a marker and a block that moves it. Where every weight of
a marker's triangle descends from a joint, the triangle turns rigidly about it; elsewhere (a few
slots near that joint) its corners move apart.
"""

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from habitus.observe.marker_rig import MarkerRig


class SimdRig(NamedTuple):
    """A `MarkerRig` whose lists of influences and pose blend shapes hold what is not zero; Z = 3
    ceil(B / 3) betas.

    The run of corner u in a list is start[u] : start[u + 1].
    """

    parents: Int[np.ndarray, " J"]
    rest_joints: Float[np.ndarray, "J 3"]
    joint_shapedirs: Float[np.ndarray, "J 3 Z"]
    rest_corners: Float[np.ndarray, "U 3"]
    corner_shapedirs: Float[np.ndarray, "U 3 Z"]
    influence_start: Int[np.ndarray, " U1"]
    influence_joint: Int[np.ndarray, " I"]
    influence_weight: Float[np.ndarray, " I"]
    posedir_start: Int[np.ndarray, " U1"]
    posedir_joint: Int[np.ndarray, " D"]
    posedirs: Float[np.ndarray, "D 3 9"]
    triangles: Int[np.ndarray, "M 3"]
    coefficients: Float[np.ndarray, "M 3"]


class Slots(NamedTuple):
    """S slots; those of marker i are start[i] : start[i + 1]. Q pairs of slots of the same marker,
    by block of the matrix.

    part_influence lists, for corner c of slot s, the influences that descend from its joint, from
    part_start[3 s + c] on, and part_weight sums them; rigid slots and betas have none. posedir
    holds the pose blend shape of the slot's joint at each corner (an index into `SimdRig.posedirs`,
    -1 for none), bent whether there is any. The pairs of the matrix' block (r, c), 1 <= c <= r, are
    pair_start[k] : pair_start[k + 1], the k's counting such blocks row by row.
    """

    start: Int[np.ndarray, " M1"]
    block: Int[np.ndarray, " S"]
    rigid: Int[np.ndarray, " S"]
    bent: Int[np.ndarray, " S"]
    posedir: Int[np.ndarray, " 3S"]
    part_start: Int[np.ndarray, " 3S1"]
    part_influence: Int[np.ndarray, " P"]
    part_weight: Float[np.ndarray, " 3S"]
    pair_start: Int[np.ndarray, " C1"]
    pair_left: Int[np.ndarray, " Q"]
    pair_right: Int[np.ndarray, " Q"]


class Offsets(NamedTuple):
    """Where things lie in the workspace (end, LANES) of one group of frames: the first row of
    each.
    """

    state: int
    trial: int
    gradient: int
    step: int
    pull: int
    stiffness: int
    local: int
    left: int
    world: int
    axes: int
    place: int
    offset: int
    rest_joint: int
    rest: int
    carried: int
    corner: int
    joint_by_shape: int
    corner_by_shape: int
    blend: int
    observed: int
    weight: int
    marker: int
    columns: int
    matrix: int
    end: int
    blocks: int
    """How many blocks of unknowns there are."""


def simd_rig(rig: MarkerRig, betas: int) -> SimdRig:
    """The rig with its first `betas` shape directions as soft tissue (0 for none)."""
    used = rig.weights != 0
    pad = ((0, 0), (0, 0), (0, -betas % 3))
    return SimdRig(
        parents=rig.parents,
        rest_joints=rig.rest_joints,
        joint_shapedirs=np.ascontiguousarray(np.pad(rig.joint_shapedirs[:, :, :betas], pad)),
        rest_corners=rig.rest_corners,
        corner_shapedirs=np.ascontiguousarray(np.pad(rig.corner_shapedirs[:, :, :betas], pad)),
        influence_start=_starts(used.sum(axis=1)),
        influence_joint=rig.influences[used],
        influence_weight=rig.weights[used],
        **_posedirs(rig),
        triangles=rig.triangles,
        coefficients=rig.coefficients,
    )


def block_count(rig: SimdRig) -> int:
    """Blocks of unknowns."""
    return 1 + len(rig.parents) + rig.corner_shapedirs.shape[2] // 3


def pack_states(
    rig: SimdRig,
    trans: Float[np.ndarray, "T 3"],
    pose: Float[np.ndarray, "T J 3"],
    soft_tissue: Float[np.ndarray, "T B"] | None,
) -> Float[np.ndarray, "T N"]:
    """Trans, pose and betas side by side, zeros up to full blocks."""
    states = np.zeros((len(trans), 3 * block_count(rig)))
    end = 3 + 3 * len(rig.parents)
    states[:, :3], states[:, 3:end] = trans, np.reshape(pose, (len(trans), end - 3))
    if soft_tissue is not None:
        states[:, end : end + np.shape(soft_tissue)[1]] = soft_tissue
    return states


def marker_slots(rig: SimdRig) -> Slots:
    """Find the slots of every marker and pair them."""
    below = descends(rig.parents)
    blocks = block_count(rig)
    per_marker = [_slots_of(rig, below, corners, blocks) for corners in rig.triangles]
    flat = [slot for slots in per_marker for slot in slots]
    start = _starts([len(slots) for slots in per_marker])
    block, rigid = np.array([(slot[0], slot[1]) for slot in flat], dtype=np.int64).T
    parts = [part for slot in flat for part in slot[2]]
    posedir = np.array([slot[3] for slot in flat], dtype=np.int64)
    influences = np.concatenate(parts)
    weights = [rig.influence_weight[part].sum() for part in parts]
    return Slots(
        start=start,
        block=np.ascontiguousarray(block),
        rigid=np.ascontiguousarray(rigid),
        bent=np.asarray(np.any(posedir >= 0, axis=1), dtype=np.int64),
        posedir=posedir.reshape(-1),
        part_start=_starts([len(part) for part in parts]),
        part_influence=influences,
        part_weight=np.array(weights),
        **_pairs(start, block, blocks),
    )


def descends(parents: Int[np.ndarray, " J"]) -> np.ndarray:
    """(J, J) bool: joint k descends from joint j, or is it."""
    below = np.eye(len(parents), dtype=bool)
    for k, parent in enumerate(parents):
        if parent >= 0:
            below[:, k] |= below[:, parent]
    return below


def _slots_of(
    rig: SimdRig, below: np.ndarray, corners: np.ndarray, blocks: int
) -> list[tuple[int, bool, list, list]]:
    """Slots of one marker: block, rigid or not, influences below the joint and pose blend shape at
    each corner.
    """
    runs = [slice(rig.influence_start[u], rig.influence_start[u + 1]) for u in corners]
    under = [below[:, rig.influence_joint[run]] for run in runs]
    whole = np.all([each.all(axis=1) for each in under], axis=0)
    features = np.full((3, len(below)), -1)
    for feature, u in zip(features, corners, strict=True):
        run = np.arange(int(rig.posedir_start[u]), int(rig.posedir_start[u + 1]))
        feature[rig.posedir_joint[run]] = run
    moving = np.any([each.any(axis=1) for each in under], axis=0) | (features >= 0).any(axis=0)
    none = np.zeros(0, dtype=np.int64)
    slots: list[tuple[int, bool, list, list]] = []
    for j in np.flatnonzero(moving):
        parts = [run.start + np.flatnonzero(each[j]) for run, each in zip(runs, under, strict=True)]
        slots.append(
            (1 + int(j), bool(whole[j]), [none] * 3 if whole[j] else parts, list(features[:, j]))
        )
    return slots + [
        (block, False, [none] * 3, [-1] * 3) for block in range(1 + len(rig.parents), blocks)
    ]


def _pairs(start: np.ndarray, block: np.ndarray, blocks: int) -> dict[str, np.ndarray]:
    pairs = [
        (a, b)
        for begin, end in pairwise(start)
        for a in range(begin, end)
        for b in range(begin, a + 1)
    ]
    left, right = np.array(pairs, dtype=np.int64).T
    r = block[left] - 1
    c = block[right] - 1
    place = r * (r + 1) // 2 + c
    order = np.argsort(place, kind="stable")
    counts = np.bincount(place, minlength=blocks * (blocks - 1) // 2)
    return {"pair_start": _starts(counts), "pair_left": left[order], "pair_right": right[order]}


def _posedirs(rig: MarkerRig) -> dict[str, np.ndarray]:
    blocks = rig.corner_posedirs.reshape(len(rig.rest_corners), 3, -1, 9).transpose(0, 2, 1, 3)
    used = (blocks != 0).any(axis=(2, 3))
    return {
        "posedir_start": _starts(used.sum(axis=1)),
        "posedir_joint": np.nonzero(used)[1] + 1,
        "posedirs": np.ascontiguousarray(blocks[used].reshape(-1, 3, 9)),
    }


def _starts(counts) -> np.ndarray:
    return np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)


def workspace_offsets(rig: SimdRig, slots: Slots | None = None) -> Offsets:
    """Lay out a workspace; without slots there is none for columns and matrix."""
    joints = len(rig.parents)
    corners = len(rig.rest_corners)
    markers = len(rig.triangles)
    blocks = block_count(rig)
    betas = rig.corner_shapedirs.shape[2]
    slot_count = 0 if slots is None else len(slots.block)
    sizes = {
        **dict.fromkeys(("state", "trial", "gradient", "step", "pull", "stiffness"), 3 * blocks),
        **dict.fromkeys(("local", "left", "world", "axes"), 9 * joints),
        **dict.fromkeys(("place", "offset", "rest_joint"), 3 * joints),
        "rest": 3 * corners,
        "carried": 3 * len(rig.influence_joint),
        "corner": 3 * corners,
        "joint_by_shape": 3 * joints * betas,
        "corner_by_shape": 3 * corners * betas,
        "blend": 9 * corners,
        "observed": 3 * markers,
        "weight": markers,
        "marker": 3 * markers,
        "columns": 9 * slot_count,
        "matrix": 0 if slots is None else 9 * (blocks * (blocks + 1) // 2),
    }
    assert tuple(sizes) == Offsets._fields[:-2]
    first = np.concatenate([[0], np.cumsum(list(sizes.values()))])
    return Offsets(
        **{name: int(row) for name, row in zip(Offsets._fields, first, strict=False)}, blocks=blocks
    )
