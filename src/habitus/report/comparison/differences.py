"""Distances between two motions of one capture, moment by moment: skin, joints, their rotations,
markers.

`pair` chooses the moments, `alignment` the rigid motion that puts B into A's world, `differences`
compares.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import product
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from habitus.body.model import BodyModel
from habitus.body.motion import Moving
from habitus.errors import HabitusError
from habitus.fit.markers.result import MarkerFit
from habitus.rotations import up_rotation

M = TypeVar("M", bound=Moving)
ALIGN = ("auto", "none", "rigid")
SAME_MARKERS_MM = 2.0
"""Observed markers of one name with a larger median distance are not of the same moments."""
SAME_WORLD = 0.10
"""Metres: joints with a smaller mean distance lie in one world."""
MAX_ALIGNED_SHARE = 0.5
"""Of the joints' distance, at most this may remain after an automatic alignment."""
BATCH = 32
"""Moments whose surfaces are held in memory at once."""
FRAME_TOLERANCE = 1e-3
"""Frames: a moment closer than this to a frame is that frame."""
MIN_JOINTS = 3
"""Shared joints without which two bodies cannot be compared."""


@dataclass(frozen=True, eq=False)
class Pairing:
    """T moments: ``times`` (s, A's clock) and their positions, in frames, in A and in B.

    ``rate_hz``: moments per second; ``notes``: what was left out or interpolated.
    """

    times: Float[np.ndarray, " T"]
    frames: tuple[Float[np.ndarray, " T"], Float[np.ndarray, " T"]]
    rate_hz: float
    notes: tuple[str, ...]

    @property
    def nearest(self) -> tuple[np.ndarray, np.ndarray]:
        """The closest whole frames of both."""
        return tuple(np.round(frames).astype(np.int64) for frames in self.frames)  # type: ignore[return-value]


