"""One damped step of frames that cameras see as keypoints, in groups of LANES frames; steps and
their acceptance are those of `habitus.fit.markers.sequence_kernels`.
"""

import numpy as np

from habitus.fit.markers.sequence_kernels import compare, gather_coupling, propose
from habitus.kernels.jit import jit
from habitus.residuals.keypoint_kernels import (
    gather_keypoints,
    keypoint_cost,
    linearize_keypoints,
)
from habitus.solve.sequence import NOISE


@jit
def visit(data, offsets, workspace, level, block):
    """`habitus.solve.sequence.DenseVisits.visit` of the frames ``block`` of a level."""
    lanes = workspace.shape[1]
    group = np.empty(lanes, dtype=np.int64)
    for first in range(0, len(block), lanes):
        count = min(lanes, len(block) - first)
        for k in range(lanes):
            group[k] = block[min(first + k, len(block) - 1)]
        gather_keypoints(data, offsets, workspace, level.frames, level.states, group)
        gather_coupling(offsets, workspace, level, group)
        own = group[:count]
        cost = linearize_keypoints(data, offsets, workspace)
        change, predicted, moved = propose(offsets, workspace, level, own, 3 * offsets.blocks)
        trial = keypoint_cost(data, offsets, workspace, offsets.trial)
        compare(offsets, workspace, level, own, cost, trial, change, predicted, moved, NOISE)
