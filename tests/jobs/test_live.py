"""`habitus.live`: a stream becomes a fit; what is lost, leaves, returns or is relabelled is
survived and said.
"""

import time
from dataclasses import replace

import numpy as np
import pytest

import habitus as hb
from habitus.body.prior import shipped_prior
from habitus.errors import HabitusError
from habitus.fit.markers.settings import MoshSettings
from habitus.io.layouts.files import load_layout
from habitus.io.streams.source import Frame, Skipped, heading
from habitus.observe.simulated_markers import Faults, simulate_capture, smooth_motion

RATE = 30.0
FRAMES = 90
LAYOUT = load_layout("cmu-41")
M = len(LAYOUT)
LABELS = tuple(f"Bob:{label}" for label in LAYOUT.labels)
HEADING = heading("natnet", LABELS, RATE, "mm", None, "+y")


class Given:
    """A source whose frames are all there; patient."""

    name = "given"
    patient = True
    skipped = Skipped()

    def __init__(self, points, headings=None, numbers=None):
        numbers = range(len(points)) if numbers is None else numbers
        headings = [HEADING] * len(points) if headings is None else headings
        self.frames = [
            Frame(n, time.perf_counter(), p, h)
            for n, p, h in zip(numbers, points, headings, strict=True)
        ]
        self.ended = False

    def poll(self, timeout):
        frames = self.frames[:1]
        self.frames = self.frames[1:]
        self.ended = not self.frames
        return frames

    def close(self):
        self.ended = True


@pytest.fixture(scope="module")
def body():
    return hb.load_body("default")


@pytest.fixture(scope="module")
def truth(body):
    rng = np.random.default_rng(5)
    prior = shipped_prior().for_joints(body.joint_names)
    betas = np.clip(rng.normal(size=body.num_betas), -2, 2)
    pose, trans = smooth_motion(prior.mean, np.sqrt(np.diag(prior.covariance)), FRAMES, RATE, rng)
    places = LAYOUT.vertices(body), LAYOUT.distances()
    return simulate_capture(body, betas, pose, trans, *places, Faults(0.0, 0.001, 0.0), rng)


@pytest.fixture(scope="module")
def points(truth):
    return 1e3 * truth.observed  # mm, as the stream says


def run(points, body, *given, **options):
    said = []
    fit = hb.live(
        Given(points, *given), body=body, say=lambda text, mark: said.append(text), **options
    )
    return fit, " | ".join(said)


@pytest.fixture(scope="module")
def fit(points, body):
    """A hasty shape stage: these tests ask what goes where, not how well the body fits."""
    hasty = MoshSettings(annealing=(10.0,), frames=3)
    return run(points, body, seconds=1.0, settings=hasty)[0]


def test_a_stream_becomes_a_fit(fit, truth):
    assert (
        fit.num_frames == FRAMES
        and fit.rate_hz == RATE
        and fit.labels == LAYOUT.labels
        and fit.up_axis == "+y"
    )
    assert np.linalg.norm(fit.trans - truth.trans, axis=1).mean() < 0.05
    assert fit.errors_mm.mean() < 15 and fit.status == "causal"


def test_a_file_is_played_and_the_result_written(fit, truth, tmp_path, body):
    np.savez(
        tmp_path / "walk.npz",
        markers=truth.observed,
        labels=LABELS,
        rate_hz=RATE,
        unit="m",
        up_axis="+y",
    )
    again = hb.live("replay", tmp_path / "walk.npz", tmp_path / "out.npz", known=fit, fps=0)
    read = hb.load_fit(tmp_path / "out.npz")
    np.testing.assert_allclose(read.pose, again.pose)
    np.testing.assert_allclose(again.vertices(80), fit.vertices(80), atol=0.01)
    np.testing.assert_array_equal(again.betas, fit.betas)
    assert again.verdict.level == fit.verdict.level


def test_a_file_is_played_at_a_rate(fit, truth, tmp_path):
    np.savez(
        tmp_path / "walk.npz",
        markers=truth.observed,
        labels=LABELS,
        rate_hz=RATE,
        unit="m",
        up_axis="+y",
    )
    began = time.perf_counter()
    again = hb.live("replay", tmp_path / "walk.npz", known=fit, fps=300)
    assert time.perf_counter() - began > FRAMES / 300 and again.rate_hz == RATE


def test_who_leaves_and_returns_is_followed_again(fit, points, body):
    away = points.copy()
    away[30:55] = np.nan
    found, said = run(away, body, known=fit)
    assert "left at 1.5 s" in said and "seen again at 1.8 s" in said
    np.testing.assert_allclose(found.trans[60:], fit.trans[60:], atol=0.02)
    assert (
        np.isfinite(found.pose).all()
        and found.flagged_frames[30:55].all()
        and not found.flagged_frames[55:].any()
    )
    assert any("left at" in warning for warning in found.warnings)


def test_frames_that_are_lost_are_counted_and_keep_their_time(fit, points, body):
    kept = np.delete(np.arange(FRAMES), [*range(40, 52), 70])
    found, said = run(
        points[kept], body, None, 7 + 2 * kept, known=fit
    )  # every second number is another camera's
    assert "12 frames were lost at" in said and any(
        "13 frames lost on the way" in w for w in found.warnings
    )
    assert found.num_frames == FRAMES and found.rate_hz == RATE / 2
    np.testing.assert_allclose(found.trans[75:], fit.trans[75:], atol=0.02)


def test_a_marker_set_that_changes_is_found_by_its_labels(fit, points, body):
    order = np.random.default_rng(0).permutation(M)[:38]
    other = replace(HEADING, labels=(*(f"Ann:{LAYOUT.labels[k]}" for k in order), "Ann:NEW"))
    changed = [
        *points[:50],
        *(np.concatenate([each[order], np.ones((1, 3))]) for each in points[50:80]),
        *points[80:],
    ]
    found, said = run(changed, body, [HEADING] * 50 + [other] * 30 + [HEADING] * 10, known=fit)
    gone = sorted(set(range(M)) - set(order.tolist()))
    assert (
        "38 of 42 markers are left" in said and "Ann:NEW" in said and LAYOUT.labels[gone[0]] in said
    )
    np.testing.assert_allclose(found.trans[60:], fit.trans[60:], atol=0.02)
    assert (
        np.isnan(found.observed_markers[60:80, gone]).all()
        and found.errors_mm[60:80, order].mean() < 15
    )
    assert (
        "42 of 42 markers are left" in said and np.isfinite(found.observed_markers[80:, gone]).all()
    )


def test_what_ctrl_c_stops_is_kept(fit, points, body):
    class Stopped(Given):
        def poll(self, timeout):
            if len(self.frames) == 20:
                raise KeyboardInterrupt
            return super().poll(timeout)

    assert hb.live(Stopped(points), known=fit).num_frames == FRAMES - 20


def test_bad_input_is_told_in_one_line(fit, points, body, tmp_path):
    with pytest.raises(HabitusError, match="there is no source 'vicon'"):
        hb.live("vicon")
    with pytest.raises(HabitusError, match=r"ends in \.npz or \.glb"):
        hb.live("replay", "walk.c3d", "out.fbx")
    with pytest.raises(HabitusError, match="no capture was given"):
        hb.live("replay")
    with pytest.raises(HabitusError, match="labelled points"):
        run(np.full_like(points, np.nan), body, known=fit)
    strangers = replace(HEADING, labels=tuple(f"X{k}" for k in range(M)))
    with pytest.raises(HabitusError, match="saved subject's markers"):
        run(points, body, [strangers] * FRAMES, known=fit)
