"""The numbers that a verdict weighs are those of the fit: each is planted in a fit and found
again.
"""

from dataclasses import replace

import numpy as np
import planted as p
import pytest

from habitus.fit.markers.evidence import evidence
from habitus.fit.markers.result import MarkerFit

HASTY = p.settings(annealing=(10.0,), frames=2, soft_tissue=False)


@pytest.fixture(scope="module")
def fit() -> MarkerFit:
    """Any fit; its markers are made to lie where the body has them."""
    found = p.fit(p.plant(frames=12), which=HASTY)
    return replace(found, observed_markers=np.array(found.predicted_pose_stage))


def still(fit: MarkerFit, frames: int, angles=None) -> MarkerFit:
    """The body at rest for some frames, or with rotation vectors by joint, markers where they
    belong.
    """
    pose = np.zeros((frames, fit.pose.shape[1], 3))
    for name, turn in (angles or {}).items():
        pose[:, fit.body.joint_names.index(name)] = turn
    markers = np.repeat(fit.latent_markers[None], frames, axis=0)
    return replace(
        fit,
        pose=pose,
        trans=np.zeros((frames, 3)),
        pose_stage=(pose, np.zeros((frames, 3))),
        observed_markers=markers,
        predicted_pose_stage=markers,
        marker_weights=np.ones(markers.shape[:2]),
        flagged_frames=np.zeros(frames, dtype=bool),
    )


def test_errors_and_trust(fit):
    rng = np.random.default_rng(0)
    length = rng.uniform(0.0, 0.03, size=fit.marker_weights.shape)
    way = rng.normal(size=(*length.shape, 3))
    way *= (length / np.linalg.norm(way, axis=2))[..., None]
    observed = fit.observed_markers + way
    weights = rng.uniform(size=length.shape)
    observed[:3, 5], length[:3, 5] = np.nan, np.nan
    found = evidence(replace(fit, observed_markers=observed, marker_weights=weights))
    assert found.mean_mm == pytest.approx(1e3 * np.nanmean(length))
    assert found.p95_mm == pytest.approx(1e3 * np.nanpercentile(length, 95))
    assert found.distrusted == pytest.approx((weights[np.isfinite(length)] < 0.5).mean())
    nothing = evidence(replace(fit, observed_markers=np.full_like(observed, np.nan)))
    assert nothing.mean_mm is nothing.p95_mm is None and nothing.distrusted == nothing.size == 0.0
    assert nothing.torn == nothing.torn_level == 0.0


def test_shape_labels_and_frames(fit):
    flagged = np.arange(12) < 3
    gap = np.where((np.arange(12) > 4) & (np.arange(12) < 10), np.nan, 1.0)[:, None, None]
    changed = replace(
        fit, betas=np.array([0.0, -3.0, 0.4, 0.0]), flagged_frames=flagged, left_out=("A",)
    )
    found = evidence(
        replace(changed, observed_markers=fit.observed_markers * gap, displaced=np.arange(42.0))
    )
    assert found.beta_sd == 3.0 and found.betas_rms == pytest.approx(np.sqrt(9.16 / 4))
    assert (found.no_data, found.gap_s, found.displaced) == (0.25, 5 / fit.rate_hz, 20.5)
    assert (found.markers, found.left_out, found.rate_hz) == (42, ("A",), fit.rate_hz)
    assert evidence(replace(fit, betas=np.array([0.3, 0.1, 0.0, 0.0]))).beta_sd == 0.3


@pytest.mark.parametrize("frames", [1, 2, 3, 4, 900])
def test_how_fast_markers_move_against_their_middle(fit, frames):
    """All go with the body at 1 m/s; half of them go 2 m/s to either side as well, faster in the
    last step.
    """
    steps = np.full(frames, 2.0) if frames > 3 else np.array([0.0, 2.0, 4.0])[:frames]
    side = np.where(np.arange(len(fit.labels)) % 2, 1.0, -1.0)
    way = np.cumsum(steps)[:, None, None] * side[:, None] * (0.0, 0.0, 1.0)
    body = np.arange(frames)[:, None] * np.array([1.0, 0.0, 0.0])
    here = still(fit, frames)
    predicted = way + body[:, None]
    found = evidence(
        replace(here, predicted_pose_stage=predicted / fit.rate_hz, trans=body / fit.rate_hz)
    )
    assert found.motion == pytest.approx({1: 0.0, 2: 2.0, 3: 3.0}.get(frames, 2.0), rel=1e-6)
    assert found.speed == pytest.approx(1.0 if frames > 1 else 0.0)


