"""A body whose shape is fixed, for many poses (S 3, eqs. 1 to 12): by compiled code for NumPy
arrays and for tensors on the CPU that need no gradient, by array operations for all others.
"""

import sys
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, Int

from habitus.arrays import Kind, broadcast_shapes, kind_of, to_numpy, unflatten
from habitus.body.body_arrays import RestSkeleton, VertexRows, add_blend_shapes
from habitus.body.body_mesh import BodyMesh
from habitus.body.face import Face
from habitus.body.kernels import joint_motions, posed_vertices
from habitus.body.pose_features import Hinges, PoseFeatures, pose_coefficients
from habitus.body.skinning import skin, skinning_motions, world_motions
from habitus.body.state import BodySurface
from habitus.rotations import matrix_from_rotvec
from habitus.types import Array, ArrayLike


@runtime_checkable
class Preparable(Protocol):
    """What of a body (`habitus.body.model.BodyModel`, which says what it is) the body function
    needs.
    """

    @property
    def name(self) -> str: ...  # noqa: D102
    @property
    def parents(self) -> tuple[int, ...]: ...  # noqa: D102
    @property
    def skinning(self) -> str: ...  # noqa: D102
    @property
    def shape_features(self) -> int: ...  # noqa: D102
    @property
    def mesh(self) -> BodyMesh | None: ...  # noqa: D102

    @property
    def num_betas(self) -> int: ...  # noqa: D102
    @property
    def num_expressions(self) -> int: ...  # noqa: D102
    @property
    def num_dynamics(self) -> int: ...  # noqa: D102
    @property
    def num_face_betas(self) -> int: ...  # noqa: D102
    @property
    def face(self) -> Face | None: ...  # noqa: D102
    @property
    def num_joints(self) -> int: ...  # noqa: D102
    @property
    def drivers(self) -> list[int]: ...  # noqa: D102
    @property
    def features(self) -> PoseFeatures: ...  # noqa: D102
    @property
    def hinges(self) -> Hinges | None: ...  # noqa: D102
    def full_pose(self, values: Any, kind: Kind) -> Array: ...  # noqa: D102
    def full_trans(self, values: Any, kind: Kind) -> Array: ...  # noqa: D102
    def prepare(  # noqa: D102
        self,
        betas: ArrayLike = (),
        vertices: Any = None,
        expression: Any = None,
        dynamics: Any = None,
        face: Any = None,
        face_betas: Any = None,
    ) -> "PreparedBody": ...
    def _in(self, kind: Kind) -> RestSkeleton: ...


