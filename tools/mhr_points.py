"""Where points of our body lie on MHR's mesh: assets/mhr_points.npz.

    python tools/mhr_points.py mhr_face_mask.ply

Registers MHR's rest mesh (Apache-2.0, github facebookresearch/MHR) with `habitus.register_scans`
and keeps, for some vertices of our body far apart from each other, the triangle of MHR's mesh that
they lie on and the barycentric coordinates there.
"""

import sys
from pathlib import Path

import igl
import numpy as np

import habitus as hb
from habitus.io.scans import read_scan
from habitus.mesh.proximity import farthest_points

COUNT = 220
MAX_OFF = 0.002
ASSET = Path(__file__).resolve().parents[1] / "src" / "habitus" / "assets" / "mhr_points.npz"


def main(path: str) -> None:
    """Register, choose and save."""
    scan = read_scan(path)
    assert scan.faces is not None
    (fit,) = hb.register_scans(scan, "neutral")
    print(fit.verdict)
    mesh = scan.points @ fit.to_body[:3, :3].T + fit.to_body[:3, 3]
    faces = np.asarray(scan.faces, np.int64)
    squared, triangle, nearest = igl.point_mesh_squared_distance(fit.vertices, mesh, faces)
    corners = mesh[faces[triangle]]
    parts = (np.ascontiguousarray(corners[:, k]) for k in range(3))
    share = igl.barycentric_coordinates(np.ascontiguousarray(nearest), *parts)
    sound = (np.sqrt(squared) < MAX_OFF) & (fit.weights > 0.9)
    names = np.array(fit.body.joint_names)[fit.body.strongest_joint]
    fingers = np.char.isnumeric(np.array([name[-1] for name in names])) & (
        np.char.find(names, "spine") < 0
    )
    rows = np.flatnonzero(sound & ~fingers)
    rest = fit.body.rest_vertices(fit.betas)
    chosen = rows[farthest_points(rest[rows], COUNT, 0)]
    np.savez_compressed(
        ASSET,
        vertices=chosen.astype(np.int32),
        corners=faces[triangle[chosen]].astype(np.int32),
        barycentric=share[chosen].astype(np.float32),
        mesh_vertices=np.array(len(mesh)),
        licence=np.array(
            "indices into MHR's mesh (Apache-2.0, github facebookresearch/MHR), found by our "
            "registration of its rest mesh"
        ),
    )
    print(len(chosen), "points,", ASSET.stat().st_size, "bytes")


if __name__ == "__main__":
    main(sys.argv[1])
