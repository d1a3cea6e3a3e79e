"""Markers and poses chosen on the default body: files, layouts that are read back and matched,
goals.
"""

import json

import numpy as np
import pytest

import habitus as hb
from habitus.cli.main import main
from habitus.errors import HabitusError
from habitus.io.layouts.files import load_layout, match_layout
from habitus.jobs.selection import find_layout, find_pool


def test_a_selection_and_what_it_leaves(tmp_path, capsys):
    words = "select-markers --from 50 --start 47 --people 1 --min-markers 44 --keep 45 48 --pairs".split()
    main([*words, "--out", str(tmp_path / "selection")])
    said = capsys.readouterr().out
    assert "47 markers" in said and "(start)" in said and "50 candidates" in said
    folder = tmp_path / "selection"
    assert {path.name for path in folder.iterdir()} == {
        "selection.json",
        "curve.svg",
        "markers.svg",
        "markers-45.toml",
        "markers-48.toml",
    }
    numbers = json.loads((folder / "selection.json").read_text())
    assert len(numbers["candidates"]) == 50 and len(numbers["start"]) == 47
    assert all(len(step["changed"]) in (1, 2) for step in numbers["removed"][1:])
    errors = [step["error_mm"] for step in (*numbers["removed"][::-1], *numbers["added"][1:])]
    assert errors[0] > errors[-1]
    layout = load_layout(folder / "markers-45.toml")
    assert 44 <= len(layout) <= 45 and set(layout.labels) < set(find_layout("47").labels)
    body = hb.load_body("default")
    layout.vertices(body)
    assert (folder / "markers.svg").read_text().count("<circle") > 20


def test_a_real_capture_matches_a_selected_layout(shared, tmp_path):
    """What was chosen of a set's markers is a layout for captures with that set."""
    capture = hb.read_capture(shared / "mocap" / "85_02.c3d")[:5]
    found = hb.select_markers(
        pool="cmu-41", start="cmu-41", people=1, min_markers=36, keep=(36,), out=tmp_path / "s"
    )
    layout = load_layout(tmp_path / "s" / "markers-36.toml")
    match = match_layout(capture.labels, capture.markers, [layout])
    assert set(match.matched) <= set(layout.labels) and len(match.matched) >= 36
    assert found.start == 39 or found.start <= 41
    with pytest.raises(HabitusError, match="no set of 3 markers"):
        found.layout(3)


def test_pools():
    body = hb.load_body("default")
    start = find_layout("mosh-47")
    pool = find_pool(body, 114, start, pairs=True)
    assert len(pool.candidates.labels) == len(set(pool.candidates.labels)) == 114
    assert sorted(k for group in pool.candidates.groups for k in group) == list(range(114))
    places = body.v_template[pool.candidates.vertices]
    for group in pool.candidates.groups:
        if len(group) == 2:
            assert np.linalg.norm(places[group[0]] - places[group[1]] * [-1, 1, 1]) < 0.015
    assert pool.candidates.count(pool.start) >= 47
    with pytest.raises(HabitusError, match="more candidates"):
        find_pool(body, 20, start, pairs=False)
    with pytest.raises(HabitusError, match="were asked for"):
        find_pool(body, 1000, start, pairs=False)


def test_poses_are_a_motion(tmp_path):
    choice, poses = hb.select_poses(
        layout="mosh-47", count=3, candidates=6, out=tmp_path / "poses.npz"
    )
    motion = hb.load_motion(tmp_path / "poses.npz")
    np.testing.assert_allclose(motion.pose, poses, atol=1e-12)
    assert motion.rate_hz == 1.0 and motion.up_axis == "+y" and len(choice.errors) == 3
    np.testing.assert_allclose(motion.vertices()[..., 1].min(axis=1), 0.0, atol=1e-6)
    for given, said in (
        ({"count": 9, "candidates": 6}, "expected 1 or more"),
        ({"out": "x.csv"}, r"\.npz"),
    ):
        with pytest.raises(HabitusError, match=said):
            hb.select_poses(**({"layout": "mosh-47", "count": 2, "candidates": 3} | given))
