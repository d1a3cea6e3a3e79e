"""The arrays that a body is made of, checked, and copies of them in the kinds (library, dtype,
device) that were asked for, laid out for speed.

Bases of blend shapes (S 3, eqs. 8 and 9) are rows of flattened surfaces, (directions, 3N) with
coordinates before vertices, so that one matrix product gives a batch of surfaces. `Ages` are
directions too: the mean person of some ages, straight lines between them.
"""

from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from types import MappingProxyType
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from habitus.arrays import Kind, flatten, namespace, to_numpy, unflatten
from habitus.body.body_mesh import BodyMesh
from habitus.body.dynamics import Dynamics
from habitus.body.face import Face
from habitus.body.kernels import LocalShapes, local_shapes
from habitus.body.pose_features import (
    Hinges,
    PoseFeatures,
    check_hinges,
    check_pose_shapes,
    find_pose_features,
    of_joints,
)
from habitus.body.prior import PosePrior
from habitus.body.skinning import SKINNING, Influences
from habitus.errors import HabitusError
from habitus.mesh.template import check_parents
from habitus.types import Array

ADULT = 18.0  # years


@dataclass(frozen=True, eq=False)
class Ages:
    """How the mean person of each of ``years`` (A, rising) differs from the template (m), and how
    tall they stand (m).

    ``statures`` are those of the whole body, so that two levels of detail grow alike; ``adult`` is
    the template's. ``spreads`` (A,) say by how much shapes vary less than the stature alone would
    scale them: small children of one age are more alike than adults.
    """

    years: Float[np.ndarray, " A"]
    directions: Float[np.ndarray, "V 3 A"]
    statures: Float[np.ndarray, " A"]
    adult: float
    spreads: Float[np.ndarray, " A"]

    def at(self, years: float | int) -> tuple[Float[np.ndarray, "V 3"], float, float]:
        """What to add to the template at an age, the stature of that age over the template's, and
        the factor of the shapes: at the known ages, that ratio times the spread.

        Raises HabitusError for an age before the first or after the last.
        """
        if not self.years[0] <= years <= self.years[-1]:
            raise HabitusError(
                f"age {years:g}: this body knows {self.years[0]:g} to {self.years[-1]:g} years"
            )
        shares = np.array([np.interp(years, self.years, unit) for unit in np.eye(len(self.years))])
        near = np.flatnonzero(shares)
        offset = self.directions[..., near].astype(np.float64) @ shares[near]
        scale = float(self.statures @ shares) / self.adult
        return offset, scale, float((self.statures * self.spreads) @ shares) / self.adult


_BLOCK = 256  # vertices at once: as many as the cache holds


def flat_rows(bases: Sequence[Float[np.ndarray, "N 3 _"]]) -> Float[np.ndarray, "K M"]:
    """The K directions of all bases as rows of 3N numbers: x of all vertices, then y, then z."""
    count = len(bases[0])
    rows = np.empty((sum(base.shape[2] for base in bases), 3, count))
    for first in range(0, count, _BLOCK):
        some = slice(first, first + _BLOCK)
        np.concatenate([base[some].transpose(2, 1, 0) for base in bases], out=rows[:, :, some])
    return rows.reshape(len(rows), -1)


def affine_regressor(
    vertices: Float[np.ndarray, "V 3"], joints: Float[np.ndarray, "J 3"]
) -> Float[np.ndarray, "J V"]:
    """A joint regressor of a body that has one shape: affine coordinates of joints among all
    vertices, the smallest that give ``joints`` exactly.
    """
    system = np.vstack([vertices.T, np.ones(len(vertices))])
    right = np.vstack([joints.T, np.ones(len(joints))])
    return np.linalg.lstsq(system, right, rcond=None)[0].T


def add_blend_shapes(
    base: Float[Array, "*base M"], coefficients: Float[Array, "*batch K"], rows: Float[Array, "K M"]
) -> Float[Array, "*batch M"]:
    """``base + coefficients @ rows``; ``base`` is one surface or one for each of the batch."""
    xp = namespace(coefficients)
    if xp is np:
        return coefficients @ rows + base
    if not coefficients.shape[:-1]:
        return xp.addmv(base, rows.T, coefficients)
    batch = coefficients.shape[:-1]
    base = base if base.ndim == 1 else flatten(base.expand(*batch, base.shape[-1]), 0, -2)
    return unflatten(xp.addmm(base, flatten(coefficients, 0, -2), rows), 0, batch)


