"""Starts: keypoints lead to a pose that no arms and turns would find; height is read off the
mask.
"""

from dataclasses import replace

import numpy as np
import pytest
import torch
from rgbd_scene_small import QUICK_DEPTH, small_scene
from scipy.spatial import KDTree

from habitus.fit.points.depth import _best_facing
from habitus.fit.points.depth_energy import DepthEnergy, look, misfit
from habitus.fit.points.depth_settings import FOLDED
from habitus.fit.points.depth_start import (
    Tried,
    arm_poses,
    find_start,
    planar_term,
    pose_of_keypoints,
    scaled_to_height,
    seen_joints,
)
from habitus.fit.points.prepared_views import PreparedView, segment
from habitus.fit.points.skin_offsets import SkinField
from habitus.render.triangles import Triangles
from habitus.rotations import matrix_from_rotvec
from habitus.solve.least_squares import Levenberg
from habitus.solve.minimize import Stage, alternate


@pytest.fixture(scope="module")
def seen():
    """The body, a sight with the keypoints of the planted person, and the planted surface in its
    world.
    """
    body, scene = small_scene()
    view = scene.capture.views[1]
    sight = PreparedView.of(view, segment(view))
    surface = scene.surfaces[1] @ sight.turn.T + sight.shift
    joints = (
        body.joint_regressor @ scene.rest
    )  # only to see that they differ from where they are posed
    names = [
        f"{s}_{j}"
        for s in ("left", "right")
        for j in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")
    ]
    part = body.skinning_weights
    points = []
    for name in names:
        k = body.joint_names.index(name)
        near = np.minimum(part[:, k], part[:, body.parents[k]])
        points.append((near[:, None] * surface).sum(0) / near.sum())
    assert len(joints) == body.num_joints
    pixels = sight.colour_camera.project(torch.tensor(np.array(points)))[0].numpy()
    keypoints = {
        name: (float(u), float(v), 0.9) for name, (u, v) in zip(names, pixels, strict=True)
    }
    return body, replace(sight, view=replace(view, keypoints=keypoints)), surface, np.array(points)


def test_keypoints_become_joints_behind_the_skin(seen):
    body, sight, _, points = seen
    joints, found = seen_joints(body, sight)
    assert len(joints) >= 9
    order = [
        f"{s}_{j}"
        for s in ("left", "right")
        for j in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")
    ]
    true = np.array([points[order.index(body.joint_names[k])] for k in joints])
    assert np.median(np.linalg.norm(found - true, axis=1)) < 0.05


def test_keypoints_lead_near_the_person(seen):
    body, sight, surface, _ = seen
    pose, trans = pose_of_keypoints(body, sight, np.zeros(body.num_betas))
    assert np.linalg.norm(body((), pose, trans).vertices - surface, axis=1).mean() < 0.12
    assert (
        pose_of_keypoints(
            body, replace(sight, view=replace(sight.view, keypoints={})), np.zeros(24)
        )
        is None
    )


def test_height_is_read_off_the_mask(seen):
    body, sight, surface, _ = seen
    betas = scaled_to_height(body, [sight])
    assert abs(np.ptp(body.rest_vertices(betas)[:, 1]) - np.ptp(surface[:, 1])) < 0.08


@pytest.mark.parametrize("stretch", [1.0, 1.2])
def test_who_reaches_beyond_the_image_is_at_least_as_tall_as_what_is_seen(seen, stretch):
    """Someone 2.04 m tall who filled the image began as someone of 1.69 m, and ended 18 cm above
    the floor.
    """
    body, sight, _, _ = seen
    points = sight.points * [1.0, stretch, 1.0]
    rows = np.flatnonzero(sight.mask.any(1))
    part = slice(rows[0], rows[-1] + 1)
    behind, mask = sight.behind[part], sight.mask[part]
    cut = replace(sight, points=points[part], mask=mask, behind=behind)
    assert cut.cut_off and not sight.cut_off
    mean = np.ptp(body.rest_vertices(body.people_mean)[:, 1])
    height = np.percentile(cut.points[cut.mask][:, 1], 99.7)
    found = np.ptp(body.rest_vertices(scaled_to_height(body, [cut]))[:, 1])
    assert found == pytest.approx(max(mean, height), abs=0.06)


