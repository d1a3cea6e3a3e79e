"""A file in, a file out: fits with their markers, motions without, real captures where there are such."""

import numpy as np
import pytest
from read_bvh import Bvh
from read_fbx import Fbx
from real_fit import real_fit
from synthetic_fit import synthetic_fit

from habitus.body.motion import BodyMotion
from habitus.body.up import up_rotation
from habitus.errors import HabitusError
from habitus.export.motion import export_motion
from habitus.io.captures.read import read_capture
from habitus.jobs.exporting import export_file


def test_a_fit_brings_its_markers_and_a_motion_has_none(tmp_path):
    fit = synthetic_fit(4)
    export_motion(fit, tmp_path / "fit.npz")
    export_motion(BodyMotion.of(fit), tmp_path / "motion.npz")
    for name, labels in (("fit", set(fit.labels)), ("motion", set())):
        told = export_file(tmp_path / f"{name}.npz", tmp_path / f"{name}.trc", body=fit.body)
        found = set(read_capture(told.path).labels)
        assert set(fit.body.joint_names) <= found and found & set(fit.labels) == found & labels
    with pytest.raises(HabitusError, match=r"other\.npz: no such file"):
        export_file(tmp_path / "other.npz", tmp_path / "a.fbx")
    with pytest.raises(HabitusError, match=r"cannot write a motion to a\.max"):
        export_file(tmp_path / "other.npz", tmp_path / "a.max")


def test_a_real_capture_on_the_default_body(shared, tmp_path_factory, tmp_path):
    fit, _ = real_fit(shared, tmp_path_factory.getbasetemp())
    turn, frames = up_rotation(fit.up_axis), [0, 20, 39]
    full = np.concatenate([part.vertices for part in fit.surfaces(frames, body=fit.finest_body)])
    told = export_file(fit, tmp_path / "a.fbx")
    found = Fbx(told.path)
    assert told.worst <= 1e-4 and 0 < told.morphs < 430
    for frame, known in zip(frames, full, strict=True):
        assert np.linalg.norm(found.vertices(frame) - known @ turn.T, axis=1).max() < 2e-4
    skeleton = Bvh(export_file(fit, tmp_path / "a.bvh").path)
    for frame, known in zip(frames, fit.joints(frames), strict=True):
        placed = np.array([skeleton.joints(frame)[name] for name in fit.body.joint_names]) / 100
        assert np.linalg.norm(placed - known @ turn.T, axis=1).max() < 2e-4
