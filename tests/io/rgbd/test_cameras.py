"""Cameras under everybody's names are the same camera; what is none is told in one line."""

import json

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from habitus.errors import HabitusError
from habitus.io.rgbd.cameras import read_rig
from habitus.io.rgbd.files import read_description
from habitus.observe.camera import Camera
from habitus.rotations import matrix_from_rotvec

SIZE = (640, 480)
LENS = [0.1, -0.2, 0.001, 0.002, 0.05]
TURN = np.asarray(matrix_from_rotvec(np.array([0.01, -0.02, 0.03])))
SHIFT = [0.025, -0.001, 0.003]
POINT = torch.tensor([[0.2, -0.1, 2.0]], dtype=torch.float64)
K = [[585.0, 0.0, 320.5], [0.0, 586.0, 240.25], [0.0, 0.0, 1.0]]
FLAT_K = [number for row in K for number in row]
FLAT = {"fx": 585.0, "fy": 586.0, "cx": 320.5, "cy": 240.25}
REALSENSE = {
    "fx": 585.0,
    "fy": 586.0,
    "ppx": 320.5,
    "ppy": 240.25,
    "model": "brown_conrady",
    "coeffs": LENS,
}
WAYS = {
    "ours": {"depth": FLAT | {"distortion": LENS}},
    "open3d": {
        "intrinsic_matrix": np.array(K).T.ravel().tolist(),
        "width": 640,
        "height": 480,
        "distortion": LENS,
    },
    "realsense": {"depth": REALSENSE | {"width": 640, "height": 480}},
    "opencv": {
        "camera_matrix": {"rows": 3, "cols": 3, "data": FLAT_K},
        "distortion_coefficients": {"data": LENS},
    },
    "ros": {
        "K": FLAT_K,
        "D": LENS,
        "distortion_model": "plumb_bob",
        "image_width": 640,
        "image_height": 480,
    },
    "nested": {
        "depth": {"intrinsics": FLAT | {"coeffs": LENS, "model": "Distortion.Brown_Conrady"}}
    },
}


@pytest.mark.parametrize("name", WAYS)
def test_everybodys_names_are_one_camera(name):
    expected = Camera.from_opencv(np.array(K), LENS, np.zeros(3), np.zeros(3), *SIZE)
    found = read_rig(WAYS[name], name, SIZE).depth
    assert (found.width, found.height) == SIZE
    torch.testing.assert_close(
        found.project(POINT)[0], expected.project(POINT)[0], rtol=0, atol=1e-9
    )


@pytest.mark.parametrize(
    "way",
    [
        {"depth_to_color": {"rotation": TURN.tolist(), "translation": SHIFT}},
        {"extrinsics": np.vstack([np.column_stack([TURN, SHIFT]), [0, 0, 0, 1]]).tolist()},
        {"R": {"data": TURN.ravel().tolist()}, "T": {"data": (1000 * np.array(SHIFT)).tolist()}},
        {
            "color_to_depth": {
                "rotation": TURN.T.tolist(),
                "translation": (-TURN.T @ SHIFT).tolist(),
            }
        },
    ],
    ids=["ours", "matrix", "opencv in mm", "the other way round"],
)
def test_the_way_between_the_cameras(way):
    rig = read_rig({"depth": FLAT, "color": FLAT} | way, "rig", SIZE)
    moved = POINT.numpy()[0] @ TURN.T + SHIFT
    np.testing.assert_allclose(rig.colour.to_camera(POINT).numpy()[0], moved, atol=1e-9)


def test_realsense_writes_matrices_by_columns():
    table = {"depth": REALSENSE, "color": REALSENSE}
    table |= {
        "extrinsics": {"rotation": TURN.T.ravel().tolist(), "translation": SHIFT},
        "depth_scale": 0.001,
    }
    rig = read_rig(table, "realsense", SIZE)
    np.testing.assert_allclose(
        rig.colour.to_camera(POINT).numpy()[0], POINT.numpy()[0] @ TURN.T + SHIFT, atol=1e-9
    )
    assert rig.metres == 0.001


