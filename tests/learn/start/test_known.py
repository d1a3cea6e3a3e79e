"""What is known of registrations that were made: started from, held, refused where it does not
fit.
"""

from dataclasses import replace

import numpy as np
import pytest
from small_rigs import poses
from small_start import ALONE, BETAS, WARM, body_of, registrations_of, template_of

from habitus.errors import HabitusError
from habitus.learn.energy import measure_energy
from habitus.learn.start.first_estimate import initial_estimate, state_problem
from habitus.learn.train import train_body
from habitus.mesh.known import Known

BLOCKS = ("skinning_weights", "joint_regressor", "shapedirs", "people", "poses")
HOLD = replace(WARM, fixed=BLOCKS, pose_shapes="local")


def made(body, **changes):
    """Registrations of a body that tell all there is to know of them."""
    data = registrations_of(body)
    rng = np.random.default_rng(8)
    betas = np.repeat(rng.normal(size=(3, BETAS)), 5, 0)
    known = Known(poses(15, 8, 0.8), 0.1 * rng.normal(size=(15, 3)), betas)
    return replace(data, known=replace(known, **changes))


@pytest.mark.parametrize("trans", [True, False])
def test_the_start_of_made_registrations_is_what_they_were_made_from(trans):
    body = body_of()
    data = made(body) if trans else made(body, trans=None)
    problem = state_problem(data, template_of(body), WARM, body)
    estimate = initial_estimate(problem, template_of(body), ALONE, body)
    assert measure_energy(problem, estimate, ALONE).terms["data"] < 1e-18
    rest = {name: estimate.templates[k] for k, name in enumerate(data.subjects)}
    told = replace(problem, registrations=made(body, betas=None, rest=rest))
    np.testing.assert_array_equal(
        initial_estimate(told, template_of(body), ALONE, body).templates, estimate.templates
    )


def test_only_blend_shapes_are_learned_where_all_else_is_known():
    """To the energy's exact minimum in one round: the second finds nothing to do."""
    truth = body_of()
    start = replace(truth, posedirs=0.5 * truth.posedirs)
    data = made(truth)
    trained = train_body(
        data, template_of(start), replace(HOLD, rounds=2, least_effect=0.0), body=start
    )
    for name in ("skinning_weights", "joint_regressor", "v_template", "shapedirs"):
        assert np.array_equal(getattr(trained.body, name), getattr(start, name)), name
    assert np.array_equal(trained.estimate.pose, data.known.pose)
    first = {record.step: record.energy for record in trained.history if record.round < 2}
    assert list(first) == ["poses as known", "pose shapes", "further"]
    known = data.known
    away = data.vertices - start(known.betas, known.pose, known.trans).vertices
    assert first["poses as known"].terms["data"] == pytest.approx(float((away**2).sum()), rel=1e-9)
    assert first["pose shapes"].total < first["poses as known"].total
    (second,) = (
        record for record in trained.history if (record.round, record.step) == (2, "pose shapes")
    )
    assert second.energy.total == pytest.approx(first["pose shapes"].total, rel=1e-9)


def test_known_people_are_held_while_poses_are_found():
    body = body_of()
    data = made(body, pose=None, trans=None)
    steps = [
        r.step
        for r in train_body(
            data, template_of(body), replace(WARM, fixed=("people",)), body=body
        ).history
    ]
    assert "subjects" not in steps and "poses" in steps
    trained = train_body(made(body), template_of(body), replace(WARM, fixed=("poses",)), body=body)
    assert np.array_equal(trained.estimate.pose, made(body).known.pose)
    assert "subjects" in [record.step for record in trained.history]


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"pose": None}, "poses fixed, but those of 15 of 15 .* are unknown"),
        ({"betas": None}, "people fixed, but those of 3 of 3 .*expected betas or rest"),
        ({"betas": np.zeros((15, BETAS + 1))}, "betas have 3 rows of numbers, small has 2"),
        ({"pose": np.zeros((15, 4, 3))}, "pose have 4 rows of numbers, small has 6"),
    ],
)
def test_what_does_not_fit_is_refused(changes, words):
    body = body_of()
    with pytest.raises(HabitusError, match=words):
        train_body(made(body, **changes), template_of(body), HOLD, body=body)


@pytest.mark.wrong_shapes
def test_what_is_known_is_checked_and_taken_with_the_registrations():
    data = made(body_of())
    few = data.take(np.array([7, 2]))
    assert np.array_equal(few.known.pose, data.known.pose[[7, 2]])
    for changes in (
        {"trans": np.zeros((14, 3))},
        {"pose": np.full((15, 6, 3), np.inf)},
        {"rest": {"s0": np.zeros(3)}},
    ):
        with pytest.raises(HabitusError, match="expected"):
            replace(data, known=replace(data.known, **changes))
