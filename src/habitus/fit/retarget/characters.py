"""Any rigged character as a body: its matched joints under our names, its skin, and a body's motion
solved on its own proportions.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from habitus.body.body_arrays import affine_regressor
from habitus.body.measurements import find_soles
from habitus.body.model import BodyModel
from habitus.body.motion import BodyMotion
from habitus.body.rig import Rig, RigMotion
from habitus.errors import HabitusError, shown
from habitus.fit.retarget.contacts import ContactSettings, ground_height, standing
from habitus.fit.retarget.figures import Setting, figure_of_body, figure_of_rig
from habitus.fit.retarget.legs import skeleton_of
from habitus.fit.retarget.recipe import RETARGET, RetargetSettings, lowest_heights
from habitus.fit.retarget.rig_matching import RigMatch, match_rig
from habitus.fit.retarget.rig_motions import Feet, placed, planted, stand_slip

MOST_VERTICES = 6000
"""Vertices of a character that are held above the ground, besides those of its feet; more would
only take time."""


class Skin(NamedTuple):
    """Vertices at rest in the rig's world and their influences, joints by the rig's numbers."""

    vertices: Float[np.ndarray, "V 3"]
    joints: Int[np.ndarray, "V K"]
    weights: Float[np.ndarray, "V K"]


@dataclass(frozen=True, eq=False)
class Character:
    """A rig with its skin as a ``body`` in metres, y up, facing +z; ``joints`` are the rig's
    numbers of the body's joints.
    """

    rig: Rig
    body: BodyModel
    joints: tuple[int, ...]
    setting: Setting
    match: RigMatch
    notes: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class CharacterMotion:
    """A character in motion (y up, the ground at 0) and how well it stands.

    ``scale``: of the way, as its legs are longer than the source's; ``standing`` s that a foot
    stands; ``slip`` m/s along the ground, root mean square and highest, of the point on which it
    stands; ``below``: the lowest vertex of source and result from the ground (m).
    """

    character: Character
    motion: BodyMotion
    scale: float
    standing: float
    slip: tuple[float, float]
    below: tuple[float, float]


def character_of(rig: Rig, skin: Skin, name: str) -> Character:
    """The character of a rig and its skin. Raises HabitusError where it is no person's."""
    at_rest = RigMotion(rig, rig.places[None], rig.turns[None], 1.0, name, "+y")
    figure, setting, match, notes = figure_of_rig(at_rest, match_rig(rig))
    chosen = sorted(match.joints.items(), key=lambda item: item[1])
    joints = tuple(joint for _, joint in chosen)
    owner = _owners(rig, joints)
    parents = tuple(owner[rig.parents[j]] if rig.parents[j] >= 0 else -1 for j in joints)
    names = tuple(part for part, _ in chosen)
    loose = [part for part, parent in zip(names[1:], parents[1:], strict=True) if parent < 0]
    if names[0] != "pelvis" or loose:
        part = loose[0] if loose else names[0]
        raise HabitusError(
            f"{rig.names[match.joints[part]]} ({part}) does not hang on the pelvis; expected a "
            "skeleton whose trunk and legs move with it"
        )
    rest = figure.rest[[figure.at(part) for part in names]]
    body = _body(name, names, parents, rest, skin, np.maximum(owner, 0), setting)
    return Character(rig, body, joints, setting, match, notes)


def _owners(rig: Rig, joints: tuple[int, ...]) -> Int[np.ndarray, " J"]:
    """For each joint of a rig the matched one that carries it, by its place among ``joints``; -1
    above all of them.
    """
    at = {joint: k for k, joint in enumerate(joints)}
    owner = np.full(rig.num_joints, -1)
    for joint, parent in enumerate(rig.parents):
        owner[joint] = at.get(joint, owner[parent] if parent >= 0 else -1)
    return owner


