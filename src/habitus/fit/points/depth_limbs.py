"""Limbs of a fit to depth views, fitted again where they are in doubt.

A limb is in doubt where its position or rotation differs between the views, or where pixels are
unexplained. People keep their pose from view to view, so that the poses of the other views are
tried, and for arms the usual ones; the pose with the least misfit is kept.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int

from habitus.body.state import BodyState
from habitus.fit.points.depth_energy import (
    DepthEnergy,
    degrees_between,
    in_pelvis_frame,
    look,
    misfit,
    person_distances,
)
from habitus.fit.points.depth_settings import DepthStage
from habitus.fit.points.depth_start import Tried, arm_poses, placed, refined, with_view, yaw_of

LIMBS = {"arm": ("shoulder", "elbow", "wrist", "hand"), "leg": ("hip", "knee", "ankle", "foot")}


def _stride(energy: DepthEnergy, k: int) -> int:
    """Of pixels, that leaves about `DepthLimbSettings.pixels` of the person."""
    pixels = energy.settings.limbs.pixels
    return int(np.clip(np.sqrt(energy.views[k].mask.sum() / pixels), 1, 4))


def retry_limbs(
    energy: DepthEnergy, state: BodyState, means: Float[np.ndarray, "K J 3"]
) -> tuple[BodyState, Float[np.ndarray, "K J 3"]]:
    """The state with limbs in doubt where they explain their views best, and what the pose's prior
    is then around.
    """
    for _ in range(energy.settings.limbs.passes):
        before = state
        for k in range(len(energy.views)):
            state, means = _of_view(energy, state, means, k)
        if state is before:
            break
    return state, means


def _of_view(
    energy: DepthEnergy, state: BodyState, means: Float[np.ndarray, "K J 3"], k: int
) -> tuple[BodyState, Float[np.ndarray, "K J 3"]]:
    """Limbs of one view, and the whole pose of another view, facing either way, where pixels are
    unexplained or several limbs are elsewhere; the state as it is where nothing is in doubt.
    """
    settings = energy.settings
    grid = energy.views[k].grid(_stride(energy, k))
    drawn = look(grid, energy.surfaces(state)[k], energy.triangles)
    unexplained = (person_distances(grid, drawn) > settings.explained_distance).mean()
    lost = bool(unexplained > settings.limbs.max_unexplained)
    first = Tried(
        BodyState(state.betas, state.pose[k : k + 1], state.trans[k : k + 1]),
        means[k],
        misfit(grid, drawn, settings),
    )
    now = first
    limbs = [(limb, _rows(energy, side, limb)) for limb in LIMBS for side in ("left", "right")]
    inconsistent = _inconsistent(energy, state, k, [rows for _, rows in limbs])
    for (limb, rows), doubtful in zip(limbs, inconsistent, strict=True):
        if len(rows) and (doubtful or (lost and limb == "arm")):
            others = _other_poses(energy, state, k, limb)
            now = _best(energy, k, now, [_with_limb(now, other, rows) for other in others])
    if (lost or sum(inconsistent) > 1) and len(state.pose) > 1:
        own = np.rad2deg(yaw_of(state.pose[k, 0]))
        whole = [
            _standing(energy, k, state.betas, pose, own + turn)
            for j, pose in enumerate(state.pose)
            if j != k
            for turn in settings.limbs.turns
        ]
        now = _best(energy, k, now, whole)
    return (state, means) if now is first else with_view(state, means, k, now)


def _inconsistent(
    energy: DepthEnergy, state: BodyState, k: int, limbs: Sequence[Int[np.ndarray, " _"]]
) -> list[bool]:
    """Whether the position or rotation of each limb, given by its joints, differs between view k
    and another one.
    """
    settings = energy.settings.limbs
    joints, rotations = in_pelvis_frame(energy.body, state)
    distance = np.linalg.norm(joints - joints[k], axis=-1).max(0)
    angle = degrees_between(rotations, rotations[k]).max(0)
    wrong = (distance > settings.max_difference) | (angle > settings.max_turn)
    return [bool(wrong[rows].any()) for rows in limbs]


def _rows(energy: DepthEnergy, side: str, limb: str) -> Int[np.ndarray, " j"]:
    """Joints of a limb."""
    names = [f"{side}_{part}" for part in LIMBS[limb]]
    return np.array(
        [k for k, name in enumerate(energy.body.joint_names) if name in names], dtype=np.int64
    )


def _other_poses(
    energy: DepthEnergy, state: BodyState, k: int, limb: str
) -> list[Float[np.ndarray, "J 3"]]:
    """Poses to take a limb's joints from: those of other views, and the usual ones of arms."""
    others = [pose for j, pose in enumerate(state.pose) if j != k]
    return others + (
        list(arm_poses(energy.body, energy.settings.search.arms)) if limb == "arm" else []
    )


def _best(energy: DepthEnergy, k: int, now: Tried, starts: list[Tried]) -> Tried:
    """Of some starts, the one with the least misfit in view k after coarse steps of all and fine
    steps of the best; ``now`` where none is better.
    """
    settings = energy.settings
    stride = _stride(energy, k)
    coarse = replace(settings.search.coarse[-1][1], stride=2 * stride)
    fine = replace(settings.limbs.fine, stride=stride)
    tried = [_refined(energy, k, start, coarse) for start in starts]
    tried = sorted(tried, key=lambda start: start.misfit)[: settings.limbs.kept]
    stays, *others = (_refined(energy, k, start, fine) for start in (now, *tried))
    best = min(others, key=lambda start: start.misfit)
    return best if best.misfit < settings.limbs.improvement * stays.misfit else now


def _standing(
    energy: DepthEnergy,
    k: int,
    betas: Float[np.ndarray, " B"],
    pose: Float[np.ndarray, "J 3"],
    degrees: float,
) -> Tried:
    """A pose of another view, upright, turned by so many degrees from facing the camera, and placed
    on the person of view k.
    """
    pose = np.concatenate([np.zeros((1, 3)), pose[1:]])
    grid = energy.views[k].grid(energy.settings.search.stride)
    return placed(energy, grid, energy.body.prepare(betas)(pose), betas, pose, degrees)


def _with_limb(now: Tried, other: Float[np.ndarray, "J 3"], rows: Int[np.ndarray, " j"]) -> Tried:
    """With the joints of a limb, and what their prior is around, from another pose."""
    pose = now.state.pose.copy()
    mean = now.mean.copy()
    pose[0, rows] = mean[rows] = other[rows]
    return replace(now, state=replace(now.state, pose=pose), mean=mean)


def _refined(energy: DepthEnergy, k: int, start: Tried, stage: DepthStage) -> Tried:
    """Some steps further; the misfit on finer pixels."""
    fine = energy.views[k].grid(_stride(energy, k))
    prepared = energy.body.prepare(start.state.betas)
    start = refined(energy, k, prepared, start, stage)
    surface = prepared(start.state.pose[0], start.state.trans[0]).vertices
    return replace(
        start, misfit=misfit(fine, look(fine, surface, energy.triangles), energy.settings)
    )
