"""What is made of a fit of a real capture: files of exaggerated and retargeted motions, and who
they belong to.
"""

from dataclasses import replace

import numpy as np
import pytest
from read_bvh import Bvh
from read_fbx import Fbx
from real_fit import real_fit
from synthetic_fit import synthetic_fit, tube_body

import habitus as hb
from habitus.body.motion import BodyMotion
from habitus.cli.main import main
from habitus.errors import HabitusError
from habitus.io.models.bodies import load_body
from habitus.jobs.results import Motion
from habitus.rotations import up_rotation


@pytest.fixture
def real(shared, tmp_path_factory):
    return real_fit(shared, tmp_path_factory.getbasetemp())[0]


def test_a_real_fit_is_exaggerated_and_read_back(real, tmp_path, capsys):
    real.export(tmp_path / "body.npz")
    main(
        [
            "exaggerate",
            str(tmp_path / "body.npz"),
            "--factor",
            "1.5",
            "--out",
            str(tmp_path / "more.npz"),
        ]
    )
    assert "40 frames; soft tissue moves the skin by" in capsys.readouterr().out
    again = hb.load_motion(tmp_path / "more.npz")
    direct = hb.exaggerate(real, 1.5)
    np.testing.assert_allclose(again.vertices([0, 20]), direct.vertices([0, 20]), atol=1e-9)
    assert again.made == direct.made and "fitted to the markers of gappy" in again.made[0]
    with pytest.raises(HabitusError, match=r"expected the body\.npz of a marker fit"):
        hb.load_fit(tmp_path / "more.npz")
    direct.export(tmp_path / "more.glb")
    assert (tmp_path / "more.glb").read_bytes()[:4] == b"glTF"


def test_a_real_fit_on_a_character_keeps_its_feet(real, tmp_path, capsys):
    level = real.body.full
    hero = level.v_template.copy()
    legs = hero[:, 1] < level.joint_template[1, 1]
    hero[legs, 1] = level.joint_template[1, 1] + 0.75 * (hero[legs, 1] - level.joint_template[1, 1])
    hb.write_surface(
        type("hero", (), {"vertices": hero, "faces": level.faces}), tmp_path / "hero.ply"
    )
    hb.exaggerate(real, 1.0, out=tmp_path / "walk.npz")
    words = ["retarget", str(tmp_path / "walk.npz"), "--target", str(tmp_path / "hero.ply")]
    main([*words, "--out", str(tmp_path / "hero.npz")])
    said = capsys.readouterr().out
    assert "legs are 0.7" in said and "40 frames of hero" in said
    found = hb.retarget(real, tmp_path / "hero.ply")
    assert found.slip[2] < found.slip[0] + 0.01 and found.below[2] > min(0, found.below[0]) - 0.003
    again = hb.load_motion(tmp_path / "hero.npz")
    np.testing.assert_allclose(
        again.vertices(7), found.motion.vertices(7), atol=1e-5
    )  # PLY keeps 32 bits
    np.testing.assert_allclose(again.body.full.v_template, hero, atol=1e-6)
    with np.load(tmp_path / "hero.npz") as file:
        assert str(file["surface_model_type"]) == "hero" and "retargeted to hero" in str(
            file["made"][-1]
        )
    with pytest.raises(HabitusError, match="belong to the body 'hero'"):
        hb.load_motion(_without(tmp_path / "hero.npz", ("character_vertices", "character_base")))


def _without(path, names):
    with np.load(path) as file:
        np.savez(
            path.with_name("less.npz"),
            **{name: file[name] for name in file.files if name not in names},
        )
    return path.with_name("less.npz")


