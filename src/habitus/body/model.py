"""The body: arrays, and the function from shape, pose and place to a surface (SMPL: S 3, eqs. 5 to 12)."""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from types import MappingProxyType

import numpy as np
from jaxtyping import Float, Int

from habitus.arrays import Kind, broadcast_shapes, kind_of, to_numpy, unflatten
from habitus.body.blend_shapes import add_blend_shapes
from habitus.body.fast import are_plain, posed_surface
from habitus.body.inputs import check_pose_shapes, read_betas, read_pose, read_vectors, read_vertices
from habitus.body.kinematics import skinning_motions, world_motions
from habitus.body.measured import Measured
from habitus.body.pose_features import PoseFeatures, extended, find_pose_features
from habitus.body.prior import PosePrior
from habitus.body.skinning import SKINNING, skin
from habitus.body.state import BodyState, BodySurface
from habitus.body.views import RestSkeleton, VertexRows, vertex_rows
from habitus.errors import HabitusError
from habitus.mesh.joint_tree import check_parents
from habitus.rotations import matrix_from_rotvec
from habitus.types import Array, ArrayLike

_NUMBERS = ("v_template", "shapedirs", "posedirs", "joint_regressor", "skinning_value")
_WHOLE_NUMBERS = ("skinning_index", "faces", "part", "mirror")


