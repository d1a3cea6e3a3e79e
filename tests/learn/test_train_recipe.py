"""Training from beginning to end on a small planted body: what comes out is the body that made the
registrations.
"""

import contextlib
import io
from collections import defaultdict
from dataclasses import dataclass, replace

import numpy as np
import pytest
import smplx
import torch

from habitus.body.model import BodyModel
from habitus.errors import HabitusError
from habitus.evaluate.generalisation import model_generalisation
from habitus.evaluate.posable import PosableBody
from habitus.io.models.bodies import load_body, save_body
from habitus.io.registrations.templates import body_template
from habitus.learn.callback import NoCallback, Record, TrainingState
from habitus.learn.options import EnergyWeights, TrainOptions
from habitus.learn.posing.surface import skeleton
from habitus.learn.train import TrainedBody, train_body
from habitus.mesh.registrations import Registrations
from habitus.mesh.template import Template
from habitus.parallel.workers import Threads
from habitus_lab.population.coarse_bodies import coarse_body
from habitus_lab.population.planted_body import joints_near_rings, planted_truth
from habitus_lab.population.registrations import Planted, planted_registrations

BETAS = 3
WEIGHTS = EnergyWeights(
    joints=2.0, pose_shapes=0.3
)  # fewer registrations and vertices than the papers'
OPTIONS = TrainOptions(rounds=2, tolerance=0.0, num_betas=BETAS, weights=WEIGHTS)


class Recorder(NoCallback):
    """Keeps what it is told."""

    def __init__(self):
        self.records: list[Record] = []
        self.states: list[TrainingState] = []
        self.counts: list[int] = []

    def on_step_end(self, record):
        self.records.append(record)

    def on_round_end(self, state):
        self.states.append(state)

    def on_surfaces_stored(self, count):
        self.counts.append(count)


@dataclass(frozen=True)
class Run:
    template: Template
    truth: BodyModel
    planted: Planted
    trained: TrainedBody
    recorder: Recorder

    def rows(self, word):
        return np.flatnonzero(np.array(self.planted.registrations.set) == word)


@pytest.fixture(scope="module")
def run() -> Run:
    base = coarse_body(load_body("default"), 320)
    template = body_template(base)
    truth = planted_truth(base, joint_regressor=joints_near_rings(template), num_betas=BETAS)
    planted = planted_registrations(
        truth,
        subjects=5,
        poses_per_subject=10,
        shape_people=24,
        test_subjects=2,
        test_poses=4,
        noise_rms=5e-4,
        seed=2,
    )
    recorder = Recorder()
    return Run(
        template,
        truth,
        planted,
        train_body(planted.registrations, template, OPTIONS, callback=recorder),
        recorder,
    )


def errors(body, run):
    """Mean distance (m) of a body fitted to held-out people in held-out poses from the surfaces
    without noise.
    """
    rows = run.rows("test")
    clean = run.planted.clean[rows]
    fits = model_generalisation(
        PosableBody(body, "any"), run.planted.registrations.take(rows), [BETAS], clean=clean
    )
    return fits.clean_errors.mean()


def test_the_energy_falls_from_step_to_step(run):
    history = run.trained.history
    assert [record.step for record in history] == [
        "poses by edges", *["subjects", "weights", "pose shapes", "poses", "further"] * 2
    ]  # fmt: skip
    assert [record.round for record in history] == [0, *[1] * 5, *[2] * 5]
    totals = np.array([record.energy.total for record in history])
    assert (np.diff(totals) <= 0).all() and totals[-1] < 0.01 * totals[0]
    rows = run.rows("pose")
    rms = np.sqrt(history[-1].energy.terms["data"] / len(rows) / run.truth.num_vertices)
    assert rms < 1e-3  # m; the noise is half of it


def test_held_out_people_are_reproduced(run):
    found = errors(run.trained.body, run)
    bare = errors(replace(run.trained.body, posedirs=None), run)
    assert found < 1.5e-3 and found < 0.6 * bare


