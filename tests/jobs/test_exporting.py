"""A file in, a file out: fits with their markers, motions without, real captures where there are
such.
"""

from dataclasses import replace

import numpy as np
import pytest
from read_fbx import Fbx
from synthetic_fit import synthetic_fit

from habitus.body.motion import BodyMotion
from habitus.errors import HabitusError
from habitus.export.motion import export_motion, write_motion
from habitus.export.npz import write_npz
from habitus.io.captures.read import read_capture
from habitus.jobs.estimates import body_from_measurements, save_estimate
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


def test_a_person_without_a_motion_is_a_rig_on_the_ground(tmp_path):
    known = body_from_measurements(sex="male", age=9.0, height=1.35)
    save_estimate(known, tmp_path / "him.npz")
    told = export_file(
        tmp_path / "him.npz", tmp_path / "him.fbx", detail="coarse", correctives="live:12"
    )
    found = Fbx(told.path).vertices(1)
    assert told.frames == 2 and told.drivers is not None
    assert np.allclose(np.ptp(found[:, 1]), 1.35, atol=2e-3) and abs(found[:, 1].min()) < 1e-5
    rest = known.body.rest_vertices(known.betas)
    assert np.allclose(found, rest - [0, rest[:, 1].min(), 0], atol=1e-5)
    mean = export_file("female", tmp_path / "her.bvh")
    assert mean.path.exists() and mean.frames == 2
    np.savez(tmp_path / "other.npz", betas=np.zeros(10), body=np.array("smplh"))
    with pytest.raises(HabitusError, match="belong to the body 'smplh'"):
        export_file(tmp_path / "other.npz", tmp_path / "a.fbx")
    np.savez(tmp_path / "other.npz", betas=np.ones(130), body=np.array("male"))
    with pytest.raises(HabitusError, match="130 betas; male has 100"):
        export_file(tmp_path / "other.npz", tmp_path / "a.fbx")


ARRAYS = ("pose", "trans", "betas", "soft_tissue")


@pytest.mark.parametrize("name", ARRAYS)
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_numbers_that_are_none_are_refused_with_their_frame(tmp_path, name, value):
    fit = synthetic_fit(5)
    array = np.array(getattr(fit, name))
    array[(1, *[0] * (array.ndim - 1))] = value
    spoilt = replace(fit, **{name: array})
    for ending in (".bvh", ".glb", ".npz", ".trc", ".fbx"):
        with pytest.raises(HabitusError, match=r"1, counted from 0"):
            export_file(spoilt, tmp_path / f"out{ending}")
    assert not list(tmp_path.iterdir())
    write_npz(fit, tmp_path / "body.npz")
    write_motion(BodyMotion.of(fit), tmp_path / "motion.npz")
    key = {"pose": "poses", "soft_tissue": "soft_tissue_betas"}.get(name, name)
    for file in ("body.npz", "motion.npz"):
        arrays = dict(np.load(tmp_path / file))
        arrays[key] = array.reshape(arrays[key].shape)
        np.savez(tmp_path / file, **arrays)
        with pytest.raises(HabitusError, match="finite"):
            export_file(tmp_path / file, tmp_path / "out.bvh", body=fit.body)
