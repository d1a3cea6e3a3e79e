"""Every format of calibration gives the same cameras; what is none is refused in one line."""

import pickle
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from habitus.errors import HabitusError
from habitus.io.cameras.read import read_calibration
from habitus.observe.camera_rig import CameraRig, RigCamera

RNG = np.random.default_rng(4)


def _rig() -> CameraRig:
    cameras = []
    for k in range(2):
        turn = Rotation.from_rotvec([0.3 + k, -0.2, 0.1 * k]).as_matrix()
        cameras.append(
            RigCamera(
                f"cam{k + 1}", 1280, 720, np.array([1000.0 + k, 1010.0]), np.array([640.5, 360.25]),
                turn, np.array([0.2, 0.4 + k, 3.0]),
                np.array([-0.05, 0.02, 0.001, -0.002, 0.0, 0.0, 0.0, 0.0]),
            )
        )  # fmt: skip
    return CameraRig(tuple(cameras))


def _opencv(camera: RigCamera) -> np.ndarray:
    k = np.diag([*camera.focal, 1.0])
    k[:2, 2] = camera.centre - 0.5
    return k


def _toml(rig: CameraRig, folder: Path) -> Path:
    lines = []
    for camera in rig.cameras:
        turn = Rotation.from_matrix(camera.rotation).as_rotvec()
        lines += [
            f"[{camera.name}]", f'name = "{camera.name}"',
            f"size = [ {camera.width}.0, {camera.height}.0]",
            f"matrix = {_opencv(camera).tolist()}",
            f"distortions = {camera.distortion[:4].tolist()}",
            f"rotation = {turn.tolist()}", f"translation = {camera.translation.tolist()}",
            "fisheye = false", "",
        ]  # fmt: skip
    path = folder / "Calib.toml"
    path.write_text("\n".join([*lines, "[metadata]", "error = 0.0"]))
    return path


def _qualisys(rig: CameraRig, folder: Path) -> Path:
    rows = []
    for camera in rig.cameras:
        turn = np.diag([1.0, -1.0, -1.0]) @ camera.rotation
        r = " ".join(f'r{i + 1}{j + 1}="{turn[i, j]!r}"' for i in range(3) for j in range(3))
        place = " ".join(f'{a}="{1e3 * v!r}"' for a, v in zip("xyz", camera.place, strict=True))
        k = 64.0 * _opencv(camera)
        k1, k2, p1, p2 = camera.distortion[:4]
        rows.append(
            f'<camera serial="{camera.name}"><fov_video left="0" top="0" '
            f'right="{camera.width - 1}" bottom="{camera.height - 1}"/><transform {r} {place}/>'
            f'<intrinsic focalLengthU="{k[0, 0]}" focalLengthV="{k[1, 1]}" '
            f'centerPointU="{k[0, 2]}" centerPointV="{k[1, 2]}" radialDistortion1="{k1}" '
            f'radialDistortion2="{k2}" radialDistortion3="0" tangentalDistortion1="{p1}" '
            f'tangentalDistortion2="{p2}"/></camera>'
        )
    path = folder / "Calib.qca.txt"
    path.write_text(
        f"<?xml version='1.0'?><calibration><cameras>{''.join(rows)}</cameras></calibration>"
        .replace("np.float64(", "").replace(')"', '"')
    )  # fmt: skip
    return path


def _yaml_matrix(name: str, table: np.ndarray) -> str:
    table = np.atleast_2d(table)
    data = ", ".join(f"{value:.17g}" for value in table.ravel())
    return (
        f"{name}: !!opencv-matrix\n  rows: {table.shape[0]}\n  cols: {table.shape[1]}\n"
        f"  dt: d\n  data: [{data}]\n"
    )


def _easymocap(rig: CameraRig, folder: Path) -> Path:
    inner = outer = "%YAML:1.0\n---\n"
    names = "names:\n" + "".join(f'  - "{camera.name}"\n' for camera in rig.cameras)
    inner, outer = inner + names, outer + names
    for camera in rig.cameras:
        inner += _yaml_matrix(f"K_{camera.name}", _opencv(camera))
        inner += _yaml_matrix(f"dist_{camera.name}", camera.distortion[:5])
        inner += f"W_{camera.name}: {camera.width}\nH_{camera.name}: {camera.height}\n"
        outer += _yaml_matrix(f"Rot_{camera.name}", camera.rotation)
        outer += _yaml_matrix(f"T_{camera.name}", camera.translation[:, None])
    (folder / "intri.yml").write_text(inner)
    (folder / "extri.yml").write_text(outer)
    return folder


def _opencv_files(rig: CameraRig, folder: Path) -> Path:
    for camera in rig.cameras:
        (folder / f"{camera.name}.yaml").write_text(
            "%YAML:1.0\n---\n"
            + f"image_width: {camera.width}\nimage_height: {camera.height}\n"
            + _yaml_matrix("camera_matrix", _opencv(camera))
            + _yaml_matrix("distortion_coefficients", camera.distortion[:5])
            + _yaml_matrix("R", camera.rotation)
            + _yaml_matrix("T", camera.translation[:, None])
        )
    return folder


def _opencap(rig: CameraRig, folder: Path) -> Path:
    for camera in rig.cameras:
        own = folder / "Videos" / camera.name
        own.mkdir(parents=True)
        table = {
            "intrinsicMat": _opencv(camera),
            "distortion": camera.distortion[None, :5],
            "rotation": camera.rotation,
            "translation": 1e3 * camera.translation[:, None],
            "imageSize": np.array([[float(camera.height)], [float(camera.width)]]),
        }
        (own / "cameraIntrinsicsExtrinsics.pickle").write_bytes(pickle.dumps(table, protocol=4))
    return folder


