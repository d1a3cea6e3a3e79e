"""Skin offsets of a person seen in depth views and scans, and the clothes that lie on the skin.

    "depth"  1/2 sum_p w_p (n_p . (q_p - t_p) + h_p + l_p)^2,    h = Z z
    "skin"   1/2 |z|^2

A thousand pixels of a belly determine betas hardly better than one does, and counted one by one
they bend the back, which no view shows, after the front. So the person's skin is off the model by h
(V,), one random field for all views (`habitus.fit.offsets`); Z (V, C) interpolates its values at C
vertices (Nystroem), z being independent with spread 1. l (V,) are clothes and hair, of known or
measured thickness. h is part of the person, l is not.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import coo_array, csr_array, diags_array

from habitus.body.jacobians import surface_jacobian
from habitus.body.model import BodyModel
from habitus.body.state import BodyState
from habitus.fit.offsets import (
    along_normals,
    field_basis,
    field_precision,
    motion_along,
    offset_spread,
)
from habitus.fit.points.correspondences import Footpads, hidden_vertices
from habitus.fit.points.depth_settings import RgbdSettings
from habitus.mesh.normals import vertex_normals
from habitus.mesh.proximity import farthest_points
from habitus.parallel.workers import map_on_threads
from habitus.residuals.points import PointObservations, points_on_surface
from habitus.solve.terms import Quadratic, Term


@dataclass(frozen=True, eq=False)
class SkinField:
    """The field's basis (V, C; m), none on the soles, which stand on the floor, the thickness of
    clothes and hair (V,; m), and that of measured hair alone (V,; m), of a body.
    """

    body: BodyModel
    basis: Float[np.ndarray, "V C"]
    layer: Float[np.ndarray, " V"]
    hair: Float[np.ndarray, " V"]

    @staticmethod
    def of(body: BodyModel, settings: RgbdSettings) -> "SkinField":
        """Laid out once for a body."""
        rest = body.rest_vertices(np.zeros(body.num_betas))
        hidden = hidden_vertices(body)
        spread = settings.skin * offset_spread(body)
        precision = field_precision(body.faces, rest, spread, settings.skin_reach)
        shown = np.arange(len(rest)) if hidden is None else np.flatnonzero(~hidden)
        places = shown[farthest_points(rest[shown], min(settings.skin_places, len(shown)))]
        basis = field_basis(precision, places)
        pads = Footpads.of(body)
        if pads is not None:
            basis[body.faces[pads.face, pads.corner]] = 0.0
        return SkinField(body, basis, clothing(body, settings), np.zeros(len(rest)))

    def with_hair(self, hair: Float[np.ndarray, " V"]) -> "SkinField":
        """With hair of a measured thickness (m)."""
        return replace(self, layer=np.maximum(self.layer, hair), hair=hair)

    @property
    def count(self) -> int:
        """C."""
        return self.basis.shape[1]

    def offset(self, numbers: Float[np.ndarray, " C"]) -> Float[np.ndarray, " V"]:
        """The skin's offset along normals (m)."""
        return self.basis @ numbers

    def seen(
        self, surfaces: Float[np.ndarray, "*K V 3"], numbers: Float[np.ndarray, " C"]
    ) -> Float[np.ndarray, "*K V 3"]:
        """Posed surfaces with skin and what is worn."""
        return along_normals(surfaces, self.offset(numbers) + self.layer, self.body)


def clothing(body: BodyModel, settings: RgbdSettings) -> Float[np.ndarray, " V"]:
    """Metres of tight clothes on trunk and thighs, and of hair above the brow and behind."""
    covered = cover_of(body, settings.clothed)
    return settings.clothes * covered + settings.hair * scalp(body, settings.hairline)


