"""`habitus train-dynamics` from files to a body that moves."""

import json
from dataclasses import replace

import numpy as np
import pytest
from soft_people import soft_people
from soft_tubes import soft_tubes
from two_levels import two_level_arrays

import habitus
from habitus.cli.main import main
from habitus.errors import HabitusError
from habitus.evaluate.dynamics import with_motions
from habitus.io.models.bodies import load_body, save_body
from habitus.learn.dynamics.train import DynamicsOptions
from habitus.parallel.workers import Threads

FEW = DynamicsOptions(components=2, rank=8, shape_features=(0, 1), ridge=(1e-6,), personal=False)


def _saved(one, path, **left_out):
    meshes = one.registrations
    told = {
        "betas": one.betas,
        "pose": one.pose,
        "trans": one.trans,
        "rate_hz": np.array(one.rate_hz),
    }
    words = {"subject": np.array(meshes.subject), "name": np.array(meshes.name)}
    told = {key: value for key, value in told.items() if key not in left_out}
    np.savez(path, vertices=np.asarray(meshes.vertices), faces=meshes.faces, **words, **told)
    return str(path)


def test_the_command_makes_a_body_that_moves(tmp_path, capsys):
    truth = soft_tubes()
    *shown, kept = soft_people(truth, people=2, sequences=2, frames=60)
    save_body(replace(truth, dynamics=None), tmp_path / "body.npz")
    files = [_saved(one, tmp_path / f"{one.name}.npz") for one in shown]
    out = tmp_path / "out"
    test = _saved(kept, tmp_path / "kept.npz")
    options = ["--components", "2", "--no-personal", "--workers", "1", "--test", test]
    main(
        [
            "train-dynamics",
            *files,
            "--body",
            str(tmp_path / "body.npz"),
            "--out",
            str(out),
            *options,
        ]
    )
    told = capsys.readouterr().out
    assert "180 frames at 60 Hz" in told and kept.name in told
    assert {path.name for path in out.iterdir()} >= {"model.npz", "dynamics.json"}
    body = load_body(out / "model.npz")
    assert body.num_dynamics == 2 and body.num_vertices == truth.num_vertices
    numbers = json.loads((out / "dynamics.json").read_text())
    errors = numbers["test"][0]["errors"]
    assert errors["simulated"]["velocity_mm_s"] < 0.5 * errors["without"]["velocity_mm_s"]
    assert numbers["frames"] == 180 and len(numbers["modes"]) <= 2
    delta = habitus.simulate_soft_tissue(body, kept.betas, kept.pose, kept.trans, 60)
    assert np.abs(body(kept.betas, kept.pose, kept.trans, dynamics=delta).vertices).max() < 10


def test_both_levels_of_detail_get_them(tmp_path):
    arrays = {
        key: value for key, value in two_level_arrays().items() if not key.startswith("dynamics")
    }
    np.savez(tmp_path / "levels.npz", **arrays)
    body = load_body(tmp_path / "levels.npz", detail="full")
    rng = np.random.default_rng(0)
    t = np.arange(40) / 60
    pose = 0.3 * rng.normal(size=(1, 55, 3)) * np.sin(9 * t)[:, None, None]
    trans = np.stack([0 * t, 0.1 * np.sin(12 * t), 0 * t], 1)
    swing = (
        np.convolve(rng.normal(size=40), np.ones(5) / 5, "same")[:, None, None]
        * 0.01
        * rng.normal(size=(300, 3))
    )
    own = replace(body, v_template=body.v_template)
    surfaces = (
        np.array([own(np.zeros(6), p, x).vertices for p, x in zip(pose, trans, strict=True)])
        + swing
    )
    words = {"subject": np.array(["anna"] * 40), "faces": body.faces}
    np.savez(
        tmp_path / "anna.npz",
        vertices=surfaces,
        pose=pose,
        trans=trans,
        betas=np.zeros(6),
        rate_hz=60,
        **words,
    )
    options = replace(FEW, components=1)
    habitus.train_dynamics(
        tmp_path / "anna.npz",
        tmp_path / "out",
        body=tmp_path / "levels.npz",
        options=options,
        workers=1,
    )
    with np.load(tmp_path / "out" / "model.npz") as file:
        assert set(arrays) < set(file) and all(
            np.array_equal(file[key], arrays[key]) for key in arrays
        )
    coarse = load_body(tmp_path / "out" / "model.npz", joints="smpl")
    assert coarse.num_dynamics == 1 and coarse.full.num_dynamics == 1 and coarse.num_vertices < 300
    assert (
        len(habitus.simulate_soft_tissue(coarse, [], np.zeros((9, 24, 3)), np.zeros((9, 3)), 60))
        == 9
    )


def test_shape_and_motion_are_fitted_where_they_are_not_told():
    body = soft_tubes(pose_shapes=0.002)
    (one,) = soft_people(
        replace(body, dynamics=body.dynamics.scaled(0.2)), people=1, sequences=1, frames=8
    )
    unknown = replace(one, betas=None, pose=None, trans=None)
    found, same = with_motions(replace(body, dynamics=None), [unknown, one], Threads(1))
    assert same is one
    np.testing.assert_allclose(found.betas, one.betas, atol=0.2)
    np.testing.assert_allclose(found.pose, one.pose, atol=0.06)
    np.testing.assert_allclose(found.trans, one.trans, atol=0.02)
    with pytest.raises(HabitusError, match="betas, pose or trans are missing"):
        list(with_motions(body, [replace(unknown, vertex_ids=np.arange(300))], Threads(1)))


def test_nothing_to_learn_from():
    with pytest.raises(HabitusError, match="no sequences"):
        habitus.train_dynamics([], body=soft_tubes())
    (one,) = soft_people(soft_tubes(), people=1, sequences=1, frames=8)
    with pytest.raises(HabitusError, match="registrations of 300 vertices; neutral has 13524"):
        habitus.train_dynamics([one], body="neutral")
