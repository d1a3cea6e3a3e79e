"""The free surface: the model moved along its normals to the scan, held by a thin plate (thesis
sec. 5.4).

    sum_p w_p (n_p . (x(b_p) - t_p))^2 A / P + mu l^4 ( E(h) + b E(h n) ),
    E(h) = |M^-1/2 L h|^2 + h^T L' h / r^2 + |M^1/2 h|^2 / R^4

x = m + h n; m are the model's vertices, n its normals and h (V,) the offset of each along its own,
L the cotangent Laplacian of m and M the areas of its vertices: the plate bends over about l = 3 cm
at mu = 1. mu is `SurfaceStage.stiffness`; in `SurfaceSettings`, l^4 is `plate`, r `level`, R
`decay` and b `crease`. L' is the same where there is no scan, 0 elsewhere: an offset levels out
across a hole. The last term makes the solution unique. E(h n), the same of the offset as a vector,
keeps what is thin or creased from swelling into itself. A scan without colours does not constrain
positions along the skin beyond what the model found: a plate on offsets in all directions slides
the skin of a calf to the side sooner than it lets it swell. A surface that cuts itself where its
model does not, at lips, toes and armpits, is drawn back there (`uncut`).
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import bsr_array, coo_array, csc_array, csr_array, diags_array, eye_array, kron
from scipy.spatial import KDTree

from habitus.fit.offsets import factored
from habitus.fit.points.correspondences import (
    Correspondences,
    Topology,
    find_correspondences,
    vertex_weights,
)
from habitus.fit.points.scan import Cloud
from habitus.fit.points.settings import SCANS, SurfaceSettings, SurfaceStage
from habitus.fit.verdict import PARTS
from habitus.mesh.intersections import intersecting_pairs
from habitus.mesh.laplacian import cotangent_laplacian
from habitus.mesh.normals import vertex_normals


def free_surface(
    topology: Topology,
    model: Float[np.ndarray, "V 3"],
    cloud: Cloud,
    settings: SurfaceSettings = SCANS.surface,
    stages: Sequence[SurfaceStage] | None = None,
    start: Float[np.ndarray, "V 3"] | None = None,
) -> Float[np.ndarray, "V 3"]:
    """The free vertices (m) of a scan whose model's are ``model``; they begin there, or at
    ``start``. stages: in place of the settings'.
    """
    plate, area = _plate(topology, model, settings)
    normal = vertex_normals(model, topology.faces)
    surface = model if start is None else start
    for stage in settings.stages if stages is None else stages:
        level = _level(topology, model, surface, cloud, settings)
        energy = _creased(settings.plate * (plate + level), normal, settings.crease)
        correspondences = find_correspondences(topology, surface, cloud.points, cloud.normals)
        rows, missing = _rows(topology, model, normal, cloud, correspondences)
        weight = correspondences.weights(cloud.points, stage.scale, settings.min_cosine)
        weight *= area.sum() / len(missing)
        offset = _solved(rows, weight, missing, stage.stiffness * energy)
        surface = model + offset[:, None] * normal
    return surface


def stretched_surface(
    topology: Topology,
    surface: Float[np.ndarray, "V 3"],
    cloud: Cloud,
    settings: SurfaceSettings = SCANS.surface,
) -> Float[np.ndarray, "V 3"]:
    """A free surface moved further in all directions: for spread fingers and sleeves, which no
    offset along normals reaches.

    The plate is that of the further offset as a vector. Where the surface lies on the scan already
    it is held as strongly as the scan would hold it, or all the skin would slide along the scan.
    """
    plate, area = _plate(topology, surface, settings)
    held = diags_array(area * _on_scan(topology, surface, cloud, settings))
    moved = surface
    for stage in settings.stretched_stages:
        level = _level(topology, surface, moved, cloud, settings)
        bending = settings.plate * (plate + level) + held / stage.stiffness
        energy = kron(bending, eye_array(3), format="csc")
        correspondences = find_correspondences(topology, moved, cloud.points, cloud.normals)
        weight = correspondences.weights(cloud.points, stage.scale, settings.min_cosine)
        weight *= area.sum() / len(cloud.points)
        blocks = (correspondences.barycentric[..., None] * correspondences.normal[:, None]).reshape(
            -1, 1, 3
        )
        table = (
            blocks,
            topology.faces[correspondences.face].ravel(),
            np.arange(0, len(blocks) + 1, 3),
        )
        rows = bsr_array(table, shape=(len(cloud.points), 3 * len(surface))).tocsr()
        start = np.einsum(
            "pk,pkc->pc", correspondences.barycentric, surface[topology.faces[correspondences.face]]
        )
        missing = ((cloud.points - start) * correspondences.normal).sum(1)
        offset = _solved(rows, weight, missing, stage.stiffness * energy)
        moved = surface + offset.reshape(-1, 3)
    return moved


def _plate(
    topology: Topology, vertices: np.ndarray, settings: SurfaceSettings
) -> tuple[csc_array, Float[np.ndarray, " V"]]:
    """The plate with the term that it needs to have a solution, and the areas of vertices."""
    laplacian, area = cotangent_laplacian(vertices, topology.faces)
    stiff = np.maximum(1.0, settings.fine_mesh**2 / area) / area
    return csc_array(
        laplacian.T @ diags_array(stiff) @ laplacian + diags_array(area / settings.decay**4)
    ), area


def _level(
    topology: Topology,
    vertices: np.ndarray,
    surface: np.ndarray,
    cloud: Cloud,
    settings: SurfaceSettings,
) -> csc_array:
    """The matrix that levels the offset where there is no scan."""
    unseen = 1.0 - vertex_weights(topology, surface, cloud, settings)[topology.faces].min(1)
    return cotangent_laplacian(vertices, topology.faces, unseen)[0] / settings.level**2


def _on_scan(
    topology: Topology, surface: np.ndarray, cloud: Cloud, settings: SurfaceSettings
) -> Float[np.ndarray, " V"]:
    """1 at vertices around which the scan lies on the surface, 0 where it is far off."""
    correspondences = find_correspondences(topology, surface, cloud.points, cloud.normals)
    count = min(settings.off_neighbours, len(cloud.points))
    near = KDTree(cloud.points).query(surface, k=count)[1].reshape(len(surface), -1)
    off = np.median(correspondences.distances(cloud.points)[near], axis=1)
    return np.clip(2.0 - off / settings.off_distance, 0.0, 1.0)


def _solved(
    rows: csr_array, weight: np.ndarray, missing: np.ndarray, energy: csc_array
) -> np.ndarray:
    matrix = csc_array(rows.T @ diags_array(weight) @ rows + energy)
    return factored(matrix).solve(rows.T @ (weight * missing))


def _creased(energy: csc_array, normal: Float[np.ndarray, "V 3"], crease: float) -> csc_array:
    """The matrix of E(h) + b E(h n) from that of E(h)."""
    table = coo_array(energy)
    row, column = table.coords
    alike = np.einsum("ec,ec->e", normal[row], normal[column])
    return csc_array(
        coo_array((table.data * (1.0 + crease * alike), (row, column)), shape=energy.shape)
    )


def _rows(
    topology: Topology,
    model: np.ndarray,
    normal: np.ndarray,
    cloud: Cloud,
    correspondences: Correspondences,
) -> tuple[csr_array, Float[np.ndarray, " P"]]:
    """Rows (P, V) of n_p . x(b_p) by h, and what is missing to them from the model."""
    corners = topology.faces[correspondences.face]
    along = correspondences.barycentric * np.einsum(
        "pkc,pc->pk", normal[corners], correspondences.normal
    )
    ends = np.arange(0, 3 * len(corners) + 1, 3)
    rows = csr_array((along.ravel(), corners.ravel(), ends), shape=(len(corners), len(model)))
    start = np.einsum("pk,pkc->pc", correspondences.barycentric, model[corners])
    return rows, ((cloud.points - start) * correspondences.normal).sum(1)


def new_cuts(
    topology: Topology,
    model: Float[np.ndarray, "V 3"],
    surface: Float[np.ndarray, "V 3"],
    part: Int[np.ndarray, " V"],
) -> dict[str, int]:
    """How many more pairs of triangles cut each other in a surface (m) than in its model, by part
    of the body.

    part: the number of each vertex's part in `habitus.fit.verdict.PARTS`. A pair of two parts, as
    of a hand in a thigh, counts for the one that is not the trunk.
    """
    faces = topology.faces[np.isin(topology.faces, topology.whole).all(1)]
    before, after = (
        np.bincount(part[faces[intersecting_pairs(each, faces)]].max((1, 2)), minlength=len(PARTS))
        for each in (model, surface)
    )
    more = np.maximum(after - before, 0).tolist()
    return dict(zip(PARTS, more, strict=True))


def uncut(
    topology: Topology,
    model: Float[np.ndarray, "V 3"],
    surface: Float[np.ndarray, "V 3"],
    settings: SurfaceSettings = SCANS.surface,
) -> Float[np.ndarray, "V 3"]:
    """The surface (m), drawn back towards its model around pairs of triangles that cut each other
    in it alone.
    """
    faces = topology.faces[np.isin(topology.faces, topology.whole).all(1)]
    before = _keys(intersecting_pairs(model, faces), len(faces))
    offset = surface - model
    for _ in range(settings.cut_rounds):
        pairs = intersecting_pairs(model + offset, faces)
        new = pairs[~np.isin(_keys(pairs, len(faces)), before)]
        if len(new) == 0:
            break
        near = _around(topology.faces, np.unique(faces[new]), len(model), settings.cut_rings)
        offset = offset * (1.0 - (1.0 - settings.cut_shrinkage) * near)[:, None]
    return model + offset


def _keys(pairs: Int[np.ndarray, "K 2"], count: int) -> Int[np.ndarray, " K"]:
    return pairs[:, 0] * count + pairs[:, 1]


def _around(
    faces: Int[np.ndarray, "F 3"], vertices: Int[np.ndarray, " n"], count: int, rings: int
) -> Float[np.ndarray, " V"]:
    """1 at some vertices and less from ring to ring around them, 0 further off."""
    near = np.zeros(count)
    near[vertices] = 1.0
    for k in range(rings):
        ring = np.unique(faces[(near[faces] > 0.0).any(1)])
        near[ring] = np.maximum(near[ring], 1.0 - (k + 1.0) / (rings + 1.0))
    return near
