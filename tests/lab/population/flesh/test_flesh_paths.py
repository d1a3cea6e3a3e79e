import numpy as np
import pytest
from bars import HingedBar, bent

from habitus_lab.population.flesh.assembly_kernels import determinants
from habitus_lab.population.flesh.newton import Inertia, Solver, newton_step
from habitus_lab.population.flesh.paths import Walk, carried, walk
from habitus_lab.population.flesh.skin import ContactRule, find_contacts


@pytest.fixture(scope="module")
def hinge():
    return HingedBar()


def volumes(flesh, nodes):
    found = np.empty(len(flesh.tets))
    determinants(nodes, flesh.tets, flesh.inverse, found)
    return found


def test_flesh_at_rest_stays(hinge):
    [stop] = walk(hinge.flesh, hinge, [bent(0)], Walk())
    np.testing.assert_allclose(stop.nodes, hinge.flesh.cage.nodes, atol=1e-9)
    assert stop.steps == 1


def test_bent_bar_keeps_its_volume_where_skinning_loses_it(hinge):
    flesh = hinge.flesh
    pose = bent(90)
    [stop] = walk(flesh, hinge, [pose], Walk())
    skinned = carried(hinge, flesh, flesh.cage.nodes, bent(0), pose)
    flat = volumes(flesh, skinned) @ flesh.volume
    full = volumes(flesh, stop.nodes) @ flesh.volume
    assert flat / flesh.volume.sum() < 0.97
    assert full / flesh.volume.sum() == pytest.approx(1, abs=0.01)
    assert volumes(flesh, stop.nodes).min() > 0
    errors = np.linalg.norm(flesh.bones(stop.nodes) - hinge.goal(pose).bones, axis=1)
    assert errors.max() < 0.015
    np.testing.assert_allclose(stop.nodes[flesh.free :], skinned[flesh.free :], atol=1e-9)


def test_relaxed_flesh_has_no_way_down(hinge):
    way = Walk(most=60, tolerance=1e-6, solver=Solver(tolerance=1e-3, gradients=300))
    [stop] = walk(hinge.flesh, hinge, [bent(40)], way)
    _, moved = newton_step(hinge.flesh, stop.nodes, hinge.goal(bent(40)), way.solver)
    assert moved < 1e-5


def gaps(flesh, nodes, **rule):
    met = find_contacts(flesh.skin, flesh.cage, flesh.free, nodes, ContactRule(**rule))
    return np.einsum("ka,kai,ki->k", met.coefficients, nodes[met.corners], met.normals)


def test_contact_is_found_where_parts_meet_and_pushes_them_apart(hinge):
    flesh = hinge.flesh
    pose = bent(150)
    assert len(gaps(flesh, flesh.cage.nodes)) == 0
    worst = []
    kept = []
    for stiffness in (0.0, 1.5):
        way = Walk(most=8, solver=Solver(contact=ContactRule(stiffness=stiffness)))
        [stop] = walk(flesh, hinge, [pose], way)
        worst.append(gaps(flesh, stop.nodes).min(initial=0.003))
        kept.append(gaps(flesh, stop.nodes, deep=0.005).min(initial=0.003))
    assert worst[0] < -0.01 < -0.005 < kept[0]
    assert worst[1] > -0.002


def test_inertia_keeps_a_free_flight_going(hinge):
    """Without bones' pull flesh moves on as it did; with damping towards the carried place it
    lags.
    """
    flesh = hinge.flesh
    nodes = flesh.cage.nodes
    drift = nodes + np.array([0, 1e-3, 0])
    weight = flesh.mass * 1e9
    on, _ = newton_step(
        flesh, nodes, hinge.goal(bent(0)), Solver(), Inertia(drift, weight, nodes, 0.0)
    )
    held, _ = newton_step(
        flesh, nodes, hinge.goal(bent(0)), Solver(), Inertia(drift, weight, nodes, 1e9)
    )
    middle = np.argsort(np.abs(nodes[: flesh.free, 0] - 0.3))[:10]
    assert (on - nodes)[middle, 1].mean() == pytest.approx(1e-3, rel=0.05)
    assert (held - nodes)[middle, 1].mean() < 5e-4
