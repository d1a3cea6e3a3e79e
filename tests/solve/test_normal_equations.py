"""Laws of terms that give normal equations, of masks and limits of steps, and of alternation."""

from dataclasses import dataclass

import numpy as np
import pytest

from habitus.errors import HabitusError
from habitus.solve.arrow_terms import arrow_problem
from habitus.solve.least_squares import Dogleg, Levenberg
from habitus.solve.minimize import METHODS, Stage, alternate, minimize
from habitus.solve.objective import Differentiation, Objective, least_squares_problem
from habitus.solve.terms import GemanMcClure, Quadratic, Term, Unknowns

T, N, M, B = 4, 3, 2, 5


def frames(seed=0, rows=7):
    """A residual (T, rows) of shared betas (B,) and of pose (T, N) and place (T, M) of each frame:
    as a term of rows with Jacobian, and as one of normal equations.
    """
    rng = np.random.default_rng(seed)
    by_betas = rng.normal(size=(T, rows, B))
    by_pose = rng.normal(size=(T, rows, N))
    by_place = rng.normal(size=(T, rows, M))
    data = rng.normal(size=(T, rows))

    def residual(betas, pose, place):
        moved = np.einsum("trb,b->tr", by_betas, betas)
        bent = np.tanh(np.einsum("trn,tn->tr", by_pose, pose))
        slopes = (1.0 - bent**2)[..., None] * by_pose
        return moved + bent + np.einsum("trm,tm->tr", by_place, place) - data, slopes

    def rows_and_jacobian(betas, pose, place):
        value, slopes = residual(betas, pose, place)
        whole = {"betas": by_betas.reshape(-1, B)}
        for name, part in (("pose", slopes), ("place", by_place)):
            wide = np.zeros((T, rows, T, part.shape[2]))
            wide[np.arange(T), :, np.arange(T)] = part
            whole[name] = wide.reshape(T * rows, -1)
        return value, whole

    def equations(betas, pose, place):
        value, slopes = residual(betas, pose, place)

        def derivatives():
            gradient = {
                "betas": np.einsum("trb,tr->b", by_betas, value),
                "pose": np.einsum("trn,tr->tn", slopes, value),
                "place": np.einsum("trm,tr->tm", by_place, value),
            }
            own = {"pose": slopes, "place": by_place}
            blocks = {("betas", "betas"): np.einsum("trb,trc->bc", by_betas, by_betas)}
            for a, b in (("pose", "pose"), ("place", "pose"), ("place", "place")):
                blocks[a, b] = np.einsum("trn,trm->tnm", own[a], own[b])
            for a, part in own.items():
                blocks[a, "betas"] = np.einsum("trn,trb->tnb", part, by_betas)
            return gradient, blocks

        return Quadratic(0.5 * float((value**2).sum()), derivatives)

    return Term(rows_and_jacobian, 2.0), Term(equations, 2.0)


def start(seed=1):
    rng = np.random.default_rng(seed)
    shapes = {"betas": (B,), "pose": (T, N), "place": (T, M)}
    return {name: 0.1 * rng.normal(size=shape) for name, shape in shapes.items()}


def assembled(term, blocks=(), more=()):
    objective = Objective.of({"data": term, **dict(more)}, None, Unknowns.of(start()))
    how = Differentiation()
    problem = arrow_problem(objective, how, blocks) if blocks else None
    cost, derivatives = (problem or least_squares_problem(objective, how))(
        objective.unknowns.vector
    )
    gradient, matrix = derivatives()
    return cost, gradient, matrix.dense() if blocks else np.asarray(matrix)


@pytest.mark.parametrize("blocks", [(), ("pose", "place"), ("place", "pose")])
def test_normal_equations_are_those_of_the_rows(blocks):
    rows, equations = frames()
    prior = {"prior": Term(lambda betas: (betas, {"betas": np.eye(B)}))}
    for ours, theirs in zip(
        assembled(equations, blocks, prior), assembled(rows, (), prior), strict=True
    ):
        np.testing.assert_allclose(ours, theirs, rtol=1e-12, atol=1e-12)


