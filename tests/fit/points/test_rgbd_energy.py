"""The energy of the depth stages: its terms' gradients are what small steps show, steps lead downhill
to what is planted, and none raises the cost.
"""

from dataclasses import replace

import numpy as np
from rgbd_scene_small import small_scene
from synthetic import synthetic_body

from habitus.body.state import BodyState
from habitus.fit.points.correspondences import points_around
from habitus.fit.points.depth_energy import BLOCKS, DepthEnergy, freed, look, match
from habitus.fit.points.depth_settings import DepthStage, RgbdSettings
from habitus.fit.points.prepared_views import PreparedView, segment
from habitus.residuals.points import PointObservations, points_on_surface
from habitus.solve.least_squares import Levenberg
from habitus.solve.minimize import Minimized, alternate

LOOSE = RgbdSettings(shape=1e-9, pose=1e-9)


def scene(settings=LOOSE, views=2, count=400):
    """A planted state, points on its surfaces as targets, and a state beside it."""
    body = synthetic_body("smpl", 120)
    rng = np.random.default_rng(2)
    shape = (views, body.num_joints, 3)
    truth = BodyState(
        0.5 * rng.normal(size=body.num_betas),
        0.1 * rng.normal(size=shape),
        rng.normal(size=(views, 3)),
    )
    face = rng.integers(0, body.num_faces, count)
    share = rng.dirichlet((1, 1, 1), count)
    frames = []
    for k in range(views):
        vertices = body(truth.betas, truth.pose[k], truth.trans[k]).vertices
        target = points_on_surface(vertices, body.faces, face, share)
        normal = np.tile([0.0, 0.0, 1.0], (count, 1))
        frames.append(PointObservations.to_planes(face, share, target, normal, np.ones(count), 1.0))
    start = BodyState(
        np.zeros(body.num_betas), truth.pose + 0.05 * rng.normal(size=shape), truth.trans + 0.1
    )
    return DepthEnergy.of(body, [], settings), truth, start, frames


def steps(energy, truth, start, frames, moves="all", count=1) -> Minimized:
    priors = energy.priors(truth.pose)

    def terms_at(values, stage, step):
        return {"depth": points_around(energy.solver, BodyState(**values), frames), **priors}

    stage = DepthStage(count, moves=moves, matching="pixel", stride=1, scales=(1.0, 1.0))
    stages = [freed(stage, energy.body, energy.settings)]
    return alternate(terms_at, start, stages, steps=Levenberg(1e-6), blocks=BLOCKS)


def test_steps_lead_to_the_planted_state_and_none_raises_the_cost():
    energy, truth, start, frames = scene()
    found = steps(energy, truth, start, frames, count=8)
    costs = np.array(found.history)
    assert costs[-1] < 1e-8 * costs[0] and (np.diff(costs) <= 0.0).all()
    for k in range(2):
        surfaces = [energy.surfaces(state)[k] for state in (found.state, truth)]
        np.testing.assert_allclose(*surfaces, atol=1e-4)


def test_only_what_moves_moves():
    energy, truth, start, frames = scene(RgbdSettings())
    placed = steps(energy, truth, start, frames, "place").state
    assert np.array_equal(placed.betas, start.betas)
    assert np.array_equal(placed.pose[:, 1:], start.pose[:, 1:])
    assert not np.allclose(placed.trans, start.trans)
    assert not np.allclose(placed.pose[:, 0], start.pose[:, 0])
    posed = steps(energy, truth, start, frames, "pose").state
    assert np.array_equal(posed.betas, start.betas)
    assert not np.allclose(posed.pose[:, 1:], start.pose[:, 1:])


def test_a_step_is_never_longer_than_its_limits():
    energy, truth, start, frames = scene(RgbdSettings())
    far = BodyState(start.betas, start.pose, start.trans + 10.0)
    moved = steps(energy, truth, far, frames).state
    assert np.abs(moved.trans - far.trans).max() <= energy.settings.max_step["trans"] + 1e-12


def test_a_cost_for_each_term_adds_up():
    energy, truth, start, frames = scene(RgbdSettings())
    found = steps(energy, truth, start, frames)
    assert set(found.costs) == {"depth", "shape", "pose"}
    np.testing.assert_allclose(sum(found.costs.values()), found.cost)


def test_the_scale_of_depth_follows_a_view_that_is_noisier_and_factors_act_on_weights():
    body, scene = small_scene()
    (view, _) = scene.capture.views
    prepared = PreparedView.of(view, segment(view))
    energy = DepthEnergy.of(body, [prepared], RgbdSettings())
    (grid,) = energy.grids(2)
    surface = scene.surfaces[0] @ prepared.turn.T + prepared.shift + np.array([0.03, 0.0, 0.01])
    drawn = look(grid, surface, energy.triangles)
    stage = DepthStage(1, moves="all", matching="pixel", stride=2, scales=(0.01, 0.01))

    def matched(scale, ratio, factor=None):
        here = replace(stage, scale_ratio=ratio)
        return match(grid, drawn, here, scale, 0.001, energy.settings, factor)

    def weights(matching, name):
        return (matching.matches[name].directions ** 2).sum((1, 2))

    median = float(np.median(matched(1.0, 0.0).distance))
    for scale, ratio, expected in ((1e-4, 3.0, 3.0 * median), (0.2, 3.0, 0.2)):
        np.testing.assert_allclose(
            weights(matched(scale, ratio), "depth"), weights(matched(expected, 0.0), "depth")
        )
    half = matched(0.01, 0.0, np.full(len(drawn.face), 0.5))
    for name in ("depth", "outline"):
        whole = weights(matched(0.01, 0.0), name)
        assert len(whole)
        np.testing.assert_allclose(weights(half, name), 0.5 * whole)
