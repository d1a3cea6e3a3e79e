"""Muscle bulges driven by human joint angles: surfaces that no model of SMPL's form can
reproduce.
"""

from typing import NamedTuple


class Muscle(NamedTuple):
    """A patch of skin that rises as a joint turns: on the left or in the middle; the right is its
    mirror image.

    The joint's rotation vector along ``axis``, from ``start`` to ``end`` (degrees), raises the
    patch by ``height`` (mm, negative sinks). Its centre lies ``along`` the bone from one joint to
    another, on its side ``towards``; ``width`` is a standard deviation in mm.
    """

    joint: str
    axis: tuple[float, float, float]
    start: float
    end: float
    bone: tuple[str, str]
    along: float
    towards: tuple[float, float, float]
    height: float
    width: float


X = (1.0, 0.0, 0.0)
Y = (0.0, 1.0, 0.0)
Z = (0.0, 0.0, 1.0)
LESS_X = (-1.0, 0.0, 0.0)
LESS_Y = (0.0, -1.0, 0.0)
LESS_Z = (0.0, 0.0, -1.0)
_ARM = ("left_shoulder", "left_elbow")
_FOREARM = ("left_elbow", "left_wrist")
_THIGH = ("left_hip", "left_knee")
_SHANK = ("left_knee", "left_ankle")
_HAND = ("left_wrist", "left_hand")
_CHEST = ("spine3", "left_shoulder")
_TOP = ("neck", "left_shoulder")
_WAIST = ("spine1", "spine2")
_RIBS = ("spine2", "spine3")
_NECK = ("neck", "head")

MUSCLES = (
    Muscle("left_elbow", LESS_Y, 5, 120, _ARM, 0.55, Z, 25, 55),  # biceps
    Muscle("left_elbow", LESS_Y, 20, 130, _ARM, 0.6, LESS_Z, -10, 55),  # triceps
    Muscle("left_elbow", LESS_Y, 10, 110, _ARM, 1.0, LESS_Z, 14, 35),  # tip of the elbow
    Muscle("left_elbow", LESS_Y, 5, 120, _FOREARM, 0.2, Z, 15, 50),
    Muscle("left_elbow", X, 0, 50, _FOREARM, 0.5, (0.0, 0.7, 0.7), 8, 50),
    Muscle("left_wrist", LESS_Z, 5, 60, _FOREARM, 0.6, LESS_Y, 8, 45),
    Muscle("left_wrist", Z, 5, 50, _FOREARM, 0.3, Y, 8, 45),
    Muscle("left_hand", LESS_Z, 5, 65, _HAND, 0.9, Y, 7, 30),  # knuckles
    Muscle("left_shoulder", Z, 0, 50, _ARM, 0.12, Y, 21, 55),  # deltoid, arm raised
    Muscle(
        "left_shoulder", LESS_Z, 5, 80, _ARM, 0.08, Y, 16, 50
    ),  # round of the shoulder, arm down
    Muscle("left_shoulder", LESS_Z, 5, 80, _ARM, 0.1, LESS_Y, 17, 55),  # armpit
    Muscle("left_shoulder", LESS_Y, 5, 90, _CHEST, 0.65, Z, 25, 70),  # chest
    Muscle("left_shoulder", LESS_Y, 5, 90, _CHEST, 0.6, LESS_Z, -15, 70),  # shoulder blade
    Muscle("left_shoulder", X, 0, 50, _ARM, 0.3, (0.0, 0.5, -0.9), 10, 55),
    Muscle("left_collar", Z, 3, 25, _TOP, 0.5, Y, 16, 50),  # trapezius
    Muscle("left_knee", X, 5, 130, _THIGH, 0.5, Z, -14, 90),
    Muscle("left_knee", X, 5, 120, _THIGH, 0.6, LESS_Z, 23, 75),  # hamstrings
    Muscle("left_knee", X, 5, 120, _SHANK, 0.25, LESS_Z, 21, 60),  # calf
    Muscle("left_knee", X, 10, 120, _THIGH, 1.0, Z, 14, 45),  # kneecap
    Muscle("left_hip", LESS_X, 5, 100, _THIGH, 0.1, Z, 23, 70),  # crease of the groin
    Muscle("left_hip", LESS_X, 5, 100, _THIGH, 0.1, LESS_Z, -25, 90),  # buttock
    Muscle("left_hip", Z, 0, 40, _THIGH, 0.05, X, 18, 70),
    Muscle("left_hip", Y, 0, 35, _THIGH, 0.35, (0.7, 0.0, 0.7), 10, 70),
    Muscle("left_ankle", X, 3, 40, _SHANK, 0.35, LESS_Z, 13, 55),
    Muscle("left_ankle", LESS_X, 2, 25, _SHANK, 0.9, Z, 8, 40),
    Muscle("left_foot", LESS_X, 5, 45, ("left_ankle", "left_foot"), 1.0, LESS_Y, 7, 30),
    Muscle("spine1", X, 0, 35, _WAIST, 0.3, Z, 28, 75),  # belly
    Muscle("spine1", X, 0, 35, _WAIST, 0.3, LESS_Z, -12, 75),
    Muscle("spine1", LESS_Z, 0, 15, _WAIST, 0.4, X, 20, 60),  # flank
    Muscle("spine2", X, 0, 25, _RIBS, 0.2, Z, 18, 75),
    Muscle("spine2", LESS_Z, 0, 12, _RIBS, 0.2, X, 15, 60),
    Muscle("spine3", Y, 0, 18, _RIBS, 0.7, (0.8, 0.0, 0.6), 12, 70),
    Muscle(
        "neck", LESS_Y, 0, 40, _NECK, 0.3, (0.7, 0.0, 0.7), 14, 35
    ),  # the side of the neck that turns forward
    Muscle("neck", X, 0, 35, _NECK, 0.4, LESS_Z, 10, 45),
    Muscle("head", X, 0, 25, _NECK, 0.7, Z, 10, 40),  # throat
    Muscle("head", LESS_Y, 0, 40, _NECK, 0.5, (0.8, 0.0, -0.5), 9, 35),
)
