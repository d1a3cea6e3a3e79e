"""Motion in: somebody else's skeleton in motion becomes a body in motion.

Lengths of limbs give betas, directions of limbs and rotations give the pose, and feet stand on the
ground where the skeleton's stand. A skeleton that a body of ours was exported with gives that body
and its motion back as they were.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from habitus.body.measurements import Soles, find_soles
from habitus.body.model import BodyModel
from habitus.body.motion import BodyMotion
from habitus.body.rig import RigMotion
from habitus.errors import listed
from habitus.fit.retarget.contacts import ContactSettings, ground_height, standing, stands
from habitus.fit.retarget.figures import Figure, figure_of_rig, pose_like
from habitus.fit.retarget.recipe import RETARGET, RetargetSettings, grounded, same_turns
from habitus.fit.retarget.rig_matching import RigMatch, match_rig
from habitus.solve.minimize import minimize
from habitus.solve.terms import Term

LIMB_SD = 0.01
"""Metres by which a limb of a skeleton may differ from the body's that it stands for."""
TRUNK_SD = 0.03
"""Metres of trunk, shoulders and hips, whose joints each skeleton puts elsewhere."""
OWN = 1e-4
"""Metres within which joints at rest are those of a body of ours."""
LEVEL = 0.03
"""Metres above the ground within which a foot stands on it."""
_LIMBS = (("hip", "knee"), ("knee", "ankle"), ("shoulder", "elbow"), ("elbow", "wrist"))
_FEET = ("ankle", "foot", "foot")

Bodies = Callable[[tuple[str, ...]], Sequence[BodyModel]]
"""Bodies that a motion may be of, by the names of joints that its skeleton has."""


class Feet(NamedTuple):
    """When heels, balls and toes stand, and how high above the ground then (m, at the source's
    size); the ground's height, and that of ankles above it in standing.
    """

    still: Bool[np.ndarray, "T 2 3"]
    rise: Float[np.ndarray, "T 2 3"]
    ground: float
    ankle: float


def body_motion_of(
    motion: RigMotion,
    bodies: Bodies,
    betas: Float[np.ndarray, " B"] | None = None,
    settings: RetargetSettings = RETARGET,
) -> BodyMotion:
    """A skeleton's motion on the first of the bodies, or on that whose own skeleton it is.

    betas: the person's; found from the lengths of limbs where missing. Raises HabitusError for a
    skeleton that is no person's.
    """
    match = match_rig(motion.rig)
    figure, _, match, notes = figure_of_rig(motion, match)
    candidates = bodies(figure.names)
    body, found, own = _person(figure, candidates, betas)
    notes = (f"read from {motion.name}, joints by {match.how}", *notes, *_left_out(match))
    if own:
        made = _exact(figure, body, found)
        notes += ("its skeleton is the body's own",)
    else:
        if betas is None:
            fit = _misfit(figure, body, found)
            notes += (f"betas of {body.name} from the lengths of limbs, {fit}",)
        feet = feet_of_figure(figure, settings.contacts)
        plain, scale = placed(figure, body, found, feet)
        made = planted(plain, feet, scale, settings)
        notes += (f"way scaled by {scale:.3f}, feet kept where they stand",)
    return replace(made, capture_name=motion.name, body_name=body.name, made=notes)


def _left_out(match: RigMatch) -> tuple[str, ...]:
    if not match.unmatched:
        return ()
    return (f"joints that are none of a body's and were left out: {listed(match.unmatched, 8)}",)


def _person(
    figure: Figure, bodies: Sequence[BodyModel], betas: np.ndarray | None
) -> tuple[BodyModel, Float[np.ndarray, " B"], bool]:
    """Body and betas, and whether the figure has the body's own joints."""
    for body in bodies:
        if set(body.joint_names) <= set(figure.names):
            exact = betas if betas is not None else _own_betas(figure, body)
            if _rest_distance(figure, body, exact) < OWN:
                return body, exact, True
    body = bodies[0]
    return body, betas if betas is not None else limb_betas(figure, body), False