@dataclass(frozen=True, eq=False)
class BodyModel(Measured):
    """An immutable body model in metres, y up, facing +z, x to the body's left, resting in the zero pose.

    Its arrays are NumPy's, float64 and int64. What it computes comes in the kind of what it is given: torch tensors, in
    their dtype, on their device and with gradients, for torch tensors; float32 for NumPy arrays of float32; float64 for
    everything else (`habitus.arrays.kind_of`). Copies of its arrays in other kinds are made when first needed.

    ``posedirs`` may be absent. They are linear in the joints' features of the kind ``pose_features`` (k numbers each,
    see `habitus.body.pose_features`; SMPL's "rotations" have k = 9) and in their products with each of the first s =
    ``shape_features`` shape coefficients: F is (J - 1) k (1 + s), block after block. ``joint_regressor`` takes shaped
    rest vertices to joints. ``skinning_index`` and ``skinning_value`` hold the K strongest joints of each vertex and
    their weights (K = 4 for SMPL); a weight of 0 fills up. ``landmarks`` name vertices; ``part`` gives each vertex its
    strongest joint; ``mirror`` its partner across the body. ``extras`` are arrays of a model file that the body
    function does not use, kept for whoever saves the body again.
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
    extras: Mapping[str, np.ndarray] = field(default_factory=lambda: MappingProxyType({}))

    def __post_init__(self):
        for name in _NUMBERS + _WHOLE_NUMBERS:
            value, dtype = getattr(self, name), np.float64 if name in _NUMBERS else np.int64
            object.__setattr__(self, name, value if value is None else to_numpy(value, dtype))
        if self.female_direction is not None:
            direction, bias = self.female_direction
            object.__setattr__(self, "female_direction", (to_numpy(direction, np.float64), float(bias)))
        check_parents(self.parents)
        if self.skinning not in SKINNING:
            raise HabitusError(f"skinning is {self.skinning!r}; expected one of {', '.join(SKINNING)}")
        check_pose_shapes(self.posedirs, self.features, self.num_joints, self.num_betas, self.shape_features)

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

    @cached_property
    def skinning_weights(self) -> Float[np.ndarray, "V J"]:
        """The skinning weights as a dense table."""
        dense = np.zeros((self.num_vertices, self.num_joints))
        np.add.at(dense, (np.arange(self.num_vertices)[:, None], self.skinning_index), self.skinning_value)
        return dense

    @cached_property
    def joint_template(self) -> Float[np.ndarray, "J 3"]:
        """The joints (m) of the template."""
        return self.joint_regressor @ self.v_template

    @cached_property
    def joint_shapedirs(self) -> Float[np.ndarray, "J 3 B"]:
        """How the rest joints move with the shape coefficients: the regressor applied to the shape directions."""
        return np.tensordot(self.joint_regressor, self.shapedirs, 1)

    @cached_property
    def _cache(self) -> dict:
        """The body's arrays in the kinds that were asked for."""
        return {}

    def __getstate__(self) -> dict:
        return {item.name: getattr(self, item.name) for item in fields(self)}

    def _in(self, kind: Kind) -> RestSkeleton:
        if kind not in self._cache:
            with kind.lasting():
                arrays = kind.array(self.joint_template), kind.array(self.joint_shapedirs), kind.index(self.faces)
                self._cache[kind] = RestSkeleton(*arrays)
        return self._cache[kind]

    def _rows(self, kind: Kind, ids: Int[np.ndarray, " N"] | None = None) -> VertexRows:
        """The arrays of some vertices, or of all."""
        weights = self.skinning_weights, self.skinning_index, self.skinning_value
        arrays = self.v_template, self.shapedirs, self.posedirs, *weights
        if ids is not None:
            return vertex_rows(kind, ids, *arrays)
        if (kind, "rows") not in self._cache:
            with kind.lasting():
                self._cache[kind, "rows"] = vertex_rows(kind, slice(None), *arrays)
        return self._cache[kind, "rows"]

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
            shapedirs=np.ascontiguousarray(self.shapedirs[..., :count]),
            female_direction=female,
            shape_features=min(count, self.shape_features),
        )

    def state(self, *batch: int) -> BodyState:
        """The template at rest at the origin: zeros, float64."""
        return BodyState(*(np.zeros((*batch, *last)) for last in ((self.num_betas,), (self.num_joints, 3), (3,))))

    def rest_vertices(self, betas: ArrayLike = ()) -> Float[Array, "*batch V 3"]:
        """Shaped vertices (m) in the rest pose (eq. 8), without pose blend shapes; ``betas`` as in a call."""
        betas = self._betas(betas, kind := kind_of(betas))
        rows = self._rows(kind)
        vertices = unflatten(add_blend_shapes(rows.template, betas, rows.shapedirs), -1, (3, -1)).mT
        return np.ascontiguousarray(vertices) if kind.xp is np else vertices.contiguous()

    def rest_joints(self, betas: ArrayLike = ()) -> Float[Array, "*batch J 3"]:
        """Joints (m) of the shaped rest surface (eq. 10); ``betas`` as in a call."""
        betas = self._betas(betas, kind := kind_of(betas))
        return self._in(kind).rest_joints(betas)

    def __call__(
        self,
        betas: ArrayLike | None = None,
        pose: ArrayLike | Mapping[str, ArrayLike] | None = None,
        trans: ArrayLike | None = None,
        *,
        vertices: ArrayLike | None = None,
        soft_tissue: ArrayLike | None = None,
    ) -> BodySurface:
        """The surface M(betas, pose) of eq. 11, moved by ``trans`` (m); batch axes broadcast.

        ``betas`` (*batch, B) may be shorter: the others are zero, as is everything not given. ``pose`` holds rotation
        vectors (rad) relative to the parent joint, (*batch, J, 3) with the root first, or (*batch, 3) by the names of
        some joints. ``vertices`` (N ids) evaluates only those rows, in that order. ``soft_tissue`` (*batch, B) adds to
        ``betas``, joints included (M 6). Raises HabitusError where a shape or a name is not the model's.
        """
        angles = pose.values() if isinstance(pose, Mapping) else (pose,)
        kind = kind_of(betas, *angles, trans, soft_tissue)
        shape = person = self._betas(() if betas is None else betas, kind)
        if soft_tissue is not None:
            shape = person + self._betas(soft_tissue, kind, "soft_tissue")
        surface = self.prepare(shape, vertices)(pose, trans)
        return surface if soft_tissue is None else replace(surface, betas=person)

    def prepare(self, betas: ArrayLike = (), vertices: ArrayLike | None = None) -> "PreparedBody":
        """This body with its shape fixed (one, or one for each of a batch) and, if asked, only some of its vertices."""
        betas = self._betas(betas, kind := kind_of(betas))
        ids = None if vertices is None else read_vertices(vertices, self.num_vertices, self.name)
        return PreparedBody(self, self._rows(kind, ids), self._in(kind).rest_joints(betas), betas, kind, ids)

    def full_pose(self, values: ArrayLike | Mapping[str, ArrayLike] | None, kind: Kind) -> Float[Array, "*batch J 3"]:
        """A pose as it may be given in a call, as rotation vectors (rad) of all joints in one kind."""
        return read_pose(values, kind, self.joint_names, self.name)

    def _betas(self, values: ArrayLike, kind: Kind, name: str = "betas") -> Float[Array, "*batch B"]:
        return read_betas(values, kind, self.num_betas, name, self.name)


