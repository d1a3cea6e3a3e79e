"""The part of a body that its markers need, as arrays that compiled kernels take.

Markers touch about 200 of some 7,000 vertices: `MarkerRig` keeps those corners of triangles, the
joints, and how shape and pose move both. `SimdRig` adds which unknowns move which marker, and how:
unknowns come in blocks of three; block 0 is trans, block 1 + j is joint j, and the betas follow,
padded to full blocks. A slot is a pair of a marker and a block that moves it. Where every weight of
a marker's triangle descends from a joint, the triangle turns rigidly about it; elsewhere (a few
slots near that joint) its corners move independently.
"""

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from habitus.arrays import to_numpy
from habitus.body.model import BodyModel
from habitus.body.pose_features import NO_HINGES, check_driven_by_rotations
from habitus.errors import HabitusError
from habitus.observe.markers import MarkerAttachment
from habitus.types import Array


# Beside `BodyModel`, as numba takes tuples of arrays and not classes, and as a fit reads the 200
# corners under its markers thousands of times: in arrays of their own they stay in the cache.
class MarkerRig(NamedTuple):
    """Arrays of a body of fixed shape for the U corners under M markers (metres; all float64 and
    int64, C order).

    J joints, K influences a corner, B shape directions, P = 9 (J - 1), or 0 for a body without pose
    blend shapes. Build it with `marker_rig`; treat the arrays as read-only.
    """

    parents: Int[np.ndarray, " J"]
    """Parent of each joint, -1 for the root; a parent comes before its children."""
    rest_joints: Float[np.ndarray, "J 3"]
    joint_shapedirs: Float[np.ndarray, "J 3 B"]
    rest_corners: Float[np.ndarray, "U 3"]
    corner_shapedirs: Float[np.ndarray, "U 3 B"]
    corner_posedirs: Float[np.ndarray, "U 3 P"]
    """Offsets per entry of vec(R - I), rows first, joint 1 first (S 3.2), without the stand-ins of
    hinges."""
    influences: Int[np.ndarray, "U K"]
    """Joints that move each corner; padding has weight 0."""
    weights: Float[np.ndarray, "U K"]
    triangles: Int[np.ndarray, "M 3"]
    """Corners (a, b, c) of each marker, as rows of the arrays above."""
    coefficients: Float[np.ndarray, "M 3"]
    """(c_n, c_t, c_s) of each marker in its triangle's basis."""
    corner_folds: Float[np.ndarray, "U 3 C"]
    """Offsets per weight of each of C hinge channels of this person (`habitus.body.pose_features`).
    """
    corner_fold_shapes: Float[np.ndarray, "U 3 C S"]
    """How these change with the first S betas."""
    hinge_joint: Int[np.ndarray, " C"]
    hinge_rows: Float[np.ndarray, "C 9"]
    hinge_bias: Float[np.ndarray, " C"]

    @property
    def num_joints(self) -> int:
        """J."""
        return len(self.parents)

    @property
    def num_markers(self) -> int:
        """M."""
        return len(self.triangles)

    @property
    def num_betas(self) -> int:
        """B."""
        return self.corner_shapedirs.shape[2]


def marker_rig(
    body: BodyModel, betas: Float[Array, " B"], attachment: MarkerAttachment
) -> MarkerRig:
    """The rig of a body of shape `betas` under the markers of `attachment`.

    `betas` may be shorter than the body's: only that many shape directions are kept. Raises
    HabitusError for a body that is not skinned linearly (S 3) or whose pose blend shapes are not
    linear in vec(R - I) alone, and for an attachment to vertices that it does not have.
    """
    corners, triangles = np.unique(attachment.triangles, return_inverse=True)
    _check(body, betas, corners)
    shape = to_numpy(betas, np.float64)
    directions = to_numpy(body.shapedirs, np.float64)[:, :, : len(betas)]
    joints = body.joint_template
    joint_directions = body.joint_shapedirs[:, :, : len(betas)]
    rest = to_numpy(body.v_template, np.float64)[corners]
    corner_directions = np.ascontiguousarray(directions[corners])
    influences, weights = _trim(
        to_numpy(body.skinning_index[corners], np.int64),
        to_numpy(body.skinning_value[corners], np.float64),
    )
    posedirs = body.smpl_posedirs(corners, beside_hinges=True)
    hinges = body.hinges or NO_HINGES
    folds = np.zeros((len(corners), 3, 0))
    fold_shapes = np.zeros((len(corners), 3, 0, 0))
    if body.hinges is not None:
        factors = np.zeros(1 + hinges.num_shapes)
        factors[0] = 1.0
        factors[1 : 1 + len(shape)] = shape[: hinges.num_shapes]
        folds = hinges.directions[corners] @ factors
        fold_shapes = np.ascontiguousarray(hinges.directions[corners][..., 1 : 1 + len(shape)])
    return MarkerRig(
        parents=np.asarray(body.parents, dtype=np.int64),
        rest_joints=joints + joint_directions @ shape,
        joint_shapedirs=np.ascontiguousarray(joint_directions),
        rest_corners=rest + corner_directions @ shape,
        corner_shapedirs=corner_directions,
        corner_posedirs=np.zeros((len(corners), 3, 0)) if posedirs is None else posedirs,
        influences=influences,
        weights=weights,
        triangles=np.ascontiguousarray(triangles.reshape(-1, 3), dtype=np.int64),
        coefficients=attachment.coefficients,
        corner_folds=np.ascontiguousarray(folds),
        corner_fold_shapes=fold_shapes,
        hinge_joint=hinges.joint,
        hinge_rows=hinges.rows,
        hinge_bias=hinges.bias,
    )