def _offsets(figure: Figure, body: BodyModel) -> Float[np.ndarray, "J 3"]:
    rest = figure.rest[[figure.at(name) for name in body.joint_names]]
    return rest - rest[0]


def _own_betas(figure: Figure, body: BodyModel) -> Float[np.ndarray, " B"]:
    """The betas whose joints are the figure's, all offsets taken together."""
    moved = body.joint_shapedirs - body.joint_shapedirs[:1]
    missing = _offsets(figure, body) - (body.joint_template - body.joint_template[0])
    solution = np.linalg.lstsq(moved.reshape(-1, body.num_betas), missing.ravel(), rcond=1e-9)
    return solution[0]


def _rest_distance(figure: Figure, body: BodyModel, betas: np.ndarray) -> float:
    rest = body.rest_joints(betas)
    return float(np.abs(rest - rest[0] - _offsets(figure, body)).max())


def limb_betas(figure: Figure, body: BodyModel) -> Float[np.ndarray, " B"]:
    """Betas by the lengths of a figure's bones, least squares with the shape prior."""
    names = body.joint_names
    pairs = [
        (f"{side}_{one}", f"{side}_{other}", LIMB_SD)
        for side in ("left", "right")
        for one, other in _LIMBS
    ]
    pairs += [(f"left_{part}", f"right_{part}", TRUNK_SD) for part in ("hip", "shoulder")]
    pairs += [(f"{side}_hip", f"{side}_shoulder", TRUNK_SD) for side in ("left", "right")]
    used = [p for p in pairs if all(n in names and n in figure.names for n in p[:2])]
    ends = np.array([[names.index(n) for n in p[:2]] for p in used])
    there = np.array([[figure.at(n) for n in p[:2]] for p in used])
    lengths = np.linalg.norm(figure.rest[there[:, 1]] - figure.rest[there[:, 0]], axis=1)
    sd = np.array([p[2] for p in used])
    moved = body.joint_shapedirs[ends[:, 1]] - body.joint_shapedirs[ends[:, 0]]

    def limbs(betas: np.ndarray):
        joints = body.rest_joints(betas)
        bones = joints[ends[:, 1]] - joints[ends[:, 0]]
        long = np.linalg.norm(bones, axis=1)
        slopes = np.einsum("nc,ncb->nb", bones / long[:, None], moved) / sd[:, None]
        return (long - lengths) / sd, {"betas": slopes}

    prior = Term(lambda betas: (betas, {"betas": np.eye(body.num_betas)}))
    start = {"betas": np.zeros(body.num_betas)}
    return minimize({"limbs": Term(limbs), "prior": prior}, start, "dogleg").values["betas"]


def _misfit(figure: Figure, body: BodyModel, betas: np.ndarray) -> str:
    """How well limbs fit, in words."""
    rest = body.rest_joints(betas)
    off = [
        abs(
            np.linalg.norm(rest[body.joint_names.index(b)] - rest[body.joint_names.index(a)])
            - np.linalg.norm(figure.rest[figure.at(b)] - figure.rest[figure.at(a)])
        )
        for side in ("left", "right")
        for a, b in pairwise([f"{side}_hip", f"{side}_knee", f"{side}_ankle"])
    ]
    return f"bones of legs within {1e3 * max(off):.0f} mm"


def _exact(figure: Figure, body: BodyModel, betas: np.ndarray) -> BodyMotion:
    """The motion of a figure that has the body's joints: root where it is."""
    rest = body.rest_joints(betas)
    pose, _ = pose_like(figure, body, rest)
    trans = figure.places[:, figure.at(body.joint_names[0])] - rest[0]
    return BodyMotion(body, betas, _continuous(pose), trans, figure.rate_hz, "+y")


def _continuous(pose: Float[np.ndarray, "T J 3"]) -> Float[np.ndarray, "T J 3"]:
    """Rotation vectors without jumps from frame to frame."""
    out = pose.copy()
    for frame in range(1, len(out)):
        out[frame] = same_turns(pose[frame], out[frame - 1])
    return out


