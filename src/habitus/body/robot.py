"""A humanoid robot: a tree of links that turn about fixed axes, with the limits of its joints.

The counterpart of a body model: `Robot.pose` places its links as a body places its joints.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from habitus.errors import HabitusError, listed
from habitus.rotations import matrix_from_rotvec

TO_ROBOT = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""From a body's axes (x left, y up, z forward) to a robot's (x forward, y left, z up)."""


class LinkPoses(NamedTuple):
    """Rotations (*batch, L, 3, 3) and origins (*batch, L, 3) of links, m, world frame."""

    rotations: Float[np.ndarray, "*batch L 3 3"]
    origins: Float[np.ndarray, "*batch L 3"]


@dataclass(frozen=True, eq=False)
class Robot:
    """A tree of L links and its n hinges, in metres and radians; x forward, y left, z up.

    A link's frame is given in its parent's with all joints at zero; parents come before their
    children and link 0 is free to move. A joint turns ``joint_links[k]`` about ``axes[k]`` (unit,
    link frame) through ``anchors[k]`` (link frame). ``lower`` and ``upper`` are the limits of
    angles, ``velocity`` those of speeds (rad/s, inf where the file names none).
    """

    name: str
    link_names: tuple[str, ...]
    parents: tuple[int, ...]
    offsets: Float[np.ndarray, "L 3"]
    turns: Float[np.ndarray, "L 3 3"]
    joint_names: tuple[str, ...]
    joint_links: Int[np.ndarray, " n"]
    axes: Float[np.ndarray, "n 3"]
    anchors: Float[np.ndarray, "n 3"]
    lower: Float[np.ndarray, " n"]
    upper: Float[np.ndarray, " n"]
    velocity: Float[np.ndarray, " n"]

    @property
    def num_links(self) -> int:
        """L."""
        return len(self.link_names)

    @property
    def num_joints(self) -> int:
        """n, without the six freedoms of the root."""
        return len(self.joint_names)

    @cached_property
    def joint_of_link(self) -> Int[np.ndarray, " L"]:
        """The joint that turns each link; -1 where it is fixed to its parent."""
        out = np.full(self.num_links, -1)
        out[self.joint_links] = np.arange(self.num_joints)
        return out

    def link(self, name: str) -> int:
        """Index of a link. Raises HabitusError for a name that the robot lacks."""
        if name not in self.link_names:
            raise HabitusError(
                f"the robot {self.name} has no link {name}; it has {listed(self.link_names, 40)}"
            )
        return self.link_names.index(name)

    def path(self, link: int) -> list[int]:
        """The link and those it hangs from, the root last."""
        out = [link]
        while self.parents[out[-1]] >= 0:
            out.append(self.parents[out[-1]])
        return out

    def pose(
        self,
        angles: Float[np.ndarray, "*batch n"],
        root: Float[np.ndarray, "*batch 3"] | None = None,
        turn: Float[np.ndarray, "*batch 3 3"] | None = None,
    ) -> LinkPoses:
        """Places of all links at joint ``angles``, the root link at ``root``, turned by ``turn``.

        The root link stands at the origin, unturned, where these are missing.
        """
        batch = angles.shape[:-1]
        rotations = np.empty((*batch, self.num_links, 3, 3))
        origins = np.empty((*batch, self.num_links, 3))
        joints = self.joint_of_link
        for link, parent in enumerate(self.parents):
            if parent < 0:
                rotations[..., link, :, :] = np.eye(3) if turn is None else turn
                origins[..., link, :] = 0.0 if root is None else root
                continue
            above = rotations[..., parent, :, :]
            frame = above @ self.turns[link]
            origins[..., link, :] = origins[..., parent, :] + above @ self.offsets[link]
            k = joints[link]
            if k >= 0:
                own = matrix_from_rotvec(angles[..., k, None] * self.axes[k])
                shift = self.anchors[k] - own @ self.anchors[k]
                origins[..., link, :] += (frame @ shift[..., None])[..., 0]
                frame = frame @ own
            rotations[..., link, :, :] = frame
        return LinkPoses(rotations, origins)

    @cached_property
    def zero(self) -> LinkPoses:
        """Places of the links at angles zero."""
        return self.pose(np.zeros(self.num_joints))