@dataclass(frozen=True, eq=False)
class PreparedBody:
    """A body with fixed shape, for many poses: ``prepared(pose, trans)``.

    ``rest_joints`` and ``shaped`` are in the kind of the betas.
    """

    model: BodyModel
    rows: VertexRows
    rest_joints: Float[Array, "*shapes J 3"]
    betas: Float[Array, "*shapes B"]
    kind: Kind
    vertices: Int[np.ndarray, " N"] | None
    given: Float[Array, "*shapes M"] | None = None
    """A rest surface in the place of that of the betas."""

    @cached_property
    def shaped(self) -> Float[Array, "*shapes M"]:
        """The rest surface (m) as rows of x, y and z."""
        if self.given is not None:
            return self.given
        return add_blend_shapes(self.rows.template, self.betas, self.rows.shapedirs)

    def __call__(
        self, pose: ArrayLike | Mapping[str, ArrayLike] | None = None, trans: ArrayLike | None = None
    ) -> BodySurface:
        """The surface in this pose (rotation vectors, rad; all joints or some by name), moved by ``trans`` (m)."""
        model, angles = self.model, pose.values() if isinstance(pose, Mapping) else (pose,)
        kind = kind_of(self.betas, *angles, trans)
        if kind != self.kind:
            return model.prepare(kind.array(self.betas), self.vertices)(pose, trans)
        pose = model.full_pose(pose, kind)
        place = kind.zeros(3) if trans is None else read_vectors(trans, kind, (3,), "trans", model.name)
        shapes = self.betas if self.given is None else self.given
        batch = broadcast_shapes(pose.shape[:-2], shapes.shape[:-1], place.shape[:-1])
        if self.given is None and are_plain(kind, pose, place, self.rest_joints, self.betas):
            one = self.shaped if self.betas.shape[:-1] == () else None
            driven = (model.features, self.betas, model.shape_features)
            rest = (self.rows, one, self.rest_joints, model.parents)
            surface = posed_surface(*rest, driven, model.skinning, pose, place, batch, kind)
            return BodySurface(*surface, model._in(kind).faces, self.betas)
        rotations = kind.xp.broadcast_to(matrix_from_rotvec(pose), (*batch, model.num_joints, 3, 3))
        rest_joints = kind.xp.broadcast_to(self.rest_joints, (*batch, model.num_joints, 3))
        feature = None
        if self.rows.posedirs is not None:
            feature = model.features.of_pose(kind.xp.broadcast_to(pose, (*batch, model.num_joints, 3)), rotations)
            feature = extended(feature, self.betas, model.shape_features)
        vertices, joints = self._surface(rotations, rest_joints, feature, place)
        return BodySurface(vertices, joints, model._in(kind).faces, self.betas)

    def _surface(
        self,
        rotations: Float[Array, "*batch J 3 3"],
        rest_joints: Float[Array, "*batch J 3"],
        feature: Float[Array, "*#batch F"] | None,
        place: Float[Array, "*#batch 3"],
    ) -> tuple[Float[Array, "*batch N 3"], Float[Array, "*batch J 3"]]:
        """Posed vertices and joints (m): pose blend shapes onto the shaped rest rows, kinematics, skinning, place."""
        world = world_motions(rotations, rest_joints, self.model.parents)
        rest = self.shaped
        if feature is not None:
            rest = add_blend_shapes(rest, feature, self.rows.posedirs)
        motions = skinning_motions(world, rest_joints)
        vertices = skin(self.model.skinning, unflatten(rest, -1, (3, -1)), motions, place, self.rows.influences)
        return vertices, world[..., 3] + place[..., None, :]
