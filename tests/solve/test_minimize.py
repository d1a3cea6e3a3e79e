"""Laws of `minimize`: known minima, agreement of methods and of ways to differentiate, weights,
what a result says.
"""

import subprocess
import sys
from functools import partial

import numpy as np
import pytest
import scipy.optimize
import scipy.sparse
import torch

from habitus.errors import HabitusError
from habitus.solve.least_squares import Tolerances
from habitus.solve.minimize import METHODS, minimize
from habitus.solve.objective import Differentiation, Objective, least_squares_problem
from habitus.solve.terms import Unknowns

GAUSS_NEWTON = ["dogleg", "levenberg"]


def rosenbrock(x, y):
    return torch.stack([10 * (y - x**2), 1 - x])


ROSENBROCK = {"x": torch.tensor(-1.2), "y": torch.tensor(1.0)}


def waves(seed=0, rows=40, noise=0.1):
    """A fit of a mixture through tanh with residuals left over: a function of (2, 3) and (2,), and
    a start.
    """
    rng = torch.Generator().manual_seed(seed)
    mix = torch.randn(rows, 6, generator=rng).double()
    shift = torch.randn(rows, 2, generator=rng).double()

    def predict(bend, offset):
        inner = mix @ bend.reshape(-1)
        return torch.tanh(inner) + 0.3 * inner + shift @ offset

    truth = {
        "bend": torch.randn(2, 3, generator=rng).double(),
        "offset": torch.randn(2, generator=rng).double(),
    }
    data = predict(**truth) + noise * torch.randn(rows, generator=rng).double()
    start = {
        name: value + 0.3 * torch.randn(value.shape, generator=rng).double()
        for name, value in truth.items()
    }
    return lambda bend, offset: predict(bend, offset) - data, start, truth


def with_jacobians(function, wrap, lazy=False):
    """The same term with explicit Jacobians, wrapped as asked."""

    def term(bend, offset):
        def jacobians():
            found = torch.func.jacrev(function, argnums=(0, 1))(bend, offset)
            return {
                k: wrap(part.reshape(-1, n))
                for k, part, n in zip(["bend", "offset"], found, [6, 2], strict=True)
            }

        return function(bend, offset), (jacobians if lazy else jacobians())

    return term


def close(a, b, atol):
    assert a.keys() == b.keys()
    for name in a:
        torch.testing.assert_close(a[name].double(), b[name].double(), atol=atol, rtol=0)


@pytest.mark.parametrize("method", METHODS)
def test_rosenbrock(method):
    result = minimize(rosenbrock, ROSENBROCK, method)
    assert result.converged and result.cost < 1e-12 and result.method == method
    close(result.values, {"x": torch.tensor(1.0), "y": torch.tensor(1.0)}, 1e-6)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("seed", range(3))
def test_what_was_planted_is_recovered(method, seed):
    function, start, truth = waves(seed, noise=0.0)
    close(minimize(function, start, method).values, truth, 1e-5)


@pytest.mark.parametrize("seed", range(3))
def test_methods_agree_with_each_other_and_with_scipy(seed):
    function, start, _ = waves(seed)
    results = [minimize(function, start, method) for method in METHODS]
    peer = scipy.optimize.least_squares(
        lambda x: function(torch.tensor(x[:6]).view(2, 3), torch.tensor(x[6:])).numpy(), flat(start)
    )
    for result in results:
        assert result.cost == pytest.approx(peer.cost, rel=1e-8)
        np.testing.assert_allclose(result.x, peer.x, atol=1e-4)
        np.testing.assert_array_equal(flat(result.values), result.x)


def flat(values):
    return np.concatenate([value.numpy().ravel() for value in values.values()])