def test_whom_a_motion_is_retargeted_to(real, tmp_path):
    from habitus.jobs.motions import find_target

    motion = BodyMotion.of(real)
    body, betas, _ = find_target(motion, "1.5,-0.5")
    assert body is motion.body and betas.tolist() == [1.5, -0.5] + 22 * [0.0]
    body, betas, name = find_target(motion, "female")
    assert name == "female" and not betas.any()
    np.testing.assert_allclose(body.full.v_template, load_body("female").full.v_template)
    real.export(tmp_path / "body.npz")
    body, betas, _ = find_target(motion, tmp_path / "body.npz")
    assert body is motion.body and np.array_equal(betas, real.betas)
    tube = tube_body()
    hb.write_surface(
        type("t", (), {"vertices": tube.v_template, "faces": tube.faces}), tmp_path / "tube.obj"
    )
    for wrong, said in (
        (tmp_path / "tube.obj", "register"),
        ("nobody", "no body to retarget"),
        ([1.0] * 25, "24"),
        ("1e6,0", "within 100 standard deviations"),
    ):
        with pytest.raises(HabitusError, match=said):
            find_target(motion, wrong)


def test_files_as_amass_has_them(real, tmp_path):
    real.save(tmp_path / "walk", npz_style="amass")
    again = hb.load_motion(tmp_path / "walk" / "body.npz")
    kept = [k for k, name in enumerate(real.body.joint_names) if "hand" not in name]
    whole = BodyMotion.of(real)
    joints = replace(whole, soft_tissue=None).joints()
    np.testing.assert_allclose(again.joints()[:, kept], joints[:, kept], atol=1e-6)
    poses = np.zeros((3, 156))
    np.savez(
        tmp_path / "amass.npz",
        poses=poses,
        trans=np.zeros((3, 3)),
        betas=np.ones(16),
        mocap_framerate=120.0,
    )
    with pytest.raises(HabitusError, match="name no body"):
        hb.load_motion(tmp_path / "amass.npz")
    with pytest.raises(HabitusError, match="another person"):
        hb.load_motion(tmp_path / "amass.npz", "default")
    smplh = load_body("default", joints="smplh")
    theirs = replace(smplh, name="smplh", finer=None, full_vertices=None)
    found = hb.load_motion(tmp_path / "amass.npz", theirs)
    assert (
        found.betas.tolist() == 16 * [1.0] + 8 * [0.0]
        and found.up_axis == "+z"
        and found.num_frames == 3
    )


def test_motions_that_cannot_be_read_or_written(tmp_path):
    fit = synthetic_fit(4)
    motion = Motion.of(fit)
    motion.export(tmp_path / "tubes.npz")
    with pytest.raises(HabitusError, match="'tubes'"):
        hb.load_motion(tmp_path / "tubes.npz")
    again = hb.load_motion(tmp_path / "tubes.npz", fit.body)
    np.testing.assert_allclose(again.vertices(), motion.vertices(), atol=1e-12)
    with pytest.raises(HabitusError, match=r"\.npz .*\.glb"):
        hb.exaggerate(motion, 2.0, out=tmp_path / "x.stl")
    for spoilt in (
        {"poses": np.zeros((4, 71))},
        {"trans": np.zeros((5, 3))},
        {"mocap_framerate": np.array(0.0)},
    ):
        with np.load(tmp_path / "tubes.npz") as file:
            arrays = {
                name: file[name] for name in file.files if name != "mocap_frame_rate"
            } | spoilt
        np.savez(tmp_path / "spoilt.npz", **arrays)
        with pytest.raises(HabitusError, match=r"spoilt\.npz"):
            hb.load_motion(tmp_path / "spoilt.npz", fit.body)
    with pytest.raises(HabitusError, match="no such file"):
        hb.load_motion(tmp_path / "none.npz")


def test_files_of_a_real_capture_show_the_fit(real, tmp_path):
    turn = up_rotation(real.up_axis)
    frames = [0, 20, 39]
    full = np.concatenate([part.vertices for part in real.surfaces(frames, body=real.finest_body)])
    told = hb.export_file(real, tmp_path / "a.fbx")
    found = Fbx(told.path)
    assert told.worst <= 1e-4 and 0 < told.morphs < 430
    for frame, known in zip(frames, full, strict=True):
        assert np.linalg.norm(found.vertices(frame) - known @ turn.T, axis=1).max() < 2e-4
    skeleton = Bvh(hb.export_file(real, tmp_path / "a.bvh").path)
    for frame, known in zip(frames, real.joints(frames), strict=True):
        placed = np.array([skeleton.joints(frame)[name] for name in real.body.joint_names]) / 100
        assert np.linalg.norm(placed - known @ turn.T, axis=1).max() < 2e-4
