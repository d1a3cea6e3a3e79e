"""Planted people come back through the whole recipe: shape, marker placement, pose, place and
change of shape.
"""

import numpy as np
import pytest
from planted import (
    NOISE,
    RATE_HZ,
    Planted,
    attach,
    carried,
    degrees_apart,
    fit,
    place_by_hand,
    plant,
    rest,
    settings,
    surface,
)
from scipy.spatial.transform import Rotation

PLACEMENT = 5e-3  # metres, sd along each axis
TRUSTING = {
    "shape": {"betas": 1e-2, "pose": 1e-3},
    "pose": {"pose": 1e-2, "acceleration": 0.1},
}  # data before priors
QUICK = settings(annealing=(10.0, 1.0), soft_tissue=False)
MEAN_NOISE = 1.6 * NOISE  # mean length of a vector of three coordinates with sd 1: sqrt(8 / pi)


def left_open(planted: Planted, frames: np.ndarray) -> np.ndarray:
    """(F, J, 3, 3) covariance (rad^2) of each joint's rotation vector in some frames that the noise
    of the markers leaves, the body known and each marker placed within PLACEMENT; by differences.

    Markers that are off their places alike in all frames leave a twist of a round limb open that
    noise does not: the whole arm turned about itself, and its markers slid around it.
    """
    step = 1e-4
    joints = planted.body.num_joints
    faces = np.asarray(planted.body.faces)
    size = planted.latent_markers.size
    shifts = step * np.eye(3)
    by_place = np.zeros((len(frames), size, size))
    for axis, shift in enumerate(shifts):
        ends = [
            carried(
                attach(planted.latent_markers + sign * shift, rest(planted.betas), faces),
                planted.betas,
                planted.pose[frames],
                planted.trans[frames],
            )
            for sign in (1, -1)
        ]
        slope = (ends[0] - ends[1]) / (2 * step)
        for k in range(size // 3):
            by_place[:, 3 * k : 3 * k + 3, 3 * k + axis] = slope[:, k]
    attachment = attach(planted.latent_markers, rest(planted.betas), faces)
    known = np.eye(size) / PLACEMENT**2
    parts = []
    for frame, places in zip(frames, by_place / NOISE, strict=True):
        state = np.concatenate([planted.trans[frame], planted.pose[frame].ravel()])
        both = np.concatenate(
            [state + step * np.eye(len(state)), state - step * np.eye(len(state))]
        )
        markers = carried(
            attachment, planted.betas, both[:, 3:].reshape(-1, joints, 3), both[:, :3]
        )
        slope = (markers[: len(state)] - markers[len(state) :]) / (2 * step * NOISE)
        table = slope.reshape(len(state), -1)
        covariance = np.linalg.inv(table @ table.T + 1e-3 * np.eye(len(state)))
        coupling = table @ places
        known += places.T @ places - coupling.T @ covariance @ coupling
        parts.append((covariance, covariance @ coupling))
    placed = np.linalg.inv(known)
    full = [covariance + gain @ placed @ gain.T for covariance, gain in parts]
    return np.array([[c[k : k + 3, k : k + 3] for k in range(3, len(c), 3)] for c in full])


@pytest.fixture(scope="module")
def exact():
    """Every marker where the layout says, 67 of them."""
    return plant(layout="mosh-67")


@pytest.fixture(scope="module")
def recovered(exact):
    return fit(exact, which=settings(**TRUSTING, soft_tissue=False))


def test_betas_and_rest_shape(exact, recovered):
    assert np.abs(recovered.betas - exact.betas).max() < 0.15
    apart = np.linalg.norm(rest(recovered.betas) - rest(exact.betas), axis=1)
    assert apart.mean() < 4 * NOISE


def test_pose_of_each_joint_that_markers_determine(exact, recovered):
    """In the directions that noise and placement leave open by less than 1.5 degrees; about its own
    axis an elbow is open by 3.
    """
    frames = np.arange(0, 60, 5)
    variances, directions = np.linalg.eigh(left_open(exact, frames))
    known = np.degrees(np.sqrt(variances)) < 1.5
    assert known.any(axis=(0, 2)).sum() >= 18 and known.mean(axis=0).sum() >= 36
    off = np.degrees(recovered.pose[frames] - exact.pose[frames])
    along = np.where(known, np.einsum("fjik,fji->fjk", directions, off), 0.0)
    apart = np.median(np.linalg.norm(along, axis=2), axis=0)[known.any(axis=(0, 2))]
    assert apart.max() < 4.5 and apart.mean() < 1.5


def test_the_body_stands_where_it_stood(exact, recovered):
    true = surface(exact.betas, exact.pose, exact.trans)
    ours = surface(recovered.betas, recovered.pose, recovered.trans)
    assert np.linalg.norm(true - ours, axis=2).mean() < 4 * NOISE
    np.testing.assert_allclose(
        recovered.trans.mean(axis=0), exact.trans.mean(axis=0), atol=6 * NOISE
    )


def test_predicted_markers_are_those_of_the_body_that_is_returned(recovered):
    """Errors are told against the state that comes with them, by a second spelling of the marker
    function.
    """
    for stage, predicted in ((recovered.pose_stage, recovered.predicted_pose_stage),):
        np.testing.assert_allclose(
            carried(recovered.attachment, recovered.betas, *stage), predicted, atol=1e-9
        )
    distance = np.linalg.norm(recovered.observed_markers - recovered.predicted_pose_stage, axis=2)
    np.testing.assert_allclose(recovered.errors("pose"), distance)
    assert distance.mean() < 2 * MEAN_NOISE
    assert recovered.errors("soft_tissue") is None and recovered.soft_tissue is None
    still = recovered.pose[:1] * 0.0
    at_rest = carried(recovered.attachment, recovered.betas, still, np.zeros((1, 3)))[0]
    np.testing.assert_allclose(at_rest, recovered.latent_markers, atol=1e-9)


def test_markers_put_on_by_hand_are_found_on_the_skin():
    truth = plant(layout="mosh-67", placement=PLACEMENT)
    found = fit(truth, which=settings(**TRUSTING, soft_tissue=False))
    layout_says = np.linalg.norm(
        place_by_hand(truth.betas, truth.layout) - truth.latent_markers, axis=1
    ).mean()
    left = np.linalg.norm(found.latent_markers - truth.latent_markers, axis=1).mean()
    assert layout_says > PLACEMENT
    assert left < 0.5 * layout_says
    assert np.abs(found.betas - truth.betas).max() < 0.25


def test_a_change_of_shape_in_time_is_found_where_the_pose_stage_cannot_follow():
    seconds = np.arange(60) / RATE_HZ
    change = np.zeros((60, 4))
    change[:, :2] = 0.8 * np.stack([np.sin(4.4 * seconds), np.cos(3.1 * seconds)], axis=1)
    change -= change.mean(axis=0)
    truth = plant(soft_tissue=change)
    found = fit(truth, which=settings(annealing=(10.0, 1.0)))
    stiff = np.nanmean(found.errors("pose"))
    soft = np.nanmean(found.errors("soft_tissue"))
    assert soft < 0.6 * stiff
    for k in (0, 1):
        assert np.corrcoef(found.soft_tissue[:, k], change[:, k])[0, 1] > 0.95
        assert 0.7 < np.std(found.soft_tissue[:, k]) / np.std(change[:, k]) < 1.3
    predicted = carried(found.attachment, found.betas + found.soft_tissue, found.pose, found.trans)
    np.testing.assert_allclose(predicted, found.predicted_soft_tissue, atol=1e-9)
    steady = fit(plant(), which=settings(annealing=(10.0, 1.0)))
    assert np.abs(steady.soft_tissue).max() < 0.5 * np.abs(found.soft_tissue).max()


@pytest.fixture(scope="module")
def upright():
    truth = plant(frames=20)
    return truth, fit(truth, which=QUICK)


@pytest.mark.parametrize("turn", [(np.pi / 2, 0, 0), (0, 2.5, 0), (1.2, -1.2, 1.2)])
def test_axes_of_the_room_do_not_matter(upright, turn):
    """A capture with z up, or of people who lie, gives the same shape, the same joints and a turned
    root.
    """
    truth, one = upright
    rotation = Rotation.from_rotvec(turn)
    moved = rotation.apply(truth.observed.reshape(-1, 3)).reshape(truth.observed.shape) + np.array(
        [3.0, -2.0, 1.0]
    )
    two = fit(truth, moved, QUICK)
    np.testing.assert_allclose(two.betas, one.betas, atol=0.02)
    assert degrees_apart(two.pose[:, 1:], one.pose[:, 1:]).mean() < 0.4
    turned = (rotation * Rotation.from_rotvec(one.pose[:, 0])).as_rotvec()
    assert degrees_apart(two.pose[:, 0], turned).max() < 0.5
    assert abs(np.mean(two.errors("pose")) - np.mean(one.errors("pose"))) < NOISE
