"""Virtual markers ride on the skin as layouts say; captures are filled; files tell what they
are.
"""

from dataclasses import replace

import ezc3d
import numpy as np
import pytest
from real_fit import real_capture, real_fit
from synthetic_fit import synthetic_fit

from habitus.body.motion import BodyMotion
from habitus.cli.main import main
from habitus.errors import HabitusError
from habitus.io.captures.read import read_capture
from habitus.io.layouts.files import load_layout
from habitus.io.models.bodies import load_body
from habitus.jobs.virtual_markers import fill_capture, virtual_markers
from habitus.observe.markers import default_markers
from habitus.observe.simulated_markers import Faults
from habitus.rotations import matrix_from_rotvec


@pytest.fixture(scope="module")
def motion() -> BodyMotion:
    body = load_body("default")
    rng = np.random.default_rng(0)
    pose = np.zeros((3, body.num_joints, 3))
    trans = rng.normal(size=(3, 3))
    pose[1:, 0], pose[2, 4] = [0.3, -1.2, 0.4], [1.0, 0, 0]
    soft = np.zeros((3, body.num_betas))
    soft[2] = 0.3
    return BodyMotion(
        body, rng.normal(size=body.num_betas), pose, trans, 50.0, "+y", soft, body_name="default"
    )


def test_markers_are_the_layouts_on_this_person_and_ride_along(motion):
    found = virtual_markers(motion, "cmu-41")
    layout = load_layout("cmu-41")
    layout = layout.restricted_to(
        tuple(marker.label for marker in layout.markers if not marker.optional)
    )
    rest = default_markers(
        motion.body, motion.betas, layout.vertices(motion.body), layout.distances()
    )
    assert found.labels == layout.labels and found.rate_hz == 50.0 and found.up_axis == "+y"
    np.testing.assert_allclose(found.markers[0], rest + motion.trans[0], atol=1e-9)
    root = motion.body.rest_joints(motion.betas)[0]
    turned = (rest - root) @ matrix_from_rotvec(motion.pose[1, 0]).T + root + motion.trans[1]
    np.testing.assert_allclose(found.markers[1], turned, atol=1e-9)
    moved = virtual_markers(replace(motion, soft_tissue=None), "cmu-41").markers - found.markers
    assert (
        not moved[:2].any() and np.linalg.norm(moved[2], axis=1).min() > 0
    )  # soft tissue carries them


def test_optional_markers_are_left_out_and_faults_are_as_told(motion):
    clean = virtual_markers(motion, "mosh-67")
    assert len(clean.labels) == 67
    noisy = (
        virtual_markers(motion, "mosh-67", faults=Faults(0.0, 0.002, 0.0), seed=1).markers
        - clean.markers
    )
    assert 0.0017 < noisy.std() < 0.0023
    placed = virtual_markers(motion, "mosh-67", faults=Faults(0.01, 0.0, 0.2, 1), seed=1).markers
    assert 0.05 < np.isnan(placed[..., 0]).mean() < 0.3
    assert 0.005 < np.nanmean(np.linalg.norm(placed - clean.markers, axis=2)) < 0.02


def test_a_fits_own_markers_are_those_it_predicts(tmp_path):
    fit = synthetic_fit(20)
    found = virtual_markers(fit, out=tmp_path / "own.c3d")
    np.testing.assert_allclose(found.markers, fit.predicted_soft_tissue, atol=1e-9)
    file = ezc3d.c3d(str(tmp_path / "own.c3d"))
    np.testing.assert_allclose(file["data"]["points"][:3].T, 1e3 * found.markers, atol=1e-3)
    assert "virtual marker" in file["parameters"]["POINT"]["DESCRIPTIONS"]["value"][0]
    assert not file["data"]["meta_points"]["residuals"].any()
    with pytest.raises(HabitusError, match="name a layout"):
        virtual_markers(BodyMotion.of(fit))
    with pytest.raises(HabitusError, match=r"\.c3d, \.trc"):
        virtual_markers(fit, out=tmp_path / "own.csv")


@pytest.fixture
def real(shared, tmp_path_factory):
    return real_fit(shared, tmp_path_factory.getbasetemp())


def test_a_real_capture_is_filled_near_the_truth(real, shared, tmp_path, capsys):
    fit, path = real
    fit.export(tmp_path / "body.npz")
    main(
        [
            "markers",
            str(tmp_path / "body.npz"),
            "--fill",
            str(path),
            "--out",
            str(tmp_path / "full.c3d"),
        ]
    )
    assert "28 samples filled" in capsys.readouterr().out
    truth = real_capture(shared)
    full = read_capture(tmp_path / "full.c3d")
    assert full.labels == truth.labels and np.isfinite(full.markers).all()
    gaps = ((5, slice(10, 22)), (20, slice(0, 6)), (32, slice(30, 40)))
    off = np.concatenate(
        [np.linalg.norm(full.markers[g, m] - truth.markers[g, m], axis=1) for m, g in gaps]
    )
    assert 1e3 * off.mean() < 12
    table = (tmp_path / "full.c3d.filled.csv").read_text().splitlines()
    assert [line.split(",")[:4] for line in table[1:]] == [
        [fit.labels[5], "11", "22", "yes"],
        [fit.labels[20], "1", "6", "yes"],
        [fit.labels[32], "31", "40", "yes"],
    ]
    text = fill_capture(fit, path, tmp_path / "full.trc").capture
    assert (
        np.isfinite(text.markers).all()
        and np.isfinite(read_capture(tmp_path / "full.trc").markers).all()
    )


def test_another_capture_is_refused(real, shared, tmp_path):
    fit, path = real
    with pytest.raises(HabitusError, match="is not the capture that was fitted"):
        fill_capture(fit, shared / "mocap" / "85_12.c3d", tmp_path / "no.c3d")
    with pytest.raises(HabitusError, match="is the capture itself"):
        fill_capture(fit, path, path)
    (tmp_path / "loop.c3d").symlink_to("loop.c3d")
    with pytest.raises(HabitusError, match=r"loop\.c3d"):
        fill_capture(fit, tmp_path / "loop.c3d", path)
    assert not (tmp_path / "no.c3d").exists()