@pytest.mark.parametrize("method", METHODS)
def test_a_weight_scales_the_residual_by_its_root(method):
    function, start, _ = waves()
    terms = {"data": function, "small": lambda bend: bend}
    weighted = minimize(terms, start, method, weights={"small": 0.3})
    scaled = minimize({**terms, "small": lambda bend: 0.3**0.5 * bend}, start, method)
    close(weighted.values, scaled.values, 1e-6)
    assert weighted.costs["small"] == pytest.approx(
        0.15 * float((weighted.values["bend"] ** 2).sum())
    )
    free = minimize(function, start, method)
    assert float((weighted.values["bend"] ** 2).sum()) < float((free.values["bend"] ** 2).sum())
    close(minimize(terms, start, method, weights={"small": 0}).values, free.values, 1e-12)


@pytest.mark.parametrize("method", METHODS)
def test_costs_of_terms_sum_to_the_cost_which_never_rises(method):
    function, start, _ = waves(4)
    wide = {name: 6 * value for name, value in start.items()}
    terms = {
        "data": function,
        "bend": lambda bend: bend,
        "both": lambda bend, offset: bend[0, :2] * offset,
    }
    result = minimize(terms, wide, method, weights={"bend": 0.1, "both": 2.0})
    assert list(result.costs) == list(terms) and all(cost > 0 for cost in result.costs.values())
    assert sum(result.costs.values()) == pytest.approx(result.cost, rel=1e-12)
    assert (np.diff(result.history) <= 0).all() and result.history[
        -1
    ] == result.cost < result.history[0]
    assert len(result.history) == result.iterations + 1 and result.seconds > 0


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("lazy", [False, True])
@pytest.mark.parametrize(
    "wrap", [torch.clone, torch.Tensor.numpy, scipy.sparse.csr_matrix, scipy.sparse.coo_array]
)
def test_explicit_jacobians_take_the_same_path(method, wrap, lazy):
    function, start, _ = waves(1)
    plain = minimize(function, start, method, max_iterations=6)
    explicit = minimize(with_jacobians(function, wrap, lazy), start, method, max_iterations=6)
    np.testing.assert_allclose(explicit.history, plain.history, rtol=1e-9)
    close(explicit.values, plain.values, 1e-9)


def chain(size, explicit):
    """A smoothed line and its lifted head: many unknowns; Jacobians explicit and mostly sparse, or
    left to autodiff.
    """
    target = torch.sin(torch.linspace(0, 9, size, dtype=torch.float64))

    def data(line):
        return line + 0.1 * line**3 - target

    def smooth(line):
        return line[2:] - 2 * line[1:-1] + line[:-2]

    def head(tail, line):
        return tail + tail**3 - line[:10]

    if not explicit:
        return {"data": data, "smooth": smooth, "head": head}
    bends = scipy.sparse.diags_array([1.0, -2.0, 1.0], offsets=[0, 1, 2], shape=(size - 2, size))
    minus = -scipy.sparse.eye_array(10, size)
    return {
        "data": lambda line: (
            data(line),
            {"line": scipy.sparse.diags_array(1 + 0.3 * line.numpy() ** 2)},
        ),
        "smooth": lambda line: (bends.tocsr() @ line.numpy(), {"line": bends.tocoo()}),
        "head": lambda tail, line: (
            head(tail, line),
            {"line": minus, "tail": torch.diag(1 + 3 * tail**2)},
        ),
    }


def test_sparse_jacobians_give_a_sparse_matrix_and_the_same_minimum():
    start = {"line": torch.zeros(600), "tail": torch.ones(10).double()}
    results = []
    for explicit in (True, False):
        terms = {**chain(600, explicit), "tail": lambda tail: tail}
        weights = {"smooth": 50.0, "tail": 0.1}
        problem = least_squares_problem(
            Objective.of(terms, weights, Unknowns.of(start)), Differentiation()
        )
        _, derivatives = problem(np.linspace(-1, 1, 610))
        results.append((*derivatives(), minimize(terms, start, weights=weights)))
    (gradient, matrix, result), (dense_gradient, dense, peer) = results
    assert (
        scipy.sparse.issparse(matrix)
        and matrix.nnz < 0.02 * dense.size
        and isinstance(dense, np.ndarray)
    )
    np.testing.assert_allclose(matrix.toarray(), dense, atol=1e-10)
    np.testing.assert_allclose(gradient, dense_gradient, atol=1e-10)
    assert result.converged and result.cost == pytest.approx(peer.cost, rel=1e-9)
    close(result.values, peer.values, 1e-6)


