"""The template that registrations are aligned to: a mesh, its parts and the tree of joints between
them (S 4.1), a tuple of parents.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType

import numpy as np
from jaxtyping import Float, Int

from habitus.errors import HabitusError
from habitus.mesh.registrations import check_faces


@dataclass(frozen=True, eq=False)
class Template:
    """A mesh in its rest pose, segmented into the parts of a kinematic tree.

    ``vertices`` (V, 3) are in metres, y up, facing +z; ``part`` (V,) gives each vertex the joint it
    belongs to; ``parents`` is a tree with its root first. ``mirror`` (V,) gives each vertex its
    partner across x = 0 and ``joint_mirror`` (J,) each joint its own; either may be absent.
    ``landmarks`` name vertices. Raises HabitusError where these do not fit together.
    """

    vertices: Float[np.ndarray, "V 3"]
    faces: Int[np.ndarray, "F 3"]
    part: Int[np.ndarray, " V"]
    parents: tuple[int, ...]
    joint_names: tuple[str, ...]
    mirror: Int[np.ndarray, " V"] | None = None
    joint_mirror: Int[np.ndarray, " J"] | None = None
    landmarks: Mapping[str, int] = field(default_factory=lambda: MappingProxyType({}))

    def __post_init__(self):
        check_parents(self.parents)
        _check_vertices(self.vertices)
        v = len(self.vertices)
        j = len(self.parents)
        check_faces(self.faces, v, "the template's")
        if len(self.joint_names) != j or len(set(self.joint_names)) != j:
            raise HabitusError(
                f"the template has joint names {list(self.joint_names)}; expected {j} distinct ones"
            )
        _check_numbers("part", self.part, v, j)
        for key, count in (("mirror", v), ("joint_mirror", j)):
            partner = getattr(self, key)
            if partner is not None:
                _check_partners(key, partner, count)
        off = [name for name, vertex in self.landmarks.items() if not 0 <= vertex < v]
        if off:
            raise HabitusError(
                f"the template's landmark {off[0]!r} is vertex {self.landmarks[off[0]]}; expected "
                f"0 to {v - 1}"
            )

    @property
    def num_vertices(self) -> int:
        """V."""
        return len(self.vertices)

    @property
    def num_joints(self) -> int:
        """J."""
        return len(self.parents)

    @property
    def empty_joints(self) -> tuple[str, ...]:
        """The joints that no vertex belongs to: nothing on the surface shows how they turn."""
        count = np.bincount(self.part, minlength=self.num_joints)
        return tuple(name for name, n in zip(self.joint_names, count, strict=True) if n == 0)

    def part_vertices(self, joint: int) -> Int[np.ndarray, " n"]:
        """The vertices that belong to a joint."""
        return np.flatnonzero(self.part == joint)


def _check_vertices(vertices: Float[np.ndarray, "V 3"]) -> None:
    if (
        vertices.ndim != 2
        or vertices.shape[1] != 3
        or vertices.dtype.kind != "f"
        or len(vertices) == 0
    ):
        raise HabitusError(
            f"the template's vertices are {vertices.dtype} {vertices.shape}; expected numbers (V, "
            "3)"
        )
    off = np.flatnonzero(~np.isfinite(vertices).all(axis=1))
    if len(off):
        raise HabitusError(
            f"{len(off)} of the template's vertices (first {off[0]}) are not finite; repair the "
            "mesh"
        )


def _check_numbers(key: str, numbers: Int[np.ndarray, " n"], count: int, below: int) -> None:
    if numbers.shape != (count,) or numbers.dtype.kind not in "iu":
        raise HabitusError(
            f"the template's {key} is {numbers.dtype} of shape {numbers.shape}; expected {count} "
            "whole numbers"
        )
    if numbers.min() < 0 or numbers.max() >= below:
        raise HabitusError(
            f"the template's {key} runs from {numbers.min()} to {numbers.max()}; expected 0 to "
            f"{below - 1}"
        )


def _check_partners(key: str, partner: Int[np.ndarray, " n"], count: int) -> None:
    _check_numbers(key, partner, count, count)
    off: Sequence[int] = np.flatnonzero(partner[partner] != np.arange(count)).tolist()
    if len(off):
        raise HabitusError(
            f"the template's {key} pairs {off[0]} with {partner[off[0]]} but {partner[off[0]]} "
            "with another; "
            "expected partners of each other"
        )


def check_parents(parents: tuple[int, ...]) -> None:
    """Raise HabitusError unless ``parents`` is one tree whose root is joint 0 and whose parents
    come first.
    """
    if not parents or parents[0] != -1:
        raise HabitusError(
            f"parents begin with {list(parents[:1])}; expected -1: joint 0 is the root"
        )
    for joint, parent in enumerate(parents[1:], 1):
        if not 0 <= parent < joint:
            raise HabitusError(
                f"the parent of joint {joint} is {parent}; expected a joint before it (0 to "
                f"{joint - 1})"
            )
