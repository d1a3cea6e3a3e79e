"""Scans come as they are in the file, whatever the format; damage is said in one line."""

import numpy as np
import pytest
import trimesh

from habitus.errors import HabitusError
from habitus.io.scans import read_scan, scans_in

BOX = trimesh.creation.icosphere(1)


@pytest.mark.parametrize("ending", ["ply", "obj", "stl", "glb", "off"])
def test_a_mesh_is_read_from_every_format(tmp_path, ending):
    BOX.export(tmp_path / f"a.{ending}")
    scan = read_scan(tmp_path / f"a.{ending}")
    assert scan.name == "a" and scan.faces.shape == BOX.faces.shape
    np.testing.assert_allclose(
        np.sort(np.unique(np.round(scan.points, 4), axis=0), axis=0),
        np.sort(np.unique(np.round(BOX.vertices, 4), axis=0), axis=0),
        atol=2e-4,
    )


def test_a_cloud_has_no_faces(tmp_path):
    trimesh.PointCloud(BOX.vertices).export(tmp_path / "a.ply")
    scan = read_scan(tmp_path / "a.ply")
    assert scan.faces is None and scan.normals is None and scan.points.shape == BOX.vertices.shape


def test_files_of_a_folder_come_in_the_order_of_their_numbers(tmp_path):
    for name in ("scan10.ply", "scan2.ply", "notes.txt"):
        (tmp_path / name).write_bytes(b"")
    assert [path.name for path in scans_in([tmp_path])] == ["scan2.ply", "scan10.ply"]
    (tmp_path / "empty").mkdir()
    with pytest.raises(HabitusError, match="no scans in it"):
        scans_in([tmp_path / "empty"])


@pytest.mark.parametrize(
    ("name", "content"), [("a.ply", b"ply\nnothing"), ("a.txt", b""), ("a.stl", b"solid")]
)
def test_damage_is_said_in_one_line(tmp_path, name, content):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(HabitusError, match=name) as found:
        read_scan(tmp_path / name)
    assert "\n" not in str(found.value)


def test_colours_of_vertices_are_read_as_linear_light(tmp_path):
    shades = np.tile([255, 128, 0, 255], (len(BOX.vertices), 1)).astype(np.uint8)
    mesh = trimesh.Trimesh(BOX.vertices, BOX.faces, vertex_colors=shades, process=False)
    for ending in ("ply", "obj"):
        mesh.export(tmp_path / f"a.{ending}")
        scan = read_scan(tmp_path / f"a.{ending}")
        np.testing.assert_allclose(scan.colours[0], [1.0, 0.2159, 0.0], atol=3e-3)
        assert scan.colours.shape == scan.colour_places.shape == scan.points.shape
    trimesh.PointCloud(BOX.vertices, shades).export(tmp_path / "b.ply")
    np.testing.assert_allclose(
        read_scan(tmp_path / "b.ply").colours[-1], [1.0, 0.2159, 0.0], atol=3e-3
    )
    mesh.export(tmp_path / "c.glb")
    np.testing.assert_allclose(
        read_scan(tmp_path / "c.glb").colours[0], [1.0, 128 / 255, 0.0], atol=3e-3
    )


@pytest.mark.parametrize("ending", ["obj", "glb"])
def test_a_picture_on_a_mesh_is_read_where_it_lies(tmp_path, ending):
    image = pytest.importorskip("PIL.Image")
    picture = np.zeros((8, 8, 3), np.uint8)
    picture[:4], picture[4:, :, 1] = (255, 0, 0), 255  # red on top, green below
    square = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], dtype=float)
    visual = trimesh.visual.TextureVisuals(uv=square[:, :2], image=image.fromarray(picture))
    trimesh.Trimesh(square, [[0, 1, 2], [0, 2, 3]], visual=visual, process=False).export(
        tmp_path / f"a.{ending}"
    )
    scan = read_scan(tmp_path / f"a.{ending}")
    high = scan.colour_places[:, 1] > 0.5
    assert len(scan.colours) > 10_000 and len(scan.points) == 4
    np.testing.assert_allclose(scan.colours[high], np.tile([1.0, 0, 0], (high.sum(), 1)), atol=0.02)
    np.testing.assert_allclose(
        scan.colours[~high], np.tile([0, 1.0, 0], ((~high).sum(), 1)), atol=0.02
    )


def test_a_scan_without_colours_has_none(tmp_path):
    for ending in ("ply", "obj", "stl", "glb"):
        BOX.export(tmp_path / f"a.{ending}")
        assert read_scan(tmp_path / f"a.{ending}").colours is None