def cover_of(body: BodyModel, joints: Sequence[str]) -> Float[np.ndarray, " V"]:
    """How much of each vertex rides on joints, named without a side, that clothes cover; 0 of a
    body without a head.
    """
    names = body.joint_names
    if "head" not in names:
        return np.zeros(body.num_vertices)
    plain = [name.removeprefix("left_").removeprefix("right_") for name in names]
    covered = [k for k, name in enumerate(plain) if name in joints]
    return np.asarray(body.skinning_weights[:, covered].sum(1))


def scalp(body: BodyModel, hairline: float) -> Float[np.ndarray, " V"]:
    """1 on the head above the brow and behind, where hair grows, 0 elsewhere."""
    names = body.joint_names
    points = body.rest_vertices(np.zeros(body.num_betas))
    if "head" not in names:
        return np.zeros(len(points))
    head = body.skinning_weights[:, names.index("head")]
    joint = body.rest_joints(np.zeros(body.num_betas))[names.index("head")]
    top = points[head > 0.5, 1].max()
    share = (points[:, 1] - joint[1]) / (top - joint[1]) + np.maximum(
        joint[2] - points[:, 2], 0.0
    ) / 0.1
    return head * np.clip((share - hairline) / 0.2, 0.0, 1.0)


def scalp_at(
    scalp: Float[np.ndarray, " V"],
    corners: Int[np.ndarray, "N 3"],
    barycentric: Float[np.ndarray, "N 3"],
) -> Float[np.ndarray, " N"]:
    """How much hair may grow at points of the skin, 0..1, given how much at each vertex."""
    return np.minimum((scalp[corners] * barycentric).sum(1), 1.0)  # beyond 1 by rounding


def moved_back(
    observations: PointObservations,
    model: Float[np.ndarray, "V 3"],
    seen: Float[np.ndarray, "V 3"],
    body: BodyModel,
) -> PointObservations:
    """Observations of a surface with skin and clothes as ones of the model: targets move by what
    lies between.
    """
    between = points_on_surface(
        model - seen, body.faces, observations.face, observations.barycentric
    )
    return replace(observations, target=observations.target + between)


@dataclass(frozen=True, eq=False)
class SkinPlanes:
    """Points against planes in pose k of a state, with skin offsets (E_D of a view): with d (U,)
    the displacement of the correspondences' corners along the normals they have there,

        1/2 |S d + r|^2,    S^T S = lumped, S^T r = pull, |r|^2 = square

    used: those corners. basis: of the field there. jacobian: of their motion along normals by
    betas, trans and pose.
    """

    body: BodyModel
    state: BodyState
    k: int
    skin: Float[np.ndarray, " C"]
    used: Int[np.ndarray, " U"]
    normal: Float[np.ndarray, "U 3"]
    model: Float[np.ndarray, "U 3"]
    basis: Float[np.ndarray, "U C"]
    lumped: csr_array
    pull: Float[np.ndarray, " U"]
    square: float

    @staticmethod
    def of(
        field: SkinField,
        state: BodyState,
        k: int,
        skin: Float[np.ndarray, " C"],
        observations: PointObservations,
        model: Float[np.ndarray, "V 3"],
        seen: Float[np.ndarray, "V 3"],
    ) -> "SkinPlanes":
        """Of pose k. observations: on the surface ``seen``, one direction each, outward or inward.
        model: the surface without skin and clothes.
        """
        body = field.body
        face, share = observations.face, observations.barycentric
        used, corner = np.unique(body.faces[face], return_inverse=True)
        row = np.repeat(np.arange(len(face)), 3)
        table = coo_array((share.ravel(), (row, corner.ravel())), shape=(len(face), len(used)))
        difference = points_on_surface(seen, body.faces, face, share) - observations.target
        normal = vertex_normals(model, body.faces)
        direction = observations.directions[:, 0]
        outward = (points_on_surface(normal, body.faces, face, share) * direction).sum(1)
        residual = np.where(outward < 0.0, -1.0, 1.0) * (direction * difference).sum(1)
        root = np.linalg.norm(direction, axis=1)
        rows = csr_array(diags_array(root) @ table.tocsr())
        return SkinPlanes(
            body,
            state,
            k,
            skin,
            used,
            normal[used],
            model[used],
            field.basis[used],
            csr_array(rows.T @ rows),
            rows.T @ residual,
            float(residual @ residual),
        )

    def displacement(
        self, betas: np.ndarray, pose: np.ndarray, trans: np.ndarray, skin: np.ndarray
    ) -> Float[np.ndarray, " U"]:
        """Of the corners, at the state of pose k."""
        here = (self.state.betas, self.state.pose[self.k], self.state.trans[self.k])
        by_skin = self.basis @ (skin - self.skin)
        if all(map(np.array_equal, here, (betas, pose, trans))):
            return by_skin
        model = np.asarray(self.body(betas, pose, trans, vertices=self.used).vertices)
        return ((model - self.model) * self.normal).sum(1) + by_skin

    def cost(self, displaced: Float[np.ndarray, " U"]) -> float:
        """Of a displacement."""
        quadratic = displaced @ (self.lumped @ displaced) + 2.0 * displaced @ self.pull
        return 0.5 * (self.square + float(quadratic))

    def equations(
        self,
        betas: np.ndarray,
        pose: np.ndarray,
        trans: np.ndarray,
        displaced: Float[np.ndarray, " U"],
    ) -> tuple[Float[np.ndarray, " N"], Float[np.ndarray, "N N"]]:
        """Gradient and matrix over betas, trans, pose and skin."""
        jacobian = surface_jacobian(self.body, betas, pose, trans, vertices=self.used)
        along = np.concatenate([motion_along(self.normal, jacobian), self.basis], 1)
        return along.T @ (self.pull + self.lumped @ displaced), along.T @ (self.lumped @ along)


