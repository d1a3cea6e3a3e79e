"""A skeleton of somebody else's, as files of motion have it: named joints in a tree, a rest pose,
and a motion in a world of its own.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float


@dataclass(frozen=True, eq=False)
class Rig:
    """A tree of joints at rest, parents first; ``places`` are in the file's unit and world.

    ``turns`` are the rotations of joints in the world at rest. ``ends`` says which joints are only
    the far end of a bone. ``roles`` holds joints that the file itself names by their part of a
    body, as VRM does (our joint name -> number).
    """

    names: tuple[str, ...]
    parents: tuple[int, ...]
    places: Float[np.ndarray, "J 3"]
    turns: Float[np.ndarray, "J 3 3"]
    ends: tuple[bool, ...]
    roles: tuple[tuple[str, int], ...] = ()

    @property
    def num_joints(self) -> int:
        """J, ends of bones included."""
        return len(self.names)

    def children(self, joint: int) -> tuple[int, ...]:
        """The joints that hang on a joint."""
        return tuple(k for k, parent in enumerate(self.parents) if parent == joint)

    def path(self, joint: int, above: int = -1) -> tuple[int, ...]:
        """The joints from below ``above`` down to a joint; empty where it is not above."""
        way = []
        while joint not in (above, -1):
            way.append(joint)
            joint = self.parents[joint]
        return tuple(reversed(way)) if joint == above else ()


@dataclass(frozen=True, eq=False)
class RigMotion:
    """A rig in motion: ``places`` (T, J, 3) and ``turns`` (T, J, 3, 3) of joints in the world.

    ``up_axis`` is empty where the format does not fix it. ``notes`` say in sentences what the
    reader had to decide.
    """

    rig: Rig
    places: Float[np.ndarray, "T J 3"]
    turns: Float[np.ndarray, "T J 3 3"]
    rate_hz: float
    name: str
    up_axis: str = ""
    notes: tuple[str, ...] = ()