@pytest.mark.parametrize("degrees", [0.0, 25.0, 90.0, 160.0])
@pytest.mark.parametrize("up", ["+y", "-y"])
def test_a_straight_body_leans_as_far_as_it_is_turned(fit, degrees, up):
    found = evidence(
        replace(still(fit, 3, {"pelvis": (np.radians(degrees), 0.0, 0.0)}), up_axis=up)
    )
    expected = evidence(still(fit, 3)).tilt_deg  # ankles and neck are not quite above each other
    assert found.standing and expected < 6.0
    assert found.tilt_deg == pytest.approx(
        degrees if up == "+y" else 180.0 - degrees, abs=expected + 0.1
    )


def test_only_straight_bodies_tell_of_the_floor_where_there_are_some(fit):
    """Eight frames sit and lean back, four stand."""
    sits = {"pelvis": (-0.9, 0.0, 0.0), "left_hip": (-1.5, 0.0, 0.0), "right_hip": (-1.5, 0.0, 0.0)}
    sits |= {"left_knee": (1.5, 0.0, 0.0), "right_knee": (1.5, 0.0, 0.0)}
    bent = still(fit, 12, sits)
    upright = still(fit, 12)
    assert not evidence(bent).standing and evidence(bent).tilt_deg > 15.0
    mixed = replace(
        bent, pose=np.where((np.arange(12) % 3 == 0)[:, None, None], upright.pose, bent.pose)
    )
    assert evidence(mixed).standing and evidence(mixed).tilt_deg == pytest.approx(
        evidence(upright).tilt_deg
    )


@pytest.mark.parametrize("factor", [0.3, 1.0, 7.0])
def test_the_size_is_that_of_the_markers_against_the_bodys(fit, factor):
    found = evidence(replace(fit, observed_markers=factor * fit.observed_markers))
    assert found.size == pytest.approx(factor)


def torn(fit, first: str, second: str, away, every=slice(None)) -> tuple[float, float]:
    """Two markers alone, the second moved away, in metres along the way from the first."""
    here = still(fit, 60)
    one = fit.labels.index(first)
    two = fit.labels.index(second)
    markers = np.full_like(here.observed_markers, np.nan)
    markers[:, [one, two]] = fit.latent_markers[[one, two]]
    way = fit.latent_markers[two] - fit.latent_markers[one]
    markers[every, two] += away if np.ndim(away) else away * way / np.linalg.norm(way)
    found = evidence(replace(here, observed_markers=markers))
    return found.torn, found.torn_level


def test_what_belongs_close_together_is_torn_where_it_is_far_apart(fit):
    assert [torn(fit, "LWRA", "LWRB", away)[0] for away in (0.0, 0.38, 0.42, 3.0)] == [
        0.0,
        0.0,
        1.0,
        1.0,
    ]
    assert torn(fit, "LFHD", "RBHD", 0.5)[0] == 1.0  # on one part, 20 cm apart
    assert torn(fit, "LKNE", "RFHD", 3.0)[0] == 0.0  # nothing that belongs together
    assert torn(fit, "LWRA", "LWRB", 3.0, slice(0, 27))[0] == 0.0  # for less than half of the time
    assert torn(fit, "LWRA", "LWRB", 3.0, slice(0, 33))[0] == 1.0


def test_two_people_stand_beside_each_other_and_labels_lie_anywhere(fit):
    assert torn(fit, "LFHD", "RFHD", (2.0, 0.2, 0.0)) == (1.0, 1.0)
    assert torn(fit, "LFHD", "RFHD", (2.0, 0.45, 0.0)) == (1.0, 0.0)
    assert evidence(still(fit, 3)).torn == evidence(still(fit, 3)).torn_level == 0.0
