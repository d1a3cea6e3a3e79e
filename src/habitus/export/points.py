"""Joints, and a fit's markers, as points in a TRC file."""

import os
from typing import TYPE_CHECKING, Any

import numpy as np

from habitus.export.trc import write_trc
from habitus.io.captures.read import Capture

if TYPE_CHECKING:
    from habitus.body.motion import Moving


def write_points(fit: "Moving", path: str | os.PathLike[str]) -> Capture:
    """Write the joints, and of a fit its markers where the body carries them, as .trc; what was
    written comes back.

    Millimetres, y up. Joints have the body's names, markers their labels; a joint of the same name
    as a marker is called ``…_joint``. Raises HabitusError where the file cannot be written.
    """
    carried: Any = getattr(fit, "predicted_soft_tissue", None)
    carried = getattr(fit, "predicted_pose_stage", None) if carried is None else carried
    labels = () if carried is None else tuple(fit.labels)  # type: ignore[attr-defined]
    names = tuple(f"{name}_joint" if name in labels else name for name in fit.body.joint_names)
    points = [fit.joints()] if carried is None else [np.asarray(carried, np.float64), fit.joints()]
    capture = Capture(
        fit.capture_name,
        (*labels, *names),
        np.concatenate(points, axis=1),
        fit.rate_hz,
        fit.up_axis,
    )
    write_trc(capture, path)
    return capture
