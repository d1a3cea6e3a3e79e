import pickle
import tracemalloc
import zipfile
from dataclasses import replace

import h5py
import numpy as np
import pytest
import trimesh
import zarr
from hypothesis import given, settings
from hypothesis import strategies as st

from habitus.errors import HabitusError
from habitus.io.meshes import read_mesh
from habitus.io.names import plain_name
from habitus.io.registrations.open import open_registrations, write_registrations
from habitus.io.registrations.table import read_table, table_text
from habitus.mesh.registrations import Registrations
from habitus.mesh.shapes import icosphere

WORDS = ("subject", "sex", "set", "name")


def people(count=7, seed=0) -> Registrations:
    shape = icosphere(1)
    rng = np.random.default_rng(seed)
    vertices = shape.vertices.numpy() * rng.uniform(0.5, 1, (count, 1, 3)) + rng.normal(
        size=(count, 1, 3)
    )
    return Registrations(
        vertices=vertices,
        faces=shape.faces.numpy(),
        subject=tuple(f"p{k // 3}" for k in range(count)),
        sex=tuple(("female", "male", "")[k // 3] for k in range(count)),
        set=tuple(("pose", "shape", "test")[k % 3] for k in range(count)),
        name=tuple(f"scan, {k}" for k in range(count)),
    )


def arrays_of(registrations) -> dict[str, np.ndarray]:
    words = {key: np.array(getattr(registrations, key)) for key in WORDS}
    return {"vertices": registrations.vertices, "faces": registrations.faces, **words}


def same(found: Registrations, expected: Registrations, atol=1e-12):
    assert found.vertices.shape == expected.vertices.shape and np.array_equal(
        found.faces, expected.faces
    )
    for key in WORDS:
        assert getattr(found, key) == getattr(expected, key)
    for k in range(len(expected)):
        assert np.allclose(found.read(k), expected.read(k), atol=atol, equal_nan=True)


def write_meshes(folder, registrations, ending="ply", scale=1.0, name="{}"):
    folder.mkdir(parents=True, exist_ok=True)
    files = [f"{name.format(k)}.{ending}" for k in range(len(registrations))]
    for k, file in enumerate(files):
        mesh = trimesh.Trimesh(scale * registrations.read(k), registrations.faces, process=False)
        mesh.export(
            folder / file, **({"vertex_normal": False} if ending == "ply" else {"digits": 12})
        )
    return files


def write_form(form, path, registrations):
    """The same registrations in each form that is read; returns the path and how exact it is."""
    arrays = arrays_of(registrations)
    if form in ("npz", "folder"):
        write_registrations(
            registrations, path := path / ("r.npz" if form == "npz" else "r"), dtype=np.float64
        )
    elif form == "savez":
        np.savez(path := path / "r.npz", **arrays)
    elif form == "compressed":
        np.savez_compressed(path := path / "r.npz", **arrays)
    elif form == "fortran":
        np.savez(
            path := path / "r.npz", **(arrays | {"vertices": np.asfortranarray(arrays["vertices"])})
        )
    elif form in ("zarr", "zarr 2"):
        group = zarr.open_group(
            str(path := path / "r.zarr"), mode="w", zarr_format=2 if form == "zarr 2" else 3
        )
        for key, value in arrays.items():
            if value.dtype.kind == "U" and form == "zarr":
                group.create_array(key, shape=value.shape, dtype=str)[:] = value
            else:
                group.create_array(
                    key, data=value, **({"chunks": (1, 42, 3)} if key == "vertices" else {})
                )
    else:
        files = write_meshes(path, registrations, form)
        columns = {"file": files, **{key: getattr(registrations, key) for key in WORDS}}
        (path / "registrations.csv").write_text(table_text(columns))
    return path, 1e-6 if form == "ply" else 1e-11


FORMS = ["npz", "folder", "savez", "compressed", "fortran", "zarr", "zarr 2", "ply", "obj"]


@pytest.mark.parametrize("form", FORMS)
def test_every_form_gives_back_what_was_written(tmp_path, form):
    registrations = people()
    path, atol = write_form(form, tmp_path, registrations)
    found = open_registrations(path)
    same(found, registrations, atol)
    same(pickle.loads(pickle.dumps(found)), registrations, atol)  # as it is sent to other processes
    assert np.allclose(found.vertices[2:5], registrations.vertices[2:5], atol=atol)
    assert np.allclose(
        found.vertices[np.array([6, 0, 6])], registrations.vertices[[6, 0, 6]], atol=atol
    )
    assert found.vertices[np.zeros(0, int)].shape == (0, 42, 3)


@pytest.mark.parametrize("form", FORMS)
def test_what_is_read_can_be_written_and_read_again(tmp_path, form):
    path, atol = write_form(form, tmp_path, people())
    for name in ("again.npz", "again"):
        write_registrations(
            open_registrations(path).where(subject=("p0", "p2")), tmp_path / "out" / name
        )
        same(
            open_registrations(tmp_path / "out" / name),
            people().where(subject=("p0", "p2")),
            atol + 1e-6,
        )
    assert sorted(file.name for file in (tmp_path / "out").iterdir()) == ["again", "again.npz"]


@pytest.mark.parametrize("form", ["npz", "folder"])
def test_opening_and_reading_one_does_not_read_all(tmp_path, form):
    faces = icosphere(1).faces.numpy()
    n = 4000
    registrations = Registrations(
        np.broadcast_to(icosphere(1).vertices.numpy(), (n, 42, 3)),
        faces,
        ("a",) * n,
        ("",) * n,
        ("pose",) * n,
        ("",) * n,
    )
    tracemalloc.start()
    path, _ = write_form(form, tmp_path, registrations)
    found = open_registrations(path)
    first = found.where(subject="a").read(n - 1)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < n * 42 * 3 * 8 / 2 and np.array_equal(first, registrations.read(0))


def test_meshes_are_read_when_asked_for_and_named_when_they_are_bad(tmp_path):
    path, _ = write_form("ply", tmp_path, people())
    (path / "3.ply").write_bytes(b"ply\nnonsense")
    small = icosphere(0)
    trimesh.Trimesh(small.vertices.numpy(), small.faces.numpy(), process=False).export(
        path / "4.ply"
    )
    trimesh.Trimesh(people().read(5), people().faces[::-1], process=False).export(path / "5.ply")
    found = open_registrations(path)
    same(found.take(np.array([0, 1, 2, 6])), people().take(np.array([0, 1, 2, 6])), 1e-6)
    for k, message in (
        (3, r"3\.ply: cannot be read"),
        (4, r"4\.ply: another topology: 12 vert"),
        (5, r"5\.ply: another"),
    ):
        with pytest.raises(HabitusError, match=message):
            found.read(k)


def test_a_folder_like_fausts_has_ten_registrations_a_subject(tmp_path):
    registrations = people(3)
    files = write_meshes(tmp_path, registrations.take(np.arange(23) % 3), name="tr_reg_{:03d}")
    (tmp_path / "notes.txt").write_text("not a mesh")
    found = open_registrations(tmp_path)
    assert found.name == tuple(file.removesuffix(".ply") for file in files)
    assert found.subject == tuple(f"tr_reg_{k // 10}" for k in range(23))
    assert set(found.set) == {"pose"} and set(found.sex) == {""}
    assert np.allclose(found.read(22), registrations.read(1), atol=1e-6)


@pytest.mark.parametrize(
    "how", [{}, {"chunks": True}, {"chunks": (42, 3, 2), "compression": "gzip"}]
)
@pytest.mark.parametrize("every", [1, 3])
def test_a_file_like_dynas_has_a_sequence_a_data_set(tmp_path, how, every):
    rng = np.random.default_rng(0)
    faces = icosphere(1).faces.numpy()
    sequences = {
        "50004_jumping_jacks": rng.normal(size=(42, 3, 5)),
        "50002_hips": rng.normal(size=(42, 3, 7)),
    }
    with h5py.File(tmp_path / "dyna.h5", "w") as file:
        file["faces"] = faces.astype(np.uint32)
        for name, vertices in sequences.items():
            file.create_dataset(name, data=vertices, **how)
    found = open_registrations(tmp_path / "dyna.h5", every=every)
    expected = [
        (name, frame)
        for name in sorted(sequences)
        for frame in range(0, sequences[name].shape[2], every)
    ]
    assert found.name == tuple(f"{name}:{frame}" for name, frame in expected)
    assert found.subject == tuple(name[:5] for name, _ in expected) and set(found.set) == {"pose"}
    for copy in (found, pickle.loads(pickle.dumps(found))):
        for k, (name, frame) in enumerate(expected):
            assert np.array_equal(copy.read(k), sequences[name][:, :, frame])


def test_several_paths_are_joined_in_order(tmp_path):
    one = people(5, seed=1)
    two = people(7, seed=2)
    (tmp_path / "obj").mkdir()
    paths = [write_form("npz", tmp_path, one)[0], write_form("obj", tmp_path / "obj", two)[0]]
    found = open_registrations(paths)
    same(found.take(np.arange(5)), one)
    same(found.take(np.arange(5, 12)), two, 1e-11)


def test_paths_of_other_topologies_are_not_joined(tmp_path):
    one = people()
    two = people()
    write_registrations(one, tmp_path / "one.npz")
    write_registrations(
        Registrations(**{**vars(two), "faces": two.faces[1:]}), tmp_path / "two.npz"
    )
    with pytest.raises(
        HabitusError, match=r"two\.npz: 42 vertices and 79 faces, another topology than .*one\.npz"
    ):
        open_registrations([tmp_path / "one.npz", tmp_path / "two.npz"])


def test_units_are_told_by_row_else_by_the_caller(tmp_path):
    registrations = people()
    arrays = arrays_of(people())
    factor = np.array([1, 1000, 100, 1, 1000, 100, 1])[:, None, None]
    unit = np.array(["", "mm", "Centimeters", "", "mm", "cm", ""])
    np.savez(
        tmp_path / "rows.npz", **(arrays | {"vertices": factor * arrays["vertices"], "unit": unit})
    )
    same(open_registrations(tmp_path / "rows.npz"), registrations)
    np.savez(tmp_path / "all.npz", **(arrays | {"vertices": 1000 * arrays["vertices"]}))
    same(open_registrations(tmp_path / "all.npz", unit="mm"), registrations)
    np.savez(
        tmp_path / "one.npz",
        **(arrays | {"vertices": 1000 * arrays["vertices"], "unit": np.array("mm")}),
    )
    same(open_registrations(tmp_path / "one.npz"), registrations)


def test_sets_that_are_not_told_follow_from_the_number_of_poses(tmp_path):
    arrays = arrays_of(people())
    del arrays["set"], arrays["name"], arrays["sex"]
    np.savez(tmp_path / "r.npz", **arrays)
    found = open_registrations(tmp_path / "r.npz")
    assert (
        found.set == ("pose",) * 6 + ("shape",)
        and found.name[6] == "r:6"
        and set(found.sex) == {""}
    )


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"vertices": None}, "no array 'vertices'"),
        ({"faces": None}, "no array 'faces'"),
        ({"subject": None}, "no array 'subject'"),
        ({"vertices": np.zeros((7, 42))}, r"vertices have shape \(7, 42\)"),
        ({"vertices": np.zeros((7, 3, 42))}, r"vertices have shape \(7, 3, 42\)"),
        ({"vertices": np.array([None])}, "pickled"),
        ({"faces": np.zeros((4, 4), int)}, r"faces are int64 of shape \(4, 4\)"),
        ({"faces": np.full((4, 3), 42)}, "expected 0 to 41"),
        ({"subject": np.array(["a"])}, "1 words of 'subject' for 7"),
        ({"sex": np.array(["w"] * 6 + ["x"])}, "registration 6: sex is 'x'"),
        ({"set": np.array(["train"] * 7)}, "registration 0: set is 'train'"),
        ({"unit": np.array(["ell"])}, "registration 0: unit is 'ell'"),
    ],
)  # fmt: skip
def test_what_is_wrong_in_an_archive_is_said_in_one_line(tmp_path, changed, message):
    arrays = {
        key: value for key, value in (arrays_of(people()) | changed).items() if value is not None
    }
    np.savez(tmp_path / "r.npz", **arrays)
    with pytest.raises(HabitusError, match=message) as refused:
        open_registrations(tmp_path / "r.npz")
    assert "\n" not in str(refused.value)