def test_azures_own_calibration():
    numbers = [0.5, 0.52, 0.49, 0.49, 0.1, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1e-4, 2e-4]
    colour = [0.5, 0.5, 0.47, 0.63, *numbers[4:]]
    place = {"Rotation": np.eye(3).ravel().tolist(), "Translation": [0, 0, 0]}
    beside = {"Rotation": TURN.ravel().tolist(), "Translation": SHIFT}
    cameras = [
        {
            "Purpose": "CALIBRATION_CameraPurposeDepth",
            "Intrinsics": {"ModelParameters": numbers},
            "Rt": place,
        },
        {
            "Purpose": "CALIBRATION_CameraPurposePhotoVideo",
            "Intrinsics": {"ModelParameters": colour},
            "Rt": beside,
        },
    ]
    rig = read_rig({"CalibrationInformation": {"Cameras": cameras}}, "azure", (640, 576))
    assert rig.depth.principal_point.tolist() == pytest.approx(
        [0.5 * 1024 - 192, 0.52 * 1024 - 180]
    )
    assert rig.depth.distortion[:4].tolist() == pytest.approx([0.1, 0.0, 2e-4, 1e-4])
    assert (rig.colour.width, rig.colour.height) == (1280, 720)
    assert rig.colour.principal_point.tolist() == pytest.approx([640, 0.5 * 960 - 120])
    np.testing.assert_allclose(
        rig.colour.to_camera(POINT).numpy()[0], POINT.numpy()[0] @ TURN.T + SHIFT, atol=1e-9
    )
    with pytest.raises(HabitusError, match="640 x 576"):
        read_rig({"Cameras": cameras}, "azure", (641, 480))


def test_opencvs_yaml_is_read(tmp_path):
    text = (
        "%YAML:1.0\n---\nimage_width: 640\nimage_height: 480\ncamera_matrix: !!opencv-matrix\n   "
        "rows: 3\n   cols: 3\n"
        f"   dt: d\n   data: {FLAT_K}\ndistortion_coefficients: !!opencv-matrix\n   rows: 1\n   "
        "cols: 5\n   dt: d\n"
        f"   data: {LENS}\n"
    )
    (tmp_path / "camera.yml").write_text(text)
    found = read_rig(read_description(tmp_path / "camera.yml"), "camera.yml", (1, 1)).depth
    assert (found.width, found.height) == SIZE and found.distortion[4] == LENS[4]


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ({}, "fx, fy"),
        ([], "table"),
        ({"fx": "far", "fy": 1, "cx": 1, "cy": 1}, "numbers"),
        (FLAT | {"distortion": [0.1] * 3}, "coefficients"),
        (FLAT | {"coeffs": LENS, "model": "fisheye"}, "fisheye"),
        (FLAT | {"depth_scale": -1}, "depth_scale"),
        ({"depth": FLAT, "color": FLAT, "extrinsics": [[1, 0, 0, 0]] * 3}, "rotation"),
        (FLAT | {"fx": -585.0}, "focal"),
    ],
)
def test_what_is_no_camera_says_so(table, words):
    with pytest.raises(HabitusError, match=words):
        read_rig(table, "file", SIZE)


JSON = st.recursive(
    st.none() | st.booleans() | st.floats() | st.text(max_size=8),
    lambda inner: (
        st.lists(inner, max_size=4)
        | st.dictionaries(
            st.sampled_from(["depth", "color", "fx", "K", "D", "width", "extrinsics", "R", "T"]),
            inner,
        )
    ),
    max_leaves=12,
)


@given(JSON)
@settings(max_examples=60, deadline=None)
def test_any_json_is_a_camera_or_one_clear_error(table):
    try:
        read_rig(json.loads(json.dumps(table)), "file", SIZE)
    except HabitusError as error:
        assert "\n" not in str(error)
