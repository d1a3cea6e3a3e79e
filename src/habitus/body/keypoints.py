"""Keypoints as detectors of people in pictures name them, from a body's joints and landmarks.

COCO's 17 (Lin et al. 2014, "Microsoft COCO") and OpenPose's BODY_25 (Cao et al. 2019). Annotators
put hips, shoulders and elbows where the joints are, eyes, ears, heels and toes on the skin.
"""

from collections.abc import Mapping
from types import MappingProxyType

from jaxtyping import Float

from habitus.arrays import namespace
from habitus.body.state import BodySurface
from habitus.errors import HabitusError
from habitus.types import Array

_PLACES: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "nose": ("nose_tip",),
        **{
            f"{side}_{name}": tuple(f"{side}_{place}" for place in places)
            for side in ("left", "right")
            for name, places in {
                "eye": ("eye",),
                "ear": ("ear",),
                "big_toe": ("big_toe",),
                "small_toe": ("little_toe",),
                "heel": ("heel",),
            }.items()
        },
        "neck": ("left_shoulder", "right_shoulder"),
        "mid_hip": ("left_hip", "right_hip"),
    }
)
"""Joints or landmarks whose mean a keypoint is, where it has not the joint's own name."""


def _sides(*names: str) -> tuple[str, ...]:
    return tuple(f"{side}_{name}" for name in names for side in ("left", "right"))


_LEG = ("hip", "knee", "ankle")
CONVENTIONS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "coco17": ("nose", *_sides("eye", "ear", "shoulder", "elbow", "wrist", *_LEG)),
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
    }
)
"""The names of a convention's keypoints, in its order."""


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
        for place in _PLACES.get(name, (name,)):
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