def kernels_cover(body: BodyModel) -> bool:
    """Whether the compiled kernels know a body of this kind: skinned linearly, pose blend shapes
    linear in vec(R - I).

    Other bodies are fitted by `habitus.observe.marker_prediction.BodyMarkers`.
    """
    usual = body.pose_features == "rotations" and not body.shape_features
    return body.skinning == "lbs" and (body.posedirs is None or usual)


def _check(body: BodyModel, betas: Array, corners: np.ndarray) -> None:
    if body.skinning != "lbs":
        raise HabitusError(
            f"marker kernels skin linearly (lbs), this body wants {body.skinning!r}; take an lbs "
            "body"
        )
    if not kernels_cover(body):
        check_driven_by_rotations(body, "marker fits")
    if len(corners) == 0:
        raise HabitusError("the attachment has no marker; give at least one")
    if corners[0] < 0 or corners[-1] >= len(body.v_template):
        raise HabitusError(
            f"markers sit on vertex {corners[-1]}, but the body has {len(body.v_template)}; "
            "attach them to this body"
        )
    if len(betas) > body.shapedirs.shape[2]:
        raise HabitusError(
            f"got {len(betas)} betas, the body has {body.shapedirs.shape[2]}; use the body of "
            "these betas"
        )
    if any(parent >= joint for joint, parent in enumerate(body.parents)) or body.parents[0] >= 0:
        raise HabitusError(
            "joints must come after their parents and the root first; reorder the body's joints"
        )


def _trim(influences: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Move each corner's non-zero weights to the front and cut the columns that none of them
    uses.
    """
    order = np.argsort(-np.abs(weights), axis=1, kind="stable")
    influences = np.take_along_axis(influences, order, 1)
    weights = np.take_along_axis(weights, order, 1)
    used = max(1, int((weights != 0).sum(axis=1).max()))
    influences = np.where(weights != 0, influences, influences[:, :1])
    return np.ascontiguousarray(influences[:, :used]), np.ascontiguousarray(weights[:, :used])


# Beside `MarkerRig`, as kernels of many frames at once run the same instructions for all lanes:
# they walk lists without zeros, where the kernels of single frames index by joint.
class SimdRig(NamedTuple):
    """A `MarkerRig` whose lists of influences and pose blend shapes hold what is not zero; Z = 3
    ceil(B / 3) betas.

    The run of corner u in a list is start[u] : start[u + 1]; that of pose blend shape d in the list
    of its joint's hinges, fold_start[d] : fold_start[d + 1].
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
    fold_start: Int[np.ndarray, " D1"]
    fold_channel: Int[np.ndarray, " E"]
    folds: Float[np.ndarray, "E 3"]
    fold_shapes: Float[np.ndarray, "E 3 S"]
    hinge_joint: Int[np.ndarray, " C"]
    hinge_rows: Float[np.ndarray, "C 9"]
    hinge_bias: Float[np.ndarray, " C"]
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
    fold: int
    """Of each hinge channel its weight, the slope of that, and its derivatives by turns."""
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
        **_posedirs(rig, betas),
        hinge_joint=rig.hinge_joint,
        hinge_rows=rig.hinge_rows,
        hinge_bias=rig.hinge_bias,
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
        parts = [none] * 3
        if not whole[j]:
            parts = [r.start + np.flatnonzero(u[j]) for r, u in zip(runs, under, strict=True)]
        slots.append((1 + int(j), bool(whole[j]), parts, list(features[:, j])))
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


def _posedirs(rig: MarkerRig, betas: int) -> dict[str, np.ndarray]:
    blocks = rig.corner_posedirs.reshape(len(rig.rest_corners), 3, -1, 9).transpose(0, 2, 1, 3)
    used = (blocks != 0).any(axis=(2, 3))
    shapes = rig.corner_fold_shapes[..., :betas]
    moved = (rig.corner_folds != 0).any(axis=1) | (shapes != 0).any(axis=(1, 3))
    corner, channel = np.nonzero(moved)
    used[corner, rig.hinge_joint[channel] - 1] = True
    number = np.cumsum(used).reshape(used.shape) - 1
    shape = number[corner, rig.hinge_joint[channel] - 1]
    order = np.argsort(shape, kind="stable")
    return {
        "posedir_start": _starts(used.sum(axis=1)),
        "posedir_joint": np.nonzero(used)[1] + 1,
        "posedirs": np.ascontiguousarray(blocks[used].reshape(-1, 3, 9)),
        "fold_start": _starts(np.bincount(shape, minlength=int(used.sum()))),
        "fold_channel": channel[order].astype(np.int64),
        "folds": np.ascontiguousarray(rig.corner_folds[corner, :, channel][order]),
        "fold_shapes": np.ascontiguousarray(shapes[corner, :, channel][order]),
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
        "fold": 5 * len(rig.hinge_joint),
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