def test_a_torn_archive_is_refused(tmp_path):
    write_registrations(people(), tmp_path / "r.npz")
    content = (tmp_path / "r.npz").read_bytes()
    for length in (0, 10, len(content) // 2, len(content) - 10):
        (tmp_path / "torn.npz").write_bytes(content[:length])
        with pytest.raises(HabitusError, match=r"torn\.npz"):
            open_registrations(tmp_path / "torn.npz")


def test_what_is_no_set_of_registrations_is_refused_with_what_would_be(tmp_path):
    (tmp_path / "text.txt").write_text("hello")
    (tmp_path / "empty").mkdir()
    (tmp_path / "no.zarr").mkdir()
    (tmp_path / "no.h5").write_bytes(b"hello")
    with h5py.File(tmp_path / "odd.h5", "w") as file:
        file["faces"], file["a_b"] = np.zeros((1, 3), int), np.zeros((5, 4, 3))
    with h5py.File(tmp_path / "bare.h5", "w") as file:
        file["a_b"] = np.zeros((5, 3, 4))
    for name, message in {
        "text.txt": "no such format", "none.npz": "no such file", "empty": "no numbered meshes",
        "no.zarr": "no zarr group", "no.h5": "cannot be read", "odd.h5": "a_b has shape", "bare.h5": "no faces",
    }.items():  # fmt: skip
        with pytest.raises(HabitusError, match=message) as refused:
            open_registrations(tmp_path / name)
        assert "\n" not in str(refused.value) and "expected" in str(refused.value)
    with pytest.raises(HabitusError, match="unit is 'ell'"):
        open_registrations(tmp_path / "empty", unit="ell")
    with pytest.raises(HabitusError, match="every 0 frames"):
        open_registrations(tmp_path / "empty", every=0)


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ("file,sex\n0.ply,f\n", "its columns are 'file, sex'"),
        ("file,subject,Subject\n0.ply,a,a\n", "at most once"),
        ("file,subject\n0.ply,\n", 'row 2: column "subject" is empty'),
        ("file,subject\n,a\n", 'row 2: column "file" is empty'),
        ("file,subject\n0.ply,a\n9.ply,a\n", r"1 files of registrations.csv \(first 9.ply\)"),
        ("file,subject,sex\n0.ply,a,q\n", "row 2: sex is 'q'"),
        ("file,subject,unit\n0.ply,a,q\n", "row 2: unit is 'q'"),
        ("file,subject\n", "no rows"),
        ("", "empty"),
        ('file,subject\n"0.ply,a\n', "no table"),
        ("subject\na\n", r"cannot be read \(.*vertices\.npy"),
    ],
)
def test_what_is_wrong_in_a_table_is_said_in_one_line(tmp_path, table, message):
    write_meshes(tmp_path, people(1))
    (tmp_path / "registrations.csv").write_text(table)
    with pytest.raises(HabitusError, match=message) as refused:
        open_registrations(tmp_path)
    assert "\n" not in str(refused.value) and str(tmp_path) in str(refused.value)


