"""Mass, centre of mass and inertia of each part of a person's body that moves with one joint, from
the volume of the fitted surface.

The surface is cut along the borders between parts and each cut is closed by a fan about the lower
joint, which both sides share: the parts' volumes add up to the body's. Densities are Dempster's
(Winter, Biomechanics and Motor Control of Human Movement, table 4.1); the trunk takes what is left
of a known mass.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int
from trimesh.triangles import mass_properties

from habitus.body.model import BodyModel
from habitus.errors import HabitusError

DENSITY: Mapping[str, float] = {
    "head": 1110.0, "neck": 1110.0, "shoulder": 1070.0, "elbow": 1130.0, "wrist": 1160.0,
    "hand": 1160.0, "hip": 1050.0, "knee": 1090.0, "ankle": 1100.0, "foot": 1100.0,
}  # fmt: skip
"""kg/m^3 of the parts that move with these joints; of the trunk"""
TRUNK_DENSITY = 1030.0
"""where the mass is not known, else within"""
TRUNK_RANGE = (850.0, 1100.0)
"""(breath, and errors of the volume)."""
FROM_VOLUME = "from the volume"
"""Source of a mass that nobody knows."""
TRUNK = ("pelvis", "spine1", "spine2", "spine3", "collar")


@dataclass(frozen=True, eq=False)
class SegmentMasses:
    """Parts of a body by joint. mass (J,): kg; centre (J, 3): m, at rest in body space; inertia (J,
    3, 3): kg m^2 about the centre, in the axes of body space. total: kg. source: where the total
    comes from. volume (J,): m^3.
    """

    mass: Float[np.ndarray, " J"]
    centre: Float[np.ndarray, "J 3"]
    inertia: Float[np.ndarray, "J 3 3"]
    source: str
    volume: Float[np.ndarray, " J"]

    def scaled(self, factor: float, source: str) -> "SegmentMasses":
        """The same parts, denser by a factor."""
        return replace(self, mass=factor * self.mass, inertia=factor * self.inertia, source=source)

    @property
    def total(self) -> float:
        """Of all parts (kg)."""
        return float(self.mass.sum())


def segment_masses(
    body: BodyModel, betas: Float[np.ndarray, " B"], mass: float | None = None, source: str = ""
) -> SegmentMasses:
    """The masses of a person's parts. mass: of the whole body (kg), where it is known, with its
    ``source`` in words; else from the volume.

    Raises HabitusError for a mass that no person has, or a surface that is not closed.
    """
    return surface_masses(body, body.rest_vertices(np.asarray(betas, np.float64)), mass, source)


def surface_masses(
    body: BodyModel,
    rest_vertices: Float[np.ndarray, "V 3"],
    mass: float | None = None,
    source: str = "",
    whole_trunk: bool = False,
) -> SegmentMasses:
    """`segment_masses` of a person whose surface at rest (m) is given, whatever shape it has.

    whole_trunk: pelvis, spine and collar bones are one part, the pelvis'.
    """
    if mass is not None and not 2.0 < mass < 400.0:
        raise HabitusError(f"mass is {mass:g} kg; expected 2 to 400")
    surface = np.asarray(rest_vertices, np.float64)
    names = body.joint_names
    volume = np.zeros(len(names))
    centre = np.array(body.joint_regressor @ surface, np.float64)
    second = np.zeros((len(names), 3, 3))
    owner = owners(body, surface, centre)
    if whole_trunk:
        trunk = [k for k, name in enumerate(names) if name.rpartition("_")[2] in TRUNK]
        owner[np.isin(owner, trunk)] = min(trunk)
    for k, triangles in _parts(surface, body.faces, owner, centre.copy(), body.parents).items():
        found = mass_properties(triangles, density=1.0, skip_inertia=False)
        if found["volume"] > 0.0:
            volume[k], centre[k], second[k] = (
                found["volume"],
                found["center_mass"],
                found["inertia"],
            )
    if volume.sum() <= 0.0:
        raise HabitusError(f"{body.name}: its surface encloses no volume; expected a closed one")
    density = np.array([_density(name) for name in names])
    trunk = np.array([name.rpartition("_")[2] in TRUNK for name in names])
    weight = density * volume
    if mass is not None and volume[trunk].sum() > 0.0:
        left = (mass - weight[~trunk].sum()) / volume[trunk].sum()
        density[trunk] = np.clip(left, *TRUNK_RANGE)
        weight = density * volume
        factor = mass / weight.sum()
        weight, density = factor * weight, factor * density
    source = FROM_VOLUME if mass is None else source
    return SegmentMasses(weight, centre, density[:, None, None] * second, source, volume)


def owners(
    body: BodyModel, surface: Float[np.ndarray, "V 3"], joints: Float[np.ndarray, "J 3"]
) -> Int[np.ndarray, " V"]:
    """The joint with which each vertex mostly moves; fingers and toes count as their hand or foot,
    the jaw and the eyes as the head. Upper arms end in a plane through the shoulder, square to the
    arm: the skin of chest and back that follows an arm is the trunk's.
    """
    strongest = np.take_along_axis(
        body.skinning_index, body.skinning_value.argmax(1)[:, None], axis=1
    )[:, 0]
    known = [_known(name) for name in body.joint_names]
    joint = np.arange(len(known))
    for k in range(len(known)):
        at = k
        while not known[at] and body.parents[at] >= 0:
            at = int(body.parents[at])
        joint[k] = at
    owner = joint[strongest]
    for side in ("left", "right"):
        names = [f"{side}_{name}" for name in ("shoulder", "elbow")]
        if all(name in body.joint_names for name in names):
            top, low = (body.joint_names.index(name) for name in names)
            along = (surface - joints[top]) @ (joints[low] - joints[top])
            owner[(owner == top) & (along < 0.0)] = joint[body.parents[top]]
    return owner


def _known(name: str) -> bool:
    plain = name.rpartition("_")[2]
    return plain in DENSITY or plain in TRUNK


def _density(name: str) -> float:
    return DENSITY.get(name.rpartition("_")[2], TRUNK_DENSITY)


def _parts(
    surface: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    owner: Int[np.ndarray, " V"],
    joints: Float[np.ndarray, "J 3"],
    parents: Sequence[int],
) -> dict[int, Float[np.ndarray, "n 3 3"]]:
    """The triangles of each part, cuts closed. A face belongs to the joint of most of its corners,
    else of the first.

    Where two cuts of a part meet at a vertex, a triangle between their tips closes what their fans
    leave open, and one to the middle of the body the polygon of the tips. Parts that meet there
    share these triangles, so that volumes still add up.
    """
    corners = owner[faces]
    own = np.where(corners[:, 1] == corners[:, 2], corners[:, 1], corners[:, 0])
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    side = np.tile(own, 3)
    keys = {(int(a), int(b)): int(k) for (a, b), k in zip(edges, side, strict=True)}
    cuts: dict[tuple[int, int], list[tuple[int, int]]] = {}
    for (a, b), k in keys.items():
        other = keys.get((b, a))
        if other is not None and other != k:
            cuts.setdefault((k, other), []).append((a, b))
    parts = {int(k): [surface[faces[own == k]]] for k in np.unique(own)}
    comes: dict[tuple[int, int], list[np.ndarray]] = {}
    goes: dict[tuple[int, int], list[np.ndarray]] = {}
    for (k, other), border in cuts.items():
        ends = np.array(border)
        apex = _apex(k, other, joints, parents)
        fan = np.stack([surface[ends[:, 1]], surface[ends[:, 0]], np.tile(apex, (len(ends), 1))], 1)
        parts[k].append(fan)
        for a, b in border:
            goes.setdefault((k, a), []).append(apex)
            comes.setdefault((k, b), []).append(apex)
    middle = surface.mean(axis=0)
    for (k, vertex), before in comes.items():
        after = goes[k, vertex]
        for one, two in zip(before, after, strict=True):
            parts[k].append(np.array([[surface[vertex], one, two], [two, one, middle]]))
    return {k: np.concatenate(pieces) for k, pieces in parts.items()}


def _apex(
    one: int, other: int, joints: Float[np.ndarray, "J 3"], parents: Sequence[int]
) -> Float[np.ndarray, "3"]:
    """Where the cut between two parts has its tip: at the lower one's joint, or midway where
    neither hangs on the other.
    """
    for low, high in ((one, other), (other, one)):
        at = low
        while at >= 0 and at != high:
            at = parents[at]
        if at == high:
            return joints[low]
    return 0.5 * (joints[one] + joints[other])