def feet_of_figure(figure: Figure, settings: ContactSettings) -> Feet:
    """Contacts by ankles and balls of a figure, whose soles are unknown."""
    columns = [
        [
            figure.at(f"{side}_{part}" if f"{side}_{part}" in figure.names else f"{side}_ankle")
            for part in _FEET
        ]
        for side in ("left", "right")
    ]
    points = figure.places[:, np.array(columns)]
    still = standing(points, figure.rate_hz, settings)
    levels = np.array(
        [ground_height(points[:, :, k, 1], still[:, :, k], settings) for k in range(3)]
    )
    rise = points[..., 1] - levels
    sole = min(levels[0] - 0.05, levels[1])
    return Feet(still, rise, 0.0 if abs(sole) < 0.1 else float(sole), float(levels[0]))


def placed(
    figure: Figure, body: BodyModel, betas: Float[np.ndarray, " B"], feet: Feet
) -> tuple[BodyMotion, float]:
    """A body in a figure's pose, the way of its hips scaled with the legs, and that scale.

    Heights are scaled about those of ankles in standing, which are the body's own afterwards.
    """
    rest = body.rest_joints(betas)
    names = body.joint_names
    hips = 0.5 * (rest[names.index("left_hip")] + rest[names.index("right_hip")])
    lowest = float(body.rest_vertices(betas)[:, 1].min())
    ankle = float(np.mean([rest[names.index(f"{s}_ankle"), 1] for s in ("left", "right")])) - lowest
    scale = _leg(names, rest) / _leg(figure.names, figure.rest)
    pose, root = pose_like(figure, body, rest)
    way = figure.middle("hip")
    origin = np.array([way[0, 0], feet.ankle, way[0, 2]])
    to = np.array([way[0, 0], feet.ground + ankle, way[0, 2]])
    goal = to + scale * (way - origin)
    trans = goal - rest[0] - (root @ (hips - rest[0]))
    return BodyMotion(body, betas, _continuous(pose), trans, figure.rate_hz, "+y"), scale


def _leg(names: tuple[str, ...], rest: np.ndarray) -> float:
    """Thigh and shank, of both sides on average."""
    ways = [
        [rest[names.index(f"{side}_{part}")] for part in ("hip", "knee", "ankle")]
        for side in ("left", "right")
    ]
    return float(np.linalg.norm(np.diff(ways, axis=1), axis=-1).sum(axis=1).mean())


def planted(
    plain: BodyMotion,
    feet: Feet,
    scale: float,
    settings: RetargetSettings,
    below: Float[np.ndarray, " T"] | float = 0.0,
) -> BodyMotion:
    """The motion with points of the soles at rest where they stand, on the ground or as far above
    it as the source's, and nothing lower than ``below`` (m, at most 0) the ground.
    """
    body = plain.body
    soles = find_soles(body, settings.contacts)
    rest = body.rest_vertices(plain.betas)
    heights = soles.means(rest[None, soles.used])[0, ..., 1] - rest[:, 1].min()
    rise = np.sign(feet.rise) * np.maximum(np.abs(feet.rise) - LEVEL, 0.0)
    targets = np.zeros((*feet.still.shape, 3))
    targets[..., 1] = feet.ground + heights + scale * rise
    least = np.broadcast_to(feet.ground + np.asarray(below), (plain.num_frames,))
    return grounded(plain, soles, feet.still, targets, least, settings)


def stand_slip(
    motion: BodyMotion, soles: Soles, still: Bool[np.ndarray, "T 2 P"]
) -> Float[np.ndarray, " n"]:
    """Horizontal speeds (m/s), frame by frame, of the point of each sole on which the foot
    stands.
    """
    points = soles.means(motion.points(soles.used))
    speeds = [np.zeros(0)]
    for side in range(points.shape[1]):
        for stand in stands(still[:, side]):
            frames = np.arange(stand.first, stand.last)
            same = stand.active[:-1]
            way = points[frames + 1, side, same] - points[frames, side, same]
            speeds.append(np.hypot(way[:, 0], way[:, 2]) * motion.rate_hz)
    return np.concatenate(speeds)