@pytest.mark.parametrize("method", GAUSS_NEWTON)
@pytest.mark.parametrize(
    "options", [{"mode": "reverse"}, {"mode": "forward", "chunk_size": 1}, {"chunk_size": 4}]
)
def test_all_ways_to_differentiate_take_the_same_path(method, options):
    function, start, _ = waves(2)
    expected = minimize(function, start, method, mode="forward")
    result = minimize(function, start, method, **options)
    np.testing.assert_allclose(result.history, expected.history, rtol=1e-10)
    close(result.values, expected.values, 1e-9)


def test_few_residuals_of_many_unknowns_are_differentiated_by_rows():
    seen = []

    def pulled(x):
        seen.append(x.requires_grad)
        return torch.stack([x.sum() - 1.0, x[0] - 3.0])

    result = minimize(pulled, {"x": torch.zeros(100)})
    assert any(seen) and result.cost < 1e-20
    assert float(result.values["x"].sum()) == pytest.approx(1.0)


class Cube(torch.autograd.Function):
    """x^3 as the renderer writes its functions: a backward outside torch, a jvp in torch, no
    batched primals.
    """

    @staticmethod
    def forward(x):
        return torch.from_numpy(x.detach().numpy() ** 3)

    @staticmethod
    def setup_context(ctx, inputs, output):
        ctx.save_for_backward(inputs[0])
        ctx.save_for_forward(inputs[0])

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, gradient):
        return torch.from_numpy(3 * ctx.saved_tensors[0].detach().numpy() ** 2 * gradient.numpy())

    @staticmethod
    def jvp(ctx, tangent):
        return 3 * ctx.saved_tensors[0] ** 2 * tangent

    @staticmethod
    def vmap(info, in_dims, x):
        raise HabitusError("batched")


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("mode", ["forward", "reverse"])
def test_custom_functions_are_differentiated_as_they_say(method, mode):
    goal = torch.tensor([1.0, 8.0, 27.0]).double()
    terms = {"image": lambda x: Cube.apply(2 * x) - goal}
    result = minimize(terms, {"x": torch.ones(3)}, method, mode=mode)
    close(result.values, {"x": torch.tensor([0.5, 1.0, 1.5])}, 1e-5)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_values_come_back_as_they_went_in(method, dtype):
    function, start, truth = waves(3, noise=0.0)
    start = {"bend": start["bend"].to(dtype).requires_grad_(), "offset": start["offset"].double()}
    before = {name: value.detach().clone() for name, value in start.items()}
    inside = []

    def term(bend, offset):
        inside.append({bend.dtype, offset.dtype})
        return function(bend, offset)

    values = minimize(term, start, method).values
    assert values["bend"].dtype == dtype and values["offset"].dtype == torch.float64
    assert values["bend"].shape == (2, 3) and not values["bend"].requires_grad
    assert all(dtypes == {torch.float64} for dtypes in inside)
    close(values, truth, 1e-4)
    close({name: value.detach() for name, value in start.items()}, before, 0.0)


@pytest.mark.parametrize("method", METHODS)
def test_an_unknown_that_nothing_depends_on_stays(method):
    free = {
        **ROSENBROCK,
        "unused": torch.tensor([7.0, -3.0]),
        "multiplied by zero": torch.tensor(2.5),
    }

    def term(x, y, **others):
        return rosenbrock(x, y) + 0 * others["multiplied by zero"]

    values = minimize({"term": term}, free, method).values
    assert torch.equal(values["unused"], free["unused"])
    assert torch.equal(values["multiplied by zero"], torch.tensor(2.5))
    assert float(values["x"]) == pytest.approx(1.0, abs=1e-4)


def test_a_partial_holds_an_unknown_for_the_first_stage():
    function, start, _ = waves(5)
    first = minimize(partial(function, bend=start["bend"]), {"offset": start["offset"]})
    assert list(first.values) == ["offset"]
    both = minimize(function, {**start, **first.values})
    assert both.cost < first.cost and both.cost == pytest.approx(minimize(function, start).cost)


