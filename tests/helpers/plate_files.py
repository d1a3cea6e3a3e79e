"""C3D files with one force plate whose forces are planted."""

from pathlib import Path

import ezc3d
import numpy as np
from scipy.spatial.transform import Rotation

FRAMES, EACH = 60, 4
SAMPLES = FRAMES * EACH
LENGTH, WIDTH = 0.6, 0.4  # metres, x and y of a plate
DEPTH, APART = 0.04, (0.21, 0.13)  # of the sensors: below the surface, from the middle along x, y


def placed(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """A plate's axes (z down) and its middle, turned about the vertical and tilted a little."""
    rng = np.random.default_rng(seed)
    turn = Rotation.from_rotvec([0.05, -0.04, rng.uniform(-3, 3)]).as_matrix()
    down = np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]])
    return turn @ down, rng.normal(size=3) * [1.0, 1.0, 0.2]


def planted(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """In the plate's axes: force on the person (N), where it acts in the surface, moment there."""
    t = np.linspace(0.0, 1.0, SAMPLES)
    load = np.clip(np.sin(2 * np.pi * t - 0.8), 0.0, None)
    force = np.stack([60 * load * np.sin(9 * t), 110 * load * np.cos(5 * t), -800 * load], 1)
    place = np.stack([0.15 * np.cos(3 * t), 0.1 - 0.25 * t, 0 * t], 1)
    return force, place, 6.0 * load * np.cos(4 * t)


def channels_of(kind: int, seed: int) -> np.ndarray:
    """What the sensors show: of Kistler's four by their places, else force and moment about them."""
    force, place, free = planted(seed)
    sensors = np.array([0.0, 0.0, DEPTH])
    moment = np.cross(place - sensors, force) + free[:, None] * [0.0, 0.0, 1.0]
    if kind != 3:
        return np.concatenate([force, 1e3 * moment], 1)
    a, b = APART
    x, y, z = force.T
    turn = moment[:, 2] / 2  # half of it by the forces along x, half by those along y
    ups = [z / 4 + s * moment[:, 0] / (4 * b) + r * moment[:, 1] / (4 * a)
           for s, r in ((1, -1), (1, 1), (-1, 1), (-1, -1))]  # fmt: skip
    return np.stack(
        [
            x / 2 - turn / (2 * b),
            x / 2 + turn / (2 * b),
            y / 2 + turn / (2 * a),
            y / 2 - turn / (2 * a),
            *ups,
        ],
        1,
    )


def write(
    path: Path,
    kind: int,
    seed: int = 0,
    sign: float = 1.0,
    flipped: bool = False,
    baseline: float = 0.0,
    events: bool = False,
) -> None:
    """A file of a plate: ``sign`` of its forces, ``flipped``: the origin above the surface."""
    axes, middle = placed(seed)
    file = ezc3d.c3d()
    points = file["parameters"]["POINT"]
    points["RATE"]["value"], points["UNITS"]["value"], points["LABELS"]["value"] = (
        [100.0],
        ["mm"],
        ["A"],
    )
    channels = sign * channels_of(kind, seed) + baseline * np.linspace(
        0.5, 1.0, 8 if kind == 3 else 6
    )
    matrix = np.eye(6) + 0.05 * np.random.default_rng(5).normal(size=(6, 6))
    if kind == 4:
        channels = channels @ np.linalg.inv(matrix).T
    names = [f"F{k}" for k in range(channels.shape[1] + 1)]
    analog = file["parameters"]["ANALOG"]
    analog["RATE"]["value"], analog["LABELS"]["value"] = [100.0 * EACH], names
    analog["UNITS"]["value"] = ["V", *["N"] * 3, *(["N"] * 5 if kind == 3 else ["Nmm"] * 3)]
    file["data"]["points"] = np.ones((4, 1, FRAMES))
    file["data"]["analogs"] = np.concatenate([np.zeros((SAMPLES, 1)), channels], 1).T[None]
    signs = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * [LENGTH / 2, WIDTH / 2]
    corners = middle + np.column_stack([signs, np.zeros(4)]) @ axes.T
    origin = np.array([*APART, -DEPTH]) if kind == 3 else np.array([0.0, 0.0, -DEPTH])
    if flipped:
        origin = origin * ([1, 1, -1] if kind == 3 else -1)
    file.add_parameter("FORCE_PLATFORM", "USED", [1])
    file.add_parameter("FORCE_PLATFORM", "TYPE", [kind])
    file.add_parameter("FORCE_PLATFORM", "CORNERS", 1e3 * corners.T[:, :, None])
    file.add_parameter("FORCE_PLATFORM", "ORIGIN", 1e3 * origin[:, None])
    file.add_parameter("FORCE_PLATFORM", "CHANNEL", np.arange(2.0, len(names) + 1.0)[:, None])
    file.add_parameter("FORCE_PLATFORM", "CAL_MATRIX", matrix[:, :, None])
    if events:
        file.add_parameter("EVENT", "CONTEXTS", ["Left", "Right"])
        file.add_parameter("EVENT", "LABELS", ["Foot Strike", "Foot Off"])
        file.add_parameter("EVENT", "TIMES", np.array([[0.0, 0.0], [0.1, 0.3]]))
    file.write(str(path))