def test_a_spreadsheets_table_is_read_too(tmp_path):
    write_meshes(tmp_path, people(2))
    table = "\ufeffFilename;ID;Gender;Frame;Weather\r\n0.ply;ann;F;12;rain\r\n\r\n1.ply;bob;Male;;sun\r\n"
    (tmp_path / "registrations.csv").write_text(table, encoding="utf-8")
    found = open_registrations(tmp_path)
    assert (found.subject, found.sex, found.name) == (
        ("ann", "bob"),
        ("female", "male"),
        ("0:12", "1"),
    )


cells = (
    st.text(st.characters(blacklist_categories=("Cs", "Cc")), min_size=1, max_size=8)
    .map(str.strip)
    .filter(bool)
)


@settings(max_examples=60, deadline=None)
@given(
    st.lists(
        st.tuples(cells, st.sampled_from(["female", "male", ""]), cells), min_size=1, max_size=5
    )
)
def test_tables_come_back_whatever_the_names(tmp_path_factory, rows):
    columns = dict(zip(("subject", "sex", "name"), zip(*rows, strict=True), strict=True))
    path = tmp_path_factory.mktemp("table") / "registrations.csv"
    path.write_text(table_text(columns), encoding="utf-8")
    assert read_table(path) == {
        key: tuple(map(plain_name, words)) for key, words in columns.items()
    }