def test_the_method_follows_from_the_terms():
    def cost(x, y):
        return 0.5 * (rosenbrock(x, y) ** 2).sum()

    assert minimize(rosenbrock, ROSENBROCK).method == "dogleg"
    scalar = minimize(cost, ROSENBROCK)
    squares = minimize(rosenbrock, ROSENBROCK, "lbfgs")
    assert scalar.method == "lbfgs"
    close(scalar.values, squares.values, 1e-6)
    mixed = minimize({"a": cost, "b": lambda x: 0 * x[None]}, ROSENBROCK, weights={"a": 3})
    assert mixed.method == "lbfgs" and mixed.history[0] == pytest.approx(3 * squares.history[0])
    huge = {"x": torch.zeros(20_000)}
    assert minimize(lambda x: x - 1.0, huge).method == "lbfgs"
    with pytest.raises(HabitusError, match="2 GiB"):
        minimize(lambda x: x - 1.0, huge, "dogleg")


def test_a_cost_below_zero_is_minimised():
    result = minimize(lambda x: torch.cos(x).sum() - 5.0, {"x": torch.tensor([2.0, 4.0])})
    assert result.cost == pytest.approx(-7.0) and result.converged
    close(result.values, {"x": torch.full((2,), torch.pi)}, 1e-5)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("unit", [1e-8, 1.0, 1e8])
def test_units_of_the_residual_do_not_matter(method, unit):
    function, start, _ = waves(6)
    expected = minimize(function, start, method)
    result = minimize(lambda bend, offset: unit * function(bend, offset), start, method)
    assert result.converged
    close(result.values, expected.values, 1e-4)


@pytest.mark.parametrize("method", METHODS)
def test_a_start_that_is_not_finite_is_reported(method):
    result = minimize(lambda x: x * torch.nan, {"x": torch.tensor([1.0, 2.0])}, method)
    assert result.status == "not finite" and result.iterations == 0 and not result.converged
    assert torch.equal(result.values["x"], torch.tensor([1.0, 2.0]))


@pytest.mark.parametrize("method", METHODS)
def test_a_hole_in_the_domain_is_stepped_around(method):
    """The logarithm is not finite below zero, where the first step would land."""
    result = minimize(
        lambda x: torch.log(x) - 1.0, {"x": torch.tensor([0.5, 40.0]).double()}, method
    )
    assert result.converged
    close(result.values, {"x": torch.full((2,), torch.e).double()}, 1e-4)


@pytest.mark.parametrize("method", METHODS)
def test_a_hole_that_the_very_first_step_falls_into_is_stepped_around(method):
    result = minimize(lambda x: torch.log(x) + 3.0, {"x": torch.tensor([0.5]).double()}, method)
    assert result.converged
    close(result.values, {"x": torch.tensor([torch.e]).double() ** -3}, 1e-4)


@pytest.mark.parametrize("method", METHODS)
def test_limits_and_callbacks_stop(method):
    assert minimize(rosenbrock, ROSENBROCK, method, max_iterations=2).status == "iterations"
    none = minimize(rosenbrock, ROSENBROCK, method, max_iterations=0)
    assert none.status == "iterations" and none.iterations == 0 and none.values == ROSENBROCK
    seen = []
    result = minimize(
        rosenbrock,
        ROSENBROCK,
        method,
        callback=lambda k, values, cost: seen.append((k, values, cost)) or k == 3,
    )
    assert result.status == "stopped" and [k for k, _, _ in seen] == [1, 2, 3]
    assert seen[-1][1] == result.values and [cost for _, _, cost in seen] == list(
        result.history[1:]
    )
    loose = minimize(rosenbrock, ROSENBROCK, method, tolerances=Tolerances(cost=0.5))
    assert (
        loose.converged and loose.iterations < minimize(rosenbrock, ROSENBROCK, method).iterations
    )