def test_joints_are_found(run):
    """Where they stand in the registrations, against where the rings of the start would have
    them.
    """
    rows = run.rows("pose")
    estimate = run.trained.estimate
    who = run.planted.registrations.where(set="pose").subject_index
    parents = run.template.parents
    planted = run.planted

    def stand(joints, poses, places):
        return np.stack(
            [
                skeleton(parents, p).positions(j) + t
                for j, p, t in zip(joints, poses, places, strict=True)
            ]
        )

    truth = stand(planted.joints[who], planted.pose[rows], planted.trans[rows])
    started, ended = (
        np.linalg.norm(stand(e.joints[who], e.pose, e.trans) - truth, axis=-1)[:, 1:].mean()
        for e in (run.recorder.states[0].estimate, estimate)
    )
    assert ended < 0.014 and ended < 0.5 * started
    regressor = run.trained.body.joint_regressor
    assert regressor.min() >= 0 and np.abs(regressor.sum(1) - 1).max() < 1e-12  # by default
    assert np.linalg.norm(regressor @ estimate.templates - estimate.joints, axis=-1).mean() < 2e-3


def test_the_zero_pose_stays_the_templates(run):
    """But for collars and shoulders, which turn against each other at rest."""
    away = run.trained.estimate.pose - run.planted.pose[run.rows("pose")]
    turned = np.degrees(np.linalg.norm(away.mean(0), axis=-1))
    names = run.trained.body.joint_names[-len(turned) :]
    girdle = np.array([name.endswith(("collar", "shoulder")) for name in names])
    assert turned[~girdle].max() < 6.0 and turned.max() < 12.0


def test_shapes_are_those_of_the_shape_set(run):
    """Edges tell: they hardly hear how a body is turned at rest, which registrations hardly
    tell.
    """
    body = run.trained.body
    faces = run.template.faces
    people = run.truth.rest_vertices(torch.from_numpy(run.planted.betas[run.rows("shape")])).numpy()

    def lengths(surface):
        return np.linalg.norm(surface[..., faces[:, 0], :] - surface[..., faces[:, 1], :], axis=-1)

    off = lengths(body.v_template) / lengths(people).mean(0) - 1
    assert np.abs(off).mean() < 0.035
    varied = (people - people.mean(0)).reshape(len(people), -1)
    span = np.linalg.qr(body.shapedirs.reshape(-1, BETAS))[0]
    varied -= np.tile((varied.reshape(len(people), -1, 3)).mean(1), (1, body.num_vertices))
    assert ((varied @ span) ** 2).sum() > 0.92 * (varied**2).sum()
    variances = (
        run.trained.shape.variances
    )  # as many directions as were planted; next is how arms are turned at rest
    assert variances[BETAS] < 0.02 * variances[BETAS - 1]
    assert np.sqrt(variances[BETAS] / body.num_vertices) < 1e-3  # m; the noise is half of it


def test_weights_are_sparse_shares(run):
    weights = run.trained.body.skinning_weights
    assert (
        weights.min() >= 0
        and np.abs(weights.sum(1) - 1).max() < 1e-9
        and ((weights > 0).sum(1) <= 4).all()
    )
    assert np.abs(weights - run.truth.skinning_weights).sum(1).mean() < 0.2


def test_callbacks_are_called(run):
    assert tuple(run.recorder.records) == run.trained.history
    assert [state.rounds for state in run.recorder.states] == [0, 1, 2]
    assert [state.finished for state in run.recorder.states] == [False, False, True]
    assert run.recorder.states[-1].estimate is run.trained.estimate
    assert run.recorder.counts[-1] == 24 and sorted(run.recorder.counts) == run.recorder.counts


