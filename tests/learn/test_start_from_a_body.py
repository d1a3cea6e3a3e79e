"""Training that starts from a body: what it knows besides is carried over, and its arrays are
started from or held.
"""

from dataclasses import replace

import numpy as np
import pytest
from small_rigs import people, planted, poses, small_rig
from small_start import ALONE, BETAS, SMALL, WARM, body_of, registrations_of, template_of

from habitus.errors import HabitusError
from habitus.io.layouts.files import shipped_layouts
from habitus.io.models.bodies import load_body, save_body
from habitus.io.registrations.templates import template_and_body
from habitus.learn.assembly import SIGNS, assemble, sex_direction
from habitus.learn.callback import NoCallback
from habitus.learn.energy import measure_energy
from habitus.learn.options import TrainOptions
from habitus.learn.posing.rig import Rig
from habitus.learn.posing.surface import surface
from habitus.learn.shape.shape_space import ShapeSpace, shape_space_of
from habitus.learn.start.first_estimate import initial_estimate, state_problem
from habitus.learn.steps.alternation import subject_step
from habitus.learn.train import train_body


@pytest.mark.parametrize("ending", [".npz", ".pkl"])
@pytest.mark.parametrize(("lowest", "signs"), [(0.0, "non-negative"), (-0.1, "signed")])
def test_the_file_of_a_trained_body_says_which_signs_its_joint_regressor_has(
    lowest, signs, ending, tmp_path
):
    regressor = np.full_like(SMALL.regressor, 1.0 / SMALL.regressor.shape[1])
    regressor[:, 0] += lowest - regressor[0, 0]
    shape = ShapeSpace(body_of().v_template, body_of().shapedirs, np.ones(BETAS))
    trained = assemble("trained", template_of(body_of()), small_rig(SMALL), regressor, shape)
    save_body(trained, tmp_path / f"model{ending}")
    assert str(load_body(tmp_path / f"model{ending}").extras[SIGNS]) == signs


def test_what_a_body_knows_besides_is_carried_over():
    body = body_of()
    shape = ShapeSpace(body.v_template, body.shapedirs, np.ones(BETAS))
    found = assemble(
        "trained", template_of(body), small_rig(SMALL), body.joint_regressor, shape, body
    )
    assert dict(found.landmarks) == dict(body.landmarks) and found.pose_prior is body.pose_prior
    assert set(found.extras) == {"hands_mean", SIGNS}
    bare = assemble("trained", template_of(body), small_rig(SMALL), body.joint_regressor, shape)
    assert (
        bare.pose_prior is None
        and bare.female_direction is None
        and dict(bare.landmarks) == dict(body.landmarks)
    )


def test_the_sex_of_a_person_is_the_same_in_another_shape_space_wherever_that_stands():
    body = body_of()
    rng = np.random.default_rng(0)
    turn = rng.normal(size=(BETAS, BETAS))  # the same people by other coefficients
    shift = rng.normal(size=BETAS)
    mean = body.v_template + body.shapedirs @ shift + [0.3, -1.0, 2.0]
    direction, bias = sex_direction(body, ShapeSpace(mean, body.shapedirs @ turn, np.ones(BETAS)))
    for betas in rng.normal(size=(5, BETAS)):
        told = body.female_direction[0] @ (shift + turn @ betas) + body.female_direction[1]
        assert direction @ betas + bias == pytest.approx(told, abs=1e-9)
    assert (
        sex_direction(
            replace(body, female_direction=None), ShapeSpace(mean, body.shapedirs, np.ones(2))
        )
        is None
    )


def test_training_starts_from_a_bodys_own_arrays():
    body = body_of()
    problem = state_problem(registrations_of(body), template_of(body), WARM, body)
    estimate = initial_estimate(problem, template_of(body), ALONE, body)
    np.testing.assert_allclose(estimate.rig.weights, body.skinning_weights, atol=1e-12)
    assert np.array_equal(estimate.rig.posedirs, body.posedirs)
    np.testing.assert_allclose(estimate.joints[0], body.joint_template, atol=1e-12)
    cold = replace(problem, options=replace(WARM, start="parts"))
    assert not initial_estimate(cold, template_of(body), ALONE, body).rig.posedirs.any()


@pytest.mark.parametrize("kind", ["sparse", "low_rank"])
def test_blend_shapes_started_from_are_of_the_kind_asked_for(kind):
    body = body_of()
    options = replace(WARM, pose_shapes=kind, rank=4)
    problem = state_problem(registrations_of(body), template_of(body), options, body)
    posedirs = initial_estimate(problem, template_of(body), ALONE, body).rig.posedirs
    if kind == "low_rank":
        assert np.linalg.matrix_rank(posedirs.reshape(-1, posedirs.shape[-1]), tol=1e-9) == 4
    else:
        driven = np.repeat(problem.initial_weights[:, 1:] > 0, 9, 1)
        assert not posedirs.swapaxes(1, 2)[~driven].any() and posedirs.any()