@dataclass(frozen=True)
class RestSkeleton:
    """The template's joints and how shape moves them, and the body's faces, in one kind."""

    template: Float[Array, "J 3"]
    directions: Float[Array, "J 3 C"]
    """By shape coefficients, then by those of the expression; by those of the dynamics not at all.
    """
    faces: Int[Array, "T 3"]

    def rest_joints(self, coefficients: Float[Array, "*batch C"]) -> Float[Array, "*batch J 3"]:
        """Joints (m) of shaped rest surfaces (S 3, eq. 10); the last coefficients may be left
        out.
        """
        directions = self.directions[..., : coefficients.shape[-1]]
        return self.template + (directions @ coefficients[..., None, :, None])[..., 0]


@dataclass(frozen=True)
class VertexRows:
    """The arrays of some vertices, laid out for speed: bases as rows (K, 3N), coordinates before
    vertices.
    """

    template: Float[Array, " M"]
    blend_shapes: Float[Array, "K M"]
    """The directions of shape, then, if asked for, those of expression and dynamics, then those of
    the pose.
    """
    num_shapes: int
    """How many there are before those of the pose."""
    influences: Influences
    local: LocalShapes | None = None
    """Those of the pose once more, without their zeros, where it pays to leave these out."""

    @property
    def shapedirs(self) -> Float[Array, "C M"]:
        """What the coefficients of shape, expression and dynamics add."""
        return self.blend_shapes[: self.num_shapes]

    @property
    def posedirs(self) -> Float[Array, "F M"] | None:
        """What pose features, and behind them hinges, add, where the body has pose blend shapes."""
        return (
            self.blend_shapes[self.num_shapes :]
            if len(self.blend_shapes) > self.num_shapes
            else None
        )


def vertex_rows(
    kind: Kind,
    ids: Int[np.ndarray, " N"] | slice,
    v_template: Float[np.ndarray, "V 3"],
    directions: Sequence[Float[np.ndarray, "V 3 _"]],
    posedirs: Float[np.ndarray, "V 3 F"] | None,
    skinning_weights: Float[np.ndarray, "V J"],
    skinning_index: Int[np.ndarray, "V K"],
    skinning_value: Float[np.ndarray, "V K"],
    driven: tuple[int, int] = (0, 1),
) -> VertexRows:
    """A body's arrays for some of its vertices; ``directions`` are those of shape and, if they
    count, others.

    ``driven``: how many features a joint has, and in how many blocks.
    """
    dense = np.ascontiguousarray(skinning_weights[ids].T)
    bases = [base[ids] for base in (*directions, posedirs) if base is not None]
    local = local_shapes(None if posedirs is None else posedirs[ids], *driven)
    if local is not None:
        local = replace(local, value=local.value.astype(kind.compiled))
    return VertexRows(
        template=kind.array(v_template[ids].T.flatten()),
        blend_shapes=kind.array(flat_rows(bases)),
        num_shapes=sum(base.shape[2] for base in directions),
        influences=Influences(
            kind.array(dense), kind.index(skinning_index[ids]), kind.array(skinning_value[ids])
        ),
        local=local,
    )


_NUMBERS = (
    "v_template",
    "shapedirs",
    "posedirs",
    "joint_regressor",
    "skinning_value",
    "expressiondirs",
    "people_mean",
    "people_skew",
)
_WHOLE_NUMBERS = ("skinning_index", "faces", "part", "mirror", "full_vertices")


