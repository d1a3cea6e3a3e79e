"""A body whose shape is fixed, for many poses (S 3, eqs. 1 to 12)."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, Int

from habitus.arrays import Kind, broadcast_shapes, kind_of, unflatten
from habitus.body.blend_shapes import add_blend_shapes
from habitus.body.fast import are_plain, posed_surface
from habitus.body.inputs import read_vectors
from habitus.body.kinematics import skinning_motions, world_motions
from habitus.body.mesh import BodyMesh
from habitus.body.pose_features import PoseFeatures, extended
from habitus.body.skinning import skin
from habitus.body.state import BodySurface
from habitus.body.views import RestSkeleton, VertexRows
from habitus.rotations import matrix_from_rotvec
from habitus.types import Array, ArrayLike


@runtime_checkable
class Preparable(Protocol):
    """What of a body (`habitus.body.model.BodyModel`, which says what it is) the body function
    needs.
    """

    name: str
    parents: tuple[int, ...]
    skinning: str
    shape_features: int
    mesh: BodyMesh | None

    @property
    def num_betas(self) -> int: ...  # noqa: D102
    @property
    def num_joints(self) -> int: ...  # noqa: D102
    @property
    def drivers(self) -> list[int]: ...  # noqa: D102
    @property
    def features(self) -> PoseFeatures: ...  # noqa: D102
    def full_pose(self, values: Any, kind: Kind) -> Array: ...  # noqa: D102
    def prepare(self, betas: ArrayLike, vertices: Any, expression: Any) -> "PreparedBody": ...  # noqa: D102
    def _in(self, kind: Kind) -> RestSkeleton: ...


@dataclass(frozen=True, eq=False)
class PreparedBody:
    """A `habitus.body.model.BodyModel` with fixed shape, for many poses: ``prepared(pose, trans)``.

    ``rest_joints`` and ``shaped`` are in the kind of the coefficients: ``betas``, and behind them,
    where such were given, those of the face's expression and of the dynamics.
    """

    model: Preparable
    rows: VertexRows
    rest_joints: Float[Array, "*shapes J 3"]
    coefficients: Float[Array, "*shapes C"]
    kind: Kind
    vertices: Int[np.ndarray, " N"] | None

    @property
    def betas(self) -> Float[Array, "*shapes B"]:
        """The shape coefficients."""
        return self.coefficients[..., : self.model.num_betas]

    @property
    def expression(self) -> Float[Array, "*shapes E"] | None:
        """The expression, where there is one."""
        count = self.model.num_betas
        end = self.model.num_betas + self.model.num_expressions
        return (
            self.coefficients[..., count:end]
            if end > count and self.coefficients.shape[-1] > count
            else None
        )

    @property
    def dynamics(self) -> Float[Array, "*shapes D"] | None:
        """The coefficients of the dynamic blend shapes, where such were given."""
        count = self.model.num_betas + self.model.num_expressions
        return self.coefficients[..., count:] if self.coefficients.shape[-1] > count else None

    @cached_property
    def shaped(self) -> Float[Array, "*shapes M"]:
        """The rest surface (m) as rows of x, y and z."""
        return add_blend_shapes(self.rows.template, self.coefficients, self.rows.shapedirs)

    def __call__(
        self,
        pose: ArrayLike | Mapping[str, ArrayLike] | None = None,
        trans: ArrayLike | None = None,
    ) -> BodySurface:
        """The surface in this pose (rotation vectors, rad; all joints or some by name), moved by
        ``trans`` (m).
        """
        model = self.model
        angles = pose.values() if isinstance(pose, Mapping) else (pose,)
        kind = kind_of(self.coefficients, *angles, trans)
        if kind != self.kind:
            given = (
                None if part is None else kind.array(part)
                for part in (self.expression, self.dynamics)
            )
            return model.prepare(kind.array(self.betas), self.vertices, *given)(pose, trans)
        pose = model.full_pose(pose, kind)
        place = (
            kind.zeros(3) if trans is None else read_vectors(trans, kind, (3,), "trans", model.name)
        )
        batch = broadcast_shapes(pose.shape[:-2], self.coefficients.shape[:-1], place.shape[:-1])
        if are_plain(kind, pose, place, self.rest_joints, self.coefficients):
            return self._surface(*self._compiled(pose, place, batch))
        return self._surface(
            *self._readable(self.shaped, self.rest_joints, self.betas, pose, place, batch)
        )

    def carried(
        self,
        rest: Float[Array, "*people N 3"],
        rest_joints: Float[Array, "*people J 3"],
        pose: Mapping[str, ArrayLike],
    ) -> Float[Array, "*people N 3"]:
        """These vertices of other people in one pose (rad; joints by name): ``rest`` (m) are theirs
        at rest, whatever their shape; the pose moves them as it moves the template.
        """
        kind = self.kind
        batch = rest.shape[:-2]
        angles = self.model.full_pose(pose, kind)
        rows = rest.swapaxes(-1, -2).reshape(*batch, -1)
        betas = kind.zeros(*batch, self.model.num_betas)
        return self._readable(rows, rest_joints, betas, angles, kind.zeros(3), batch)[0]

    def moved(
        self,
        shaped: Float[Array, "*#batch M"],
        pose: Float[Array, "*#batch J 3"],
        trans: Float[Array, "*#batch 3"] | None = None,
    ) -> BodySurface:
        """The surface in this pose (rad), with the rest surface ``shaped`` (m; in rows) in place of
        its own.
        """
        place = self.kind.zeros(3) if trans is None else trans
        batch = broadcast_shapes(pose.shape[:-2], shaped.shape[:-1], place.shape[:-1])
        return self._surface(
            *self._readable(shaped, self.rest_joints, self.betas, pose, place, batch)
        )

    def _surface(
        self, vertices: Float[Array, "*batch N 3"], joints: Float[Array, "*batch J 3"]
    ) -> BodySurface:
        mesh = self.model.mesh if self.vertices is None else None
        return BodySurface(vertices, joints, self.model._in(self.kind).faces, self.betas, mesh)

    def _compiled(
        self,
        pose: Float[Array, "*#batch J 3"],
        place: Float[Array, "*#batch 3"],
        batch: tuple[int, ...],
    ) -> tuple[Float[Array, "*batch N 3"], Float[Array, "*batch J 3"]]:
        model = self.model
        one = self.shaped if self.coefficients.shape[:-1] == () else None
        driven = (model.features, self.coefficients, model.shape_features, model.drivers)
        rest = (self.rows, one, self.rest_joints, model.parents)
        return posed_surface(*rest, driven, model.skinning, pose, place, batch, self.kind)

    def _readable(
        self,
        rest: Float[Array, "*#batch M"],
        rest_joints: Float[Array, "*#batch J 3"],
        betas: Float[Array, "*#batch B"],
        pose: Float[Array, "*#batch J 3"],
        place: Float[Array, "*#batch 3"],
        batch: tuple[int, ...],
    ) -> tuple[Float[Array, "*batch N 3"], Float[Array, "*batch J 3"]]:
        """Pose blend shapes onto the shaped rest rows, kinematics, skinning, place."""
        model = self.model
        xp = self.kind.xp
        rotations = xp.broadcast_to(matrix_from_rotvec(pose), (*batch, model.num_joints, 3, 3))
        rest_joints = xp.broadcast_to(rest_joints, (*batch, model.num_joints, 3))
        posedirs = self.rows.posedirs
        if posedirs is not None:
            whole = xp.broadcast_to(pose, (*batch, model.num_joints, 3))
            feature = model.features.of_pose(whole, rotations, model.drivers)
            rest = add_blend_shapes(rest, extended(feature, betas, model.shape_features), posedirs)
        world = world_motions(rotations, rest_joints, model.parents)
        motions = skinning_motions(world, rest_joints)
        vertices = skin(
            model.skinning, unflatten(rest, -1, (3, -1)), motions, place, self.rows.influences
        )
        return vertices, world[..., 3] + place[..., None, :]