def test_what_is_held_fixed_is_what_it_was_and_the_rest_is_learned():
    body = body_of()
    steps = []

    class Steps(NoCallback):
        def on_step_end(self, record):
            steps.append((record.step, record.energy.total))

    options = replace(WARM, fixed=("skinning_weights", "joint_regressor", "shapedirs"))
    trained = train_body(
        registrations_of(body), template_of(body), options, body=body, callback=Steps()
    )
    found = trained.body
    for name in ("skinning_weights", "joint_regressor", "v_template", "shapedirs"):
        assert np.array_equal(getattr(found, name), getattr(body, name)), name
    assert [name for name, _ in steps] == [
        "poses by edges",
        "subjects",
        "pose shapes",
        "poses",
        "further",
    ]
    assert not np.array_equal(found.posedirs, body.posedirs)
    energies = np.array([energy for _, energy in steps])
    assert (np.diff(energies) <= 1e-9 * energies[0]).all() and energies[-1] < 0.2 * energies[0]
    joints = body.joint_regressor @ trained.estimate.templates
    assert np.abs(joints - trained.estimate.joints).max() < 1e-9


def test_fixed_blend_shapes_stay():
    body = body_of()
    options = replace(WARM, fixed="posedirs", pose_shapes="sparse")
    trained = train_body(registrations_of(body), template_of(body), options, body=body)
    assert np.array_equal(trained.body.posedirs, body.posedirs)
    assert not np.array_equal(trained.body.joint_regressor, body.joint_regressor)


def test_joints_that_are_held_are_the_regressors_and_no_way_down_is_left():
    """The step's minimum among joints that are the regressor's: no energy in between."""
    problem, _ = planted(
        small=SMALL,
        each=5,
        noise=0.004,
        start="body",
        fixed=("joint_regressor",),
        pose_shapes="none",
    )
    rng = np.random.default_rng(0)
    _, truth = planted(small=SMALL, each=5, noise=0.004, pose_shapes="none")
    moved = truth.templates + 0.01 * rng.normal(size=truth.templates.shape)
    start = replace(truth, templates=moved, joints=SMALL.regressor @ moved)
    found = subject_step(problem, start, ALONE)
    assert np.abs(found.joints - SMALL.regressor @ found.templates).max() < 1e-9
    least = measure_energy(problem, found, ALONE).total
    assert least < 0.5 * measure_energy(problem, start, ALONE).total
    for k in range(10):
        off = found.templates + 10.0 ** -(2 + k % 3) * rng.normal(size=moved.shape)
        assert (
            measure_energy(
                problem, replace(found, templates=off, joints=SMALL.regressor @ off), ALONE
            ).total
            > least
        )


@pytest.mark.parametrize(
    ("asked", "words"),
    [
        (
            {"fixed": ("pose",), "start": "body"},
            "fixed names 'pose'; expected some of skinning_weights",
        ),
        (
            {"fixed": ("posedirs",)},
            "posedirs fixed, with a start from 'parts'; expected start 'body'",
        ),
        (
            {"fixed": ("posedirs",), "start": "body", "pose_shapes": "none"},
            "posedirs fixed with pose_shapes 'none'",
        ),
        (
            {"fixed": ("shapedirs",), "start": "body", "shape_features": 1},
            "shapedirs fixed with shape_features 1",
        ),
        ({"start": "anywhere"}, "start is 'anywhere'; expected one of parts, body"),
    ],
)
def test_options_that_make_no_sense_are_refused(asked, words):
    with pytest.raises(HabitusError, match=words):
        TrainOptions(**asked)


def test_a_start_without_a_body_of_the_template_is_refused():
    body = body_of()
    data = registrations_of(body)
    with pytest.raises(HabitusError, match="start 'body' without a body of this template"):
        train_body(data, template_of(body), WARM)
    driven = replace(WARM, fixed=("posedirs",), pose_features="angles")
    with pytest.raises(
        HabitusError, match="posedirs fixed, but those of small are driven by 'rotations'"
    ):
        train_body(data, template_of(body), driven, body=body)


def test_the_posed_body_is_the_rigs():
    """What the tests above make registrations with is what training poses with."""
    body = body_of()
    rig, (person,) = small_rig(SMALL, 1), people(SMALL, 1, 1)
    pose = poses(1, 2)[0]
    person = replace(person, template=body.v_template, joints=body.joint_template)
    np.testing.assert_allclose(surface(rig, person, pose), body((), pose).vertices, atol=1e-12)


def test_a_body_trained_on_the_default_template_carries_the_shipped_layouts(tmp_path):
    """After it was saved and read again: `habitus mosh --body model.npz` asks for no more."""
    template, body = template_and_body("default")
    rig = Rig(body.parents, "lbs", "rotations", 0, body.skinning_index, body.skinning_value, None)
    save_body(
        assemble("trained", template, rig, body.joint_regressor, shape_space_of(body), body),
        tmp_path / "m.npz",
    )
    found = load_body(tmp_path / "m.npz")
    for layout in shipped_layouts():
        assert np.array_equal(layout.vertices(found), layout.vertices(body)), layout.name
    np.testing.assert_allclose(found.female_direction[0], body.female_direction[0], atol=1e-9)
    assert found.female_direction[1] == pytest.approx(body.female_direction[1], abs=1e-9)