def test_many_unknowns_keep_blocks_sparse():
    count = 300

    def residual(x):
        return Quadratic(
            0.5 * (x**2).sum(), lambda: ({"x": x}, {("x", "x"): np.tile(np.eye(2), (count, 1, 1))})
        )

    objective = Objective.of(Term(residual), None, Unknowns.of({"x": np.ones((count, 2))}))
    problem = least_squares_problem(objective, Differentiation())
    matrix = problem(objective.unknowns.vector)[1]()[1]
    assert matrix.nnz == 2 * count
    assert minimize(Term(residual), {"x": np.ones((count, 2))}).cost < 1e-20


@pytest.mark.parametrize("method", METHODS)
def test_both_forms_have_the_same_minimum(method):
    rows, equations = frames()
    prior = Term(lambda pose: (pose.ravel(), {"pose": np.eye(T * N)}), 0.1)
    ours, theirs = (
        minimize({"data": term, "prior": prior}, start(), method, max_iterations=500)
        for term in (equations, rows)
    )
    assert ours.cost == pytest.approx(theirs.cost, rel=1e-8)
    assert ours.costs == pytest.approx(theirs.costs, rel=1e-4)


def test_the_order_of_names_does_not_matter():
    rng = np.random.default_rng(2)
    jacobians = {"a": rng.normal(size=(6, 2)), "b": rng.normal(size=(6, 3))}
    data = rng.normal(size=6)

    def residual(**values):
        return sum(jacobians[n] @ values[n] for n in ("a", "b")) - data, jacobians

    terms = {"one": Term(residual, takes=("a", "b")), "two": Term(residual, takes=("b", "a"))}
    begin = {"a": np.ones(2), "b": np.ones(3)}
    objective = Objective.of(terms, None, Unknowns.of(begin))
    matrix = least_squares_problem(objective, Differentiation())(objective.unknowns.vector)[1]()[1]
    whole = np.concatenate([jacobians["a"], jacobians["b"]], axis=1)
    np.testing.assert_allclose(matrix, 2.0 * whole.T @ whole, rtol=1e-12)


def wrong(gradient, blocks):
    return Term(lambda x: Quadratic(float(x @ x), lambda: (gradient, blocks)))


@pytest.mark.parametrize(
    ("term", "word"),
    [
        (wrong({}, {}), "gradients"),
        (wrong({"x": np.zeros(2)}, {}), "2 numbers"),
        (wrong({"x": np.zeros(3)}, {("x", "x"): np.eye(2)}), r"\(2, 2\)"),
        (Term(lambda x: Quadratic(1.0, dict), robust=GemanMcClure(1.0)), "robust"),
    ],
)
def test_wrong_normal_equations_are_refused(term, word):
    with pytest.raises(HabitusError, match=word):
        minimize(term, {"x": np.ones(3)})


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("blocks", [(), ("pose", "place")])
def test_a_mask_holds_numbers(method, blocks):
    _, equations = frames()
    begin = start()
    free = np.arange(B) < 2
    first = np.arange(N) < 1
    result = minimize(
        equations,
        begin,
        method,
        masks={"betas": free, "pose": first},
        blocks=() if method == "lbfgs" else blocks,
        max_iterations=500,
    )
    np.testing.assert_array_equal(result.values["betas"][2:], begin["betas"][2:])
    np.testing.assert_array_equal(result.values["pose"][:, 1:], begin["pose"][:, 1:])
    assert (result.values["betas"][:2] != begin["betas"][:2]).all()
    gradient = equations(result.values).quadratic.derivatives()[0]
    np.testing.assert_allclose(gradient["betas"][:2], 0.0, atol=1e-4)
    np.testing.assert_allclose(gradient["pose"][:, 0], 0.0, atol=1e-4)


@pytest.mark.parametrize("masks", [{"x": np.ones(2, bool)}, {"y": np.ones(3, bool)}])
def test_a_mask_that_does_not_fit_is_refused(masks):
    with pytest.raises(HabitusError, match="mask"):
        minimize(Term(lambda x: (x, {"x": np.eye(3)})), {"x": np.ones(3)}, masks=masks)


