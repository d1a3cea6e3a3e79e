"""Keypoints as detectors of people in pictures name them, from a body's joints and landmarks.

COCO's 17 (Lin et al. 2014, "Microsoft COCO"), OpenPose's BODY_25 (Cao et al. 2019) and BODY_25B
(Hidalgo et al. 2019), Halpe's 26 (Fang et al. 2022), the body and feet, 23, of COCO-WholeBody (Jin
et al. 2020), BlazePose's 33 (Bazarevsky et al. 2020), and 30 of SAM 3D Body's 70. Annotators put
hips, shoulders and elbows where the joints are, eyes, ears, heels and toes on the skin;
`keypoint_place` reads the table assets/keypoints.toml.

Files do not always say which of these their points are, and two have 25 points in another order:
`convention_of` decides by anatomy.
"""

import tomllib
from collections.abc import Mapping, Sequence
from functools import cache
from importlib.resources import files
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from habitus.arrays import namespace
from habitus.body.state import BodySurface
from habitus.errors import HabitusError
from habitus.types import Array


class KeypointPlace(NamedTuple):
    """A keypoint of `habitus.assets.keypoints.toml`, which says what its numbers mean: ``parts``,
    ``bone``, ``offset`` (m), ``definition`` (m) and ``noise``.
    """

    parts: tuple[str, ...]
    bone: str | None
    offset: tuple[float, float, float]
    definition: float
    noise: float


@cache
def keypoint_table() -> Mapping[str, KeypointPlace]:
    """The shipped table. Keypoints of both sides are listed without their side, those learned for
    one convention as ``blazepose33.knee``.
    """
    text = (files("habitus.assets") / "keypoints.toml").read_text(encoding="utf-8")
    table: dict[str, KeypointPlace] = {}
    for name, row in tomllib.loads(text).items():
        if name in CONVENTIONS:
            table |= {f"{name}.{own}": _place(each, table[own]) for own, each in row.items()}
        else:
            table[name] = _place(row, None)
    return MappingProxyType(table)


def _place(row: Mapping[str, Any], plain: KeypointPlace | None) -> KeypointPlace:
    """A row of the table; parts and bone are those of the general row unless it has its own."""
    x, y, z = row.get("offset", (0.0, 0.0, 0.0))
    return KeypointPlace(
        tuple(row.get("parts", plain.parts if plain else ())),
        row.get("bone", plain.bone if plain else None),
        (x, y, z),
        row["definition"],
        row["noise"],
    )


def keypoint_place(name: str, convention: str = "") -> KeypointPlace:
    """The place of a keypoint: the one learned for the convention's detector where there is one,
    else the general one. Raises HabitusError for an unknown keypoint.
    """
    table = keypoint_table()
    side, _, plain = name.partition("_")
    sided = side in ("left", "right") and plain in table
    if not (sided or name in table):
        known = [each for each in table if "." not in each]
        raise HabitusError(f"no keypoint is called {name!r}; expected one of {', '.join(known)}")
    key = plain if sided else name
    row = table.get(f"{convention}.{key}", table[key])
    own = f"{side}_" if sided else ""
    parts = row.parts or (plain if sided else name,)
    middle = {"nose_tip", "chin", "neck"}
    x, y, z = row.offset
    return KeypointPlace(
        tuple(part if part in middle else own + part for part in parts),
        row.bone if row.bone in (None, "head") else own + row.bone,
        (-x if side == "right" else x, y, z),
        row.definition,
        row.noise,
    )


def keypoint_bone(name: str, joint_names: Sequence[str], parents: Sequence[int]) -> int:
    """The joint that a keypoint rides on: of a joint's own keypoint the one above it."""
    place = keypoint_place(name)
    if place.bone is not None and place.bone in joint_names:
        return list(joint_names).index(place.bone)
    joint = place.parts[0]
    if joint not in joint_names:
        raise HabitusError(f"the body has no joint {place.bone or joint!r}, which {name} rides on")
    return max(parents[list(joint_names).index(joint)], 0)


def _sides(*names: str) -> tuple[str, ...]:
    return tuple(f"{side}_{name}" for name in names for side in ("left", "right"))


_LEG = ("hip", "knee", "ankle")
_COCO = ("nose", *_sides("eye", "ear", "shoulder", "elbow", "wrist", *_LEG))
_EYE = ("eye_inner", "eye", "eye_outer")
_FOOT = ("big_toe", "small_toe", "heel")
_MHR_HAND = ("thumb", "index", "pinky", "wrist")
_LEFT_FOOT = tuple(f"left_{name}" for name in _FOOT)
_RIGHT_FOOT = tuple(f"right_{name}" for name in _FOOT)
CONVENTIONS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "coco17": _COCO,
        "openpose25": (
            "nose",
            "neck",
            "right_shoulder",
            "right_elbow",
            "right_wrist",
            "left_shoulder",
            "left_elbow",
            "left_wrist",
            "mid_hip",
            *(f"right_{name}" for name in _LEG),
            *(f"left_{name}" for name in _LEG),
            "right_eye",
            "left_eye",
            "right_ear",
            "left_ear",
            "left_big_toe",
            "left_small_toe",
            "left_heel",
            "right_big_toe",
            "right_small_toe",
            "right_heel",
        ),
        "body25b": (*_COCO, "upper_neck", "head_top", *_LEFT_FOOT, *_RIGHT_FOOT),
        "halpe26": (*_COCO, "head_top", "neck", "mid_hip", *_sides(*_FOOT)),
        "wholebody23": (*_COCO, *_LEFT_FOOT, *_RIGHT_FOOT),
        "blazepose33": (
            "nose",
            *(f"{side}_{eye}" for side in ("left", "right") for eye in _EYE),
            *_sides("ear", "mouth", "shoulder", "elbow", "wrist", "pinky", "index", "thumb"),
            *_sides(*_LEG, "heel", "foot_index"),
        ),
        "mhr70": (
            "nose",
            *_sides("eye", "ear", "shoulder", "elbow", *_LEG),
            *(f"left_{name}" for name in _FOOT),
            *(f"right_{name}" for name in _FOOT),
            *(f"{side}_{name}" for side in ("right", "left") for name in _MHR_HAND),
            "neck",
        ),
    }
)
"""The names of a convention's keypoints, in its order."""