@settings(max_examples=60, deadline=None)
@given(st.binary(max_size=300))
def test_bytes_that_are_no_registrations_are_refused(tmp_path_factory, content):
    folder = tmp_path_factory.mktemp("bytes")
    for name in ("r.npz", "r.h5", "registrations.csv"):
        (folder / name).write_bytes(content)
    for path in (folder / "r.npz", folder / "r.h5", folder):
        with pytest.raises(HabitusError):
            open_registrations(path)


def test_a_failed_write_leaves_what_was_there(tmp_path):
    class Torn:
        shape = (3, 42, 3)

        def __getitem__(self, k):
            raise HabitusError("torn")

    three = people(3)
    torn = Registrations(Torn(), three.faces, three.subject, three.sex, three.set, three.name)
    write_registrations(three, tmp_path / "r.npz")
    for name in ("r.npz", "folder"):
        with pytest.raises(HabitusError, match="torn"):
            write_registrations(torn, tmp_path / name)
    same(open_registrations(tmp_path / "r.npz"), three, 1e-6)
    assert [path.name for path in tmp_path.iterdir()] == ["r.npz"]


def test_a_folder_that_holds_something_is_not_overwritten(tmp_path):
    (tmp_path / "mine").write_text("mine")
    for path, message in ((tmp_path, "not empty"), (tmp_path / "r.tar", "ending '.tar'")):
        with pytest.raises(HabitusError, match=message):
            write_registrations(people(), path)


