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


@pytest.mark.parametrize(("name", "content"), [("a.ply", b"ply\nnothing"), ("a.txt", b""), ("a.stl", b"solid")])
def test_damage_is_said_in_one_line(tmp_path, name, content):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(HabitusError, match=name) as found:
        read_scan(tmp_path / name)
    assert "\n" not in str(found.value)
