"""A file in, a file out: fits with their markers, motions without, real captures where there are such."""

import pytest
from synthetic_fit import synthetic_fit

from habitus.body.motion import BodyMotion
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
