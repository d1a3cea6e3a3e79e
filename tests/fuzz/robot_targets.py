"""Readers of robots: MJCF, URDF and tables of pairs."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
from made_robot import PAIRS, URDF, mjcf
from target import Target, alone


def robot_makers() -> tuple[Callable[[Path], list[Target]], ...]:
    """What makes the targets, each in a folder of its own."""
    return _robots, _pairs


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
