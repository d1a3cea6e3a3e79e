"""Made registrations from files to files: a run that is stopped or lengthened ends at the same
model; its errors.
"""

import json
from dataclasses import replace

import numpy as np
import pytest
from toy_people import toy

from habitus.cli.evaluate import known_table
from habitus.errors import HabitusError
from habitus.evaluate.known_state import known_errors
from habitus.jobs.checkpoints import CheckpointingCallback
from habitus.jobs.evaluate import evaluate_known
from habitus.jobs.train import train
from habitus.learn.options import EnergyWeights, TrainOptions
from habitus.mesh.known import Known

FREE = TrainOptions(
    start="body",
    fixed=("joint_regressor", "shapedirs", "people", "poses"),
    pose_shapes="local",
    rounds=2,
    tolerance=0.0,
    weights=EnergyWeights(pose_shapes=1.0),
)
HELD = replace(FREE, rounds=1, fixed=(*FREE.fixed, "skinning_weights"))
SHOWN = 60  # vertices that count: most of the flesh, and quick


def made():
    """The toy's registrations with all that they were made from, and the body without its flesh to
    start from.
    """
    planted = toy()[1]
    known = Known(planted.pose, planted.trans, planted.betas)
    weights = np.zeros(planted.registrations.num_vertices)
    weights[np.abs(planted.surface.posedirs).sum((1, 2)).argsort()[-SHOWN:]] = 1.0
    data = replace(planted.registrations, known=known, weights=weights)
    return data, replace(planted.surface, posedirs=None)


def learn(out, options=FREE):
    data, start = made()
    return train(data.where(set="pose"), out, template=start, options=options, workers=1)[0].body


def test_a_run_that_is_lengthened_and_stopped_in_a_round_ends_at_the_same_model(
    tmp_path, monkeypatch
):
    once = CheckpointingCallback.on_state

    def dying(callback, state):
        once(callback, state)
        if (state.history[-1].round, state.history[-1].step) == (2, "pose shapes"):
            raise KeyboardInterrupt

    learn(tmp_path / "parts", replace(FREE, rounds=1))
    monkeypatch.setattr(CheckpointingCallback, "on_state", dying)
    with pytest.raises(KeyboardInterrupt):
        learn(tmp_path / "parts")
    monkeypatch.undo()
    whole = learn(tmp_path / "whole")
    np.testing.assert_array_equal(learn(tmp_path / "parts").posedirs, whole.posedirs)


def test_errors_in_known_poses_are_those_of_the_flesh_alone(tmp_path):
    data, start = made()
    learned = replace(learn(tmp_path, HELD), name="learned")
    truth = replace(toy()[1].surface, name="truth")
    found = evaluate_known([learned, truth], data, tmp_path)
    all_people = {name: groups["all"] for name, groups in found.models.items()}
    assert list(all_people) == ["plain LBS", "plain DQBS", "learned", "truth"]
    assert all_people["truth"]["mean"] < 1.1e-3 < all_people["plain LBS"]["mean"]  # the noise
    assert all_people["truth"]["removed"] > all_people["learned"]["removed"] > 0.2
    assert all_people["plain LBS"]["removed"] == 0.0
    rows = data.where(set="test")
    away = (
        rows.vertices[:]
        - start(*(getattr(rows.known, key) for key in ("betas", "pose", "trans"))).vertices
    )
    mean = np.linalg.norm(away, axis=-1)[:, data.weights > 0].mean()
    assert all_people["plain LBS"]["mean"] == pytest.approx(mean, rel=1e-9)
    assert (
        json.loads((tmp_path / "known.json").read_text())["metres"]["learned"]["all"]
        == all_people["learned"]
    )
    assert known_table(found).row_count == 4 * len(found.models["truth"])


def test_known_people_in_new_poses_are_told_from_new_people_and_weights_count():
    data, start = made()
    mixed = replace(
        data, set=("test", *data.set[1:])
    )  # the first pose of a person of whom others are in training
    groups = evaluate_known([replace(start, posedirs=None)], mixed).models["plain LBS"]
    assert set(groups) == {"all", "new people", "known people"}
    weights = np.zeros(data.num_vertices)
    weights[:7] = np.linspace(0.1, 0.5, 7)
    few = evaluate_known([start], replace(data, weights=weights)).errors["plain LBS"]
    rows = data.where(set="test")
    away = (
        rows.vertices[:]
        - start(*(getattr(rows.known, key) for key in ("betas", "pose", "trans"))).vertices
    )
    mean = np.linalg.norm(away, axis=-1) @ weights / weights.sum()
    np.testing.assert_allclose(few.mean, mean, rtol=1e-9)


def test_what_is_not_known_cannot_be_measured():
    data, start = made()
    for changes, words in (({"pose": None}, "are missing"), ({"betas": None}, "are missing")):
        with pytest.raises(HabitusError, match=words):
            evaluate_known([start], replace(data, known=replace(data.known, **changes)))
    few = replace(data, known=replace(data.known, pose=data.known.pose[:, :20]))
    with pytest.raises(HabitusError, match="expected registrations made from this body"):
        evaluate_known([start], few)


def test_people_told_by_their_rest_surfaces_have_the_errors_of_those_told_by_betas():
    data, start = made()
    betas = dict(zip(data.subject, data.known.betas, strict=True))
    rest = {subject: start.rest_vertices(one) for subject, one in betas.items()}
    by_rest = replace(data, known=replace(data.known, betas=None, rest=rest))
    one, other = (known_errors({"plain": start}, each)["plain"] for each in (data, by_rest))
    assert one.mean.min() > 1e-4
    np.testing.assert_allclose(other.mean, one.mean, atol=1e-9)
