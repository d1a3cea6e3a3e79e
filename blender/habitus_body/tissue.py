# SPDX-License-Identifier: GPL-3.0-or-later
"""Soft tissue in motion: coefficients of a body's dynamic blend shapes from how its joints move
(SMPL 6), in NumPy.
"""

import numpy as np

from .core import Body, matrices

REST_SECONDS, REST_SHARE = 2.0, 0.01


def simulated(
    body: Body,
    betas: np.ndarray,
    age: float,
    pose: np.ndarray,
    trans: np.ndarray,
    rate: float,
    strength: float = 1.0,
) -> np.ndarray:
    """Coefficients (T, D) for a motion: ``pose`` (T, J, 3; rad), ``trans`` (T, 3; m), frames a
    second.

    As habitus.simulate_soft_tissue. Raises ValueError for a body without dynamics, and below 10
    frames a second.
    """
    arrays = body.arrays
    if "dynamics_drive" not in arrays:
        raise ValueError("this body has no dynamic blend shapes")
    if rate < 10:
        raise ValueError(f"{rate:g} frames a second are too few for soft tissue; 10 or more")
    own = float(arrays["dynamics_rate"])
    history, drive = _of_person(arrays, body.padded(betas), own)
    controls = _resampled(_controls(body, body.joints(betas, age), pose, trans, rate), rate, own)
    limits = arrays["dynamics_limits"]
    coefficients = _free_run(history, np.clip(controls, -limits, limits) @ drive.T)
    if len(coefficients) != len(pose) or rate != own:
        coefficients = _at_frames(coefficients, np.arange(len(pose)) * (own / rate))
    return strength * coefficients


def _of_person(arrays: dict, betas: np.ndarray, rate: float) -> tuple[np.ndarray, np.ndarray]:
    known = len(arrays["dynamics_drive"]) - 1
    factors = np.concatenate([[1.0], np.clip(betas[:known], *arrays["dynamics_reach"])])
    history = np.tensordot(factors, arrays["dynamics_history"], 1)
    count = history.shape[-1]
    companion = np.block([[history[0], history[1]], [np.eye(count), np.zeros((count, count))]])
    radius = float(np.abs(np.linalg.eigvals(companion)).max(initial=0.0))
    shrink = min(1.0, REST_SHARE ** (1 / (REST_SECONDS * rate)) / radius) if radius > 0 else 1.0
    return history * np.array([shrink, shrink**2])[:, None, None], np.tensordot(
        factors, arrays["dynamics_drive"], 1
    )


def _controls(
    body: Body, joints: np.ndarray, pose: np.ndarray, trans: np.ndarray, rate: float
) -> np.ndarray:
    """Of each joint, in its own frame: linear acceleration, angular velocity, angular
    acceleration.
    """
    chosen = [body.joint_names.index(str(name)) for name in body.arrays["dynamics_joints"]]
    if len(pose) < 3:
        return np.zeros((len(pose), 9 * len(chosen)))
    local, world = matrices(pose), np.empty((*pose.shape, 3))
    places = np.empty(pose.shape)
    for joint, parent in enumerate(body.parents):
        if parent < 0:
            world[:, joint], places[:, joint] = local[:, joint], joints[joint] + trans
        else:
            world[:, joint] = world[:, parent] @ local[:, joint]
            places[:, joint] = places[:, parent] + world[:, parent] @ (
                joints[joint] - joints[parent]
            )
    world = world[:, chosen]
    acceleration = _differences(np.diff(places[:, chosen], axis=0), rate)[1]
    spin, spin_up = _differences(_vectors(world[:-1].swapaxes(-1, -2) @ world[1:]), rate)
    own = (world.swapaxes(-1, -2) @ acceleration[..., None])[..., 0]
    return np.concatenate([own, spin, spin_up], axis=-1).reshape(len(world), -1)


def _vectors(turns: np.ndarray) -> np.ndarray:
    """Rotation matrices between neighbouring frames as vectors."""
    axis = np.stack([turns[..., 2, 1] - turns[..., 1, 2], turns[..., 0, 2] - turns[..., 2, 0],
                     turns[..., 1, 0] - turns[..., 0, 1]], -1) / 2  # fmt: skip
    sine = np.linalg.norm(axis, axis=-1, keepdims=True)
    angle = np.arctan2(sine, (np.trace(turns, axis1=-2, axis2=-1)[..., None] - 1) / 2)
    return axis * np.where(sine > 1e-9, angle / np.maximum(sine, 1e-9), 1.0)


def _differences(steps: np.ndarray, rate: float) -> tuple[np.ndarray, np.ndarray]:
    steps = np.concatenate([steps[:1], steps, steps[-1:]])
    return 0.5 * rate * (steps[1:] + steps[:-1]), rate**2 * np.diff(steps, axis=0)


def _free_run(history: np.ndarray, pushes: np.ndarray) -> np.ndarray:
    coefficients = np.zeros((len(pushes) + 2, pushes.shape[1]))
    for t, push in enumerate(pushes):
        coefficients[t + 2] = history[0] @ coefficients[t + 1] + history[1] @ coefficients[t] + push
    return coefficients[2:]


def _resampled(values: np.ndarray, rate: float, to: float) -> np.ndarray:
    if abs(rate - to) <= 1e-6 * to or len(values) < 2:
        return values
    at = np.arange(int((len(values) - 1) * to / rate + 1e-9) + 1) * (rate / to)
    if to > rate:
        return _at_frames(values, at)
    summed = np.concatenate(
        [np.zeros((1, values.shape[1])), np.cumsum(0.5 * (values[1:] + values[:-1]), axis=0)]
    )
    half, last = 0.5 * rate / to, len(values) - 1.0
    begin, end = np.maximum(at - half, 0.0), np.minimum(at + half, last)
    return (_at_frames(summed, end) - _at_frames(summed, begin)) / (end - begin)[:, None]


def _at_frames(values: np.ndarray, places: np.ndarray) -> np.ndarray:
    below = np.minimum(places.astype(np.int64), max(len(values) - 2, 0))
    share = np.minimum(places - below, 1.0)[:, None]
    return (1.0 - share) * values[below] + share * values[np.minimum(below + 1, len(values) - 1)]