BONES: tuple[tuple[str, str], ...] = (
    *(
        (f"{side}_{start}", f"{side}_{end}")
        for side in ("left", "right")
        for start, end in (
            ("shoulder", "elbow"),
            ("elbow", "wrist"),
            ("hip", "knee"),
            ("knee", "ankle"),
            ("eye", "ear"),
            ("ankle", "heel"),
            ("heel", "big_toe"),
        )
    ),
    ("nose", "left_eye"),
    ("nose", "right_eye"),
)
"""Pairs of neighbouring keypoints on a person."""
MIN_BONES = 6
"""Fewest visible bones by which conventions are compared."""
MAX_BONE_LENGTH = 0.25
"""The mean length of `BONES`, as a share of the diagonal of the box around all points. 649 detected
people of BODY_25B have 0.08 to 0.17, 400 simulated ones of COCO 0.10 to 0.22; points read in the
order of another convention have 0.21 to 0.40."""
MIN_LENGTH_RATIO = 1.2
"""The second best convention's mean length over the best one's. The 649 people have 1.8 to 4.2 with
BODY_25 as the second, 400 simulated ones of BODY_25 1.3 to 7.5 with BODY_25B."""


def convention_of(
    points: Float[np.ndarray, "*people K 2"], confidence: Float[np.ndarray, "*people K"]
) -> str:
    """The convention of K detected points (pixels; confidence 0: not seen) of one or several
    people: of those with K points, the one by whose names bones are short.

    Raises HabitusError where no convention has K points, where too few bones are visible to choose
    between several, and where the bones are too long in each of them.
    """
    count = points.shape[-2]
    candidates = [name for name, names in CONVENTIONS.items() if len(names) == count]
    if not candidates:
        known = ", ".join(f"{name} ({len(names)})" for name, names in CONVENTIONS.items())
        raise HabitusError(f"{count} keypoints a person; expected those of one of {known}")
    lengths = {name: _bone_length(name, points, confidence) for name in candidates}
    if any(np.isnan(length) for length in lengths.values()):
        if len(candidates) == 1:
            return candidates[0]
        raise HabitusError(
            f"too few of {count} keypoints are visible to choose between "
            f"{' and '.join(candidates)}; expected at least {MIN_BONES} neighbouring pairs"
        )
    best, *others = sorted(candidates, key=lambda name: lengths[name])
    if lengths[best] > MAX_BONE_LENGTH or (
        others and lengths[others[0]] < MIN_LENGTH_RATIO * lengths[best]
    ):
        raise HabitusError(
            f"{count} keypoints in an order that gives no person; expected that of "
            f"{' or '.join(candidates)}"
        )
    return best


def _bone_length(convention: str, points: np.ndarray, confidence: np.ndarray) -> float:
    """The mean length of the bones that were seen, over people, each in units of the diagonal of
    the person's box; NaN where no person has enough of them.
    """
    place = {name: k for k, name in enumerate(CONVENTIONS[convention])}
    ends = np.array([[place[a], place[b]] for a, b in BONES if a in place and b in place])
    lengths = []
    for person, sure in zip(
        points.reshape(-1, *points.shape[-2:]),
        confidence.reshape(-1, points.shape[-2]),
        strict=True,
    ):
        seen = sure > 0
        bones = ends[seen[ends].all(1)]
        if len(bones) < MIN_BONES:
            continue
        length = np.linalg.norm(person[bones[:, 0]] - person[bones[:, 1]], axis=-1).mean()
        lengths.append(length / max(float(np.linalg.norm(np.ptp(person[seen], axis=0))), 1e-9))
    return float(np.mean(lengths)) if lengths else float("nan")


def keypoints(
    convention: str,
    surface: BodySurface,
    joint_names: tuple[str, ...],
    landmarks: Mapping[str, int],
    num_vertices: int,
    body: str,
) -> Float[Array, "*batch K 3"]:
    """The keypoints (m) of a posed surface, as `habitus.body.model.BodyModel.keypoints` says."""
    if convention not in CONVENTIONS:
        raise HabitusError(f"keypoints {convention!r}; expected one of {', '.join(CONVENTIONS)}")
    if surface.vertices.shape[-2] != num_vertices or surface.joints.shape[-2] != len(joint_names):
        raise HabitusError(
            f"a surface of {surface.vertices.shape[-2]} vertices and {surface.joints.shape[-2]} "
            "joints; expected the "
            f"{num_vertices} and {len(joint_names)} of {body}: evaluate it at all its vertices"
        )
    joints = {name: surface.joints[..., k, :] for k, name in enumerate(joint_names)}
    points = []
    for name in CONVENTIONS[convention]:
        located = []
        for place in keypoint_place(name).parts:
            if place not in joints and place not in landmarks:
                raise HabitusError(
                    f"{body} has neither a joint nor a landmark {place!r}, where {convention} has "
                    f"{name}"
                )
            located.append(
                joints[place] if place in joints else surface.vertices[..., landmarks[place], :]
            )
        points.append(sum(located[1:], located[0]) / len(located))
    return namespace(surface.vertices).stack(points, -2)