def _vicon(rig: CameraRig, folder: Path) -> Path:
    rows = []
    for camera in rig.cameras:
        turn = " ".join(map(repr, Rotation.from_matrix(camera.rotation).as_quat().tolist()))
        place = " ".join(map(repr, (1e3 * camera.place).tolist()))
        k = _opencv(camera)
        aspect = k[0, 0] / k[1, 1]
        rows.append(
            f'<Camera USERID="{camera.name}" SENSOR_SIZE="{camera.width} {camera.height}" '
            f'PIXEL_ASPECT_RATIO="{aspect!r}"><KeyFrames><KeyFrame FOCAL_LENGTH="{k[0, 0]}" '
            f'ORIENTATION="{turn}" POSITION="{place}" PRINCIPAL_POINT="{k[0, 2]} {k[1, 2]}" '
            'VICON_RADIAL2="ViconRadial2 0 0 0 0 0"/></KeyFrames></Camera>'
        )
    path = folder / "a.xcp"
    path.write_text(
        f"<Cameras>{''.join(rows)}</Cameras>".replace("np.float64(", "").replace(')"', '"')
    )
    return path


@pytest.mark.parametrize(
    "write", [_toml, _qualisys, _easymocap, _opencv_files, _opencap, _vicon],
    ids=lambda write: write.__name__[1:],
)  # fmt: skip
def test_every_format_gives_the_same_cameras(write, tmp_path):
    true = _rig()
    rig = read_calibration(write(true, tmp_path))
    assert rig.names == true.names
    for one, other in zip(rig.cameras, true.cameras, strict=True):
        assert (one.width, one.height) == (other.width, other.height)
        np.testing.assert_allclose(one.focal, other.focal, rtol=1e-9)
        np.testing.assert_allclose(one.centre, other.centre, atol=1e-6)
        np.testing.assert_allclose(one.rotation, other.rotation, atol=1e-9)
        np.testing.assert_allclose(one.translation, other.translation, atol=1e-9)
        if write is not _vicon:
            np.testing.assert_allclose(one.distortion, other.distortion, atol=1e-12)


def test_lenses_are_taken_out_and_put_back():
    camera = _rig().cameras[0]
    points = np.array([[0.4, -0.2, 0.5], [-0.3, 0.1, 0.0], [0.0, 0.0, 0.2]])
    pixels = camera.project(points)
    plain = CameraRig((camera,)).project(points)[0]
    assert np.abs(pixels - plain).max() > 0.2
    np.testing.assert_allclose(camera.ideal(pixels), plain, atol=1e-4)
    behind = camera.place - 2.0 * camera.rotation[2]
    assert np.isnan(camera.project(behind)).all()


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("fisheye = false", "fisheye = true", "fish-eye"),
        ("1000.0", "-3.0", "no camera has"),
        ("1280.0", "0.0", "no camera has"),
        ("rotation = [", "rotation = [9, ", "rotation"),
        ("cam2", "cam1", "calibration"),
        ("matrix", "matrices", "0 cameras"),
    ],
)
def test_what_is_no_calibration_is_refused_in_one_line(old, new, says, tmp_path):
    path = _toml(_rig(), tmp_path)
    text = path.read_text().replace(old, new)
    path.write_text(text)
    with pytest.raises(HabitusError) as error:
        read_calibration(path)
    assert str(path) in str(error.value) and "\n" not in str(error.value)


def test_a_mirrored_rotation_is_refused(tmp_path):
    path = _opencv_files(_rig(), tmp_path) / "cam1.yaml"
    rig = _rig()
    mirrored = rig.cameras[0].rotation * [[1.0], [1.0], [-1.0]]
    text = path.read_text().replace(
        _yaml_matrix("R", rig.cameras[0].rotation), _yaml_matrix("R", mirrored)
    )
    path.write_text(text)
    with pytest.raises(HabitusError, match="mirrored or scaled"):
        read_calibration(tmp_path)


def test_millimetres_are_known_by_the_size_of_the_room(tmp_path):
    path = _toml(_rig(), tmp_path)
    text = path.read_text().replace(
        "translation = [0.2, 0.4, 3.0]", "translation = [200, 400, 3000]"
    )
    text = text.replace("translation = [0.2, 1.4, 3.0]", "translation = [200, 1400, 3000]")
    path.write_text(text)
    rig = read_calibration(path)
    np.testing.assert_allclose(rig.translation, _rig().translation)
    assert any("millimetres" in note for note in rig.notes)


def test_missing_files_and_folders_are_refused(tmp_path):
    for path in (tmp_path / "none.toml", tmp_path, tmp_path / "a.bin"):
        if path.suffix == ".bin":
            path.write_bytes(b"\0")
        with pytest.raises(HabitusError, match="expected"):
            read_calibration(path)


def test_a_pickle_runs_no_code(tmp_path):
    class Bad:
        def __reduce__(self):
            return (print, ("run",))

    own = tmp_path / "Cam0"
    own.mkdir()
    (own / "cameraIntrinsicsExtrinsics.pickle").write_bytes(pickle.dumps({"rotation": Bad()}))
    with pytest.raises(HabitusError):
        read_calibration(tmp_path)
