"""One call for all endings, of a fit and of a motion that is none."""

import numpy as np
import pytest
import trimesh
from read_glb import Glb
from synthetic_fit import synthetic_fit, tube_body

from habitus.body.motion import BodyMotion
from habitus.errors import HabitusError
from habitus.export.motion import export_motion
from habitus.io.people import read_fit, read_motion
from habitus.jobs.results import Motion
from habitus.rotations import up_rotation


@pytest.mark.parametrize(
    "ending", [".fbx", ".glb", ".bvh", ".trc", ".mot", ".npz", ".obj", ".ply", ""]
)
def test_every_ending_of_a_fit_and_of_a_motion(tmp_path, ending):
    fit = synthetic_fit(8, body=tube_body(posedirs=True), rate_hz=120.0)
    for name, moving in (("a", fit), ("b", BodyMotion.of(fit))):
        told = export_motion(moving, tmp_path / f"{name}{ending}")
        frames = 1 if ending in (".obj", ".ply") else 8
        assert (told.frames, told.rate_hz) == (frames, 120.0) and told.path.exists()
        assert bool(told.morphs) == (ending in (".fbx", ".glb"))
    slow = export_motion(fit, tmp_path / f"c{ending}", fps=60)
    assert (slow.frames, slow.rate_hz) == (min(frames, 4), 60.0)


def test_a_fit_keeps_its_markers_and_another_rate_is_a_motion(tmp_path):
    fit = synthetic_fit(8, rate_hz=120.0)
    fit.export(tmp_path / "a.npz")
    assert read_fit(tmp_path / "a.npz", fit.body).labels == fit.labels
    fit.export(tmp_path / "b.npz", fps=30)
    assert np.allclose(read_motion(tmp_path / "b.npz", fit.body).pose, fit.pose[::4])
    Motion.of(fit).export(tmp_path / "c.glb", fps=30, correctives="pca:2")
    glb = Glb(tmp_path / "c.glb")
    assert (
        len({name.removesuffix("_back") for name in glb.json["meshes"][0]["extras"]["targetNames"]})
        == 2
    )
    assert np.allclose(glb.array(glb.json["animations"][0]["samplers"][0]["input"]), [0, 1 / 30])


def test_one_mesh_of_a_frame_or_at_rest(tmp_path):
    fit = synthetic_fit(6)
    for frame, known in (
        (None, fit.body.rest_vertices(fit.betas)),
        (4, fit.vertices(4) @ up_rotation("+z").T),
    ):
        export_motion(fit, tmp_path / "a.ply", frame=frame)
        found = trimesh.load(tmp_path / "a.ply", process=False)
        assert np.abs(found.vertices - known).max() < 1e-6
    with pytest.raises(HabitusError, match="expected 0 to 5"):
        export_motion(fit, tmp_path / "a.ply", frame=6)


def test_other_endings_and_words_are_refused_before_the_work(tmp_path):
    with pytest.raises(HabitusError, match=r"cannot write a motion to a\.max: expected .*\.fbx"):
        synthetic_fit(2).export(tmp_path / "a.max")
    with pytest.raises(HabitusError, match="pca:16"):
        synthetic_fit(2).export(tmp_path / "a.fbx", correctives="many")
    assert not list(tmp_path.iterdir())
