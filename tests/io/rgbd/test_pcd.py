"""Organised point clouds: each form of PCL's files gives the depth, the camera and the colours."""

import struct

import numpy as np
import pytest

from habitus.errors import HabitusError
from habitus.io.rgbd.pcd import read_pcd
from habitus.io.rgbd.read import read_views

FOCAL, MIDDLE, SIZE = 40.0, (15.3, 11.8), (32, 24)


def _points() -> tuple[np.ndarray, np.ndarray]:
    """Points of a wavy wall in rows of pixels, some missing, and packed colours."""
    column, row = np.meshgrid(np.arange(SIZE[0]) + 0.5, np.arange(SIZE[1]) + 0.5)
    depth = 2.0 + 0.3 * np.sin(column / 5.0) + 0.01 * row
    points = np.stack(
        [(column - MIDDLE[0]) / FOCAL * depth, (row - MIDDLE[1]) / FOCAL * depth, depth], -1
    )
    points[3:6, 4:9] = np.nan
    red = (7 * column.astype(np.uint32)) % 256
    return points.astype("<f4"), (red << 16) | (20 << 8) | 90


def _literals(data: bytes) -> bytes:
    """LZF of nothing but literal runs."""
    runs = [data[k : k + 32] for k in range(0, len(data), 32)]
    return b"".join(bytes([len(run) - 1]) + run for run in runs)


def pcd(form: str, height: int = SIZE[1]) -> bytes:
    points, colours = _points()
    width = SIZE[0] * SIZE[1] // height
    header = (
        "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z rgba\nSIZE 4 4 4 4\nTYPE F F F U\nCOUNT 1 1 1 1\n"
        f"WIDTH {width}\nHEIGHT {height}\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {SIZE[0] * SIZE[1]}\n"
        f"DATA {form}\n"
    ).encode()
    columns = [*points.reshape(-1, 3).T, colours.ravel().astype("<u4")]
    if form == "ascii":
        rows = zip(*columns, strict=True)
        return header + "\n".join(f"{x} {y} {z} {c}" for x, y, z, c in rows).encode()
    if form == "binary":
        kinds = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("rgba", "<u4")]
        return header + np.rec.fromarrays(columns, dtype=kinds).tobytes()
    whole = b"".join(column.tobytes() for column in columns)
    packed = _literals(whole)
    return header + struct.pack("<II", len(packed), len(whole)) + packed


@pytest.mark.parametrize("form", ["ascii", "binary", "binary_compressed"])
def test_every_form_gives_the_same_view(tmp_path, form):
    path = tmp_path / "frame.pcd"
    path.write_bytes(pcd(form))
    (view,) = read_views(path).views
    points, colours = _points()
    np.testing.assert_allclose(view.depth, np.nan_to_num(points[..., 2]), rtol=1e-6)
    np.testing.assert_allclose(view.camera.focal_length, FOCAL, rtol=1e-4)
    np.testing.assert_allclose(view.camera.principal_point, MIDDLE, atol=1e-2)
    assert (view.colour[..., 0] == colours >> 16).all() and (view.colour[..., 2] == 90).all()


def test_a_copy_of_what_was_unpacked_may_overlap_itself(tmp_path):
    """LZF: a run of one value is one literal and a copy from one byte before."""
    from habitus.io.rgbd.pcd import _unpack_lzf

    packed = np.frombuffer(bytes([1, 5, 6, (7 << 5), 10, 0]), np.uint8)
    out = np.zeros(21, np.uint8)
    assert _unpack_lzf(packed, out) == 21
    assert out.tolist() == [5, *[6] * 20]
    assert _unpack_lzf(packed, np.zeros(20, np.uint8)) == -1
    assert _unpack_lzf(np.array([255, 255, 255], np.uint8), out) == -1


@pytest.mark.parametrize(
    "spoilt",
    [
        pcd("binary", height=1),
        pcd("binary_compressed")[:-40],
        pcd("binary").replace(b"DATA binary", b"DATA gzipped"),
        pcd("binary").replace(b"WIDTH 32", b"WIDTH 99999999"),
        pcd("ascii").replace(b"FIELDS x", b"FIELDS w"),
        b"# nothing",
    ],
    ids=["no image", "cut", "form", "size", "fields", "text"],
)
def test_other_files_are_refused_in_one_line(tmp_path, spoilt):
    path = tmp_path / "frame.pcd"
    path.write_bytes(spoilt)
    with pytest.raises(HabitusError) as error:
        read_pcd(path)
    assert str(path) in str(error.value) and "\n" not in str(error.value)


def test_points_of_no_pinhole_camera_are_refused(tmp_path):
    path = tmp_path / "frame.pcd"
    data = bytearray(pcd("binary"))
    start = data.index(b"DATA binary\n") + len(b"DATA binary\n")
    rng = np.random.default_rng(0)
    data[start:] = rng.permutation(np.frombuffer(bytes(data[start:]), "V16")).tobytes()
    path.write_bytes(data)
    with pytest.raises(HabitusError, match="no pinhole camera"):
        read_pcd(path)
