"""Where vertices of SMPL, SMPL-X and MHR lie on the default body: assets/topologies.

    python -m habitus_lab.default_body.topology_maps FOLDER MHR.ply [--only NAME]

FOLDER: human_man.obj, human_woman.obj (SMPL's mean bodies) and human_neutral.obj (SMPL-X's) of
github odedstein/meshes, CC BY 4.0. MHR.ply: mhr_face_mask.ply of github facebookresearch/MHR,
Apache-2.0. Each mesh is registered with `habitus.register_scans` to the full detail of the body of
its sex. A vertex goes to the closest place of the registered surface whose normal is near its own;
one of an eyeball to the eyeball. Of several meshes of a topology the places are averaged on the
template. A registration says little of where along the skin a trunk's vertices lie: SMPL's man and
woman disagree by 2 cm there. So the body is solved again at the averaged places, its surface moved
along its normals onto the mesh, and the places are found and averaged anew, twice. Prints how far
each mesh is from what the map makes of its surface, and by how much the meshes disagree.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

import habitus as hb
from habitus.body.model import BodyModel
from habitus.fit.known_points import fit_known_points, spread
from habitus.fit.points.correspondences import hidden_vertices
from habitus.io.meshes import read_mesh
from habitus.io.models.bodies import load_body
from habitus.io.scans import read_scan
from habitus.io.topologies import FOLDER, TOPOLOGIES, map_arrays
from habitus.mesh.normals import face_normals, vertex_normals
from habitus.mesh.proximity import at_barycentrics, barycentric_coordinates, closest_points
from habitus.mesh.surface_map import SurfaceMap

SOURCES = {
    "smpl": (("human_man.obj", "male"), ("human_woman.obj", "female")),
    "smplx": (("human_neutral.obj", "neutral"),),
    "mhr": (("mhr_face_mask.ply", "neutral"),),
}
FAR = 0.008
"""Metres from the surface beyond which a vertex has no place on it."""
BETAS = 100
ROUNDS = 2
"""Further ones change what the shape space leaves by less than .1 mm each."""
SAME_SIDE = 0.3
"""Cosine of the angle between normals that a place must have at least."""


class Registered(NamedTuple):
    """A mesh (m), our surface on it, and the body of its sex."""

    mesh: np.ndarray
    faces: np.ndarray
    surface: np.ndarray
    person: BodyModel


class Places(NamedTuple):
    """Triangles, barycentric coordinates, and whether the two surfaces match there."""

    face: np.ndarray
    barycentric: np.ndarray
    matched: np.ndarray

    def on(self, surface: np.ndarray, faces: np.ndarray) -> np.ndarray:
        """The places (m)."""
        return at_barycentrics(surface, faces[self.face], self.barycentric)


def registered(path: Path, sex: str) -> Registered:
    """The mesh with the full surface of the body of a sex registered to it."""
    scan = read_scan(path)
    body = load_body(sex, joints="smplx").full
    assert body is not None
    (fit,) = hb.register_scans(scan, body)
    print(path.name, fit.verdict.level, f"{1e3 * np.median(fit.to_surface):.2f} mm (median)")
    vertices, faces = read_mesh(path)  # in the file's own order
    mesh = vertices @ fit.to_body[:3, :3].T + fit.to_body[:3, 3]
    person = load_body(sex, joints="smplx", num_betas=BETAS).full
    assert person is not None
    return Registered(mesh, faces, fit.vertices, person)


def slid(mesh: Registered, places: SurfaceMap) -> Registered:
    """With the surface of the body solved at the places, moved along its normals onto the mesh."""
    kept = np.flatnonzero(places.matched)
    fit = fit_known_points(
        mesh.person, places.face[kept], places.barycentric[kept], mesh.mesh[None, kept]
    )
    print(f"  solved: {fit.error_mm['mean']:.2f} mm mean, {fit.error_mm['p95']:.2f} mm 95 %")
    posed = mesh.person(fit.betas, fit.pose[0], fit.trans[0]).vertices
    normal = vertex_normals(posed, mesh.person.faces)
    off = spread(posed, mesh.person.faces, places, mesh.mesh - places.vertices(posed))
    return mesh._replace(surface=posed + normal * (off * normal).sum(1, keepdims=True))


def parts(faces: np.ndarray, count: int) -> np.ndarray:
    """The connected part of each vertex, the largest first."""
    edges = faces[:, [0, 1, 1, 2]].reshape(-1, 2)
    graph = coo_array((np.ones(len(edges)), tuple(edges.T)), shape=(count, count))
    _, label = connected_components(graph, directed=False)
    order = np.argsort(-np.bincount(label), kind="stable")
    return np.argsort(order)[label]


def placed(mesh: Registered, body: BodyModel) -> Places:
    """Where the vertices of a mesh lie on the surface registered to it."""
    faces = body.faces
    skin = parts(faces, body.num_vertices) == 0
    hidden = hidden_vertices(body)
    outer = (skin if hidden is None else skin & ~hidden)[faces].all(1)
    own = parts(mesh.faces, len(mesh.mesh))
    normal = vertex_normals(mesh.mesh, mesh.faces)
    out = closest(mesh.mesh, normal, mesh.surface, faces, np.flatnonzero(outer))
    for side in (1.0, -1.0):  # eyeballs: the same direction from the centre
        ours = ~skin & (side * mesh.surface[:, 0] > 0.0)
        theirs = eyeball(mesh, own, side)
        if theirs is None:
            continue
        centre, radius = ball(mesh.mesh[theirs])
        middle, reach = ball(mesh.surface[ours])
        at = middle + (mesh.mesh[theirs] - centre) * (reach / radius)
        eye = closest(at, normal[theirs], mesh.surface, faces, np.flatnonzero(ours[faces].all(1)))
        out.face[theirs], out.barycentric[theirs] = eye.face, eye.barycentric
        out.matched[theirs] = False  # a gaze, if need be: no shape
    return out


def eyeball(mesh: Registered, own: np.ndarray, side: float) -> np.ndarray | None:
    """The vertices of a part that is as small as an eyeball, on one side; None without such."""
    for part in range(1, own.max() + 1):
        rows = np.flatnonzero(own == part)
        if np.ptp(mesh.mesh[rows], axis=0).max() < 0.04 and side * mesh.mesh[rows, 0].mean() > 0.0:
            return rows
    return None


def ball(points: np.ndarray) -> tuple[np.ndarray, float]:
    """Centre and radius (m) of the sphere through points, by least squares."""
    table = np.c_[2.0 * points, np.ones(len(points))]
    solved = np.linalg.lstsq(table, (points**2).sum(1), rcond=None)[0]
    return solved[:3], float(np.sqrt(solved[3] + solved[:3] @ solved[:3]))


def closest(
    points: np.ndarray, normal: np.ndarray, surface: np.ndarray, faces: np.ndarray, some: np.ndarray
) -> Places:
    """The closest places on ``some`` faces, on the side that points face as far as there is one."""
    found, at = closest_points(points, surface, faces[some])
    outward = face_normals(surface, faces[some])
    outward /= np.linalg.norm(outward, axis=1, keepdims=True) + 1e-300
    turned = np.flatnonzero((outward[found] * normal).sum(1) < SAME_SIDE)
    sound = np.ones(len(points), bool)
    for k in turned:
        facing = np.flatnonzero(outward @ normal[k] > SAME_SIDE)
        (again,), place = closest_points(points[k : k + 1], surface, faces[some[facing]])
        if np.linalg.norm(place[0] - points[k]) < FAR:
            found[k], at[k] = facing[again], place[0]
        else:
            sound[k] = False
    face = some[found]
    share = np.clip(barycentric_coordinates(at, surface[faces[face]]), 0.0, 1.0)
    near = np.linalg.norm(at - points, axis=1) < FAR
    return Places(face, share / share.sum(1, keepdims=True), sound & near)


def averaged(each: Sequence[Places], body: BodyModel) -> Places:
    """The mean places on the template."""
    if len(each) == 1:
        return each[0]
    template, faces = body.v_template, body.faces
    at = np.mean([one.on(template, faces) for one in each], axis=0)
    normal = vertex_normals(template, faces)
    wanted = np.mean([one.on(normal, faces) for one in each], axis=0)
    wanted /= np.linalg.norm(wanted, axis=1, keepdims=True) + 1e-300
    hidden = hidden_vertices(body)
    seen = np.flatnonzero(~hidden[faces].any(1)) if hidden is not None else np.arange(len(faces))
    return closest(at, wanted, template, faces, seen)


def joined(
    name: str, each: Sequence[Places], matched: np.ndarray, faces: np.ndarray, body: BodyModel
) -> SurfaceMap:
    """The map of the averaged places."""
    mean = averaged(each, body)
    if len(each) > 1:
        one, other = (places.on(body.v_template, body.faces) for places in each)
        show_distances("disagreement", one - other, matched)
    corners = body.faces[mean.face]
    return SurfaceMap(name, mean.face, corners, mean.barycentric, matched, faces, body.num_vertices)


def show_distances(name: str, off: np.ndarray, matched: np.ndarray) -> None:
    """Distances (m) in mm."""
    rest = np.linalg.norm(off, axis=1)[matched]
    print(f"  {name}: {1e3 * rest.mean():.2f} mm mean, {1e3 * np.percentile(rest, 95):.2f} mm 95 %")


def main() -> None:
    """Register, place, average and save."""
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("folder", type=Path)
    arguments.add_argument("mhr", type=Path)
    arguments.add_argument("--only", choices=TOPOLOGIES)
    options = arguments.parse_args()
    body = load_body("neutral").full
    assert body is not None
    FOLDER.mkdir(exist_ok=True)
    for name in TOPOLOGIES if options.only is None else (options.only,):
        paths = [
            (options.mhr if name == "mhr" else options.folder / file, sex)
            for file, sex in SOURCES[name]
        ]
        meshes = [registered(path, sex) for path, sex in paths]
        each = [placed(mesh, body) for mesh in meshes]
        matched = np.all([one.matched for one in each], axis=0)
        made = joined(name, each, matched, meshes[0].faces, body)
        for _ in range(ROUNDS):
            meshes = [slid(mesh, made) for mesh in meshes]
            each = [placed(mesh, body) for mesh in meshes]
            made = joined(name, each, matched, meshes[0].faces, body)
        print(name, made.num_vertices, "vertices,", int(matched.sum()), "matched")
        for (path, _), mesh in zip(paths, meshes, strict=True):
            show_distances(path.name, made.vertices(mesh.surface) - mesh.mesh, matched)
        np.savez_compressed(FOLDER / f"{name}.npz", **map_arrays(made))
        print(" ", (FOLDER / f"{name}.npz").stat().st_size, "bytes")


if __name__ == "__main__":
    main()
