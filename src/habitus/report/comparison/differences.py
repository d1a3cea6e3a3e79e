"""How far two motions of one capture are apart, moment by moment: skin, joints, their rotations,
markers.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from habitus.body.model import BodyModel
from habitus.body.motion import Moving
from habitus.errors import HabitusError
from habitus.fit.markers.result import MarkerFit
from habitus.report.comparison.pairing import (
    Pairing,
    pair,
    points_at,
    shared_joints,
    shared_levels,
    surfaces_at,
)
from habitus.report.comparison.placed import Placing, moved, placing

ALIGN = ("auto", "none", "rigid")
OTHER_CAPTURE = 2.0
"""Millimetres: observed markers of one name that lie further apart (median) are not of the same
moments.
"""


@dataclass(frozen=True, eq=False)
class MarkersApart:
    """M markers that both fits have: how far B predicts each from where A does, and each fit's own
    errors, (T, M) mm.

    NaN where a marker is not seen.
    """

    labels: tuple[str, ...]
    apart: Float[np.ndarray, "T M"]
    errors: tuple[Float[np.ndarray, "T M"], Float[np.ndarray, "T M"]]
    observed: Float[np.ndarray, "T M"]


@dataclass(frozen=True, eq=False)
class Differences:
    """Distances (mm) and angles (degrees) between A and B at the T moments of ``pairing``.

    ``b`` is B in A's world (``place``). ``joints`` (T, J): between joints of one name; ``centred``:
    the same after the first of them lies on its counterpart. ``turned`` (T, J): between the joints'
    own rotations; None where the two skeletons differ. ``skin`` (T, 3): mean, 95th percentile and
    largest distance between vertices; None where the bodies have different meshes; ``vertex`` (T,)
    is the vertex that is furthest. ``at_rest`` (V,): between the shapes.
    """

    a: Moving
    b: Moving
    pairing: Pairing
    place: Placing
    joint_names: tuple[str, ...]
    joints: Float[np.ndarray, "T J"]
    centred: Float[np.ndarray, "T J"]
    turned: Float[np.ndarray, "T J"] | None
    levels: tuple[BodyModel, BodyModel] | None
    skin: Float[np.ndarray, "T 3"] | None
    vertex: np.ndarray | None
    at_rest: Float[np.ndarray, " V"] | None
    markers: MarkersApart | None

    @property
    def apart(self) -> Float[np.ndarray, " T"]:
        """How far the bodies are apart: mean over the skin, over the joints where the meshes
        differ, mm.
        """
        return self.joints.mean(axis=1) if self.skin is None else self.skin[:, 0]

    @property
    def same_moments(self) -> bool:
        """Whether observed markers of one name, where both have such, lie at the same places
        (OTHER_CAPTURE).
        """
        return self.observed_apart is None or self.observed_apart <= OTHER_CAPTURE

    @property
    def observed_apart(self) -> float | None:
        """How far observed markers of one name are apart, mm (median); None where none is seen by
        both.
        """
        seen = (
            None
            if self.markers is None
            else self.markers.observed[np.isfinite(self.markers.observed)]
        )
        return None if seen is None or not seen.size else float(np.median(seen))


def differences(a: Moving, b: Moving, *, offset: float = 0.0, align: str = "auto") -> Differences:
    """Compare two bodies in motion; B begins ``offset`` seconds after A.

    align: what is done where the two stand in different worlds
    (`habitus.report.comparison.placed.placing`). Raises HabitusError where they share no moment, or
    neither a joint's name nor a mesh.
    """
    if align not in ALIGN:
        raise HabitusError(f"align is {align!r}; expected one of {', '.join(ALIGN)}")
    names, *numbers = shared_joints(a, b)
    if len(names) < 3:
        raise HabitusError(
            f"{a.body.name} and {b.body.name} have {len(names)} joints of one name; expected two "
            "bodies of people"
        )
    pairing = pair(a, b, offset)
    levels = shared_levels(a, b)
    joints = tuple(
        _joints(m, f)[:, k] for m, f, k in zip((a, b), pairing.frames, numbers, strict=True)
    )
    place = placing(a, b, joints, align)
    b = moved(b, place, a.up_axis)
    off = place.apply(joints[1]) - joints[0]
    skin, vertex = (None, None) if levels is None else _skin(a, b, pairing, levels)
    return Differences(
        a=a,
        b=b,
        pairing=pairing,
        place=place,
        joint_names=names,
        joints=_mm(off),
        centred=_mm(off - off[:, :1]),
        turned=_turned(a, b, pairing, numbers),
        levels=levels,
        skin=skin,
        vertex=vertex,
        at_rest=None if levels is None else _at_rest(a, b, levels),
        markers=_markers(a, b, pairing),
    )


def _joints(moving: Moving, frames: np.ndarray) -> Float[np.ndarray, "T J 3"]:
    return np.concatenate([joints for _, joints in surfaces_at(moving, frames, None, skin=False)])


def _mm(off: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch"]:
    return 1e3 * np.linalg.norm(off, axis=-1)


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
        apart = _mm(theirs - ours)
        numbers.append(np.stack([apart.mean(1), np.percentile(apart, 95, axis=1), apart.max(1)], 1))
        furthest.append(apart.argmax(1))
    return np.concatenate(numbers), np.concatenate(furthest)


def _at_rest(a: Moving, b: Moving, levels: tuple[BodyModel, BodyModel]) -> Float[np.ndarray, " V"]:
    """Distances of the shapes at rest, pelvis on pelvis."""
    first, second = (
        level.rest_vertices(m.betas) - level.rest_joints(m.betas)[0]
        for m, level in zip((a, b), levels, strict=True)
    )
    return _mm(second - first)


def _turned(
    a: Moving, b: Moving, pairing: Pairing, numbers: list[np.ndarray]
) -> Float[np.ndarray, "T J"] | None:
    """Angles between the joints' rotations relative to their parents, where every shared joint has
    the same parent.
    """
    above = (
        [_parent(m.body, joint) for joint in own] for m, own in zip((a, b), numbers, strict=True)
    )
    if not all(one == other for one, other in zip(*above, strict=True)):
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


def _markers(a: Moving, b: Moving, pairing: Pairing) -> MarkersApart | None:
    if not isinstance(a, MarkerFit) or not isinstance(b, MarkerFit):
        return None
    labels = tuple(label for label in a.labels if label in b.labels)
    if not labels:
        return None
    columns = [[fit.labels.index(label) for label in labels] for fit in (a, b)]
    both = list(zip((a, b), columns, pairing.frames, strict=True))
    predicted = [points_at(_predicted(fit)[:, k], f) for fit, k, f in both]
    observed = [points_at(np.asarray(fit.observed_markers)[:, k], f) for fit, k, f in both]
    seen, offs = (_mm(two[1] - two[0]) for two in (observed, predicted))
    errors = [
        np.asarray(fit.errors_mm)[near][:, k]
        for (fit, k, _), near in zip(both, pairing.nearest, strict=True)
    ]
    return MarkersApart(labels, offs, (errors[0], errors[1]), seen)


def _predicted(fit: MarkerFit) -> Any:
    return np.asarray(
        fit.predicted_pose_stage if fit.predicted_soft_tissue is None else fit.predicted_soft_tissue
    )


def notes(found: Differences) -> tuple[str, ...]:
    """What whoever reads the distances must know, a sentence each."""
    told = [*found.pairing.notes, *filter(None, [found.place.told])]
    if not found.place.told and found.place.degrees > 1e-3:
        told.append(f"B's up was another: it was turned so that {found.a.up_axis} is up, as in A.")
    if found.levels is None:
        told.append(
            f"The bodies have different meshes ({found.a.body_name}, {found.b.body_name}): they "
            "are compared by joints "
            "and markers of one name. Joints of one name lie at other places in another body, by "
            "a centimetre or more."
        )
    if not found.same_moments:
        told.insert(
            0,
            f"Observed markers of one name are {found.observed_apart:.0f} mm apart (median): "
            "these are not the same "
            "moments of one capture; the distances say nothing of the fits. Is there an offset in "
            "time?",
        )
    return tuple(told)
