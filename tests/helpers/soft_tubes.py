"""A small body of tubes with dynamic blend shapes, and motions that shake it."""

from dataclasses import replace

import numpy as np
from tube_body import tube_body

from habitus.body.dynamics import CONTROLS, Dynamics, DynamicsRegressor
from habitus.body.model import BodyModel

RATE = 60.0
JOINTS = ("joint_0", "joint_1", "joint_6")


def soft_tubes(
    controls: str = "joints", count: int = 2, shapes: int = 1, **kind: object
) -> BodyModel:
    """Tubes whose flesh swings in ``count`` ways at 4 Hz and more."""
    body = tube_body(**kind)
    return replace(
        body, dynamics=Dynamics(swaying(body, count), planted_regressor(controls, count, shapes))
    )


def swaying(body: BodyModel, count: int) -> np.ndarray:
    """Smooth blend shapes, orthogonal to each other, of 5 to 10 mm."""
    rng = np.random.default_rng(5)
    waves = [
        np.sin(4.0 * body.v_template @ rng.normal(size=(3, 3)) + rng.uniform(0, 6, 3))
        for _ in range(count)
    ]
    axes = np.linalg.qr(np.reshape(waves, (count, -1)).T)[0]
    return (axes * np.sqrt(body.num_vertices) * np.linspace(0.01, 0.005, count)).reshape(
        -1, 3, count
    )


def planted_regressor(
    controls: str = "joints", count: int = 2, shapes: int = 1
) -> DynamicsRegressor:
    """Damped oscillators that the joints drive; the first ``shapes`` coefficients change them a
    little.
    """
    rng = np.random.default_rng(6)
    angle = 2 * np.pi * np.linspace(4.0, 7.0, count) / RATE
    radius = np.linspace(0.92, 0.88, count)
    mix = np.linalg.qr(rng.normal(size=(count, count)))[0]
    history = np.array(
        [mix @ np.diag(each) @ mix.T for each in (2 * radius * np.cos(angle), -(radius**2))]
    )
    inputs = CONTROLS[controls].count(len(JOINTS))
    drive = 0.02 * rng.normal(size=(count, inputs)) * _units(controls)
    more = [
        0.01 * rng.normal(size=(shapes, *part.shape)) * np.abs(part).mean()
        for part in (history, drive)
    ]
    return DynamicsRegressor(
        history=np.concatenate([history[None], more[0]]),
        drive=np.concatenate([drive[None], 10 * more[1]]),
        joints=JOINTS,
        rate_hz=RATE,
        limits=np.full(inputs, 1e4),
        reach=np.array([[-3.0] * shapes, [3.0] * shapes]),
        controls=controls,
    )


def _units(controls: str) -> np.ndarray:
    """About how much of each control makes as much of a stir: accelerations, speeds, spins."""
    if controls == "smpl":
        return np.repeat([0.3, 0.05, 0.3, 0.3], [3 * len(JOINTS), 3 * len(JOINTS), 3, 3])
    return np.tile(np.repeat([0.3, 0.3, 0.05], 3), len(JOINTS))


def shaken(
    frames: int, seed: int = 0, joints: int = 10, rate: float = RATE
) -> tuple[np.ndarray, np.ndarray]:
    """Pose (rad) and trans (m) of a motion with much going on below 5 Hz."""
    rng = np.random.default_rng(seed)
    t = np.arange(frames) / rate

    def course(columns: int, size: float) -> np.ndarray:
        hz = rng.uniform(0.3, 5.0, (6, columns))
        phase = rng.uniform(0, 6, (6, columns))
        waves = np.sin(2 * np.pi * hz * t[:, None, None] + phase) / hz
        return size * (rng.normal(size=(6, columns)) * waves).sum(1)

    return course(3 * joints, 0.15).reshape(frames, joints, 3), course(3, 0.05)