def _body(
    name: str,
    names: tuple[str, ...],
    parents: tuple[int, ...],
    rest: Float[np.ndarray, "n 3"],
    skin: Skin,
    owner: Int[np.ndarray, " J"],
    setting: Setting,
) -> BodyModel:
    index = owner[skin.joints]
    strongest = index[np.arange(len(index)), skin.weights.argmax(axis=1)]
    feet = [k for k, part in enumerate(names) if part.endswith(("_ankle", "_foot"))]
    on_feet = np.isin(strongest, feet)
    step = max(1, int(np.sum(~on_feet)) // MOST_VERTICES)
    kept = np.flatnonzero(on_feet | (np.cumsum(~on_feet) % step == 0))
    vertices = setting.scale * skin.vertices[kept] @ setting.upright.T
    if len(vertices) < 4:
        raise HabitusError(f"{shown(name)}: {len(vertices)} skinned vertices; expected a character")
    weights = skin.weights[kept] / skin.weights[kept].sum(axis=1, keepdims=True)
    return BodyModel(
        name=name,
        v_template=vertices,
        shapedirs=np.zeros((len(vertices), 3, 1)),
        posedirs=None,
        joint_regressor=affine_regressor(vertices, rest),
        skinning_index=index[kept],
        skinning_value=weights,
        parents=parents,
        faces=np.array([[0, 1, 2]]),
        joint_names=names,
    )


def moved_character(
    source: BodyMotion, character: Character, settings: RetargetSettings = RETARGET
) -> CharacterMotion:
    """A body's motion (y up) on a character: limbs point as the source's do, the way is scaled with
    the legs, and the feet that stand keep their place.
    """
    feet, lowest = feet_of_body(source, settings.contacts)
    figure = figure_of_body(source)
    body = character.body
    plain, scale = placed(figure, body, np.zeros(1), feet)
    below = scale * np.minimum(lowest - feet.ground, 0.0)
    moved = planted(plain, feet, scale, settings, below)
    slip = stand_slip(moved, find_soles(body, settings.contacts), feet.still)
    speeds = (float(np.sqrt(np.mean(slip**2))), float(slip.max())) if len(slip) else (0.0, 0.0)
    seconds = float(feet.still.any(axis=(1, 2)).sum() / source.rate_hz)
    depth = (lowest.min() - feet.ground, lowest_heights(moved).min() - feet.ground)
    grounded = BodyMotion(
        body, np.zeros(1), moved.pose, moved.trans - [0.0, feet.ground, 0.0], source.rate_hz, "+y"
    )
    return CharacterMotion(
        character, grounded, scale, seconds, speeds, (float(depth[0]), float(depth[1]))
    )


def feet_of_body(
    motion: BodyMotion, settings: ContactSettings
) -> tuple[Feet, Float[np.ndarray, " T"]]:
    """Contacts of a body's soles, and the height of its lowest vertex in every frame."""
    soles = find_soles(motion.body, settings)
    points = soles.means(motion.points(soles.used))
    still = standing(points, motion.rate_hz, settings)
    levels = [ground_height(points[:, :, k, 1], still[:, :, k], settings) for k in range(3)]
    ground = ground_height(points[..., 1], still, settings)
    rest = motion.body.rest_joints(np.asarray(motion.betas, np.float64))
    low = float(motion.body.rest_vertices(motion.betas)[:, 1].min())
    ankles = [motion.body.joint_names.index(f"{side}_ankle") for side in ("left", "right")]
    ankle = ground + float(rest[ankles, 1].mean()) - low
    return Feet(still, points[..., 1] - np.array(levels), ground, ankle), lowest_heights(motion)


def node_tracks(
    moved: CharacterMotion,
) -> tuple[Float[np.ndarray, "T n 3 3"], Float[np.ndarray, "T 3"]]:
    """Rotations of the rig's matched joints in what they hang on, and the pelvis' places in the
    rig's own world.
    """
    character = moved.character
    rig, setting = character.rig, character.setting
    world = skeleton_of(moved.motion).world
    up = setting.upright
    turned = up.T @ world[..., :3] @ up
    owner = _owners(rig, character.joints)
    local = np.empty_like(turned)
    for k, joint in enumerate(character.joints):
        parent = rig.parents[joint]
        own = turned[:, k] @ rig.turns[joint]
        above = np.eye(3) if parent < 0 else rig.turns[parent]
        if parent >= 0 and owner[parent] >= 0:
            above = turned[:, owner[parent]] @ above
        local[:, k] = np.swapaxes(np.broadcast_to(above, own.shape), 1, 2) @ own
    return local, world[:, 0, :, 3] @ up / setting.scale
