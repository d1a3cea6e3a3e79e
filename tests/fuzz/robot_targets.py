"""Readers of robots (MJCF, URDF, tables of pairs) and of vertices in other topologies."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
from made_robot import PAIRS, URDF, mjcf
from target import Target, alone


def robot_makers() -> tuple[Callable[[Path], list[Target]], ...]:
    """What makes the targets, each in a folder of its own."""
    return _robots, _pairs, _vertices


def _read_robot(path: Path) -> None:
    from habitus.io.robots.read import read_robot

    robot = read_robot(path)
    assert robot.num_joints > 0
    assert np.isfinite(robot.offsets).all() and np.isfinite(robot.turns).all()
    np.testing.assert_allclose(np.linalg.norm(robot.axes, axis=1), 1.0)
    assert (robot.lower <= robot.upper).all() and (robot.velocity > 0.0).all()
    assert all(parent < k for k, parent in enumerate(robot.parents))
    assert np.isfinite(robot.pose(np.zeros(robot.num_joints)).origins).all()


def _robots(_: Path) -> list[Target]:
    return [
        alone("robot.xml", _read_robot, mjcf().encode()),
        alone("robot.urdf", _read_robot, URDF.encode()),
    ]


def _read_pairs(path: Path) -> None:
    from habitus.io.robots.pairs import read_pairs

    pairs = read_pairs(path)
    for part in pairs.segments.values():
        for way in part.directions.values():
            np.testing.assert_allclose(np.linalg.norm(way), 1.0)
    for part in pairs.capsules.values():
        assert part.radius > 0.0 and np.isfinite(part.ends).all()
    assert all(np.isfinite(sole.middle).all() for sole in pairs.soles)


def _pairs(_: Path) -> list[Target]:
    return [alone("pairs.toml", _read_pairs, PAIRS.encode())]


def _read_vertices(path: Path) -> None:
    from habitus.io.topologies import read_vertices

    read = read_vertices(path, 4)
    assert read.vertices.shape[1:] == (4, 3) and np.isfinite(read.vertices).all()
    assert 0.1 < np.ptp(read.vertices, axis=1).max() < 6.0
    assert read.rate_hz is None or read.rate_hz > 0.0


def _vertices(folder: Path) -> list[Target]:
    corners = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.7, 0.0], [0.0, 0.0, 0.5]])
    still = np.stack([corners, corners + 0.5])
    np.savez(folder / "a.npz", vertices=still, rate_hz=np.array(30.0), up_axis=np.array("+y"))
    np.savez_compressed(folder / "b.npz", vertices=(1e3 * corners).astype(np.float32))
    lines = [f"v {x} {y} {z}" for x, y, z in corners]
    obj = "\n".join([*lines, "f 1 2 3", "f 1 4 3", ""]).encode()
    return [
        alone("vertices.npz", _read_vertices, *((folder / f"{n}.npz").read_bytes() for n in "ab")),
        alone("vertices.obj", _read_vertices, obj),
    ]