@dataclass(frozen=True)
class Alignment:
    """The rigid motion x' = rotation x + translation (m); ``reason`` is a sentence, empty where
    the worlds are one.
    """

    rotation: Float[np.ndarray, "3 3"]
    translation: Float[np.ndarray, " 3"]
    reason: str = ""

    @property
    def degrees(self) -> float:
        """The angle of the rotation."""
        return float(np.degrees(Rotation.from_matrix(self.rotation).magnitude()))

    def apply(self, points: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
        """Points of B's world in A's."""
        return points @ self.rotation.T + self.translation


@dataclass(frozen=True, eq=False)
class MarkerDistances:
    """M markers that both fits have, mm: distances between the predictions of A and B, each fit's
    own errors, and distances between the observations; NaN where a marker is not visible.
    """

    labels: tuple[str, ...]
    predicted: Float[np.ndarray, "T M"]
    errors: tuple[Float[np.ndarray, "T M"], Float[np.ndarray, "T M"]]
    observed: Float[np.ndarray, "T M"]


@dataclass(frozen=True, eq=False)
class Differences:
    """Distances (mm) and angles (degrees) between A and B at the T moments of ``pairing``.

    ``b`` is B in A's world (``alignment``). ``joints`` (T, J): between joints of one name;
    ``root_aligned``: the same with the first of them moved onto its counterpart. ``rotations`` (T,
    J): between the joints' relative rotations; None where the two skeletons differ. ``skin`` (T,
    3): mean, 95th percentile and largest distance between vertices; None where the bodies have
    different meshes; ``worst_vertex`` (T,) has the largest. ``at_rest`` (V,): between the shapes.
    """

    a: Moving
    b: Moving
    pairing: Pairing
    alignment: Alignment
    joint_names: tuple[str, ...]
    joints: Float[np.ndarray, "T J"]
    root_aligned: Float[np.ndarray, "T J"]
    rotations: Float[np.ndarray, "T J"] | None
    levels: tuple[BodyModel, BodyModel] | None
    skin: Float[np.ndarray, "T 3"] | None
    worst_vertex: Int[np.ndarray, " T"] | None
    at_rest: Float[np.ndarray, " V"] | None
    markers: MarkerDistances | None

    @property
    def distance(self) -> Float[np.ndarray, " T"]:
        """Mean distance of the bodies, mm: over the skin, or over the joints where the meshes
        differ.
        """
        return self.joints.mean(axis=1) if self.skin is None else self.skin[:, 0]

    @property
    def same_moments(self) -> bool:
        """Whether observed markers of one name, where both have any, coincide (SAME_MARKERS_MM)."""
        return self.observed_distance is None or self.observed_distance <= SAME_MARKERS_MM

    @property
    def observed_distance(self) -> float | None:
        """Median distance (mm) between observed markers of one name; None where none is visible in
        both.
        """
        if self.markers is None:
            return None
        known = self.markers.observed[np.isfinite(self.markers.observed)]
        return float(np.median(known)) if known.size else None


def differences(a: Moving, b: Moving, *, offset: float = 0.0, align: str = "auto") -> Differences:
    """Compare two bodies in motion; B begins ``offset`` seconds after A.

    align: how B is put into A's world (`alignment`). Raises HabitusError where the two share no
    moment or fewer than MIN_JOINTS joints.
    """
    if align not in ALIGN:
        raise HabitusError(f"align is {align!r}; expected one of {', '.join(ALIGN)}")
    names, *numbers = shared_joints(a, b)
    if len(names) < MIN_JOINTS:
        raise HabitusError(
            f"{a.body.name} and {b.body.name} share {len(names)} joints; expected two bodies of "
            "people"
        )
    pairing = pair(a, b, offset)
    levels = shared_levels(a, b)
    ours, theirs = (
        _joints(m, f)[:, k] for m, f, k in zip((a, b), pairing.frames, numbers, strict=True)
    )
    joints = ours, theirs
    motion = alignment(a, b, joints, align)
    b = transformed(b, motion, a.up_axis)
    offsets = motion.apply(joints[1]) - joints[0]
    skin, vertex = (None, None) if levels is None else _skin(a, b, pairing, levels)
    return Differences(
        a=a,
        b=b,
        pairing=pairing,
        alignment=motion,
        joint_names=names,
        joints=_mm(offsets),
        root_aligned=_mm(offsets - offsets[:, :1]),
        rotations=_rotations(a, b, pairing, numbers),
        levels=levels,
        skin=skin,
        worst_vertex=vertex,
        at_rest=None if levels is None else _at_rest(a, b, levels),
        markers=_markers(a, b, pairing),
    )


def _joints(moving: Moving, frames: np.ndarray) -> Float[np.ndarray, "T J 3"]:
    return np.concatenate([joints for _, joints in surfaces_at(moving, frames, None, skin=False)])


def _mm(offsets: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch"]:
    return 1e3 * np.linalg.norm(offsets, axis=-1)


def _skin(
    a: Moving, b: Moving, pairing: Pairing, levels: tuple[BodyModel, BodyModel]
) -> tuple[np.ndarray, np.ndarray]:
    numbers = []
    furthest = []
    parts = (
        surfaces_at(m, f, level, True)
        for m, f, level in zip((a, b), pairing.frames, levels, strict=True)
    )
    for (ours, _), (theirs, _) in zip(*parts, strict=True):
        distance = _mm(theirs - ours)
        high = np.percentile(distance, 95, axis=1)
        numbers.append(np.stack([distance.mean(1), high, distance.max(1)], 1))
        furthest.append(distance.argmax(1))
    return np.concatenate(numbers), np.concatenate(furthest)


def _at_rest(a: Moving, b: Moving, levels: tuple[BodyModel, BodyModel]) -> Float[np.ndarray, " V"]:
    """Distances of the shapes at rest, with the pelvises at one place."""
    first, second = (
        level.rest_vertices(m.betas) - level.rest_joints(m.betas)[0]
        for m, level in zip((a, b), levels, strict=True)
    )
    return _mm(second - first)


def _rotations(
    a: Moving, b: Moving, pairing: Pairing, numbers: list[np.ndarray]
) -> Float[np.ndarray, "T J"] | None:
    """Angles (degrees) between the joints' rotations relative to their parents; None unless every
    shared joint has the same parent in both.
    """
    parents = [
        [_parent(m.body, joint) for joint in joints]
        for m, joints in zip((a, b), numbers, strict=True)
    ]
    if parents[0] != parents[1]:
        return None
    ours, theirs = (
        m.pose[f][:, k] for m, f, k in zip((a, b), pairing.nearest, numbers, strict=True)
    )
    shape = ours.shape[:2]
    turns = [
        Rotation.from_rotvec(np.asarray(pose, np.float64).reshape(-1, 3)) for pose in (ours, theirs)
    ]
    return np.degrees((turns[0].inv() * turns[1]).magnitude()).reshape(shape)


def _parent(body: BodyModel, joint: int) -> str:
    return "" if body.parents[joint] < 0 else body.joint_names[body.parents[joint]]


def _markers(a: Moving, b: Moving, pairing: Pairing) -> MarkerDistances | None:
    if not isinstance(a, MarkerFit) or not isinstance(b, MarkerFit):
        return None
    labels = tuple(label for label in a.labels if label in b.labels)
    if not labels:
        return None
    columns = [[fit.labels.index(label) for label in labels] for fit in (a, b)]
    both = list(zip((a, b), columns, pairing.frames, strict=True))
    predicted = [points_at(_predicted(fit)[:, k], f) for fit, k, f in both]
    observed = [points_at(np.asarray(fit.observed_markers)[:, k], f) for fit, k, f in both]
    observations, predictions = (_mm(pair[1] - pair[0]) for pair in (observed, predicted))
    errors = [
        np.asarray(fit.errors_mm)[rows][:, k]
        for (fit, k, _), rows in zip(both, pairing.nearest, strict=True)
    ]
    return MarkerDistances(labels, predictions, (errors[0], errors[1]), observations)


def _predicted(fit: MarkerFit) -> Any:
    return np.asarray(
        fit.predicted_pose_stage if fit.predicted_soft_tissue is None else fit.predicted_soft_tissue
    )


def notes(result: Differences) -> tuple[str, ...]:
    """What a reader of the distances must know, a sentence each."""
    sentences = [*result.pairing.notes, *filter(None, [result.alignment.reason])]
    if not result.alignment.reason and result.alignment.degrees > 1e-3:
        sentences.append(f"B has another up axis: it was turned so that {result.a.up_axis} is up.")
    if result.levels is None:
        sentences.append(
            f"The bodies have different meshes ({result.a.body_name}, {result.b.body_name}): only "
            "joints and markers of one name are compared. Joints of one name have different "
            "definitions in different bodies, which differ by a centimetre or more."
        )
    if not result.same_moments:
        sentences.insert(
            0,
            f"The median distance between observed markers of one name is "
            f"{result.observed_distance:.0f} mm: these are not the same moments of one capture, "
            "and the distances do not compare the fits. Check the offset in time.",
        )
    return tuple(sentences)


def pair(a: Moving, b: Moving, offset: float = 0.0) -> Pairing:
    """The moments that both have, at the frames of the one with the lower rate; B begins ``offset``
    seconds after A. Raises HabitusError where they have none in common.
    """
    if not np.isfinite(offset):
        raise HabitusError(f"the offset is {offset}; expected seconds from A's first frame to B's")
    slow, fast, swapped = (a, b, False) if a.rate_hz <= b.rate_hz else (b, a, True)
    shift = -offset if swapped else offset
    slow_frames = np.arange(slow.num_frames)
    fast_frames = _whole((slow_frames / slow.rate_hz - shift) * fast.rate_hz)
    both = (fast_frames >= 0) & (fast_frames <= fast.num_frames - 1)
    if not both.any():
        ends = " and ".join(f"{m.num_frames / m.rate_hz:.2f} s" for m in (a, b))
        raise HabitusError(
            f"A and B have no moment in common ({ends} long, B {offset:g} s after A); give "
            "another offset"
        )
    slow_frames = slow_frames[both].astype(float)
    fast_frames = fast_frames[both]
    frames = (fast_frames, slow_frames) if swapped else (slow_frames, fast_frames)
    ranges = _ranges(a, b, len(slow_frames), slow.rate_hz, offset)
    notes = [*_rates(a, b, fast_frames), *ranges]
    return Pairing(frames[0] / a.rate_hz, frames, slow.rate_hz, tuple(notes))


def _whole(frames: np.ndarray) -> np.ndarray:
    whole = np.round(frames)
    return np.where(np.abs(frames - whole) < FRAME_TOLERANCE, whole, frames)


def _rates(a: Moving, b: Moving, fast_frames: np.ndarray) -> Iterator[str]:
    interpolated = bool((fast_frames % 1).any())
    if abs(a.rate_hz - b.rate_hz) > 1e-6 * a.rate_hz:
        between = " The other is interpolated between its frames." if interpolated else ""
        rates = f"A has {a.rate_hz:g} frames per second, B {b.rate_hz:g}"
        yield f"{rates}: compared at the frames of the lower rate.{between}"
    elif interpolated:
        yield "The offset is not a whole number of frames: one motion is interpolated."


def _ranges(a: Moving, b: Moving, count: int, rate_hz: float, offset: float) -> Iterator[str]:
    seconds = [m.num_frames / m.rate_hz for m in (a, b)]
    if max(seconds) - count / rate_hz > 1.5 / rate_hz:
        lengths = f"A is {seconds[0]:.2f} s long, B {seconds[1]:.2f} s"
        start = f"B begins {offset:g} s after A" if offset else "both begin with their first frame"
        yield f"{lengths}, {start}: {count / rate_hz:.2f} s are compared."


def shared_levels(a: Moving, b: Moving) -> tuple[BodyModel, BodyModel] | None:
    """The coarsest levels of detail of both bodies that have the same mesh; None where none do."""
    levels = ([level for level in (m.body, m.body.full) if level is not None] for m in (a, b))
    for ours, theirs in product(*levels):
        if ours.num_vertices == theirs.num_vertices and np.array_equal(ours.faces, theirs.faces):
            return ours, theirs
    return None


def shared_joints(a: Moving, b: Moving) -> tuple[tuple[str, ...], np.ndarray, np.ndarray]:
    """Names of the joints that both have, in A's order, and their indices in A and in B."""
    names = tuple(name for name in a.body.joint_names if name in b.body.joint_names)
    ours, theirs = (
        np.array([m.body.joint_names.index(name) for name in names], np.int64) for m in (a, b)
    )
    return names, ours, theirs


def surfaces_at(
    moving: Moving, frames: Float[np.ndarray, " T"], body: BodyModel | None, skin: bool
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Vertices (t, V, 3) and joints (t, J, 3) at some moments, linear between two frames, BATCH
    moments at a time; without ``skin`` one vertex only.
    """
    some = None if skin else [0]
    for start in range(0, len(frames), BATCH):
        part = frames[start : start + BATCH]
        low = np.floor(part).astype(np.int64)
        share = (part - low)[:, None, None]
        before = next(moving.surfaces(low, some, body))
        vertices = np.asarray(before.vertices)
        joints = np.asarray(before.joints)
        if share.any():
            after = next(moving.surfaces(np.minimum(low + 1, moving.num_frames - 1), some, body))
            vertices = (1 - share) * vertices + share * np.asarray(after.vertices)
            joints = (1 - share) * joints + share * np.asarray(after.joints)
        yield vertices, joints


def points_at(
    points: Float[np.ndarray, "T M 3"], frames: Float[np.ndarray, " T"]
) -> Float[np.ndarray, "T M 3"]:
    """Points at some moments, linear between two frames."""
    low = np.floor(frames).astype(np.int64)
    share = (frames - low)[:, None, None]
    return (1 - share) * points[low] + share * points[np.minimum(low + 1, len(points) - 1)]


def same_up(a: Moving, b: Moving) -> Alignment:
    """The rotation that turns b's up axis into a's."""
    return Alignment(up_rotation(a.up_axis).T @ up_rotation(b.up_axis), np.zeros(3))


def rigid(targets: Float[np.ndarray, "N 3"], points: Float[np.ndarray, "N 3"]) -> Alignment:
    """The rigid motion that brings points closest to the targets (Kabsch 1976)."""
    middles = targets.mean(0), points.mean(0)
    left, _, right = np.linalg.svd((targets - middles[0]).T @ (points - middles[1]))
    turn = left @ np.diag([1.0, 1.0, np.sign(np.linalg.det(left @ right))]) @ right
    return Alignment(turn, middles[0] - turn @ middles[1])


def alignment(a: Moving, b: Moving, joints: tuple[np.ndarray, np.ndarray], align: str) -> Alignment:
    """The motion that puts b into a's world; ``joints`` are the shared ones of both, (T, J, 3)
    each, in their own worlds.

    align: "none" only turns b's up axis into a's; "rigid" minimises the distances of all joints in
    all frames; "auto" does that where the worlds are clearly different: joints SAME_WORLD or more
    apart on average, and at most MAX_ALIGNED_SHARE of that afterwards.
    """
    upright = same_up(a, b)
    if align == "none":
        return upright
    targets, points = (part.reshape(-1, 3) for part in joints)
    best = rigid(targets, points)
    before, after = (
        float(np.linalg.norm(motion.apply(points) - targets, axis=1).mean())
        for motion in (upright, best)
    )
    if align == "auto" and not (before > SAME_WORLD and after < MAX_ALIGNED_SHARE * before):
        return upright
    turn = replace(best, rotation=best.rotation @ upright.rotation.T).degrees
    lead = "B has another world frame" if align == "auto" else "B was aligned with A"
    reason = (
        f"{lead}: a rotation by {turn:.1f} degrees and a translation reduce the mean distance of "
        f"the joints from {100 * before:.0f} cm to {1e3 * after:.0f} mm."
    )
    return replace(best, reason=reason)


def transformed(moving: M, motion: Alignment, up_axis: str) -> M:
    """The same motion, and its markers where it has any, after the rigid ``motion``."""
    pose, trans = _transformed(moving, moving.pose, moving.trans, motion, last=True)
    changes: dict[str, Any] = {"pose": pose, "trans": trans, "up_axis": up_axis}
    if hasattr(moving, "observed_markers"):
        changes["pose_stage"] = _transformed(moving, *moving.pose_stage, motion, last=False)
        for name in ("observed_markers", "predicted_pose_stage", "predicted_soft_tissue"):
            points = getattr(moving, name)
            changes[name] = None if points is None else motion.apply(np.asarray(points))
    return replace(moving, **changes)  # type: ignore[type-var]


def _transformed(
    moving: Moving, pose: np.ndarray, trans: np.ndarray, motion: Alignment, last: bool
) -> tuple[Any, Any]:
    """Pose and translation after a rigid motion, which turns the body about the world's origin, not
    about its root; ``last``: of the last stage, whose root soft tissue moves.
    """
    turned = np.array(pose, np.float64)
    turned[:, 0] = (
        Rotation.from_matrix(motion.rotation) * Rotation.from_rotvec(turned[:, 0])
    ).as_rotvec()
    body = moving.body
    root = body.joint_template[0] + body.joint_shapedirs[0] @ moving.betas
    if last and moving.soft_tissue is not None:
        root = root + np.asarray(moving.soft_tissue) @ body.joint_shapedirs[0].T
    return turned, motion.apply(root + trans) - root
