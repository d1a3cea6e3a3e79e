"""Vertices in other topologies, the way back, and parameters of a planted model; the commands."""

import json
from pathlib import Path

import numpy as np
import pytest
from planted_model import planted_model

import habitus as hb
from habitus.body.motion import BodyMotion
from habitus.body.prior import shipped_prior
from habitus.cli.main import main
from habitus.errors import HabitusError
from habitus.export.motion import write_motion
from habitus.export.topology import topology_vertices
from habitus.io.meshes import read_mesh
from habitus.io.models.bodies import load_body, save_body
from habitus.io.people import read_motion
from habitus.io.topologies import load_topology, read_vertices
from habitus.jobs.topologies import register_vertices, solve_model
from habitus.observe.simulated_markers import smooth_motion
from habitus.rotations import matrix_from_rotvec, rotvec_from_matrix, up_rotation

MESHES = Path(__file__).resolve().parents[3] / "shared" / "topologies"


def degrees(pose, other):
    between = np.swapaxes(matrix_from_rotvec(other), -1, -2) @ matrix_from_rotvec(pose)
    return np.degrees(np.linalg.norm(rotvec_from_matrix(between), axis=-1))


def run(*arguments: object) -> int:
    try:
        main([str(word) for word in arguments])
    except SystemExit as stop:
        return int(stop.code or 0)
    return 0


def made_motion(body, betas, frames=3, seed=3):
    rng = np.random.default_rng(seed)
    prior = shipped_prior().for_joints(body.joint_names)
    pose, trans = smooth_motion(prior.mean, np.sqrt(np.diag(prior.covariance)), frames, 4.0, rng)
    return BodyMotion(
        body, betas, pose, trans, 30.0, up_axis="+y", capture_name="made", body_name=body.name,
        gender="female",
    )  # fmt: skip


@pytest.fixture(scope="module")
def motion():
    body = load_body("female", joints="smplh")
    return made_motion(body, np.clip(np.random.default_rng(1).normal(size=24), -2, 2))


@pytest.fixture(scope="module")
def npz(motion, tmp_path_factory):
    path = tmp_path_factory.mktemp("made") / "made.npz"
    write_motion(motion, path)
    return path


@pytest.mark.parametrize(("topology", "count"), [("smpl", 6890), ("smplx", 10475), ("mhr", 18439)])
def test_vertices_of_all_frames_lie_on_our_surface(motion, npz, tmp_path, topology, count):
    out = tmp_path / "a.npz"
    assert hb.export_file(npz, out, topology=topology).frames == 3
    with np.load(out) as file:
        vertices, faces = file["vertices"], file["faces"]
        assert (str(file["topology"]), str(file["up_axis"])) == (topology, "+y")
    assert vertices.shape == (3, count, 3) and faces.max() == count - 1
    places = load_topology(topology, motion.body.full)
    surface = np.concatenate(
        [s.vertices for s in motion.surfaces([0, 1, 2], body=motion.body.full)]
    )
    np.testing.assert_allclose(vertices, places.vertices(surface), atol=1e-6)


def test_one_frame_the_rest_and_a_folder(motion, npz, tmp_path, capsys):
    assert run("export", npz, "--topology", "smpl", "--frame", 1, "--out", tmp_path / "a.obj") == 0
    assert run("export", npz, "--topology", "smpl", "--out", tmp_path / "rest.ply") == 0
    assert run("export", npz, "--topology", "smpl", "--out", tmp_path / "all") == 0
    assert "one mesh" in capsys.readouterr().out
    places = load_topology("smpl", motion.body.full)
    posed, faces = read_mesh(tmp_path / "a.obj")
    expected = topology_vertices(motion, places, np.array([1]))[0]
    np.testing.assert_allclose(posed, expected, atol=2e-5)
    np.testing.assert_array_equal(faces, places.faces)
    rest = read_mesh(tmp_path / "rest.ply")[0]
    np.testing.assert_allclose(
        rest, places.vertices(motion.body.full.rest_vertices(motion.betas)), atol=1e-5
    )
    assert len(list((tmp_path / "all").glob("*.obj"))) == 3


@pytest.mark.parametrize("topology", ["smpl", "smplx"])
def test_there_and_back_is_the_same_person(motion, npz, tmp_path, topology, capsys):
    out = tmp_path / "there.npz"
    assert run("export", npz, "--topology", topology, "--out", out) == 0
    back = tmp_path / "back"
    assert run(
        "register", out, "--topology", topology, "--body", "female", "--out", back, "--strict"
    ) == 0  # fmt: skip
    assert "good" in capsys.readouterr().out
    found = read_motion(back)
    names = [name for name in motion.body.joint_names if name in found.body.joint_names]
    ours, theirs = (
        [body.joint_names.index(name) for name in names] for body in (motion.body, found.body)
    )
    assert degrees(found.pose[:, theirs], motion.pose[:, ours]).mean() < 0.2
    assert np.abs(found.betas - motion.betas).max() < 0.05
    assert json.loads((back / "metrics.json").read_text())["error_mm"]["mean"] < 0.3
    assert (found.up_axis, found.rate_hz, found.body_name) == ("+y", 30.0, "female")