def test_a_step_is_cut_where_one_unknown_would_leap():
    def residual(x, y):
        return np.concatenate([x, y]), {"x": np.eye(4, 2), "y": np.eye(4, 2, -2)}

    begin = {"x": np.array([4.0, 1.0]), "y": np.array([8.0, 0.0])}
    result = minimize(
        Term(residual), begin, Levenberg(1e-12), max_step={"x": 1.0}, max_accepted=1, stretch=False
    )
    assert result.status == "iterations" and result.iterations == 1
    np.testing.assert_allclose(result.values["x"], [3.0, 0.75], rtol=1e-9)
    np.testing.assert_allclose(result.values["y"], [6.0, 0.0], rtol=1e-9)


def test_damping_carries_over_from_call_to_call():
    """On a linear problem each good step thirds the damping, in one call or in several."""
    term = Term(lambda x: (x, {"x": np.eye(2)}))
    steps = Levenberg(9.0)
    state = {"x": np.ones(2)}
    for damping in (3.0, 1.0, 1.0 / 3.0):
        before = state["x"]
        state = minimize(term, state, steps, max_iterations=1, stretch=False).values
        assert steps.damping == pytest.approx(damping)
        np.testing.assert_allclose(state["x"], before * (1.0 - 1.0 / (1.0 + 3.0 * damping)))


def test_a_trust_region_carries_over_and_its_step_does_not():
    steps = Dogleg()
    steps.radius = 0.5
    for target in (3.0, -3.0):
        term = Term(lambda x, target=target: (x - target, {"x": np.eye(1)}))
        moved = minimize(term, {"x": np.zeros(1)}, steps, max_iterations=1, stretch=False)
        assert np.sign(moved.values["x"][0]) == np.sign(target)
    assert moved.values["x"][0] == pytest.approx(-1.0) and steps.radius == 2.0


def circle_terms(points):
    """Points against the nearest place of a circle about a centre: found anew at each state."""

    def terms_at(state, stage, step):
        off = points - state["centre"]
        normal = off / np.linalg.norm(off, axis=1, keepdims=True)
        target = points - normal

        def residual(centre):
            return ((centre - target) * normal).sum(1), {"centre": normal}

        return {"circle": Term(residual)}

    return terms_at


def arc(seed=0):
    angle = np.random.default_rng(seed).uniform(0.0, 2.0, 40)
    return np.array([0.3, -0.2]) + np.stack([np.cos(angle), np.sin(angle)], 1)


def test_alternation_finds_what_correspondences_hide():
    until = Stage(50, until=None)
    result = alternate(circle_terms(arc()), {"centre": np.zeros(2)}, [until])
    np.testing.assert_allclose(result.values["centre"], [0.3, -0.2], atol=1e-8)
    assert result.costs["circle"] < 1e-15 and len(result.history) == result.iterations + 1


def test_alternation_ends_where_a_step_is_small():
    from habitus.solve.least_squares import Tolerances

    stage = Stage(50, until=Tolerances(step=1e-6))
    result = alternate(circle_terms(arc()), {"centre": np.zeros(2)}, [stage])
    assert result.status == "converged" and result.iterations < 50


@dataclass
class Place:
    centre: np.ndarray
    turn: np.ndarray | None = None


def test_stages_hold_mask_and_limit():
    """A recipe's stage may have fields of its own, and its state be a dataclass."""

    @dataclass(frozen=True)
    class Own(Stage):
        scale: float = 1.0

    seen = []
    points = arc()

    def terms_at(state, stage, step):
        seen.append((stage.scale, step, state["centre"].copy()))
        return circle_terms(points)(state, stage, step)

    stages = [
        Own(1, masks={"centre": np.array([True, False])}, scale=2.0),
        Own(2, max_step={"centre": 0.01}),
    ]
    result = alternate(terms_at, Place(np.zeros(2)), stages)
    assert isinstance(result.state, Place) and result.status == "iterations"
    assert [each[:2] for each in seen] == [(2.0, 0), (1.0, 0), (1.0, 1)]
    assert seen[1][2][0] != 0.0 and seen[1][2][1] == 0.0
    assert 0.0 < np.abs(result.state.centre - seen[1][2]).max() <= 0.02 + 1e-12


def test_a_refused_step_is_reported():
    def terms_at(state, stage, step):
        return {"lie": Term(lambda x: Quadratic(float(x[0]), lambda: ({"x": -np.ones(1)}, {})))}

    result = alternate(terms_at, {"x": np.ones(1)}, [Stage(1)])
    assert result.status == "stalled" and result.values["x"] == 1.0
