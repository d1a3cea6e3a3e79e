import numpy as np
import pytest

from habitus_lab.population.flesh.assembly_kernels import add_elastic, total_energy
from habitus_lab.population.flesh.elastic_kernels import energy_density, rotations_of

CORNERS = np.arange(4)[None]
ALL = np.arange(16, dtype=np.int32)[None]
MU = np.array([1.3])
LAM = np.array([40.0])


@pytest.fixture(scope="module")
def rest():
    return np.vstack([np.zeros(3), np.eye(3)]) + 0.1 * np.random.default_rng(0).normal(size=(4, 3))


def element(rest):
    edges = (rest[1:] - rest[0]).T
    return np.linalg.inv(edges)[None], np.array([np.linalg.det(edges) / 6])


def derivatives(nodes, rest):
    inverse, volume = element(rest)
    gradient = np.zeros((4, 3))
    blocks = np.zeros((16, 3, 3))
    add_elastic(nodes, CORNERS, inverse, volume, MU, LAM, ALL, gradient, blocks)
    return gradient, blocks.reshape(4, 4, 3, 3).swapaxes(1, 2).reshape(12, 12)


def slopes(function, point, step):
    moves = step * np.eye(point.size).reshape(-1, *point.shape)
    return np.array(
        [(function(point + move) - function(point - move)) / (2 * step) for move in moves]
    )


@pytest.mark.parametrize(
    "singular",
    [(1.2, 0.9, 0.4), (1.0, 1.0, 1.0), (2.0, 1.0, 0.0), (1.5, 0.7, -0.3), (1.0, 0.0, 0.0)],
)
def test_singular_values_are_of_rotations(singular):
    q, _ = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))
    p, _ = np.linalg.qr(np.random.default_rng(2).normal(size=(3, 3)))
    f = (q * np.linalg.det(q)) @ np.diag(singular) @ (p * np.linalg.det(p)).T
    u = np.empty((3, 3))
    v = np.empty((3, 3))
    sigma = np.empty(3)
    rotations_of(f, u, sigma, v, np.empty((3, 3)))
    np.testing.assert_allclose(u @ np.diag(sigma) @ v.T, f, atol=1e-8)
    for turn in (u, v):
        np.testing.assert_allclose(turn.T @ turn, np.eye(3), atol=1e-9)
        assert np.linalg.det(turn) > 0


@pytest.mark.parametrize("strength", [0.05, 0.3, 0.8])
def test_forces_are_the_slope_of_the_energy(rest, strength):
    nodes = rest + strength * np.random.default_rng(3).normal(size=(4, 3))
    inverse, volume = element(rest)
    wanted = slopes(
        lambda x: total_energy(x, CORNERS, inverse, volume, MU, LAM), nodes, 1e-6
    ).reshape(4, 3)
    gradient, _ = derivatives(nodes, rest)
    np.testing.assert_allclose(gradient, wanted, atol=1e-7 * np.abs(wanted).max() + 1e-9)


@pytest.mark.parametrize("seed", range(4))
def test_matrix_is_the_second_derivative_without_negative_modes(rest, seed):
    """Against the eigenvalues of a 9 x 9 matrix by differences; seeds with J from below 0 to over
    10 are among them.
    """
    nodes = rest + (0.1, 0.5, 0.8, 1.0)[seed] * np.random.default_rng(seed).normal(size=(4, 3))
    inverse, volume = element(rest)
    f = (nodes[1:] - nodes[0]).T @ inverse[0]

    def density(x):
        return energy_density(x, np.linalg.det(x), MU[0], LAM[0])

    second = slopes(lambda x: slopes(density, x, 1e-5), f, 1e-4)
    values, modes = np.linalg.eigh((second + second.T) / 2)
    hats = np.concatenate([-inverse[0].sum(0, keepdims=True), inverse[0]])
    to_f = np.einsum("ac,ij->icaj", hats, np.eye(3)).reshape(9, 12)
    wanted = volume[0] * to_f.T @ (modes * np.maximum(values, 0)) @ modes.T @ to_f
    _, found = derivatives(nodes, rest)
    np.testing.assert_allclose(found, wanted, atol=1e-5 * np.abs(wanted).max())


def test_rest_has_no_energy_and_no_forces(rest):
    inverse, volume = element(rest)
    turn, _ = np.linalg.qr(np.random.default_rng(5).normal(size=(3, 3)))
    nodes = rest @ (turn * np.linalg.det(turn)).T + 2.0
    assert total_energy(nodes, CORNERS, inverse, volume, MU, LAM) == pytest.approx(0, abs=1e-12)
    gradient, _ = derivatives(nodes, rest)
    assert np.abs(gradient).max() < 1e-9
