"""A person of 41 markers who sways, made up here: what the tests of the capture readers write and
read back.
"""

from pathlib import Path

import ezc3d
import numpy as np

# Body frame in metres: x to the left, y up, z in front; the left and middle markers, the right ones
# mirror them.
_LEFT = {
    "LFHD": (0.07, 1.70, 0.09),
    "LBHD": (0.07, 1.71, -0.08),
    "LSHO": (0.19, 1.47, 0.0),
    "LUPA": (0.33, 1.42, -0.03),
    "LELB": (0.46, 1.45, -0.02),
    "LFRM": (0.58, 1.44, 0.01),
    "LWRA": (0.70, 1.45, 0.07),
    "LWRB": (0.71, 1.43, -0.06),
    "LFIN": (0.80, 1.44, 0.0),
    "LFWT": (0.13, 1.02, 0.11),
    "LBWT": (0.06, 1.04, -0.10),
    "LTHI": (0.18, 0.78, 0.03),
    "LKNE": (0.17, 0.52, 0.01),
    "LSHN": (0.16, 0.33, 0.02),
    "LANK": (0.16, 0.10, -0.03),
    "LHEE": (0.12, 0.06, -0.11),
    "LMT5": (0.18, 0.05, 0.09),
    "LTOE": (0.13, 0.05, 0.14),
}
_MIDDLE = {
    "C7": (0.0, 1.50, -0.09),
    "T10": (0.005, 1.27, -0.13),
    "CLAV": (0.0, 1.42, 0.08),
    "STRN": (0.004, 1.26, 0.12),
    "RBAC": (-0.11, 1.38, -0.13),
}
LABELS = (*_LEFT, *(f"R{label[1:]}" for label in _LEFT), *_MIDDLE)
RECORDED = {"height_m": 1.78, "mass_kg": 71.5, "marker_diameter_m": 0.014, "sex": "female"}


def body_points(frames: int = 60, seed: int = 0) -> np.ndarray:
    """(T, 41, 3) metres in the body frame: a sway, swinging arms and 0.2 mm of noise; the right
    side is 1 cm lower.
    """
    generator = np.random.default_rng(seed)
    left = np.array(list(_LEFT.values()))
    rest = np.concatenate(
        [left, left * (-1, 1, 1) - (0.003, 0.01, 0.004), np.array(list(_MIDDLE.values()))]
    )
    time = np.linspace(0.0, 2.0, frames)[:, None]
    points = np.tile(rest, (frames, 1, 1)) + generator.normal(
        scale=2e-4, size=(frames, len(rest), 3)
    )
    points[..., 0] += 0.25 * np.sin(2 * np.pi * time / 2.3) * (rest[:, 1] / 1.7)
    points[..., 2] += (
        0.2 * np.cos(2 * np.pi * time / 1.7) * np.sign(rest[:, 0]) * (np.abs(rest[:, 0]) > 0.3)
    )
    return points


def world_points(
    up: str = "+z", frames: int = 60, seed: int = 0, mirrored: bool = False
) -> np.ndarray:
    """The same body standing on the floor of a world whose signed axis ``up`` is up, 2 m from the
    world's middle.
    """
    axis = "xyz".index(up[1])
    sign = 1.0 if up[0] == "+" else -1.0
    turn = np.zeros((3, 3))
    turn[axis, 1] = sign
    turn[(axis + 1) % 3, 2] = 1.0
    turn[(axis + 2) % 3, 0] = sign
    if np.linalg.det(turn) < 0:
        turn[(axis + 1) % 3, 2] = -1.0
    points = body_points(frames, seed) @ turn.T
    points[..., (axis + 1) % 3] += 2.0
    if mirrored:
        points[..., (axis + 2) % 3] *= -1.0
    return points


def write_raw_c3d(
    path: Path,
    labels: tuple[str, ...],
    points: np.ndarray,
    unit: str | None = "mm",
    rate: float = 100.0,
    parameters: dict[tuple[str, str], list] | None = None,
) -> Path:
    """A C3D file with exactly these labels, numbers and parameters, by ezc3d; NaN is written as
    missing.
    """
    file = ezc3d.c3d()
    missing = ~np.isfinite(points).all(axis=2).T
    values = np.nan_to_num(points).transpose(2, 1, 0)
    values[:, missing] = 0.0
    file["data"]["points"] = np.concatenate([values, np.ones((1, *values.shape[1:]))])
    file["data"]["meta_points"]["residuals"] = np.where(missing, -1.0, 0.0)[None]
    point = file["parameters"]["POINT"]
    point["RATE"]["value"], point["UNITS"]["value"] = [rate], [unit] if unit else []
    point["LABELS"]["value"] = list(labels[:255])
    for start in range(255, len(labels), 255):
        file.add_parameter("POINT", f"LABELS{start // 255 + 1}", list(labels[start : start + 255]))
    for (group, name), value in (parameters or {}).items():
        file.add_parameter(group, name, value)
    file.write(str(path))
    return path