@dataclass(frozen=True, eq=False)
class BodyArrays:
    """The arrays of a `habitus.body.model.BodyModel`, which says what they are, and what follows
    from them alone.
    """

    name: str
    v_template: Float[np.ndarray, "V 3"]
    shapedirs: Float[np.ndarray, "V 3 B"]
    posedirs: Float[np.ndarray, "V 3 F"] | None
    joint_regressor: Float[np.ndarray, "J V"]
    skinning_index: Int[np.ndarray, "V K"]
    skinning_value: Float[np.ndarray, "V K"]
    parents: tuple[int, ...]
    faces: Int[np.ndarray, "T 3"]
    joint_names: tuple[str, ...]
    skinning: str = "lbs"
    pose_features: str = "rotations"
    shape_features: int = 0
    landmarks: Mapping[str, int] = field(default_factory=lambda: MappingProxyType({}))
    part: Int[np.ndarray, " V"] | None = None
    mirror: Int[np.ndarray, " V"] | None = None
    pose_prior: PosePrior | None = None
    female_direction: tuple[Float[np.ndarray, " B"], float] | None = None
    female_rows: tuple[Float[np.ndarray, "B B"], Float[np.ndarray, " B"]] | None = None
    people_mean: Float[np.ndarray, " B"] | None = None
    people_skew: Float[np.ndarray, " B"] | None = None
    pose_joints: tuple[int, ...] | None = None
    hinges: Hinges | None = None
    expressiondirs: Float[np.ndarray, "V 3 E"] | None = None
    dynamics: Dynamics | None = None
    face: Face | None = None
    ages: Ages | None = None
    age: float | None = None
    mesh: BodyMesh | None = None
    finer: Callable[[], Any] | None = None
    full_vertices: Int[np.ndarray, " V"] | None = None
    pockets: Bool[np.ndarray, " V"] | None = None
    extras: Mapping[str, np.ndarray] = field(default_factory=lambda: MappingProxyType({}))

    def __post_init__(self):
        for name in _NUMBERS + _WHOLE_NUMBERS:
            value = getattr(self, name)
            dtype = np.float64 if name in _NUMBERS else np.int64
            object.__setattr__(self, name, value if value is None else to_numpy(value, dtype))
        if self.female_direction is not None:
            direction, bias = self.female_direction
            object.__setattr__(
                self, "female_direction", (to_numpy(direction, np.float64), float(bias))
            )
        check_parents(self.parents)
        if self.skinning not in SKINNING:
            raise HabitusError(
                f"skinning is {self.skinning!r}; expected one of {', '.join(SKINNING)}"
            )
        driven = (self.num_joints, self.num_betas, self.shape_features, self.pose_joints)
        check_pose_shapes(self.posedirs, self.features, *driven)
        if self.posedirs is None:  # hinges add to them: they go together
            object.__setattr__(self, "hinges", None)
        if self.hinges is not None:
            if self.pose_features != "rotations" or self.shape_features:
                raise HabitusError(
                    "hinge channels need posedirs that are linear in R - I alone; expected "
                    "pose_features 'rotations' and no shape_features"
                )
            check_hinges(self.hinges, self.num_vertices, self.drivers, self.num_betas)
        if self.face is not None and self.face.vertices.max(initial=-1) >= self.num_vertices:
            raise HabitusError(
                f"face units move vertex {self.face.vertices.max()}; expected vertices 0 to "
                f"{self.num_vertices - 1}"
            )
        if self.dynamics is not None and len(self.dynamics.directions) != self.num_vertices:
            raise HabitusError(
                f"dynamic blend shapes of {len(self.dynamics.directions)} vertices; expected "
                f"{self.num_vertices}"
            )

    @property
    def called(self) -> str:
        """Its name, with its age where it has one."""
        return self.name if self.age is None else f"{self.name} of {self.age:g} years"

    @property
    def features(self) -> PoseFeatures:
        """What drives the pose blend shapes."""
        return find_pose_features(self.pose_features)

    @property
    def num_vertices(self) -> int:
        """V."""
        return self.v_template.shape[0]

    @property
    def num_faces(self) -> int:
        """F."""
        return self.faces.shape[0]

    @property
    def num_joints(self) -> int:
        """J."""
        return len(self.parents)

    @property
    def num_betas(self) -> int:
        """B."""
        return self.shapedirs.shape[-1]

    @property
    def num_expressions(self) -> int:
        """E; 0 where nothing is known of the face."""
        return 0 if self.expressiondirs is None else self.expressiondirs.shape[-1]

    @property
    def num_dynamics(self) -> int:
        """D; 0 where nothing is known of soft tissue in motion."""
        return 0 if self.dynamics is None else self.dynamics.directions.shape[-1]

    @property
    def face_unit_names(self) -> tuple[str, ...]:
        """The face's units, in the order of their weights; none where nothing is known of them."""
        return () if self.face is None else self.face.unit_names

    @property
    def num_face_betas(self) -> int:
        """Components of the face's identity; 0 where nothing is known of them."""
        return 0 if self.face is None else self.face.identity_directions.shape[-1]

    @property
    def drivers(self) -> list[int]:
        """The joints that drive the pose blend shapes, in their order."""
        return list(range(1, self.num_joints) if self.pose_joints is None else self.pose_joints)

    def smpl_posedirs(
        self, rows: Any = slice(None), *, beside_hinges: bool = False
    ) -> Float[np.ndarray, "N 3 F"] | None:
        """``posedirs`` of some vertices as SMPL has them, driven by all joints but the root: zeros
        for those that do not. ``beside_hinges``: without the hinges' stand-ins.
        """
        posedirs = self.pose_directions if beside_hinges else self.posedirs
        if posedirs is None or self.posedirs is None:
            return None
        some = posedirs[rows][..., : self.posedirs.shape[-1]]
        if self.pose_joints is None:
            return some
        everyone = tuple(range(1, self.num_joints))
        given = self.features.per_joint, self.pose_joints
        return of_joints(some, *given, everyone, self.shape_features)

    @cached_property
    def pose_directions(self) -> Float[np.ndarray, "V 3 G"] | None:
        """All that a pose adds: ``posedirs``, or, where the body has hinges, what is left of them
        without the hinges' stand-ins, the hinges' directions, and zeros up to a block of nine
        (`pose_coefficients`).
        """
        if self.posedirs is None or self.hinges is None:
            return self.posedirs
        plain = self.hinges.without_linear(self.posedirs, self.drivers)
        folds = self.hinges.directions.reshape(self.num_vertices, 3, -1)
        none = np.zeros((self.num_vertices, 3, self.hinges.padding))
        return np.concatenate([plain, folds, none], axis=2)

    @cached_property
    def skinning_weights(self) -> Float[np.ndarray, "V J"]:
        """The skinning weights as a dense table."""
        dense = np.zeros((self.num_vertices, self.num_joints))
        np.add.at(
            dense, (np.arange(self.num_vertices)[:, None], self.skinning_index), self.skinning_value
        )
        return dense

    @cached_property
    def strongest_joint(self) -> Int[np.ndarray, " V"]:
        """The joint of the largest skinning weight of each vertex."""
        return self.skinning_index[np.arange(self.num_vertices), self.skinning_value.argmax(1)]

    @cached_property
    def joint_template(self) -> Float[np.ndarray, "J 3"]:
        """The joints (m) of the template."""
        return self.joint_regressor @ self.v_template

    @cached_property
    def joint_shapedirs(self) -> Float[np.ndarray, "J 3 B"]:
        """How the rest joints move with the shape coefficients: the regressor applied to the shape
        directions.
        """
        return np.tensordot(self.joint_regressor, self.shapedirs, 1)

    @cached_property
    def joint_expressiondirs(self) -> Float[np.ndarray, "J 3 E"]:
        """How the rest joints move with the expression; E may be 0."""
        none = np.zeros((self.num_vertices, 3, 0))
        return np.tensordot(
            self.joint_regressor, none if self.expressiondirs is None else self.expressiondirs, 1
        )

    @cached_property
    def _cache(self) -> dict:
        """The body's arrays in the kinds that were asked for."""
        return {}

    def __getstate__(self) -> dict:
        return {item.name: getattr(self, item.name) for item in fields(self)}

    def _in(self, kind: Kind) -> RestSkeleton:
        if kind not in self._cache:
            still = np.zeros((self.num_joints, 3, self.num_dynamics))
            parts = [self.joint_shapedirs, self.joint_expressiondirs, still]
            if self.face is not None:  # who a face is places its joints, what it does not
                regressor = self.joint_regressor[:, self.face.vertices]
                parts.append(np.tensordot(regressor, self.face.identity_directions, 1))
                parts.append(np.zeros((self.num_joints, 3, len(self.face_unit_names))))
            directions = np.concatenate(parts, -1)
            with kind.lasting():
                arrays = (
                    kind.array(self.joint_template),
                    kind.array(directions),
                    kind.index(self.faces),
                )
                self._cache[kind] = RestSkeleton(*arrays)
        return self._cache[kind]

    def _rows(
        self, kind: Kind, ids: Int[np.ndarray, " N"] | None = None, coefficients: int | None = None
    ) -> VertexRows:
        """The arrays of some vertices, or of all, for so many ``coefficients``: those of the shape,
        of shape and expression, of shape, expression and dynamics, or of these and the face.
        """
        count = coefficients or self.num_betas
        if ids is None and (kind, count) in self._cache:
            return self._cache[kind, count]
        some = slice(None) if ids is None else ids
        directions = [self.shapedirs]
        if count > self.num_betas and self.expressiondirs is not None:
            directions.append(self.expressiondirs)
        if count > self.num_betas + self.num_expressions and self.dynamics is not None:
            directions.append(self.dynamics.directions)
        if (
            count > self.num_betas + self.num_expressions + self.num_dynamics
            and self.face is not None
        ):
            directions.append(self.face.directions(self.num_vertices))
        with kind.lasting() if ids is None else nullcontext():
            weights = self.skinning_weights, self.skinning_index, self.skinning_value
            driven = self.features.per_joint, 1 + self.shape_features
            rows = vertex_rows(
                kind, some, self.v_template, directions, self.pose_directions, *weights, driven
            )
        if ids is None:
            self._cache[kind, count] = rows
        return rows
