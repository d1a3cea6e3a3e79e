"""Skin off the model, and what lies on the skin: how far what was seen is from a body of betas,
along its normals.

    E_D = 1/2 sum_p w_p (n_p . (q_p - t_p) + h_p + l_p)^2 + 1/2 |z|^2,    h = Z z

What is left of a person after betas is alike over centimetres: a thousand pixels of a belly tell of
betas hardly more than one does, and counted each for itself they bend the back, which no view
shows, after the front. So the person's skin is off the model by h (V,), one random field for all
views, of Matern's kind as in `registration.offset_stage`; Z (V, C) spreads its values at C places
over the surface (Nystroem), z being independent numbers of spread 1. l (V,) is what is worn:
clothes and hair of a thickness that is told. h is part of the person, l is not.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import coo_array, csc_array, csr_array, diags_array
from scipy.sparse.linalg import splu

from habitus.body.jacobians import surface_jacobian
from habitus.body.model import BodyModel
from habitus.fit.points.correspondences import Topology, hidden_vertices
from habitus.fit.points.floor import Footpads
from habitus.fit.points.scan_fitting import field_precision, offset_spread
from habitus.fit.points.settings import RgbdSettings
from habitus.fit.points.state import State
from habitus.mesh.normals import vertex_normals
from habitus.residuals.points import PointObservations, points_on_surface

WORN = ("pelvis", "spine1", "spine2", "spine3", "hip", "collar")
"""Parts that tight clothes cover."""
BROW = 0.5
"""Share of the way from the head's joint to its top from which hair grows, in front."""


@dataclass(frozen=True, eq=False)
class OffModel:
    """The field's basis (V, C; m), none on the soles, which stand on the floor, and the thickness
    of what is worn (V,; m) of a body.
    """

    body: BodyModel
    basis: Float[np.ndarray, "V C"]
    layer: Float[np.ndarray, " V"]

    @staticmethod
    def of(body: BodyModel, settings: RgbdSettings) -> "OffModel":
        """Laid out once for a body."""
        rest = body.rest_vertices(np.zeros(body.num_betas))
        hidden = hidden_vertices(body)
        spread = settings.skin * offset_spread(body)
        held = field_precision(
            Topology.of(body.faces, body.num_vertices, hidden), rest, spread, settings.skin_reach
        )
        shown = np.arange(len(rest)) if hidden is None else np.flatnonzero(~hidden)
        places = shown[spread_out(rest[shown], min(settings.skin_places, len(shown)))]
        one = csc_array(
            (np.ones(len(places)), (places, np.arange(len(places)))), (len(rest), len(places))
        )
        factor = splu(held, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})
        alike = factor.solve(one.toarray())
        root = np.linalg.cholesky(alike[places] + 1e-9 * np.eye(len(places)))
        basis = np.linalg.solve(root, alike.T).T
        pads = Footpads.of(body)
        if pads is not None:
            basis[body.faces[pads.face, pads.corner]] = 0.0
        return OffModel(body, basis, worn(body, settings.clothes, settings.hair))

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


def along_normals(
    surfaces: Float[np.ndarray, "*K V 3"], offset: Float[np.ndarray, " V"], body: BodyModel
) -> Float[np.ndarray, "*K V 3"]:
    """Surfaces moved along their normals (m)."""
    return surfaces + offset[:, None] * vertex_normals(surfaces, body.faces)


def spread_out(points: Float[np.ndarray, "N 3"], count: int) -> Int[np.ndarray, " count"]:
    """Rows of points that are far from each other: each next one is the farthest from those
    before.
    """
    found = [0]
    away = np.linalg.norm(points - points[0], axis=1)
    for _ in range(count - 1):
        found.append(int(away.argmax()))
        away = np.minimum(away, np.linalg.norm(points - points[found[-1]], axis=1))
    return np.array(found)


def worn(body: BodyModel, clothes: float, hair: float) -> Float[np.ndarray, " V"]:
    """Metres of tight clothes on trunk and thighs, and of hair above the brow and behind."""
    names = body.joint_names
    points = body.rest_vertices(np.zeros(body.num_betas))
    if "head" not in names:
        return np.zeros(len(points))
    weights = body.skinning_weights
    covered = weights[
        :,
        [
            k
            for k, name in enumerate(names)
            if name.removeprefix("left_").removeprefix("right_") in WORN
        ],
    ]
    head = weights[:, names.index("head")]
    joint = body.rest_joints(np.zeros(body.num_betas))[names.index("head")]
    top = points[head > 0.5, 1].max()
    share = (points[:, 1] - joint[1]) / (top - joint[1]) + np.maximum(
        joint[2] - points[:, 2], 0.0
    ) / 0.1
    return clothes * covered.sum(1) + hair * head * np.clip((share - BROW) / 0.2, 0.0, 1.0)


