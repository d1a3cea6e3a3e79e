"""The body: the function from shape, pose and place to a surface, over its arrays (SMPL: S 3, eqs.
5 to 12).
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from difflib import get_close_matches
from functools import cached_property, partial
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from habitus.arrays import Kind, broadcast_shapes, kind_of, to_numpy, unflatten
from habitus.body.body_arrays import ADULT, BodyArrays, add_blend_shapes
from habitus.body.draws import skewed_along
from habitus.body.face import read_face_weights
from habitus.body.joint_layouts import fold, folded_weights
from habitus.body.keypoints import keypoints
from habitus.body.measurements import Measured
from habitus.body.pose_features import of_joints
from habitus.body.prepared import PreparedBody
from habitus.body.state import BodyState, BodySurface
from habitus.errors import HabitusError
from habitus.types import Array, ArrayLike


@dataclass(frozen=True, eq=False)
class BodyModel(BodyArrays, Measured):
    """An immutable body model in metres, y up, facing +z, x to the body's left, resting in the zero
    pose.

    Its arrays are NumPy's, float64 and int64. What it computes comes in the kind of what it is
    given: torch tensors, in their dtype, on their device and with gradients, for torch tensors;
    float32 for NumPy arrays of float32; float64 for everything else (`habitus.arrays.kind_of`).
    Copies of its arrays in other kinds are made when first needed.

    ``posedirs`` may be absent. They are linear in the features, of the kind ``pose_features`` (k
    numbers each, see `habitus.body.pose_features`; SMPL's "rotations" have k = 9), of
    ``pose_joints`` (P joints in that order; None: all but the root, as in SMPL) and in their
    products with each of the first s = ``shape_features`` shape coefficients: F is P k (1 + s),
    block after block. ``hinges`` add what deep folds need besides (`habitus.body.pose_features`).
    ``joint_regressor`` takes shaped rest vertices to joints. ``skinning_index``
    and ``skinning_value`` hold the K strongest joints of each vertex and their weights (K = 4 for
    SMPL); a weight of 0 fills up. ``expressiondirs`` move the face and nothing else, apart from
    shape; ``face`` holds named units and components of identity (`habitus.body.face`);
    ``dynamics`` are blend shapes of soft tissue in motion, and what predicts them
    (`habitus.body.dynamics`). ``landmarks`` name vertices; ``part`` gives each vertex its strongest
    joint; ``mirror`` its partner across the body; ``mesh`` what there is besides triangles;
    ``pockets`` which vertices nobody sees, inside mouth and eyes (None: not known);
    ``ages`` how the mean person of other ages differs, ``age`` the one it was brought to
    (`at_age`). ``female_direction``, weights and bias, gives the log odds of a woman from the betas
    (`habitus.body.gender`), row n - 1 of ``female_rows`` those from the first n alone.
    ``people_mean`` are the betas of the mean person that a survey measured, where that is not the
    template; ``people_skew`` is the direction of betas along which people are skewed, as
    long as their skewness (`draw_betas`).

    A coarse body may know the ``full`` one, whose vertex ``full_vertices[k]`` is its own vertex k:
    the same person with more vertices, which ``finer()`` makes when it is first asked for.
    `with_betas`, `with_joints` and `at_age` change both; a body that is changed by itself has no
    full one any more, as that would be another. ``extras`` are arrays of a model file that the body
    function does not use, kept for whoever saves the body again.
    """

    @cached_property
    def full(self) -> "BodyModel | None":
        """The body of the full level of detail; None where there is none, or where this is no
        longer the same body.
        """
        finer = None if self.finer is None else self.finer()
        return finer if finer is not None and in_step(self, finer, self.full_vertices) else None

    def with_betas(self, count: int) -> "BodyModel":
        """The same body with its first ``count`` shape directions only (they are sorted by
        variance).

        Raises HabitusError where there are not as many, or fewer than pose blend shapes depend on.
        """
        if not 0 < count <= self.num_betas:
            raise HabitusError(
                f"{count} shape directions asked of {self.name}; expected 1 to {self.num_betas}"
            )
        if self.posedirs is not None and count < self.shape_features:
            raise HabitusError(
                f"{count} shape directions asked of {self.name}, whose pose blend shapes depend "
                "on the first "
                f"{self.shape_features}; ask for {self.shape_features} to {self.num_betas}"
            )
        female, rows = _sex_classifiers(self.female_direction, self.female_rows, count)
        return replace(
            self,
            shapedirs=np.ascontiguousarray(self.shapedirs[..., :count]),
            female_direction=female,
            female_rows=rows,
            people_mean=None if self.people_mean is None else self.people_mean[:count],
            people_skew=None if self.people_skew is None else self.people_skew[:count],
            shape_features=min(count, self.shape_features),
            hinges=None if self.hinges is None else self.hinges.with_shapes(count),
            finer=then(self.finer, "with_betas", count),
        )

    def with_joints(self, joints: str) -> "BodyModel":
        """The same body with the joints of "smpl" (24), "smplh" (52: fingers) or "smplx" (55: jaw
        and eyes, too).

        A joint that is left out rides on the one it hangs on, fingers on the hand, which stands
        where the middle finger begins; what it drove of the pose blend shapes goes. Raises
        HabitusError where the body has not those joints.
        """
        way = fold(self.joint_names, self.parents, joints, self.name)
        if way.layout.joint_names == self.joint_names:
            return self
        drivers = tuple(joint for joint in self.drivers if joint in way.kept)
        posedirs = self.posedirs
        if posedirs is not None:
            given = self.features.per_joint, tuple(self.drivers)
            posedirs = of_joints(posedirs, *given, drivers, self.shape_features)
        index, value = folded_weights(way.carries, self.skinning_index, self.skinning_value)
        return replace(
            self,
            joint_names=way.layout.joint_names,
            parents=way.layout.parents,
            joint_regressor=self.joint_regressor[list(way.stands)],
            skinning_index=index,
            skinning_value=value,
            part=None if self.part is None else np.asarray(way.carries)[self.part],
            posedirs=posedirs,
            pose_joints=tuple(way.kept[joint] for joint in drivers),
            hinges=None if self.hinges is None else self.hinges.with_joints(dict(way.kept)),
            face=None
            if self.face is None
            else self.face.with_joints(
                way.kept, self.v_template, self.joint_template, self.skinning_weights
            ),
            finer=then(self.finer, "with_joints", joints),
        )

    def at_age(self, years: float | int) -> "BodyModel":
        """The body whose template is the mean person of that age. Shapes vary about it in
        proportion to its stature, and less among small children (`Ages.spreads`).

        Straight lines lead from one known age to the next. Who tells sexes apart by adults' shapes
        cannot tell children's: below `ADULT` years there is no ``female_direction``. Raises
        HabitusError for a body that knows of no ages or has one already, and for an age beyond
        those it knows.
        """
        if self.age is not None:
            raise HabitusError(
                f"{self.called} cannot be brought to {years:g}; begin with one without an age"
            )
        if self.ages is None:
            raise HabitusError(
                f"{self.name} knows of no ages; the bodies neutral, female and male do"
            )
        offset, scale, shapes = self.ages.at(years)
        grown = years >= ADULT
        return replace(
            self,
            female_direction=self.female_direction if grown else None,
            female_rows=self.female_rows if grown else None,
            people_mean=self.people_mean if grown else None,
            people_skew=self.people_skew if grown else None,
            age=float(years),
            v_template=self.v_template + offset,
            shapedirs=shapes * self.shapedirs,
            posedirs=None if self.posedirs is None else scale * self.posedirs,
            hinges=None if self.hinges is None else self.hinges.scaled(scale),
            dynamics=None if self.dynamics is None else self.dynamics.scaled(scale),
            face=None if self.face is None else self.face.scaled(scale),
            ages=None,
            finer=then(self.finer, "at_age", years),
        )

    def state(self, *batch: int) -> BodyState:
        """The template at rest at the origin: zeros, float64."""
        return BodyState(
            *(np.zeros((*batch, *last)) for last in ((self.num_betas,), (self.num_joints, 3), (3,)))
        )

    def draw_betas(self, count: int, rng: np.random.Generator) -> Float[np.ndarray, "count B"]:
        """Betas of people drawn at random: zero mean, unit variance, skewed as the waists of the
        people that the body was made of (more are much wider than the mean than much slimmer);
        normal where the body has no ``people_skew``.
        """
        normal = rng.normal(size=(count, self.num_betas))
        return normal if self.people_skew is None else skewed_along(normal, self.people_skew)

    def rest_vertices(self, betas: ArrayLike = ()) -> Float[Array, "*batch V 3"]:
        """Shaped vertices (m) in the rest pose (eq. 8), without pose blend shapes; ``betas`` as in
        a call.
        """
        betas = self._betas(betas, kind := kind_of(betas))
        single = kind.xp is np and betas.ndim == 1
        person = kind, betas.tobytes() if single else b""
        last, known = self._cache.get("rest", (None, None))
        if single and last == person and known is not None:
            return known.copy()  # each term of a fit asks for the same person
        rows = self._rows(kind)
        vertices = unflatten(add_blend_shapes(rows.template, betas, rows.shapedirs), -1, (3, -1)).mT
        vertices = np.ascontiguousarray(vertices) if kind.xp is np else vertices.contiguous()
        if single:
            self._cache["rest"] = person, vertices.copy()
        return vertices

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
        expression: ArrayLike | None = None,
        dynamics: ArrayLike | None = None,
        face: ArrayLike | Mapping[str, ArrayLike] | None = None,
        face_betas: ArrayLike | None = None,
    ) -> BodySurface:
        """The surface M(betas, pose) of eq. 11, moved by ``trans`` (m); batch axes broadcast.

        ``betas`` (*batch, B) may be shorter: the others are zero, as is everything not given.
        ``pose`` holds rotation vectors (rad) relative to the parent joint, (*batch, J, 3) with the
        root first, or (*batch, 3) by the names of some joints. ``vertices`` (N ids) evaluates only
        those rows, in that order. ``soft_tissue`` (*batch, B) adds to ``betas``, joints included (M
        6). ``expression`` (*batch, E), which may be shorter, too, moves the face, ``dynamics``
        (*batch, D) soft tissue and no joint (S eq. 16; `habitus.simulate_soft_tissue`). ``face``
        holds weights of the face's units (`face_unit_names`: ARKit's names), (*batch, U) of all or
        (*batch,) by name, usually 0 to 1; units turn jaw and eyes, too. ``face_betas`` (*batch, I),
        which may be shorter, are components of the face's identity, in standard deviations. Raises
        HabitusError where a shape or a name is not the model's.
        """
        angles = pose.values() if isinstance(pose, Mapping) else (pose,)
        units = face.values() if isinstance(face, Mapping) else (face,)
        given = expression, dynamics, face_betas
        kind = kind_of(betas, *angles, trans, soft_tissue, *given, *units)
        shape = person = self._betas(() if betas is None else betas, kind)
        if soft_tissue is not None:
            shape = person + self._betas(soft_tissue, kind, "soft_tissue")
        surface = self.prepare(shape, vertices, expression, dynamics, face, face_betas)(pose, trans)
        return surface if soft_tissue is None else replace(surface, betas=person)

    def prepare(
        self,
        betas: ArrayLike = (),
        vertices: ArrayLike | None = None,
        expression: ArrayLike | None = None,
        dynamics: ArrayLike | None = None,
        face: ArrayLike | Mapping[str, ArrayLike] | None = None,
        face_betas: ArrayLike | None = None,
    ) -> PreparedBody:
        """This body with its shape fixed (one, or one for each of a batch) and, if asked, only some
        of its vertices.
        """
        units = face.values() if isinstance(face, Mapping) else (face,)
        kind = kind_of(betas, expression, dynamics, face_betas, *units)
        shape = self._betas(betas, kind)
        ids = None if vertices is None else read_vertices(vertices, self.num_vertices, self.name)
        parts = [shape]
        of_face = face is not None or face_betas is not None
        if expression is not None or dynamics is not None or of_face:
            mimic = () if expression is None else expression
            parts.append(read_betas(mimic, kind, self.num_expressions, "expression", self.name))
        if dynamics is not None or of_face:
            moving = () if dynamics is None else dynamics
            parts.append(read_dynamics(moving, kind, self.num_dynamics, self.name))
        if of_face:
            identity = () if face_betas is None else face_betas
            parts.append(read_betas(identity, kind, self.num_face_betas, "face_betas", self.name))
            parts.append(
                read_face_weights({} if face is None else face, kind, self.face, self.name)
            )
        if len(parts) > 1:
            batch = broadcast_shapes(*(part.shape[:-1] for part in parts))
            shape = kind.xp.concatenate(
                [kind.xp.broadcast_to(part, (*batch, part.shape[-1])) for part in parts], -1
            )
        rows = self._rows(kind, ids, shape.shape[-1])
        return PreparedBody(self, rows, self._in(kind).rest_joints(shape), shape, kind, ids)

    def keypoints(self, convention: str, surface: BodySurface) -> Float[Array, "*batch K 3"]:
        """The points (m) that a detector of people names: "coco17", "openpose25", "body25b",
        "halpe26" or "wholebody23" (`habitus.body.keypoints`).

        ``surface`` is this body's, with all its vertices. Raises HabitusError for other names, and
        for a body without the landmarks that they need.
        """
        return keypoints(
            convention, surface, self.joint_names, self.landmarks, self.num_vertices, self.name
        )

    def full_pose(
        self, values: ArrayLike | Mapping[str, ArrayLike] | None, kind: Kind
    ) -> Float[Array, "*batch J 3"]:
        """A pose as it may be given in a call, as rotation vectors (rad) of all joints in one
        kind.
        """
        return read_pose(values, kind, self.joint_names, self.name)

    def full_trans(self, values: ArrayLike | None, kind: Kind) -> Float[Array, "*batch 3"]:
        """A translation as it may be given in a call, (m) in one kind; zero where it is None."""
        return (
            kind.zeros(3)
            if values is None
            else read_vectors(values, kind, (3,), "trans", self.name)
        )

    def _betas(
        self, values: ArrayLike, kind: Kind, name: str = "betas"
    ) -> Float[Array, "*batch B"]:
        return read_betas(values, kind, self.num_betas, name, self.name)


def read_betas(
    values: ArrayLike, kind: Kind, count: int, name: str, body: str
) -> Float[Array, "*batch B"]:
    """``count`` shape coefficients, with zeros for those that are not given; HabitusError where
    there are more.
    """
    betas = kind.array(values)
    missing = count - betas.shape[-1] if betas.ndim else -1
    if missing < 0:
        raise HabitusError(
            f"{name} has shape {tuple(betas.shape)}; expected (*batch, {count}) or fewer for {body}"
        )
    return (
        kind.xp.concatenate([betas, kind.zeros(*betas.shape[:-1], missing)], -1)
        if missing
        else betas
    )


def read_dynamics(values: ArrayLike, kind: Kind, count: int, body: str) -> Float[Array, "*batch D"]:
    """As `read_betas`, of dynamic blend shapes; HabitusError that says so where the body has
    none.
    """
    given = kind.array(values)
    if not count and given.shape[-1:] != (0,):
        raise HabitusError(
            f"dynamics of shape {tuple(given.shape)} given to {body}, which has no dynamic blend "
            "shapes; take a body "
            "that has some, or learn them: habitus train-dynamics"
        )
    return read_betas(given, kind, count, "dynamics", body)


def read_pose(
    values: ArrayLike | Mapping[str, ArrayLike] | None,
    kind: Kind,
    joint_names: tuple[str, ...],
    body: str,
) -> Float[Array, "*batch J 3"]:
    """Rotation vectors (rad) of all joints, from those of all or those of some by name; the others
    are zero.
    """
    if values is None:
        return kind.zeros(len(joint_names), 3)
    if not isinstance(values, Mapping):
        return read_vectors(values, kind, (len(joint_names), 3), "pose", body)
    if unknown := [name for name in values if name not in joint_names]:
        near = get_close_matches(str(unknown[0]), joint_names, cutoff=0.4) or joint_names
        raise HabitusError(f"{body} has no joint {unknown[0]!r}; did you mean {', '.join(near)}?")
    named = {
        name: read_vectors(value, kind, (3,), f"pose[{name!r}]", body)
        for name, value in values.items()
    }
    batch = broadcast_shapes(*(value.shape[:-1] for value in named.values()))
    rest = kind.zeros(3)
    return kind.xp.stack(
        [kind.xp.broadcast_to(named.get(name, rest), (*batch, 3)) for name in joint_names], -2
    )


def read_vectors(
    values: ArrayLike, kind: Kind, last: tuple[int, ...], name: str, body: str
) -> Array:
    """Numbers whose last axes are ``last``; HabitusError where they are not."""
    array = kind.array(values)
    if tuple(array.shape[-len(last) :]) != last:
        expected = ", ".join(map(str, last))
        raise HabitusError(
            f"{name} has shape {tuple(array.shape)}; expected (*batch, {expected}) for {body}"
        )
    return array


def read_vertices(values: ArrayLike, count: int, body: str) -> Int[np.ndarray, " N"]:
    """Vertex numbers of a body with ``count``; HabitusError where they are none of its."""
    ids = to_numpy(values)
    if ids.ndim != 1 or (len(ids) and ids.dtype.kind not in "iu"):
        raise HabitusError(
            f"vertices are {ids.dtype} of shape {ids.shape}; expected vertex numbers (N,); of a "
            "mask, its nonzero()"
        )
    if len(ids) and not (ids.min() >= 0 and ids.max() < count):
        raise HabitusError(
            f"vertices run from {ids.min()} to {ids.max()}; {body} has vertices 0 to {count - 1}"
        )
    return ids.astype(np.int64)


_SAMPLES = 64
_ALIKE = (
    "parents",
    "joint_names",
    "skinning",
    "pose_features",
    "shape_features",
    "pose_joints",
    "num_betas",
)
_ARRAYS = ("shapedirs", "posedirs", "expressiondirs", "skinning_value")


def in_step(coarse: Any, full: Any, rows: Int[np.ndarray, " V"] | None) -> bool:
    """Whether a body and its full level are one: vertex k of the coarse is vertex ``rows[k]`` of
    the full.

    The template is compared whole, what moves it at a sample of the vertices.
    """
    if (
        rows is None
        or len(rows) != len(coarse.v_template)
        or rows.max(initial=-1) >= len(full.v_template)
    ):
        return False
    if any(getattr(coarse, name) != getattr(full, name) for name in _ALIKE):
        return False
    if not np.array_equal(coarse.v_template, full.v_template[rows]):
        return False
    some = np.linspace(0, len(rows) - 1, min(_SAMPLES, len(rows))).astype(np.int64)
    for name in _ARRAYS:
        ours = getattr(coarse, name)
        theirs = getattr(full, name)
        if (ours is None) != (theirs is None):
            return False
        if ours is not None and not np.array_equal(ours[some], theirs[rows[some]]):
            return False
    return _same_hinges(coarse.hinges, full.hinges, some, rows) and _same_dynamics(
        coarse.dynamics, full.dynamics, some, rows
    )


def _same_hinges(coarse: Any, full: Any, some: np.ndarray, rows: np.ndarray) -> bool:
    if coarse is None or full is None:
        return coarse is full
    return np.array_equal(coarse.rows, full.rows) and np.array_equal(
        coarse.directions[some], full.directions[rows[some]]
    )


def _same_dynamics(coarse: Any, full: Any, some: np.ndarray, rows: np.ndarray) -> bool:
    if coarse is None or full is None:
        return coarse is full
    if not np.array_equal(coarse.directions[some], full.directions[rows[some]]):
        return False
    return np.array_equal(coarse.regressor.drive, full.regressor.drive)


def then(finer: Callable[[], Any] | None, change: str, *arguments: Any) -> Callable[[], Any] | None:
    """What makes the full level, followed by one of its methods that gives another body."""
    return None if finer is None else partial(_then, finer, change, arguments)


def _then(finer: Callable[[], Any], change: str, arguments: tuple[Any, ...]) -> Any:
    return getattr(finer(), change)(*arguments)


def _sex_classifiers(
    direction: tuple[Float[np.ndarray, " B"], float] | None,
    rows: tuple[Float[np.ndarray, "B B"], Float[np.ndarray, " B"]] | None,
    count: int,
) -> tuple[
    tuple[Float[np.ndarray, " n"], float] | None,
    tuple[Float[np.ndarray, "n n"], Float[np.ndarray, " n"]] | None,
]:
    """The classifier of sex (log odds of a woman, weights . betas + bias) of the first ``count``
    betas, and those of fewer.

    Where none was fitted to this number of betas, the weights of the others are left out, which
    makes the classifier less accurate and overconfident.
    """
    if rows is None:
        return (None, None) if direction is None else ((direction[0][:count], direction[1]), None)
    weights, bias = rows
    return (weights[count - 1, :count], float(bias[count - 1])), (
        weights[:count, :count],
        bias[:count],
    )
