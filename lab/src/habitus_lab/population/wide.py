"""People further from the mean than the survey's, with what bodies do not model, in the poses and
with the hands of real scans.

Shapes are 1.5 times as wide as the survey's and heavy-tailed (Student's t, 5 degrees of freedom);
the skin lies off the body by a smooth random field of 3 to 10 mm (sd), not symmetric, a quarter of
it on hands, feet and face; every second head has hair of up to 5 cm that leaves the ears free.
Hands are fists, grips, pinches, flat or relaxed, each side for itself; hands also rest on hips,
fold, and lie beside the head.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from jaxtyping import Float

from habitus.body.hands import HAND_POSES, SIDES, hand_pose
from habitus.body.model import BodyModel
from habitus.fit.selection.held_out import smooth_field
from habitus.mesh.normals import vertex_normals
from habitus_lab.population.scans import BONY, STANCES, posed_near

WIDER = 1.5
FREEDOM = 5
MAX_BETA = 4.5
FIELD = (0.003, 0.010)
"""Metres: between which the sd of a person's own field lies."""
HAIR = (0.005, 0.05)
EAR = (0.03, 0.06)
"""Metres from the ear's landmark: no hair up to the first, all of it from the second on."""
ARMS: Mapping[str, Mapping[str, tuple[float, float, float]]] = MappingProxyType(
    {
        "hands on hips": {"shoulder": (1.14, -0.29, -0.93), "elbow": (0.0, -1.3, 0.0)},
        "folded hands": {"shoulder": (0.62, -0.66, -1.23), "elbow": (0.0, -1.11, 0.0)},
        "hands at the head": {
            "collar": (0.0, 0.0, 0.4),
            "shoulder": (-1.49, -0.46, -0.26),
            "elbow": (0.0, -2.06, 0.0),
        },
    }
)
WIDE_STANCES = MappingProxyType({**STANCES, **ARMS})


@dataclass(frozen=True)
class WidePerson:
    """A person in a pose: vertices (m), the stance, and the pose of each hand."""

    vertices: Float[np.ndarray, "V 3"]
    stance: str
    hands: tuple[str, str]
    pose: Float[np.ndarray, "J 3"]


def wide_person(
    body: BodyModel,
    stance: str,
    rng: np.random.Generator,
    angles: Mapping[str, tuple[float, float, float]] | None = None,
) -> WidePerson:
    """A random person in a stance (`WIDE_STANCES`, or one of these ``angles``, rad), with hands of
    their own. The body needs finger joints.
    """
    names = body.joint_names
    betas = wide_betas(body, rng)
    pose = posed_near(WIDE_STANCES[stance] if angles is None else angles, names, rng)
    hands = tuple(str(rng.choice(list(HAND_POSES))) for _ in SIDES)
    for side, grip in zip(SIDES, hands, strict=True):
        for joint, rotation in hand_pose(body, grip, (side,)).items():
            pose[names.index(joint)] = rotation + 0.1 * rng.normal(size=3)
    surface = np.asarray(body(betas, pose).vertices)
    off = sum(wide_offsets(body, rng))
    surface = surface + off[:, None] * vertex_normals(surface, body.faces)
    return WidePerson(surface, stance, (hands[0], hands[1]), pose)


def wide_rest(
    body: BodyModel, rng: np.random.Generator
) -> tuple[Float[np.ndarray, "V 3"], Float[np.ndarray, " V"]]:
    """A random person at rest without hair (m), and the hair's thickness at each vertex (m)."""
    rest = body.rest_vertices(wide_betas(body, rng))
    skin, hair = wide_offsets(body, rng)
    return rest + skin[:, None] * vertex_normals(rest, body.faces), hair


def wide_betas(body: BodyModel, rng: np.random.Generator) -> Float[np.ndarray, " B"]:
    """Betas of a random person."""
    spread = np.sqrt((FREEDOM - 2) / FREEDOM) * WIDER
    return np.clip(spread * rng.standard_t(FREEDOM, body.num_betas), -MAX_BETA, MAX_BETA)


def wide_offsets(
    body: BodyModel, rng: np.random.Generator
) -> tuple[Float[np.ndarray, " V"], Float[np.ndarray, " V"]]:
    """How far skin and hair lie outwards of the body's surface (m): skin, then hair on it."""
    rest, names = body.v_template, body.joint_names
    still = np.asarray(body.skinning_weights)[
        :, [k for k, name in enumerate(names) if is_bony(name)]
    ].sum(1)
    skin = rng.uniform(*FIELD) * smooth_field(rest, rng)[:, 0] * (1.0 - 0.75 * still)
    hair = np.zeros(len(rest))
    if rng.random() < 0.5:
        hair = rng.uniform(*HAIR) * _scalp(body)
    return skin, hair


def is_bony(joint: str) -> bool:
    """Whether a joint carries a hand, a foot or the head."""
    return joint.rpartition("_")[2].rstrip("123") in {
        *BONY,
        "ankle",
        *("index", "middle", "ring", "pinky", "thumb"),
    }


def _scalp(body: BodyModel) -> Float[np.ndarray, " V"]:
    """1 on top and back of the head, 0 on the face and the ears, smooth in between."""
    rest = np.asarray(body.v_template)
    head = np.asarray(body.skinning_weights)[:, body.joint_names.index("head")]
    mine = head > 0.5
    middle = rest[mine].mean(0)
    size = rest[mine, 1].max() - middle[1]
    height = (rest[:, 1] - middle[1] - 0.7 * (rest[:, 2] - middle[2])) / size
    ears = rest[[body.landmarks[f"{side}_ear"] for side in SIDES]]
    from_ear = np.linalg.norm(rest[:, None] - ears, axis=2).min(1)
    free = np.clip((from_ear - EAR[0]) / (EAR[1] - EAR[0]), 0.0, 1.0)
    return head * free * np.clip(2.0 * height - 0.5, 0.0, 1.0)
