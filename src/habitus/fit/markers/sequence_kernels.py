"""Compiled steps of the whole-sequence solve, and the charts of root rotations;
`habitus.solve.sequence` is the same in NumPy.

Implements all terms of `habitus.fit.markers.energy.sequence_terms`: "data", "pose" and
"soft_tissue" by `habitus.residuals.marker_kernels`, and here the "acceleration" terms, which couple
a frame to its neighbours. Rotation vectors theta and theta + 2 pi k along its axis are the same
rotation; a root that turns and turns changes to the shorter one past 1.5 pi.
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from habitus.kernels.jit import jit, jit_inline
from habitus.kernels.simd import load, spread, store, where_less
from habitus.kernels.simd_cholesky import factor, solve_factored
from habitus.kernels.simd_linalg import block_row
from habitus.residuals.marker_kernels import frame_cost, linearize
from habitus.solve.sequence import FLOOR


class MarkerData(NamedTuple):
    """What the markers are compared with: T frames of M observed markers, and the Gaussian over the
    N unknowns.
    """

    observed: Float[np.ndarray, "T M 3"]
    weights: Float[np.ndarray, "T M"]
    inverse_squared_scales: Float[np.ndarray, " M"]
    weight: float
    mean: Float[np.ndarray, " N"]
    precision: Float[np.ndarray, "N N"]


class LevelArrays(NamedTuple):
    """The frames of one level (`habitus.solve.sequence.Level`): F frames, N unknowns."""

    frames: Int[np.ndarray, " F"]
    states: Float[np.ndarray, "F N"]
    links: Float[np.ndarray, "F2 N"]
    costs: Float[np.ndarray, " F"]
    damping: Float[np.ndarray, " F"]
    moved: Float[np.ndarray, " F"]
    cost_decrease: Float[np.ndarray, " F"]
    relaxations: Float[np.ndarray, " F"]


@jit
def visit(
    rig, slots, offsets, workspace, data, level, block, measured_end, times, tolerance, rounding
):
    """Damped Gauss-Newton steps of the frames `block` (indices into the level) in groups of as many
    as the workspace has lanes.

    Up to so many `times` a group, until its first frame moves by less than `tolerance`. Where a
    group is not full, copies of the last frame fill the other lanes. A step may raise the cost by
    the share `rounding` of it.
    """
    lanes = workspace.shape[1]
    group = np.empty(lanes, dtype=np.int64)
    for first in range(0, len(block), lanes):
        count = min(lanes, len(block) - first)
        for k in range(lanes):
            group[k] = block[min(first + k, len(block) - 1)]
        for _ in range(times):
            gather(rig, offsets, workspace, data, level.frames, level.states, group)
            gather_coupling(offsets, workspace, level, group)
            own = group[:count]
            cost = linearize(rig, slots, offsets, workspace, data)
            change, predicted, moved = propose(offsets, workspace, level, own, measured_end)
            trial = frame_cost(rig, offsets, workspace, data, offsets.trial)
            compare(offsets, workspace, level, own, cost, trial, change, predicted, moved, rounding)
            if level.moved[group[0]] < tolerance:
                break


@jit
def costs(rig, offsets, workspace, data, frames, states, out):
    """f of frames in their states (F, N), into out (F,)."""
    lanes = workspace.shape[1]
    group = np.empty(lanes, dtype=np.int64)
    for first in range(0, len(frames), lanes):
        for k in range(lanes):
            group[k] = min(first + k, len(frames) - 1)
        gather(rig, offsets, workspace, data, frames, states, group)
        store(workspace, offsets.step, frame_cost(rig, offsets, workspace, data, offsets.state))
        for k in range(lanes):
            out[group[k]] = workspace[offsets.step, k]


@jit_inline
def gather(rig, offsets, workspace, data, frames, states, group):
    """Bring states and observations of a group to its lanes, relative to the body's translation."""
    for k in range(workspace.shape[1]):
        t = frames[group[k]]
        for n in range(states.shape[1]):
            workspace[offsets.state + n, k] = 0.0 if n < 3 else states[group[k], n]
        for i in range(len(rig.triangles)):
            workspace[offsets.weight + i, k] = data.weights[t, i]
            for c in range(3):
                away = data.observed[t, i, c] - states[group[k], c]
                workspace[offsets.observed + 3 * i + c, k] = away


