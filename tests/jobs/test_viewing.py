"""`habitus view`: a page with a body under sliders, a motion and a mesh; what it cannot show it
says in one line.
"""

import urllib.request
from pathlib import Path

import numpy as np
import pytest
from synthetic_fit import synthetic_fit

import habitus
from habitus.errors import HabitusError
from habitus.io.models.bodies import save_body
from habitus.jobs.results import Motion
from habitus.jobs.viewing import view


@pytest.fixture(scope="module")
def shown(tmp_path_factory):
    pytest.importorskip("viser")
    folder: Path = tmp_path_factory.mktemp("view")
    body = habitus.load_body("default")
    pose = np.zeros((9, body.num_joints, 3))
    pose[:, 0, 2] = np.linspace(0.0, 0.4, 9)
    trans = np.linspace([1.0, 2.0, 0.0], [1.5, 2.0, 0.0], 9)
    motion = Motion(
        body,
        np.zeros(body.num_betas),
        pose,
        trans,
        rate_hz=30.0,
        up_axis="+z",
        capture_name="turn",
        body_name="default",
    )
    motion.export(folder / "turn.npz")
    body().export(folder / "rest.ply")
    page = view(["female", folder / "turn.npz", folder / "rest.ply"], port=8471)
    yield page
    page.close()


def test_the_page_is_served(shown):
    assert b"<html" in urllib.request.urlopen(shown.address, timeout=10).read().lower()
    assert len(shown.panels) == 3


def test_sliders_move_the_body_and_its_measurements(shown):
    panel = shown.panels[0]
    body = habitus.load_body("female", detail="full")
    panel.betas[0].value, panel.joint.value, panel.turn[1].value = 1.5, "left_elbow", -80.0
    expected = body([1.5], {"left_elbow": (0.0, np.deg2rad(-80.0), 0.0)}).vertices
    np.testing.assert_allclose(panel._skin.vertices, expected, atol=1e-5)
    assert f"height {100 * body.measure([1.5])['height_m']:.1f} cm" in panel._text.content
    panel.joint.value = "left_knee"
    assert panel.turn[1].value == 0.0 and panel.pose[body.joint_names.index("left_elbow"), 1] < -1.0
    panel.rest._impl.update_cb[0](None)
    np.testing.assert_allclose(panel._skin.vertices, body().vertices, atol=1e-5)


def test_a_motion_plays_and_stands_on_its_own_place(shown):
    panel = shown.panels[1]
    first = panel._skin.vertices.mean(axis=0)
    assert np.abs(first[[0, 2]]).max() < 0.2  # begun at the node, whatever the capture's place was
    panel.frame.value = 8
    assert panel._skin.vertices.mean(axis=0)[0] - first[0] > 0.3
    panel.playing.value = True
    panel._last -= 0.1
    panel.tick()
    assert panel.frame.value in range(9) and panel.frame.value != 8


def test_a_fit_shows_its_markers_and_a_motion_has_none(tmp_path):
    pytest.importorskip("viser")
    fit = synthetic_fit(4)
    save_body(fit.body, tmp_path / "tubes_body.npz")
    fit.export(tmp_path / "fit.npz")
    Motion.of(fit).export(tmp_path / "motion.npz")
    page = view(
        [tmp_path / "fit.npz", tmp_path / "motion.npz"], body=tmp_path / "tubes_body.npz", port=8472
    )
    try:
        assert [panel._markers is not None for panel in page.panels] == [True, False]
        np.testing.assert_allclose(page.panels[0]._markers, fit.observed_markers, atol=1e-6)
    finally:
        page.close()


@pytest.mark.parametrize(
    ("sources", "options", "words"),
    [
        ([], {}, "nothing to view"),
        (["no-such.npz"], {}, r"no-such\.npz: no such file"),
        (["no-such.ply"], {}, r"no-such\.ply: No such file"),
        (["default"], {"up": "north"}, "up is 'north'; expected one of"),
    ],
)
def test_what_cannot_be_shown_is_said(sources, options, words):
    pytest.importorskip("viser")
    with pytest.raises(HabitusError, match=words):
        view(sources, **options)