def uncoated(
    terms: Mapping[str, PointObservations],
    model: Float[np.ndarray, "V 3"],
    seen: Float[np.ndarray, "V 3"],
    body: BodyModel,
) -> Mapping[str, PointObservations]:
    """Terms for points of what is seen as terms for the model's: targets are moved back by what
    lies between.
    """
    between = model - seen
    return {
        name: replace(
            one,
            target=one.target + points_on_surface(between, body.faces, one.face, one.barycentric),
        )
        for name, one in terms.items()
    }


@dataclass(frozen=True, eq=False)
class OffEquations:
    """E_D's cost, gradient (n + C,) and matrix (n + C, n + C): the state's numbers, then the
    field's.
    """

    cost: float
    gradient: Float[np.ndarray, " m"]
    matrix: Float[np.ndarray, "m m"]


def off_equations(
    off: OffModel,
    state: State,
    numbers: Float[np.ndarray, " C"],
    matches: Sequence[PointObservations],
    models: Float[np.ndarray, "K V 3"],
    surfaces: Float[np.ndarray, "K V 3"],
) -> OffEquations:
    """E_D of all views (one direction a match, already at its weight's root) and the field's own
    prior.

    models: the bodies of betas alone. surfaces: what the matches' points lie on.
    """
    body = off.body
    head = len(state.betas)
    width = 3 + state.pose[0].size
    size = len(state.vector)
    matrix = np.zeros((size + off.count,) * 2)
    gradient = np.zeros(size + off.count)
    field = size + np.arange(off.count)
    cost = 0.5 * float(numbers @ numbers)
    gradient[field], matrix[field, field] = numbers, 1.0
    for k, (match, surface) in enumerate(zip(matches, surfaces, strict=True)):
        if not len(match.face):
            continue
        columns = np.concatenate([np.arange(head), head + k * width + np.arange(width), field])
        used, lumped, wanted, left = _lumped(match, surface, body)
        by = np.concatenate([_along(body, state, k, used, models[k]), off.basis[used]], 1)
        matrix[np.ix_(columns, columns)] += by.T @ (lumped @ by)
        gradient[columns] += by.T @ wanted
        cost += left
    return OffEquations(cost, gradient, matrix)


def _lumped(
    match: PointObservations, surface: Float[np.ndarray, "V 3"], body: BodyModel
) -> tuple[Int[np.ndarray, " U"], csr_array, Float[np.ndarray, " U"], float]:
    """Corners of the points' triangles, the points' weights and residuals laid on them, and the
    cost.
    """
    used, corner = np.unique(body.faces[match.face], return_inverse=True)
    row = np.repeat(np.arange(len(match.face)), 3)
    entries = (match.barycentric.ravel(), (row, corner.ravel()))
    share = coo_array(entries, shape=(len(match.face), len(used))).tocsr()
    apart = points_on_surface(surface, body.faces, match.face, match.barycentric) - match.target
    direction = match.directions[:, 0]
    residual = (direction * apart).sum(1)
    root = np.linalg.norm(direction, axis=1)
    lumped = csr_array(share.T @ diags_array(root**2) @ share)
    return used, lumped, share.T @ (root * residual), 0.5 * float(residual @ residual)


def _along(
    body: BodyModel,
    state: State,
    k: int,
    used: Int[np.ndarray, " U"],
    model: Float[np.ndarray, "V 3"],
) -> Float[np.ndarray, "U P"]:
    """How vertices ``used`` of view k move along their normals with betas, trans and pose."""
    slopes = surface_jacobian(body, state.betas, state.pose[k], state.trans[k], vertices=used)
    normal = vertex_normals(model, body.faces)[used]
    by_betas, by_pose = (
        np.einsum("vc,vcn->vn", normal, each.reshape(len(used), 3, -1), optimize=True)
        for each in (slopes.vertices_betas, slopes.vertices_pose)
    )
    return np.concatenate([by_betas, normal, by_pose], 1)
