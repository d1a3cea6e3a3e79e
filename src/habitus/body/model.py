"""The body: arrays, and the function from shape, pose and place to a surface (SMPL: S 3, eqs. 5 to 12)."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from types import MappingProxyType

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from habitus.arrays import broadcast_shapes
from habitus.body.blend_shapes import add_blend_shapes, flat_rows
from habitus.body.kinematics import skinning_motions, world_motions
from habitus.body.pose_features import PoseFeatures, extended, find_pose_features
from habitus.body.skinning import SKINNING, Influences, skin
from habitus.body.state import BodyState, BodySurface, PosePrior
from habitus.errors import HabitusError
from habitus.mesh.joint_tree import check_parents
from habitus.rotations import matrix_from_rotvec

Vertices = Int[Tensor, " N"] | Int[np.ndarray, " N"] | Sequence[int]


@dataclass(frozen=True, eq=False)
class BodyModel:
    """An immutable body model in metres, y up, facing +z, x to the body's left, resting in the zero pose.

    ``posedirs`` may be absent. They are linear in the joints' features of the kind ``pose_features`` (k numbers each,
    see `habitus.body.pose_features`; SMPL's "rotations" have k = 9) and in their products with each of the first s =
    ``shape_features`` shape coefficients: F is (J - 1) k (1 + s), block after block. ``joint_regressor`` takes shaped
    rest vertices to joints. ``skinning_index`` and ``skinning_value`` hold the K strongest joints of each vertex and
    their weights (K = 4 for SMPL); a weight of 0 fills up. ``landmarks`` name vertices; ``part`` gives each vertex its
    strongest joint; ``mirror`` its partner across the body. ``extras`` are arrays of a model file that the body
    function does not use, kept for whoever saves the body again.
    """

    name: str
    v_template: Float[Tensor, "V 3"]
    shapedirs: Float[Tensor, "V 3 B"]
    posedirs: Float[Tensor, "V 3 F"] | None
    joint_regressor: Float[Tensor, "J V"]
    skinning_index: Int[Tensor, "V K"]
    skinning_value: Float[Tensor, "V K"]
    parents: tuple[int, ...]
    faces: Int[Tensor, "T 3"]
    joint_names: tuple[str, ...]
    skinning: str = "lbs"
    pose_features: str = "rotations"
    shape_features: int = 0
    landmarks: Mapping[str, int] = field(default_factory=lambda: MappingProxyType({}))
    part: Int[Tensor, " V"] | None = None
    mirror: Int[Tensor, " V"] | None = None
    pose_prior: PosePrior | None = None
    female_direction: tuple[Float[Tensor, " B"], float] | None = None
    extras: Mapping[str, np.ndarray] = field(default_factory=lambda: MappingProxyType({}))

    def __post_init__(self):
        check_parents(self.parents)
        if self.skinning not in SKINNING:
            raise HabitusError(f"skinning is {self.skinning!r}; expected one of {', '.join(SKINNING)}")
        if not 0 <= self.shape_features <= self.num_betas:
            raise HabitusError(
                f"shape_features is {self.shape_features}; expected 0 to {self.num_betas} shape coefficients"
            )
        found, count = self.posedirs, self.features.count(self.num_joints, self.shape_features)
        if found is not None and found.shape[-1] != count:
            raise HabitusError(
                f"posedirs has {found.shape[-1]} directions; expected {count}: {self.pose_features!r} of "
                f"{self.num_joints - 1} joints, with {self.shape_features} shape_features"
            )

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
    def dtype(self) -> torch.dtype:
        """The dtype that states are expected in."""
        return self.v_template.dtype

    @property
    def device(self) -> torch.device:
        """The device that states are expected on."""
        return self.v_template.device

    @cached_property
    def skinning_weights(self) -> Float[Tensor, "V J"]:
        """The skinning weights as a dense table."""
        dense = self.skinning_value.new_zeros(self.num_vertices, self.num_joints)
        return dense.scatter_add(1, self.skinning_index, self.skinning_value)

    @cached_property
    def _all_rows(self) -> "_Rows":
        return self._rows(slice(None))

    def _rows(self, ids: Int[Tensor, " N"] | slice) -> "_Rows":
        index, value, dense = self.skinning_index[ids], self.skinning_value[ids], self.skinning_weights[ids]
        return _Rows(
            template=self.v_template[ids].T.flatten(),
            shapedirs=flat_rows(self.shapedirs[ids]),
            posedirs=None if self.posedirs is None else flat_rows(self.posedirs[ids]),
            influences=Influences(dense.T.contiguous(), index, value),
        )

    @cached_property
    def _joint_template(self) -> Float[Tensor, "J 3"]:
        return self.joint_regressor @ self.v_template

    @cached_property
    def joint_shapedirs(self) -> Float[Tensor, "J 3 B"]:
        """How the rest joints move with the shape coefficients: the regressor applied to the shape directions."""
        return (self.joint_regressor @ self.shapedirs.flatten(1)).unflatten(1, (3, -1))

    def to(self, dtype: torch.dtype | None = None, device: torch.device | str | None = None) -> "BodyModel":
        """The same body in another floating dtype or on another device."""
        changed = {}
        for item in fields(self):
            value = getattr(self, item.name)
            if isinstance(value, Tensor):
                changed[item.name] = value.to(device=device, dtype=dtype if value.is_floating_point() else None)
            elif isinstance(value, PosePrior):
                changed[item.name] = value.to(dtype, device)
        if self.female_direction is not None:
            changed["female_direction"] = (
                self.female_direction[0].to(dtype=dtype, device=device),
                self.female_direction[1],
            )
        return replace(self, **changed)

    def with_betas(self, count: int) -> "BodyModel":
        """The same body with its first ``count`` shape directions only (they are sorted by variance).

        Raises HabitusError where there are not as many, or fewer than pose blend shapes depend on.
        """
        if not 0 < count <= self.num_betas:
            raise HabitusError(f"{count} shape directions asked of {self.name}; expected 1 to {self.num_betas}")
        if self.posedirs is not None and count < self.shape_features:
            raise HabitusError(
                f"{count} shape directions asked of {self.name}, whose pose blend shapes depend on the first "
                f"{self.shape_features}; ask for {self.shape_features} to {self.num_betas}"
            )
        female = self.female_direction and (self.female_direction[0][:count], self.female_direction[1])
        return replace(
            self,
            shapedirs=self.shapedirs[..., :count].contiguous(),
            female_direction=female,
            shape_features=min(count, self.shape_features),
        )

    def rest_vertices(self, betas: Float[Tensor, "*batch B"]) -> Float[Tensor, "*batch V 3"]:
        """Shaped vertices (m) in the rest pose (eq. 8), without pose blend shapes."""
        shaped = add_blend_shapes(
            self._all_rows.template, self._checked(betas, "betas", (self.num_betas,)), self._all_rows.shapedirs
        )
        return shaped.unflatten(-1, (3, -1)).mT.contiguous()

    def rest_joints(self, betas: Float[Tensor, "*batch B"]) -> Float[Tensor, "*batch J 3"]:
        """Joints (m) of the shaped rest surface (eq. 10)."""
        return self._joint_template + (self.joint_shapedirs @ betas[..., None, :, None]).squeeze(-1)

    def zero_state(self, *batch: int) -> BodyState:
        """The template at rest at the origin, in the model's dtype and on its device."""
        zeros = self.v_template.new_zeros
        return BodyState(zeros(*batch, self.num_betas), zeros(*batch, self.num_joints, 3), zeros(*batch, 3))

    def __call__(
        self,
        betas: Float[Tensor, "*#batch B"],
        pose: Float[Tensor, "*#batch J 3"],
        trans: Float[Tensor, "*#batch 3"] | None = None,
        *,
        vertices: Vertices | None = None,
        soft_tissue: Float[Tensor, "*#batch B"] | None = None,
    ) -> BodySurface:
        """The surface M(betas, pose) of eq. 11, moved by ``trans`` (m); batch axes broadcast.

        ``pose`` holds rotation vectors (rad) relative to the parent joint, root first. ``vertices`` (ids) evaluates
        only those rows, in that order. ``soft_tissue`` adds to ``betas``, joints included (M 6). Raises HabitusError
        where a shape is not the model's.
        """
        shape = betas if soft_tissue is None else betas + soft_tissue
        return self.prepare(shape, vertices)(pose, trans)

    def prepare(self, betas: Float[Tensor, "*batch B"], vertices: Vertices | None = None) -> "PreparedBody":
        """This body with its shape fixed (one, or one for each of a batch) and, if asked, only some of its vertices."""
        betas = self._checked(betas, "betas", (self.num_betas,))
        rows = self._all_rows if vertices is None else self._rows(self._vertex_ids(vertices))
        shaped = add_blend_shapes(rows.template, betas, rows.shapedirs)
        return PreparedBody(self, rows, shaped, self.rest_joints(betas), betas[..., : self.shape_features])

    def _vertex_ids(self, vertices: Vertices) -> Int[Tensor, " N"]:
        ids = torch.as_tensor(vertices, device=self.device)
        if len(ids) and (ids.is_floating_point() or ids.dtype == torch.bool):
            raise HabitusError(f"vertices are {ids.dtype}; expected vertex numbers (of a mask, take mask.nonzero())")
        ids = ids.long()
        if len(ids) and not (int(ids.min()) >= 0 and int(ids.max()) < self.num_vertices):
            raise HabitusError(
                f"vertices run from {ids.min()} to {ids.max()}; {self.name} has vertices 0 to {self.num_vertices - 1}"
            )
        return ids

    def _checked(self, value: Tensor, name: str, last: tuple[int, ...]) -> Tensor:
        if tuple(value.shape[-len(last) :]) != last:
            raise HabitusError(
                f"{name} has shape {tuple(value.shape)}; expected (*batch, {', '.join(map(str, last))}) for {self.name}"
            )
        if value.dtype != self.dtype:
            raise HabitusError(
                f"{name} is {value.dtype}; the body {self.name} is {self.dtype}: convert one, body.to(dtype=…)"
            )
        return value