@jit_inline
def gather_coupling(offsets, workspace, level, group):
    """Gradient and curvature of the second differences that each frame is part of."""
    last = len(level.states) - 1
    for k in range(workspace.shape[1]):
        f = group[k]
        a = level.states[max(f - 2, 0)]
        b = level.states[max(f - 1, 0)]
        c = level.states[f]
        d = level.states[min(f + 1, last)]
        e = level.states[min(f + 2, last)]
        x = level.links[f]
        y = level.links[f + 1]
        z = level.links[f + 2]
        for n in range(len(c)):
            pull = x[n] * (c[n] - 2.0 * b[n] + a[n]) - 2.0 * y[n] * (d[n] - 2.0 * c[n] + b[n])
            workspace[offsets.pull + n, k] = pull + z[n] * (e[n] - 2.0 * d[n] + c[n])
            workspace[offsets.stiffness + n, k] = x[n] + 4.0 * y[n] + z[n]


@jit_inline
def propose(offsets, workspace, level, group, measured_end):
    """States to try, in rows offsets.trial, by the normal equations of a linearised group and the
    pull and stiffness of its neighbours; the change of the coupling, what the step should gain, and
    the mean square by which rows 3 to ``measured_end`` would move.
    """
    unknowns = 3 * offsets.blocks
    for k in range(workspace.shape[1]):
        workspace[offsets.trial, k] = level.damping[group[min(k, len(group) - 1)]]
        workspace[offsets.trial + 1, k] = level.relaxations[group[min(k, len(group) - 1)]]
    damping = load(workspace, offsets.trial)
    relaxation = load(workspace, offsets.trial + 1)
    for n in range(unknowns):
        gradient = load(workspace, offsets.gradient + n) + load(workspace, offsets.pull + n)
        store(workspace, offsets.gradient + n, gradient)
        store(workspace, offsets.step + n, -gradient)
        row = offsets.matrix + block_row(n // 3, n // 3) + 4 * (n % 3)
        store(
            workspace,
            row,
            load(workspace, row) + (load(workspace, offsets.stiffness + n) + damping + FLOOR),
        )
    factor(workspace, offsets.matrix, offsets.blocks)
    solve_factored(workspace, offsets.matrix, offsets.blocks, offsets.step)
    change = spread(workspace, 0.0)
    predicted = spread(workspace, 0.0)
    moved = spread(workspace, 0.0)
    along = spread(workspace, 0.0)
    spent = spread(workspace, 0.0)
    for n in range(unknowns):
        newton = load(workspace, offsets.step + n)
        gradient = load(workspace, offsets.gradient + n)
        p = relaxation * newton
        store(workspace, offsets.trial + n, load(workspace, offsets.state + n) + p)
        change = (
            change
            + (load(workspace, offsets.pull + n) + 0.5 * load(workspace, offsets.stiffness + n) * p)
            * p
        )
        predicted = predicted + (gradient - 0.5 * relaxation * (gradient + damping * newton)) * p
        along = along - gradient * newton
        spent = spent + damping * newton * newton
        if 3 <= n < measured_end:
            moved = moved + newton * newton
    least = 1e-6 * along
    longer = along / where_less(along - spent, least, least, along - spent)
    return change, predicted, longer * longer * moved / (measured_end - 3.0)


@jit_inline
def compare(offsets, workspace, level, group, cost, trial, change, predicted, moved, rounding):
    """Take the steps whose own cost ``trial``, instead of ``cost``, lowers the total; write back
    the rest.
    """
    store(workspace, offsets.gradient, change + trial - cost)
    store(workspace, offsets.gradient + 1, predicted)
    store(workspace, offsets.gradient + 2, moved)
    store(workspace, offsets.gradient + 3, trial)
    store(workspace, offsets.gradient + 4, cost)
    write_back(offsets, workspace, level, group, rounding)


@jit_inline
def write_back(offsets, workspace, level, group, rounding):
    """Take the steps that lower the total cost; set costs, damping and how far each frame moved."""
    for k in range(len(group)):
        f = group[k]
        change = workspace[offsets.gradient, k]
        predicted = workspace[offsets.gradient + 1, k]
        taken = change < rounding * workspace[offsets.gradient + 4, k]
        level.cost_decrease[f] = -change if taken else 0.0
        level.costs[f] = (
            workspace[offsets.gradient + 3, k] if taken else workspace[offsets.gradient + 4, k]
        )
        size = np.sqrt(workspace[offsets.gradient + 2, k])
        level.moved[f] = size if np.isfinite(size) else 0.0
        damping = level.damping[f]
        if taken:
            for n in range(level.states.shape[1]):
                step = workspace[offsets.trial + n, k] - workspace[offsets.state + n, k]
                level.states[f, n] += step
            ratio = change / predicted
            factor_down = 0.1 if ratio > 0.75 else 0.5 if ratio > 0.25 else 2.0
            level.damping[f] = damping * factor_down if damping > 1e-2 else 0.0
        else:
            level.damping[f] = min(max(8.0 * damping, 10.0), 1e12)


LONGEST_TURN = 1.5 * np.pi
"""A longer root rotation vector (rad) gives way to its shorter equivalent: the chart is singular at
2 pi.
"""
WHOLE = 2.0 * np.pi


def nearest_equivalent(
    vectors: Float[np.ndarray, "*F 3"], reference: Float[np.ndarray, "*F 3"]
) -> Float[np.ndarray, "*F 3"]:
    """The same rotations by the vectors (theta + 2 pi k along their axes) closest to
    `reference`.
    """
    angle = np.linalg.norm(vectors, axis=-1, keepdims=True)
    axis = np.where(angle > 1e-12, vectors / np.maximum(angle, 1e-300), 0.0)
    turns = np.round((np.sum(axis * reference, axis=-1, keepdims=True) - angle) / WHOLE)
    return vectors + WHOLE * turns * axis


def shortened(vector: Float[np.ndarray, " 3"]) -> Float[np.ndarray, " 3"]:
    """The same rotation by its shortest vector if this one passes `LONGEST_TURN`."""
    angle = math.sqrt(vector @ vector)
    return (
        vector if angle <= LONGEST_TURN else vector * (1.0 - WHOLE * round(angle / WHOLE) / angle)
    )


def unwrap(
    vectors: Float[np.ndarray, "T 3"],
) -> tuple[Float[np.ndarray, "T 3"], Bool[np.ndarray, " T"]]:
    """Rotation vectors that follow each other, and where (T,) they jump to a shorter equivalent
    past `LONGEST_TURN`.
    """
    out = np.array(vectors, dtype=float)
    jumps = np.zeros(len(vectors), dtype=bool)
    _unwrap(out, jumps)
    return out, jumps


@jit
def _unwrap(out, jumps):
    for t in range(len(out)):
        x = out[t, 0]
        y = out[t, 1]
        z = out[t, 2]
        angle = math.sqrt(x * x + y * y + z * z)
        if angle > 1e-12:
            along = (
                (x * out[t - 1, 0] + y * out[t - 1, 1] + z * out[t - 1, 2]) / angle
                if t > 0
                else angle
            )
            longer = angle + WHOLE * math.floor((along - angle) / WHOLE + 0.5)
            if abs(longer) > LONGEST_TURN:
                longer -= WHOLE * math.floor(longer / WHOLE + 0.5)
                jumps[t] = t > 0
            for k in range(3):
                out[t, k] *= longer / angle