@dataclass(frozen=True, eq=False)
class PreparedBody:
    """A `habitus.body.model.BodyModel` with fixed shape, for many poses: ``prepared(pose, trans)``.

    ``rest_joints`` and ``shaped`` are in the kind of the coefficients: ``betas``, and behind them,
    where such were given, those of the face's expression, of the dynamics, of the face's identity
    and of its units.
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
        end = count + self.model.num_dynamics
        return self.coefficients[..., count:end] if self.coefficients.shape[-1] > count else None

    @property
    def face_betas(self) -> Float[Array, "*shapes I"] | None:
        """The components of the face's identity, where such or units were given."""
        model = self.model
        count = model.num_betas + model.num_expressions + model.num_dynamics
        end = count + model.num_face_betas
        return self.coefficients[..., count:end] if self.coefficients.shape[-1] > count else None

    @property
    def face(self) -> Float[Array, "*shapes U"] | None:
        """The weights of the face's units, where such or identity were given."""
        model = self.model
        count = model.num_betas + model.num_expressions + model.num_dynamics + model.num_face_betas
        return self.coefficients[..., count:] if self.coefficients.shape[-1] > count else None

    def _turned(self, pose: Float[Array, "*poses J 3"]) -> Float[Array, "*batch J 3"]:
        """The pose with what the face's units turn."""
        weights, face = self.face, self.model.face
        if weights is None or face is None or not face.joints:
            return pose
        turns = self.kind.array(face.joint_turns(self.model.num_joints))
        return pose + unflatten(weights @ turns, -1, (-1, 3))

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
                for part in (self.expression, self.dynamics, self.face, self.face_betas)
            )
            return model.prepare(kind.array(self.betas), self.vertices, *given)(pose, trans)
        turns: Array = self._turned(model.full_pose(pose, kind))
        place = model.full_trans(trans, kind)
        batch = broadcast_shapes(turns.shape[:-2], self.coefficients.shape[:-1], place.shape[:-1])
        inputs = turns, place, self.rest_joints, self.coefficients
        if are_plain(kind, *inputs):
            return self._surface(*self._compiled(turns, place, batch))
        if model.skinning == "lbs" and are_concrete(kind, *inputs):
            return self._surface(*self._with_gradient(turns, place, batch))
        return self._surface(
            *self._readable(self.shaped, self.rest_joints, self.betas, turns, place, batch)
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
        driven = (model.features, model.hinges, model.shape_features, model.drivers)
        rest = (self.rows, one, self.rest_joints, model.parents, self.coefficients)
        return posed_surface(*rest, driven, model.skinning, pose, place, batch, self.kind)

    def _with_gradient(
        self,
        pose: Float[Array, "*#batch J 3"],
        place: Float[Array, "*#batch 3"],
        batch: tuple[int, ...],
    ) -> tuple[Float[Array, "*batch N 3"], Float[Array, "*batch J 3"]]:
        """As `_compiled`, for tensors of which some want a gradient (`habitus.body.gradients`)."""
        from habitus.body.gradients import moving_joints, moving_vertices

        model = self.model
        count = int(np.prod(batch, dtype=int))

        def stacked(array: Array, last: int) -> Any:
            shape = array.shape[array.ndim - last :]
            whole = self.kind.xp.broadcast_to(array, (*batch, *shape))
            return whole.reshape(count, *shape).contiguous()

        turns, joints = stacked(pose, 2), stacked(self.rest_joints, 2)
        places, shape = stacked(place, 1), stacked(self.coefficients, 1)
        motions, posed, entries = moving_joints(turns, joints, model.parents)
        features = None
        if self.rows.posedirs is not None:
            rotations = entries + self.kind.array(np.eye(3))
            driven = (model.features, model.hinges, model.shape_features, model.drivers)
            features = pose_coefficients(*driven, turns, rotations, shape[:, : model.num_betas])
        vertices = moving_vertices(self.rows, shape, features, motions, places)
        return (
            unflatten(vertices, 0, batch) if batch else vertices[0],
            unflatten(posed + places[:, None], 0, batch) if batch else (posed + places[:, None])[0],
        )

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
            driven = (model.features, model.hinges, model.shape_features, model.drivers)
            rest = add_blend_shapes(
                rest, pose_coefficients(*driven, whole, rotations, betas), posedirs
            )
        world = world_motions(rotations, rest_joints, model.parents)
        motions = skinning_motions(world, rest_joints)
        vertices = skin(
            model.skinning, unflatten(rest, -1, (3, -1)), motions, place, self.rows.influences
        )
        return vertices, world[..., 3] + place[..., None, :]


def are_plain(kind: Kind, *arrays: Array | None) -> bool:
    """Whether these are only numbers: no gradient is asked for, no transform of torch wraps
    them.
    """
    if kind.xp is np:
        return True
    if not are_concrete(kind, *arrays):
        return False
    given = [array for array in arrays if array is not None]
    torch = sys.modules["torch"]
    return not torch.is_grad_enabled() or not any(array.requires_grad for array in given)


def are_concrete(kind: Kind, *arrays: Array | None) -> bool:
    """Whether these tensors hold numbers that compiled code can read: on the CPU, not traced, no
    transform of torch wraps them.
    """
    if kind.xp is np:
        return False
    torch = sys.modules["torch"]
    return (
        kind.device.type == "cpu"
        and kind.dtype in (torch.float32, torch.float64)
        and not torch.compiler.is_compiling()
        and torch.autograd.forward_ad._current_level < 0
        and not any(_is_wrapped(array) for array in arrays if array is not None)
    )


def _is_wrapped(array: Any) -> bool:
    torch = sys.modules["torch"]
    return type(array) is not torch.Tensor or torch._C._functorch.is_functorch_wrapped_tensor(array)


def posed_surface(
    rows: VertexRows,
    shaped: Float[Array, " M"] | None,
    rest_joints: Float[Array, "*#batch J 3"],
    parents: tuple[int, ...],
    betas: Float[Array, "*#batch C"],
    driven: tuple[PoseFeatures, Hinges | None, int, list[int]],
    skinning: str,
    pose: Float[Array, "*#batch J 3"],
    trans: Float[Array, "*#batch 3"],
    batch: tuple[int, ...],
    kind: Kind,
) -> tuple[Float[Array, "*batch N 3"], Float[Array, "*batch J 3"]]:
    """Posed vertices and joints (m) in the kind given, as `PreparedBody` says.

    ``shaped`` is the rest surface where all share one. ``betas``: the coefficients of shape and
    expression. ``driven``: the kind of pose features, hinges, how many of the coefficients the
    features are multiplied with, and the joints whose features count.
    """
    count = int(np.prod(batch, dtype=int))
    pose = _stacked(pose, 2, batch, count, whole=True)
    joints = _stacked(rest_joints, 2, batch, count)
    places = _stacked(trans, 1, batch, count, whole=True)
    motions, posed, entries = joint_motions(pose, joints, np.array(parents))
    coefficients = [] if shaped is not None else [_stacked(betas, 1, batch, count, whole=True)]
    local = None
    if rows.posedirs is not None:
        rotations = entries.reshape(*pose.shape, 3) + np.eye(3, dtype=pose.dtype)
        moved = pose_coefficients(*driven, pose, rotations, _stacked(betas, 1, batch, count))
        local = None if rows.local is None else (rows.local, np.ascontiguousarray(moved))
        coefficients += [] if local else [moved]
    base = to_numpy(rows.template if shaped is None else shaped)
    bases = to_numpy(rows.blend_shapes)
    bases = bases[0 if shaped is None else rows.num_shapes : rows.num_shapes if local else None]
    together = (
        np.concatenate(coefficients, axis=-1) if coefficients else np.zeros((count, 0), pose.dtype)
    )
    index = to_numpy(rows.influences.index)
    value = to_numpy(rows.influences.value)
    vertices = posed_vertices(base, together, bases, motions, places, index, value, skinning, local)
    posed += places[:, None]
    return tuple(
        _in_kind(points.reshape(*batch, points.shape[1], 3), kind) for points in (vertices, posed)
    )  # pyright: ignore


def _stacked(
    array: Array, axes: int, batch: tuple[int, ...], count: int, whole: bool = False
) -> np.ndarray:
    """The batch axes as one: of length 1 where all of a batch share the values (unless ``whole``),
    else ``count``.
    """
    plain = to_numpy(array)
    last = array.shape[array.ndim - axes :]
    if not whole and plain.size == np.prod(last, dtype=int):
        return plain.reshape(1, *last)
    return np.ascontiguousarray(np.broadcast_to(plain, (*batch, *last))).reshape(count, *last)


def _in_kind(array: np.ndarray, kind: Kind) -> Array:
    return array if kind.xp is np else kind.xp.from_numpy(array)
