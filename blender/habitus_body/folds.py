# SPDX-License-Identifier: GPL-3.0-or-later
"""Pose blend shapes of deep folds, as a body's file has them: weights clip(row . vec(R - I) - bias,
0, 1)^2, over pose blend shapes less what stands in for them.
"""

import numpy as np

NONE = {"rows": np.zeros((0, 9)), "bias": np.zeros(0), "linear": np.zeros((0, 9))}


def fold_shapes(held: dict, names: list, drivers: list, posedirs: np.ndarray) -> tuple:
    """A body's folds as the add-on has them, and its ``posedirs`` (V, 3, 9 K) without their
    stand-ins.
    """
    joints = [int(joint) for joint in held.get("hinge_joints", ())]
    count = len(joints)
    rows, bias, linear = (
        np.asarray(held.get(f"hinge_{name}", none), np.float64).reshape(count, *none.shape[1:])
        for name, none in NONE.items()
    )
    shapes = np.asarray(held.get("hingedirs", np.zeros((len(posedirs), 3, 0, 1))), np.float64)
    if shapes.shape[:3] != (len(posedirs), 3, count):
        raise ValueError(f"has hingedirs of shape {shapes.shape} for {count} hinge channels")
    posedirs = posedirs.copy()
    for c, joint in enumerate(joints):
        k = drivers.index(joint)
        posedirs[..., 9 * k : 9 * k + 9] -= shapes[:, :, c, :1] * linear[c]
    moved = [np.flatnonzero(shapes[:, :, c].any((1, 2))) for c in range(count)]
    values = [shapes[some, :, c] for c, some in enumerate(moved)]
    called = [""] * count
    for joint in set(joints):
        some = [c for c in range(count) if joints[c] == joint]
        for c, name in zip(some, fold_names(rows[some], bias[some]), strict=True):
            called[c] = f"{names[joint]}_{name}"
    return {
        "fold_joints": np.array(joints, int),
        "fold_rows": rows,
        "fold_bias": bias,
        "fold_names": np.array(called, np.str_),
        "fold_start": np.cumsum([0, *map(len, moved)]),
        "fold_vertices": np.concatenate([np.zeros(0, np.int64), *moved]),
        "fold_values": np.concatenate([np.zeros((0, 3, shapes.shape[3])), *values]),
    }, posedirs


def fold_names(rows: np.ndarray, bias: np.ndarray) -> tuple:
    """Names of a joint's folds as `habitus export` gives them, by the angle where they begin."""
    angles = [round(beginning(*each)) for each in zip(rows, bias, strict=True)]
    alike = len(set(angles)) < len(angles)
    return tuple(f"fold_{k + 1 if alike else angle}" for k, angle in enumerate(angles))


def beginning(row: np.ndarray, bias: float) -> float:
    """The least angle (degrees) by which any rotation makes row . vec(R - I) as large as ``bias``;
    180 where none does: `habitus.export.folds.beginning` explains it.
    """
    m = row.reshape(3, 3)
    k = np.zeros((4, 4))
    k[0, 1:] = k[1:, 0] = m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]
    k[1:, 1:] = m + m.T - 2 * np.trace(m) * np.eye(3)
    k -= bias * np.eye(4)
    first = np.diag([1.0, 0, 0, 0])
    low, high = 0.0, 1e4 / np.abs(k).max()
    for _ in range(100):
        a, b = (2 * low + high) / 3, (low + 2 * high) / 3
        if np.linalg.eigvalsh(first + a * k)[-1] < np.linalg.eigvalsh(first + b * k)[-1]:
            high = b
        else:
            low = a
    most = np.clip(np.linalg.eigvalsh(first + low * k)[-1], 0.0, 1.0)
    return float(np.degrees(2 * np.arccos(np.sqrt(most))))
