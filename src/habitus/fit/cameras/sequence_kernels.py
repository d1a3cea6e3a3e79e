"""One damped step of frames that cameras see as keypoints, in groups of LANES frames; steps and
their acceptance are those of `habitus.fit.markers.sequence_kernels`.
"""

import numpy as np

from habitus.fit.markers.sequence_kernels import compare, gather_coupling, propose
from habitus.kernels.jit import jit
from habitus.kernels.simd import LANES
from habitus.residuals.keypoint_kernels import (
    gather_keypoints,
    keypoint_cost,
    linearize_keypoints,
)


@jit
def visit(data, offsets, workspace, level, block):
    """`habitus.solve.sequence.DenseVisits.visit` of the frames ``block`` of a level."""
    group = np.empty(LANES, dtype=np.int64)
    for first in range(0, len(block), LANES):
        count = min(LANES, len(block) - first)
        for k in range(LANES):
            group[k] = block[min(first + k, len(block) - 1)]
        gather_keypoints(data, offsets, workspace, level.frames, level.states, group)
        gather_coupling(offsets, workspace, level, group)
        own = group[:count]
        cost = linearize_keypoints(data, offsets, workspace)
        change, predicted, moved = propose(offsets, workspace, level, own, 3 * offsets.blocks)
        trial = keypoint_cost(data, offsets, workspace, offsets.trial)
        compare(offsets, workspace, level, own, cost, trial, change, predicted, moved)