@dataclass(frozen=True)
class _Rows:
    """The arrays of some vertices, laid out for speed: bases as rows (K, 3N), coordinates before vertices."""

    template: Float[Tensor, " M"]
    shapedirs: Float[Tensor, "B M"]
    posedirs: Float[Tensor, "F M"] | None
    influences: Influences


@dataclass(frozen=True, eq=False)
class PreparedBody:
    """A body with fixed shape, for many poses: ``prepared(pose, trans)``.

    ``betas`` are the shape coefficients that pose blend shapes depend on.
    """

    model: BodyModel
    rows: _Rows
    shaped: Float[Tensor, "*shapes M"]
    rest_joints: Float[Tensor, "*shapes J 3"]
    betas: Float[Tensor, "*shapes S"]

    def __call__(
        self, pose: Float[Tensor, "*#batch J 3"], trans: Float[Tensor, "*#batch 3"] | None = None
    ) -> BodySurface:
        """The surface in this pose (rotation vectors, rad), moved by ``trans`` (m)."""
        model = self.model
        pose = model._checked(pose, "pose", (model.num_joints, 3))
        place = self.shaped.new_zeros(3) if trans is None else model._checked(trans, "trans", (3,))
        batch = broadcast_shapes(pose.shape[:-2], self.shaped.shape[:-1], place.shape[:-1])
        rotations = matrix_from_rotvec(pose).expand(*batch, model.num_joints, 3, 3)
        rest_joints = self.rest_joints.expand(*batch, model.num_joints, 3)
        world = world_motions(rotations, rest_joints, model.parents)
        rest = self.shaped
        if self.rows.posedirs is not None:
            feature = model.features.of_pose(pose.expand(*batch, model.num_joints, 3), rotations)
            rest = add_blend_shapes(rest, extended(feature, self.betas, model.shape_features), self.rows.posedirs)
        motions = skinning_motions(world, rest_joints)
        vertices = skin(model.skinning, rest.unflatten(-1, (3, -1)), motions, place, self.rows.influences)
        return BodySurface(vertices, world[..., 3] + place[..., None, :])