def test_an_archive_is_not_compressed_and_half_the_size_in_single_precision(tmp_path):
    write_registrations(people(), tmp_path / "r.npz")
    with zipfile.ZipFile(tmp_path / "r.npz") as archive:
        assert archive.getinfo("vertices.npy").compress_size == 7 * 42 * 3 * 4 + 128
    with np.load(tmp_path / "r.npz") as arrays:  # numpy reads it as well
        assert np.allclose(arrays["vertices"], people().vertices, atol=1e-6)


QUADS = """v 0 0 0
v 1 0 0
v 1 1 0
v 0 1 0
v 0 0 0
v 2 2 2
vt 0 0
vt 1 1
vn 0 0 1
f 1/1/1 2/2/1 3/1/1 4/2/1
f 5/2/1 2/1/1 6/1/1
"""


def test_an_obj_keeps_its_vertices_where_textures_have_seams_and_cuts_quads_alike(tmp_path):
    (tmp_path / "a.obj").write_text(QUADS)
    (tmp_path / "b.obj").write_text(QUADS.replace("1 1 0", "9 9 0"))
    vertices, faces = read_mesh(tmp_path / "a.obj")
    assert vertices.tolist() == [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 0], [2, 2, 2]]
    assert sorted(map(sorted, faces.tolist())) == [[0, 1, 2], [0, 2, 3], [1, 4, 5]]
    assert np.array_equal(faces, read_mesh(tmp_path / "b.obj")[1])


@pytest.mark.parametrize("content", [b"", b"hello", b"v 0 0 0\n", b"f 1 2 3\n"])
@pytest.mark.parametrize("name", ["a.obj", "a.ply"])
def test_what_is_no_mesh_is_named(tmp_path, name, content):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(HabitusError, match=r"a\.(obj|ply): ") as refused:
        read_mesh(tmp_path / name)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("vertex", ["2147483648", "34294967295/3", "9" * 600])
def test_a_face_cannot_name_a_vertex_beyond_the_file(tmp_path, vertex):
    """The reader of meshes would set up as many numbers."""
    (tmp_path / "a.obj").write_text(QUADS + f"f 1/1/1 {vertex} 2/1/1\n")
    with pytest.raises(HabitusError, match=r"a\.obj: a face names vertex") as refused:
        read_mesh(tmp_path / "a.obj")
    assert len(str(refused.value)) < 500


def test_meshes_of_a_table_are_named_with_their_folders(tmp_path):
    """Else ``ann/000.ply`` and ``bob/000.ply`` would have one name."""
    registrations = people()
    for folder in ("ann", "bob"):
        write_meshes(tmp_path / folder, registrations.take(np.array([0])), name="{:03d}")
    (tmp_path / "registrations.csv").write_text("file,subject\nann/000.ply,ann\nbob/000.ply,bob\n")
    assert open_registrations(tmp_path).name == ("ann/000", "bob/000")


@pytest.mark.parametrize("name", ["people.npz", "people"])
def test_weights_and_holes_are_written_and_read_again(tmp_path, name):
    whole = people()
    vertices = whole.vertices.astype(np.float32).astype(float)
    vertices[1, 4] = np.nan
    each = np.round(np.random.default_rng(0).random(vertices.shape[:2]), 2).astype(np.float32)
    for k, weights in enumerate((each[0], each)):
        path = tmp_path / str(k) / name
        path.parent.mkdir()
        expected = replace(whole, vertices=vertices, weights=weights)
        write_registrations(expected, path)
        found = open_registrations(path)
        same(found, expected)
        assert np.array_equal(found.weights, weights)
    write_registrations(replace(whole, vertices=vertices), tmp_path / "plain.npz")
    both = open_registrations([tmp_path / "plain.npz", path])
    assert np.array_equal(both.weights, np.concatenate([np.ones_like(each), each]))
    with np.load(tmp_path / "plain.npz") as arrays:
        np.savez(tmp_path / "odd.npz", **arrays, weights=np.ones(3))
    with pytest.raises(
        HabitusError, match=r"odd.npz: its weights are float64 of shape \(3,\); expected numbers"
    ):
        open_registrations(tmp_path / "odd.npz")