@pytest.mark.parametrize("method", GAUSS_NEWTON)
def test_refused_steps_compute_no_derivatives(method):
    """Jacobians are asked for once at the start and once for each step that was taken."""
    asked = []

    def term(x):
        return torch.atan(4 * x), lambda: asked.append(1) or {"x": torch.diag(4 / (1 + 16 * x**2))}

    result = minimize(term, {"x": torch.tensor([1.0, -0.9])}, method)
    falls = np.diff(result.history) < 0
    assert result.cost < 1e-12 and not falls.all()
    assert len(asked) == 1 + falls.sum()


@pytest.mark.parametrize("method", GAUSS_NEWTON)
def test_edges_far_off_are_not_followed_pixel_by_pixel(method):
    """A Jacobian of an image knows an edge's own pixels only, a few; steps are stretched over the
    other hundreds.
    """
    pixels = torch.arange(600.0, dtype=torch.float64)

    def bar(left, width):
        return torch.sigmoid(pixels - left) - torch.sigmoid(pixels - left - width)

    seen = bar(torch.tensor(310.3), torch.tensor(180.6))
    start = {"left": torch.tensor(100.0), "width": torch.tensor(280.0)}
    result = minimize(lambda left, width: bar(left, width) - seen, start, method)
    assert result.converged and result.cost < 1e-20 and (np.diff(result.history) <= 0).all()
    assert result.iterations < 20


ONE = {"x": torch.ones(2)}
BAD = {
    "no number is free": (lambda x: x, {}),
    "expected a mapping": (lambda x: x, [torch.ones(2)]),
    "torch.int64; expected a floating": (lambda x: x, {"x": torch.arange(3)}),
    "a float; expected a floating tensor": (lambda x: x, {"x": 1.0}),
    "no terms": ({}, ONE),
    "is a Tensor; expected a function": ({"a": torch.ones(2)}, ONE),
    "asks for 'y'": (lambda x, y: x + y, ONE),
    "gives a list": (lambda x: [1.0], ONE),
    "gives a tensor of torch.bool": (lambda x: x > 0, ONE),
    "gives no residuals": (lambda x: x[:0], ONE),
    "keep their number": (lambda x: x[x > 0.5], ONE),
    "Jacobians of 'y'": (lambda x: (x, {"y": torch.eye(2)}), ONE),
    "Jacobians of a list": (lambda x: (x, [torch.eye(2)]), ONE),
    r"has shape \(3, 3\); expected \(2, 2\)": (
        lambda x: (x, {"x": scipy.sparse.eye_array(3)}),
        ONE,
    ),
    r"has shape \(2,\); expected \(2, 2\)": (lambda x: (x, {"x": torch.ones(2)}), ONE),
    "a cost; it needs residuals": (lambda x: x.sum(), ONE),
}


@pytest.mark.parametrize("message", BAD)
def test_bad_input_is_one_clear_line(message):
    with pytest.raises(HabitusError, match=message) as caught:
        minimize(*BAD[message], "dogleg")
    assert "\n" not in str(caught.value)


def test_bad_options_are_one_clear_line():
    for options, message in [
        ({"method": "newton"}, "dogleg, levenberg, lbfgs"),
        ({"weights": {"data": 1.0}}, "the terms are 'objective'"),
        ({"weights": {"objective": -1.0}}, "0 or more"),
        ({"weights": {"objective": np.nan}}, "0 or more"),
        ({"mode": "sideways"}, "forward or reverse"),
        ({"chunk_size": 0}, "1 or more"),
    ]:
        with pytest.raises(HabitusError, match=message):
            minimize(lambda x: x, ONE, **options)


@pytest.mark.parametrize(
    "first", ["import habitus.solve.minimize", "import habitus.solve.least_squares", "pass"]
)
def test_the_function_keeps_its_name_whatever_was_imported_first(first):
    code = f"""
import sys, habitus.solve
assert not {{"torch", "scipy"}} & set(sys.modules)
{first}
from habitus.solve.minimize import minimize as one
from habitus.solve import minimize as two
assert one is two is habitus.solve.minimize and one.__name__ == "minimize" and callable(one)
"""
    subprocess.run([sys.executable, "-c", code], check=True)
