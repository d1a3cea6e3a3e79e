"""The maps that come along, and files of vertices."""

import numpy as np
import pytest
from synthetic_fit import tube_body

from habitus.errors import HabitusError
from habitus.fit.points.correspondences import hidden_vertices
from habitus.io.models.bodies import load_body
from habitus.io.topologies import (
    FOLDER,
    TOPOLOGIES,
    load_topology,
    map_arrays,
    read_vertices,
    topology_of,
)
from habitus.mesh.normals import face_normals, vertex_normals

COUNTS = {"smpl": 6890, "smplx": 10475, "mhr": 18439}


@pytest.fixture(scope="module")
def full():
    body = load_body("neutral").full
    assert body is not None
    return body


@pytest.mark.parametrize("name", TOPOLOGIES)
def test_barycentric_coordinates_are_inside_and_sum_to_one(name, full):
    places = load_topology(name, full)
    assert places.num_vertices == COUNTS[name]
    np.testing.assert_allclose(places.barycentric.sum(1), 1.0, atol=1e-12)
    assert places.barycentric.min() >= -1e-12
    np.testing.assert_array_equal(places.corners, full.faces[places.face])
    assert places.matched.mean() > 0.88


@pytest.mark.parametrize("name", TOPOLOGIES)
def test_every_vertex_has_a_face_and_faces_look_outwards(name, full):
    places = load_topology(name, full)
    assert np.array_equal(np.unique(places.faces), np.arange(places.num_vertices))
    mesh = places.vertices(full.v_template)
    normal = np.einsum(
        "nkc,nk->nc",
        vertex_normals(full.v_template, full.faces)[places.corners],
        places.barycentric,
    )
    own = face_normals(mesh, places.faces)
    seen = places.matched[places.faces].all(1)
    ours = normal[places.faces].sum(1)
    area = np.linalg.norm(own, axis=1)[seen]
    outward = (own * ours).sum(1)[seen] > 0.0
    assert (area * outward).sum() / area.sum() > 0.99


@pytest.mark.parametrize("name", TOPOLOGIES)
def test_matched_vertices_lie_on_skin_that_is_seen(name, full):
    places = load_topology(name, full)
    hidden = hidden_vertices(full)
    assert hidden is not None
    assert not hidden[places.corners[places.matched]].all(1).any()


@pytest.mark.parametrize("name", TOPOLOGIES)
def test_a_map_is_written_as_it_was_read(name, full):
    with np.load(FOLDER / f"{name}.npz") as file:
        for key, array in map_arrays(load_topology(name, full)).items():
            assert np.abs(array.astype(int) - file[key].astype(int)).max() <= 1  # of 65,535 steps


def test_the_three_bodies_share_the_maps(full):
    for sex in ("female", "male"):
        other = load_body(sex).full
        assert other is not None
        np.testing.assert_array_equal(other.faces, full.faces)


def test_other_names_and_bodies_are_refused(full):
    with pytest.raises(HabitusError, match="topology is 'star'; expected one of smpl, smplx, mhr"):
        load_topology("star", full)
    with pytest.raises(HabitusError, match="topologies are mapped on the bundled bodies' 13524"):
        load_topology("smpl", tube_body())
    assert topology_of(10475) == "smplx"
    with pytest.raises(HabitusError, match=r"5023 vertices; expected 6890 \(smpl\)"):
        topology_of(5023)


@pytest.mark.parametrize(("unit", "factor"), [("m", 1.0), ("cm", 100.0), ("mm", 1000.0)])
def test_the_unit_is_found_by_the_size_of_a_person(unit, factor, tmp_path):
    person = np.random.default_rng(0).random((2, 5, 3)) * [0.5, 1.7, 0.3]
    np.savez(tmp_path / "a.npz", vertices=factor * person, rate_hz=60.0, up_axis="+y")
    for asked in ("auto", unit):
        read = read_vertices(tmp_path / "a.npz", 5, asked)
        np.testing.assert_allclose(read.vertices, person, rtol=1e-12)
        assert (read.rate_hz, read.up_axis) == (60.0, "+y")


@pytest.mark.parametrize(
    ("vertices", "message"),
    [
        (np.zeros((2, 4, 3)), "expected 5 of each frame"),
        (np.full((1, 5, 3), np.nan), "no finite numbers"),
        (np.full((1, 5, 3), 2.0), "0 m across; expected a person's"),
        (np.array(["a"]), "expected numbers"),
    ],
)
def test_what_is_no_person_is_refused(vertices, message, tmp_path):
    np.savez(tmp_path / "a.npz", vertices=vertices)
    with pytest.raises(HabitusError, match=message):
        read_vertices(tmp_path / "a.npz", 5)


def test_files_of_another_kind_are_refused(tmp_path):
    np.savez(tmp_path / "a.npz", points=np.zeros(3))
    with pytest.raises(HabitusError, match="expected an npz with vertices"):
        read_vertices(tmp_path / "a.npz", 5)
    with pytest.raises(HabitusError, match="expected vertices in a mesh"):
        read_vertices(tmp_path / "a.fbx", 5)


@pytest.mark.parametrize("shape", [(0, 5, 3), (0, 3), (2, 0, 3)])
def test_a_file_without_vertices_is_refused(tmp_path, shape):
    np.savez(tmp_path / "a.npz", vertices=np.zeros(shape))
    with pytest.raises(HabitusError, match="expected numbers"):
        read_vertices(tmp_path / "a.npz", 5)
