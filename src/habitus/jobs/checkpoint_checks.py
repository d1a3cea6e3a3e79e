"""Whether what a checkpoint holds fits together: a damaged file may be whole and yet no state of a
training.
"""

from typing import Any

import numpy as np

from habitus.learn.callback import TrainingState
from habitus.learn.estimate import Estimate
from habitus.mesh.joint_tree import check_parents


def checked_state(state: TrainingState, seconds: Any) -> tuple[TrainingState, list[float]]:
    """The state and its seconds as they are. Raises ValueError, TypeError or HabitusError where
    they cannot be.
    """
    if type(state.finished) is not bool:
        raise ValueError("it does not say whether it is finished")
    for record in state.history:
        if type(record.round) is not int or record.round < 0 or not isinstance(record.step, str):
            raise ValueError("its history is spoilt")
        if not np.isfinite([float(value) for value in record.energy.terms.values()]).all():
            raise ValueError("its energies are spoilt")
    times = [float(second) for second in seconds]
    if len(times) != len(state.history) or not np.isfinite(times).all():
        raise ValueError("its seconds are spoilt")
    for estimate in filter(None, (state.estimate, state.before)):
        _check_estimate(estimate)
    return state, times


def _check_estimate(estimate: Estimate) -> None:
    rig = estimate.rig
    check_parents(rig.parents)
    s = len(estimate.templates)
    n = len(estimate.pose)
    j = rig.num_joints
    v = rig.num_vertices
    shapes = {
        "templates": (s, v, 3),
        "joints": (s, j, 3),
        "descriptors": (s, *estimate.descriptors.shape[1:]),
        "pose": (n, j, 3),
        "trans": (n, 3),
    }
    arrays = {key: getattr(estimate, key) for key in shapes} | {"value": rig.value}
    shapes["value"] = rig.index.shape
    if rig.posedirs is not None:
        arrays["posedirs"], shapes["posedirs"] = rig.posedirs, (v, 3, *rig.posedirs.shape[2:])
    for key, array in arrays.items():
        if array.shape != shapes[key] or array.dtype.kind != "f" or not np.isfinite(array).all():
            raise ValueError(f"its {key} are {array.dtype} of shape {array.shape}, or not finite")
    whole = rig.index.dtype.kind in "iu" and rig.index.ndim == 2 and rig.index.size > 0
    if not whole or rig.index.min() < 0 or rig.index.max() >= j:
        raise ValueError("its skinning names joints that are not there")
