"""Made scans have as many points, holes and noise as was asked for, and show only what a camera
sees.
"""

import numpy as np
import trimesh

from habitus_lab.population.scans import Scanner, scanned

BALL = trimesh.creation.icosphere(4, 0.5)


def test_a_scan_has_its_points_its_noise_and_its_holes():
    rng = np.random.default_rng(0)
    scan = scanned(BALL.vertices, BALL.faces, Scanner(points=20_000, noise=0.002, holes=0.2), rng)
    assert abs(len(scan.points) - 20_000) < 1500
    off = np.linalg.norm(scan.points, axis=1) - 0.5
    assert 0.0015 < off.std() < 0.0025
    near = np.linalg.norm(BALL.vertices[:, None] - scan.points[None, ::10], axis=2).min(1)
    assert 0.08 < (near > 0.03).mean() < 0.35


def test_a_camera_sees_its_side_only():
    scan = scanned(
        BALL.vertices,
        BALL.faces,
        Scanner(4000, 0.0, 0.0, ((0.0, 0.0, 1.0),)),
        np.random.default_rng(1),
    )
    assert scan.points[:, 2].min() > 0.0 and len(scan.points) > 1500
