"""Which link of a robot is which segment of a body, where its soles are, and how thick it is."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from habitus.body.robot import Robot

BODY_AXES = {"up": (0.0, 1.0, 0.0), "left": (1.0, 0.0, 0.0), "forward": (0.0, 0.0, 1.0)}
"""Directions of a body at rest that are the same for each segment."""
PALM = (0.0, -1.0, 0.0)
"""Where palms of a body at rest (T-pose) look."""
SEGMENTS = {
    "pelvis": ("pelvis", None),
    "torso": ("spine3", None),
    "head": ("head", None),
    **{
        f"{side}_{name}": (f"{side}_{joint}", f"{side}_{end}")
        for side in ("left", "right")
        for name, joint, end in (
            ("thigh", "hip", "knee"),
            ("shank", "knee", "ankle"),
            ("foot", "ankle", "foot"),
            ("upper_arm", "shoulder", "elbow"),
            ("forearm", "elbow", "wrist"),
            ("hand", "wrist", "hand"),
        )
    },
}
"""Segments of a body: the joint with which each moves, and the joint to which it reaches
(``along``)."""
DIRECTIONS = ("along", "up", "left", "forward", "palm")
REQUIRED = ("pelvis", *(f"{s}_{p}" for s in ("left", "right") for p in ("thigh", "shank", "foot")))


@dataclass(frozen=True)
class Segment:
    """A robot's link that is a segment of the body. ``directions`` name directions of the segment
    (`DIRECTIONS`) and give them for the robot with all joints at zero, x forward, y left, z up.
    """

    link: str
    directions: dict[str, Float[np.ndarray, " 3"]]
    weight: float = 1.0


@dataclass(frozen=True)
class Sole:
    """The underside of a foot: places (n, 3) of its heel and of its toes, m from the link's origin
    with all joints at zero.
    """

    link: str
    heel: Float[np.ndarray, "n 3"]
    toes: Float[np.ndarray, "m 3"]

    @property
    def middle(self) -> Float[np.ndarray, " 3"]:
        """Between heel and toes."""
        return 0.5 * (self.heel.mean(axis=0) + self.toes.mean(axis=0))


@dataclass(frozen=True)
class Capsule:
    """A part of a robot that touches nothing else: a segment (2, 3), m from the link's origin with
    all joints at zero, and a radius (m).
    """

    link: str
    ends: Float[np.ndarray, "2 3"]
    radius: float


@dataclass(frozen=True)
class RobotPairs:
    """What a robot's links are to a body.

    ``segments`` by the name of the segment (`SEGMENTS`), ``soles`` left and right, ``capsules`` by
    names of their own, ``velocity`` (rad/s) for joints of which the robot's file names none.
    """

    name: str
    segments: dict[str, Segment]
    soles: tuple[Sole, Sole]
    capsules: dict[str, Capsule]
    velocity: float = np.inf

    def missing(self, robot: Robot) -> list[str]:
        """Links that the table names and the robot lacks."""
        named = [*self.segments.values(), *self.soles, *self.capsules.values()]
        return sorted({each.link for each in named} - set(robot.link_names))