def test_the_best_of_three_bodies_is_the_one_that_was_meant(npz, tmp_path):
    out = tmp_path / "there.npz"
    hb.export_file(npz, out, topology="smpl")
    assert hb.register_vertices(out, "smpl").motion.body_name == "female"


@pytest.mark.parametrize("topology", ["smpl", "smplx"])
def test_a_planted_model_is_recovered_through_our_surface(topology, tmp_path):
    model = planted_model(topology)
    save_body(model, tmp_path / "model.npz")
    model = load_body(tmp_path / "model.npz", num_betas=10)
    betas = np.clip(np.random.default_rng(2).normal(size=10), -2, 2)
    planted = made_motion(model, betas)
    vertices = planted.vertices()
    np.savez(tmp_path / "a.npz", vertices=vertices, up_axis="+y", rate_hz=30.0)
    ours = register_vertices(tmp_path / "a.npz", topology, "neutral", own_surface=True)
    assert ours.error_mm["mean"] < 2.0
    write_motion(ours.motion, tmp_path / "ours.npz")
    code = run(
        "export", tmp_path / "ours.npz", "--model", tmp_path / "model.npz",
        "--out", tmp_path / "amass.npz",
    )  # fmt: skip
    assert code == 0
    solved = read_motion(tmp_path / "amass.npz", load_body(tmp_path / "model.npz"))
    with np.load(tmp_path / "amass.npz") as file:
        assert file["poses"].shape == (3, 3 * model.num_joints)
        assert {"trans", "betas", "gender", "mocap_framerate", "error_mm"} <= set(file.files)
        assert str(file["surface_model_type"]) == ("smplh" if topology == "smpl" else "smplx")
        assert file["error_mm"][0] < 2.0
    assert solved.up_axis == "+z"
    places = load_topology(topology, ours.motion.finest_body)
    again = (solved.vertices() @ up_rotation("+z").T)[:, places.matched]
    off = 1e3 * np.linalg.norm(again - vertices[:, places.matched], axis=-1)
    assert off.mean() < 2.0
    pose = solved.pose.copy()
    pose[:, 0] = rotvec_from_matrix(up_rotation("+z") @ matrix_from_rotvec(pose[:, 0]))
    body_joints = list(range(22))
    assert degrees(pose, planted.pose)[:, body_joints].mean() < 1.0


def test_a_model_of_another_topology_is_refused(motion, tmp_path):
    with pytest.raises(HabitusError, match=r"7499 vertices; expected 6890 \(smpl\)"):
        solve_model(motion, load_body("female"))
    with pytest.raises(HabitusError, match=r"expected \.npz"):
        hb.export_file(motion, tmp_path / "a.fbx", model=load_body("female"))
    with pytest.raises(HabitusError, match=r"cannot write a topology to a\.glb"):
        hb.export_file(motion, tmp_path / "a.glb", topology="smpl")
    with pytest.raises(HabitusError, match="go alone"):
        hb.export_file(motion, tmp_path / "a.npz", topology="smpl", face=True)
    assert not list(tmp_path.iterdir())


def test_options_of_another_recipe_are_refused(npz, tmp_path, capsys):
    mesh, out = tmp_path / "a.obj", tmp_path / "out"
    hb.export_file(npz, mesh, topology="smpl", frame=0)
    for options in (["--own-surface"], ["--fps", 30], ["--topology", "smpl", "--texture"]):
        assert run("register", mesh, "--out", out, *options) == 2
    assert run("register", mesh, "--topology", "smplx", "--out", out) == 2
    assert "expected 10475 of each frame" in capsys.readouterr().err
    assert not out.exists()


def test_a_file_in_another_order_has_failed(npz, tmp_path, capsys):
    hb.export_file(npz, tmp_path / "a.npz", topology="smpl", frame=0)
    with np.load(tmp_path / "a.npz") as file:
        vertices = np.random.default_rng(0).permutation(file["vertices"], axis=1)
    np.savez(tmp_path / "b.npz", vertices=vertices)
    code = run(
        "register", tmp_path / "b.npz", "--topology", "smpl", "--body", "female",
        "--out", tmp_path / "out", "--strict",
    )  # fmt: skip
    assert code == 3
    assert "another order of vertices" in capsys.readouterr().out


@pytest.mark.skipif(not MESHES.is_dir(), reason="the mean meshes lie beside a checkout alone")
@pytest.mark.parametrize(
    ("file", "topology"), [("human_man.obj", "smpl"), ("human_neutral.obj", "smplx")]
)
def test_a_mean_body_goes_to_ours_and_back_within_2_mm(file, topology):
    made = register_vertices(MESHES / file, topology, "neutral", own_surface=True)
    places = load_topology(topology, made.motion.finest_body)
    given = read_vertices(MESHES / file, places.num_vertices).vertices
    back = topology_vertices(made.motion, places, np.arange(1))
    assert 1e3 * np.linalg.norm(back - given, axis=-1).mean() < 2.0