def skin_planes_term(body: BodyModel, planes: Sequence[SkinPlanes], count: int) -> Term:
    """The term of several sets of points, over betas, all trans and poses and ``count`` numbers of
    the skin.
    """
    head = body.num_betas
    size = head + 3 + 3 * body.num_joints
    part = {
        "betas": slice(head),
        "trans": slice(head, head + 3),
        "pose": slice(head + 3, size),
        "skin": slice(size, size + count),
    }
    own = (("trans", "trans"), ("trans", "pose"), ("pose", "pose"))
    mixed = tuple((a, b) for a in ("trans", "pose") for b in ("betas", "skin"))
    common = (("betas", "betas"), ("betas", "skin"), ("skin", "skin"))

    def residual(
        betas: np.ndarray, pose: np.ndarray, trans: np.ndarray, skin: np.ndarray
    ) -> Quadratic:
        moved = [each.displacement(betas, pose[each.k], trans[each.k], skin) for each in planes]

        def derivatives() -> tuple[dict[str, np.ndarray], dict[tuple[str, str], np.ndarray]]:
            gradient = np.zeros((len(pose), size + count))
            matrix = np.zeros((len(pose), size + count, size + count))

            def of_planes(row: int) -> tuple[np.ndarray, np.ndarray]:
                each = planes[row]
                return each.equations(betas, pose[each.k], trans[each.k], moved[row])

            equations = map_on_threads(of_planes, range(len(planes)))
            for each, (slope, curvature) in zip(planes, equations, strict=True):
                gradient[each.k] += slope
                matrix[each.k] += curvature
            blocks = {(a, b): matrix[:, part[a], part[b]] for a, b in own + mixed}
            blocks |= {(a, b): matrix[:, part[a], part[b]].sum(0) for a, b in common}
            slopes = {name: gradient[:, where] for name, where in part.items()}
            for name in ("betas", "skin"):
                slopes[name] = slopes[name].sum(0)
            return slopes, blocks

        cost = sum(each.cost(displaced) for each, displaced in zip(planes, moved, strict=True))
        return Quadratic(cost, derivatives)

    return Term(residual)


def skin_prior(count: int) -> Term:
    """The term "skin" over the C numbers of the field."""
    return Term(lambda skin: (skin, {"skin": np.eye(count)}))
