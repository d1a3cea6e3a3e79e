"""body.npz in AMASS's style: the slices of AMASS's own notebooks fit, and the motion is that of the
fit.
"""

from dataclasses import replace

import numpy as np
import pytest
import tyro
from synthetic_fit import reference_vertices, synthetic_fit, tube_body

import habitus
from habitus.body.joint_layouts import SMPLH
from habitus.cli.mosh import Mosh, run
from habitus.errors import HabitusError
from habitus.export import write_amass
from habitus.io.models.bodies import load_body, save_body
from habitus.jobs.exporting import export_file
from habitus.rotations import UP_AXES, up_rotation


def amass_loader(path) -> dict[str, np.ndarray]:
    """What scripts for AMASS take out of a file."""
    with np.load(path) as data:
        return {
            "root_orient": data["poses"][:, :3],
            "pose_body": data["poses"][:, 3:66],
            "pose_hand": data["poses"][:, 66:],
            "trans": data["trans"],
            "betas": np.repeat(data["betas"][:16][np.newaxis], repeats=len(data["trans"]), axis=0),
            "dmpls": data["dmpls"][:, :8],
            "gender": str(data["gender"]),
            "rate": float(data["mocap_framerate"]),
            "own": data["body_betas"],
            "body": str(data["body"]),
            "root_joint": data["root_joint"],
        }


@pytest.mark.parametrize("soft", [True, False])
def test_an_amass_loader_gets_its_shapes(tmp_path, soft):
    fit = synthetic_fit(frames=20, soft=soft)
    write_amass(fit, tmp_path / "a.npz")
    found = amass_loader(tmp_path / "a.npz")
    shapes = {
        "root_orient": 3,
        "pose_body": 63,
        "pose_hand": 90,
        "trans": 3,
        "betas": 16,
        "dmpls": 8,
    }
    assert all(found[name].shape == (20, width) for name, width in shapes.items())
    assert (
        found["gender"] == "neutral"
        and found["rate"] == fit.rate_hz
        and found["body"] == fit.body_name
    )
    assert not found["pose_hand"].any() and not found["dmpls"].any()


@pytest.mark.parametrize("up", UP_AXES)
def test_the_motion_is_the_fits_with_z_up(tmp_path, up):
    fit = synthetic_fit(frames=12, soft=False, up_axis=up)
    write_amass(fit, tmp_path / "a.npz")
    found = amass_loader(tmp_path / "a.npz")
    pose = np.c_[found["root_orient"], found["pose_body"], np.zeros((12, 6))].reshape(12, 24, 3)
    turn = up_rotation("+z").T @ up_rotation(up)
    surface = reference_vertices(fit.body, np.tile(found["own"], (12, 1)), pose, found["trans"])
    assert np.abs(surface - fit.vertices() @ turn.T).max() < 1e-9
    assert np.allclose(found["root_joint"], fit.body.rest_joints(fit.betas)[0])


def test_joints_are_found_by_name_and_foreign_betas_stay_at_home(tmp_path):
    body = tube_body()
    order = [0, 3, 1, 2, 4, 5, *range(6, 24)]  # the spine before the hips
    place = {old: new for new, old in enumerate(order)}
    names = tuple(body.joint_names[k] for k in order)
    parents = tuple(-1 if body.parents[k] < 0 else place[body.parents[k]] for k in order)
    fit = synthetic_fit(frames=3, soft=False)
    other = replace(
        fit.body, joint_names=names, parents=parents, joint_regressor=body.joint_regressor[order]
    )
    write_amass(fit, tmp_path / "a.npz")
    write_amass(replace(fit, body=other, pose=fit.pose[:, order]), tmp_path / "b.npz")
    a = amass_loader(tmp_path / "a.npz")
    b = amass_loader(tmp_path / "b.npz")
    assert np.array_equal(a["pose_body"], b["pose_body"])
    assert not a["betas"].any() and np.array_equal(a["own"], fit.betas)