def test_a_saved_model_is_the_same_to_smplx(run, tmp_path):
    body = run.trained.body
    save_body(body, tmp_path / "SMPL_NEUTRAL.pkl")
    with contextlib.redirect_stdout(io.StringIO()):
        theirs = smplx.SMPL(
            str(tmp_path / "SMPL_NEUTRAL.pkl"),
            num_betas=BETAS,
            dtype=torch.float64,
            vertex_ids=defaultdict(int),
        )
    rows = run.rows("test")
    betas, pose, trans = (
        torch.from_numpy(x[rows]) for x in (run.planted.betas, run.planted.pose, run.planted.trans)
    )
    flat = pose.flatten(1)
    with torch.no_grad():
        surface = theirs(
            betas=betas, global_orient=flat[:, :3], body_pose=flat[:, 3:], transl=trans
        ).vertices
    ours = body(betas, pose, trans).vertices
    again = load_body(tmp_path / "SMPL_NEUTRAL.pkl")(betas, pose, trans).vertices
    assert (surface - ours).abs().max() < 1e-6
    assert (again - ours).abs().max() < 1e-6


def test_without_a_shape_set_the_subjects_serve(run, tmp_path):
    few = run.planted.registrations.where(set="pose").take(
        np.concatenate([np.arange(5), np.arange(20, 25)])
    )
    options = TrainOptions(
        skinning="dqbs",
        pose_shapes="sparse",
        pose_features="quaternions",
        rounds=1,
        num_betas=1,
        weights=WEIGHTS,
    )
    trained = train_body(few, run.template, options, workers=Threads(2), name="few")
    body = trained.body
    assert (body.name, body.skinning, body.pose_features, body.num_betas) == (
        "few",
        "dqbs",
        "quaternions",
        1,
    )
    between = np.diff(trained.estimate.templates, axis=0)[0]
    between = (
        between - body.joint_regressor[0] @ between
    ).flatten()  # where a root stands is nobody's shape
    along = body.shapedirs.flatten()
    assert abs(between @ along) == pytest.approx(
        np.linalg.norm(between) * np.linalg.norm(along), rel=1e-6
    )
    save_body(body, tmp_path / "few.npz")
    again = load_body(tmp_path / "few.npz")
    state = torch.ones(1, dtype=torch.float64), torch.from_numpy(run.planted.pose[3])
    assert (again(*state).vertices - body(*state).vertices).abs().max() < 1e-12


def test_training_ends_where_a_round_brings_little(run):
    few = run.planted.registrations.where(set="pose").take(np.arange(3))
    options = replace(OPTIONS, rounds=9, tolerance=1.0, num_betas=1)
    recorder = Recorder()
    with contextlib.suppress(HabitusError):  # one subject has no shape space
        train_body(few, run.template, options, callback=recorder)
    assert [state.rounds for state in recorder.states] == [0, 1] and recorder.states[1].finished


def test_nothing_to_learn_from_is_said(run):
    shapes: Registrations = run.planted.registrations.where(set="shape")
    with pytest.raises(HabitusError, match="no registration belongs to the set 'pose'"):
        train_body(shapes, run.template, OPTIONS)


def test_registrations_with_holes_give_nearly_the_same_body(run):
    """A tenth of every mesh unseen, in patches, and rubbish written there."""
    whole = run.planted.registrations
    rng = np.random.default_rng(6)
    vertices = np.array(whole.vertices[:], dtype=float)
    for k in range(len(vertices)):
        middle = vertices[k, rng.integers(vertices.shape[1])]
        near = np.argsort(np.linalg.norm(vertices[k] - middle, axis=1))[: vertices.shape[1] // 10]
        vertices[k, near] = np.nan
    holes = train_body(replace(whole, vertices=vertices), run.template, OPTIONS)
    totals = np.array([record.energy.total for record in holes.history])
    assert (np.diff(totals) <= 1e-9 * totals[0]).all()
    assert errors(holes.body, run) < 1.9 * errors(run.trained.body, run)
    assert np.abs(holes.body.v_template - run.trained.body.v_template).max() < 0.02