def test_the_true_surface_misfits_least(seen):
    body, sight, surface, _ = seen
    grid = sight.grid(2)
    triangles = Triangles.of(body.faces, num_vertices=body.num_vertices)
    true, aside = (
        misfit(grid, look(grid, surface + np.array([x, 0.0, 0.0]), triangles)) for x in (0.0, 0.15)
    )
    assert true < 0.02 and aside > 2.5 * true
    assert misfit(grid, look(grid, surface + np.array([9.0, 0.0, 0.0]), triangles)) == 0.3


def test_a_grids_pixels_are_the_images(seen):
    _, sight, _, _ = seen
    grid = sight.grid(3)
    inside = grid.points[grid.person]
    pixels = grid.camera.project(torch.from_numpy(inside))[0].numpy()
    rows, columns = np.nonzero(grid.person)
    np.testing.assert_allclose(pixels, np.stack([columns + 0.5, rows + 0.5], 1), atol=1e-3)


def test_folded_forearms_lie_before_the_belly(seen):
    body = seen[0]
    (pose,) = arm_poses(body, (FOLDED,))
    joints = body((), pose).joints
    wrists = joints[[body.joint_names.index(f"{side}_wrist") for side in ("left", "right")]]
    belly = joints[0]
    assert (wrists[:, 2] > belly[2] + 0.1).all() and (np.abs(wrists[:, 0] - belly[0]) < 0.2).all()
    assert (wrists[:, 1] > belly[1]).all() and np.allclose(
        wrists[0] * [-1, 1, 1], wrists[1], atol=0.02
    )


def test_the_planar_term_is_least_where_the_surface_was_observed(seen):
    """Its cost falls along its gradient, and a solve leads from a turned and moved surface back."""
    body, sight, surface, _ = seen
    grid = sight.grid(4)
    triangles = Triangles.of(body.faces, num_vertices=body.num_vertices)
    observed = grid.points[grid.person]
    centre = surface.mean(0)

    def terms_at(values, stage, step):
        turn = matrix_from_rotvec(np.array([0.0, values["yaw"][0], 0.0]))
        placed = (surface - centre) @ turn.T + values["place"]
        drawn = look(grid, placed, triangles)
        return {"depth": planar_term(drawn, observed, KDTree(observed), **values)}

    start = {"yaw": np.array([0.2]), "place": centre + np.array([0.05, 0.0, 0.05])}
    term = terms_at(start, None, 0)["depth"]
    here = term(start)
    gradient, _ = here.quadratic.derivatives()
    step = {name: value - 1e-9 * gradient[name] for name, value in start.items()}
    slope = sum((each**2).sum() for each in gradient.values())
    assert here.cost - term(step).cost == pytest.approx(1e-9 * slope, rel=1e-2)
    found = alternate(terms_at, start, [Stage(12)], steps=Levenberg(1e-6))
    assert abs(found.values["yaw"][0]) < 0.03
    assert np.abs(found.values["place"] - centre).max() < 0.01


def test_a_view_that_begins_facing_the_wrong_way_is_turned_by_the_cost_of_its_fit():
    """Of five people who walk away from a depth camera two had begun facing it."""
    body, scene = small_scene()
    search = replace(QUICK_DEPTH.search, turns=(0.0, 180.0), rival_misfit=np.inf)
    settings = replace(QUICK_DEPTH, search=search, skin_places=60)
    view = scene.capture.views[0].in_camera_frame()
    energy = DepthEnergy.of(body, [PreparedView.of(view, segment(view))], settings)
    right = find_start(energy, (None,))
    (other,) = right.opposite
    own = Tried(right.state, right.means[0], right.misfits[0])
    wrong = replace(right.with_view(0, other), opposite=(own,))
    facing = [matrix_from_rotvec(each.state.pose[0, 0])[2, 2] for each in (right, wrong)]
    assert facing[0] > 0.8 and facing[1] < -0.8
    field = SkinField.of(body, settings)
    for start in (right, wrong):
        _, chosen = _best_facing("", energy, field, start)
        np.testing.assert_array_equal(chosen.state.pose, right.state.pose)