def test_what_cannot_be_held_is_said_before_the_fit(tmp_path):
    fit = synthetic_fit(frames=2, soft=False)
    names = tuple(f"joint_{k}" for k in range(24))
    with pytest.raises(HabitusError, match="no joint pelvis, which SMPL-H's poses have"):
        write_amass(replace(fit, body=replace(fit.body, joint_names=names)), tmp_path / "a.npz")
    with pytest.raises(HabitusError, match="npz_style is 'amas'; expected one of habitus, amass"):
        habitus.mosh(tmp_path / "none.c3d", npz_style="amas")
    assert not list(tmp_path.iterdir()) and SMPLH.joint_names[:22] == fit.body.joint_names[:22]


def test_a_saved_fit_is_in_the_style_that_was_asked_for(tmp_path):
    fit = synthetic_fit(frames=4)
    fit.save(tmp_path / "a", npz_style="amass")
    assert amass_loader(tmp_path / "a" / "body.npz")["pose_hand"].shape == (4, 90)
    with pytest.raises(HabitusError, match=r"AMASS's style.*no markers"):
        habitus.load_fit(tmp_path / "a" / "body.npz", fit.body)


def test_betas_on_another_body_of_the_same_sizes_are_refused(tmp_path):
    fit = synthetic_fit(frames=4)
    fit.save(tmp_path / "a")
    assert np.array_equal(habitus.load_fit(tmp_path / "a" / "body.npz", fit.body).betas, fit.betas)
    thicker = replace(fit.body, v_template=1.05 * fit.body.v_template)
    with pytest.raises(HabitusError, match=r"another person, whose skin is [0-9]+ mm away"):
        habitus.load_fit(tmp_path / "a" / "body.npz", thicker)


def test_the_command_passes_the_style_on(tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr(
        "habitus.jobs.batch.fit_all", lambda *given, **more: asked.append(given[0]) or []
    )
    options = tyro.cli(
        Mosh,
        args=["walk.c3d", "two.c3d", "--out", str(tmp_path), "--npz-style", "amass", "--quiet"],
    )
    run(options)
    assert asked[0].npz_style == "amass"


def test_smplx_shows_the_person_where_the_shape_is_padded(tmp_path):
    """As docs/amass.md says: unpadded, the package takes 10 of the 24 betas."""
    smplx = pytest.importorskip("smplx")
    torch = pytest.importorskip("torch")
    body = load_body("default")
    betas = np.random.default_rng(0).normal(size=(1, body.num_betas))
    found = []
    path = tmp_path / "SMPL_NEUTRAL.pkl"
    for count in (0, 300):
        save_body(body, path, shape_directions=count)
        person = smplx.SMPL(str(path), num_betas=body.num_betas)
        given = torch.tensor(betas[:, : person.num_betas], dtype=torch.float32)
        found.append(person(betas=given).vertices.detach().numpy()[0])
    known = body(betas[0]).vertices
    assert np.abs(found[1] - known).max() < 1e-5 < 1e-3 < np.abs(found[0] - known).max()
    again = load_body(path)
    assert again.num_betas == body.num_betas  # its own reader knows them
    np.testing.assert_allclose(again(betas[0]).vertices, known, atol=1e-6)
    with pytest.raises(HabitusError, match="with 55 joints"):
        save_body(load_body("default", joints="smplx"), tmp_path / "x.npz", shape_directions=300)


def test_a_fit_of_a_file_becomes_amass_style(tmp_path):
    fit = synthetic_fit(4, body=load_body("default"), body_name="default", soft=False)
    fit.export(tmp_path / "body.npz")
    export_file(tmp_path / "body.npz", tmp_path / "amass.npz", npz_style="amass")
    write_amass(fit, tmp_path / "direct.npz")
    with np.load(tmp_path / "amass.npz") as file, np.load(tmp_path / "direct.npz") as direct:
        assert set(file.files) == set(direct.files) and file["poses"].shape == (4, 156)
        for name in file.files:
            np.testing.assert_array_equal(file[name], direct[name], err_msg=name)
    with pytest.raises(HabitusError, match=r"\.npz"):
        export_file(tmp_path / "body.npz", tmp_path / "a.bvh", npz_style="amass")
    with pytest.raises(HabitusError, match="npz_style"):
        export_file(tmp_path / "body.npz", tmp_path / "a.npz", npz_style="other")
