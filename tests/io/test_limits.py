"""No file makes a reader take more memory or time than a file of its size may ask for."""

import io
import json
import struct
import time
import tracemalloc
import zipfile
import zlib
from pathlib import Path

import h5py
import numpy as np
import pytest
import zarr

from habitus.errors import HabitusError
from habitus.io.archives import NpzArchive, open_archive
from habitus.io.captures.read import read_captures
from habitus.io.layouts.files import load_layout
from habitus.io.limits import BASE_BYTES, MAX_GROWTH, Allowance, array_size, check_inflated
from habitus.io.meshes import read_mesh
from habitus.io.models.bodies import load_body
from habitus.io.people import open_person
from habitus.io.registrations.open import open_registrations
from habitus.io.registrations.templates import load_template
from habitus.io.rgbd.files import read_description
from habitus.io.scans import read_scan

MOST = 1 << 30
SLOWEST_S = 5.0
READERS = {
    "capture.npz": read_captures,
    "body.npz": load_body,
    "template.npz": load_template,
    "set.npz": open_registrations,
}


def refused(read, path: Path) -> str:
    """The one line that a reader refuses a file with, having taken less than 1 GB and a few
    seconds.
    """
    tracemalloc.start()
    started = time.process_time()
    try:
        with pytest.raises(HabitusError) as caught:
            read(path)
        assert tracemalloc.get_traced_memory()[1] < MOST
    finally:
        tracemalloc.stop()
    assert time.process_time() - started < SLOWEST_S
    assert not isinstance(caught.value.__cause__, MemoryError)
    return str(caught.value)


def npy(descr: str, shape: tuple[int, ...], data: bytes = b"") -> bytes:
    text = (
        repr({"descr": descr, "fortran_order": False, "shape": shape}).encode().ljust(117) + b"\n"
    )
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text + data


def archive(path: Path, kind: int = zipfile.ZIP_STORED, **members: bytes) -> Path:
    with zipfile.ZipFile(path, "w", kind) as file:
        for name, content in members.items():
            file.writestr(f"{name}.npy", content)
    return path


WORDS = {
    "labels": npy("<U1", (1,), b"A\0\0\0"),
    "subject": npy("<U1", (1,), b"A\0\0\0"),
    "faces": npy("<i8", (0, 3)),
}
CLAIMS = {
    "a hundred gigabytes": npy("<f8", (4_000_000_000, 3)),
    "no bytes, many rows": npy("<f8", (10**12, 0, 3)),
    "rows of nothing": npy("|V0", (10**12, 3, 3)),
    "empty texts": npy("<U0", (10**12, 3, 3)),
    "one long text": npy("<U500000000", (1,)),
    "a negative length": npy("<f8", (-1, 3)),
    "objects": npy("|O", (10**9, 1, 3), b"\x80\x04."),
    "brackets": b"\x93NUMPY\x01\x00" + struct.pack("<H", 9000) + b"(" * 9000,
    "signs": b"\x93NUMPY\x01\x00" + struct.pack("<H", 9000) + b"{'shape': " + b"-" * 8990,
    "no numpy": b"hello",
}


@pytest.mark.parametrize("claim", CLAIMS)
@pytest.mark.parametrize("name", READERS)
def test_headers_of_arrays_are_held_against_the_bytes_that_are_there(tmp_path, name, claim):
    content = CLAIMS[claim]
    members = dict.fromkeys(("markers", "vertices", "v_template", "shapedirs", "parents"), content)
    assert name in refused(READERS[name], archive(tmp_path / name, **(WORDS | members)))


@pytest.fixture(scope="module")
def bomb() -> bytes:
    bomb = io.BytesIO()
    with zipfile.ZipFile(bomb, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as file:
        for key in ("markers", "vertices", "v_template", "shapedirs"):
            with file.open(f"{key}.npy", "w") as member:
                member.write(npy("|u1", (18_000_000, 1, 3)))
                for _ in range(54):
                    member.write(bytes(1_000_000))
        for key, content in (WORDS | {"skinning_index": npy("<i8", (0,))}).items():
            file.writestr(f"{key}.npy", content)
    return bomb.getvalue()


@pytest.mark.parametrize("name", READERS)
def test_an_archive_that_inflates_without_end_is_refused(tmp_path, name, bomb):
    (tmp_path / name).write_bytes(bomb)
    assert "may fill" in refused(READERS[name], tmp_path / name)


def test_all_arrays_of_an_archive_share_what_it_may_fill(tmp_path):
    small = archive(
        tmp_path / "a.npz",
        zipfile.ZIP_DEFLATED,
        **{f"a{k}": npy("|u1", (6_000_000,), bytes(6_000_000)) for k in range(4)},
    )
    with open_archive(small) as file:
        file.read("a0"), file.read("a1")
        with pytest.raises(HabitusError, match="may fill"):
            file.read("a2")


def test_numbers_that_are_no_characters_are_refused(tmp_path):
    path = archive(tmp_path / "a.npz", words=npy("<U2", (1,), b"\xff\xff\xff\xff" + bytes(4)))
    with open_archive(path) as file, pytest.raises(HabitusError, match="not characters"):
        file.read("words")


def test_honest_archives_are_read(tmp_path):
    rng = np.random.default_rng(0)
    arrays = {
        "a": rng.normal(size=(200, 3)),
        "b": np.array(["x", "Ünï"]),
        "c": np.asfortranarray(rng.normal(size=(3, 4))),
    }
    for write in (np.savez, np.savez_compressed):
        write(tmp_path / "a.npz", **arrays)
        found = NpzArchive((tmp_path / "a.npz").read_bytes())
        assert all(np.array_equal(found[name], array) for name, array in arrays.items())


@pytest.mark.parametrize(
    "head",
    [
        "element vertex 1000000000000\nproperty float x\nelement face 1\n",
        "element vertex -5\nelement face 99999999999999999999\n",
        "element vertex 3\n" + "property list uchar int a\n" * 100_000,
    ],
)
def test_a_ply_that_counts_more_than_it_has_is_refused(tmp_path, head):
    for form in ("ascii", "binary_little_endian"):
        (tmp_path / "a.ply").write_text(f"ply\nformat {form} 1.0\n{head}end_header\n1 2 3\n")
        assert "a.ply" in refused(read_mesh, tmp_path / "a.ply")


# -- HDF5 and zarr ---------------------------------------------------------------------------------


def h5(path: Path, **options) -> Path:
    with h5py.File(path, "w") as file:
        file["faces"] = np.array([[0, 1, 2]])
        file.create_dataset("a_b", **options)
    return path


def test_hdf5_that_claims_more_than_it_holds_is_refused(tmp_path):
    huge = {"shape": (10**7, 3, 10**6), "dtype": "f4", "chunks": (1000, 3, 10)}
    assert "a_b" in refused(open_registrations, h5(tmp_path / "a.h5", **huge))
    chunk = {"shape": (10**6, 3, 100), "dtype": "f8", "chunks": (10**6, 3, 50)}
    assert "a_b" in refused(open_registrations, h5(tmp_path / "a.h5", **chunk))
    elsewhere = {"shape": (4, 3, 2), "dtype": "f8", "external": [(tmp_path / "other.bin", 0, 1000)]}
    assert "in this file" in refused(open_registrations, h5(tmp_path / "a.h5", **elsewhere))
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["faces"] = h5py.ExternalLink("/etc/passwd", "faces")
        file["a_b"] = np.zeros((4, 3, 2))
    assert "link to elsewhere" in refused(open_registrations, tmp_path / "a.h5")


def test_a_piece_of_hdf5_that_inflates_without_end_is_refused(tmp_path):
    path = h5(tmp_path / "a.h5", shape=(4, 3, 1), dtype="f8", chunks=(4, 3, 1), compression="gzip")
    with h5py.File(path, "r+") as file:
        file["a_b"].id.write_direct_chunk((0, 0, 0), zlib.compress(bytes(200 << 20), 1))
    assert "packed piece" in refused(open_registrations, path)


def test_a_piece_of_hdf5_beyond_the_end_of_its_file_is_refused(tmp_path):
    path = h5(tmp_path / "a.h5", shape=(4, 3, 1), dtype="f8", chunks=(4, 3, 1), compression="gzip")
    with h5py.File(path, "r+") as file:
        file["a_b"][:] = np.random.default_rng(0).normal(size=(4, 3, 1))
        size = file["a_b"].id.get_chunk_info(0).size
    key = struct.pack("<II", size, 0)  # of the tree of pieces: its size and the mask of its filters
    raw = path.read_bytes()
    assert raw.count(key) == 1
    path.write_bytes(raw.replace(key, struct.pack("<II", 0x7FFFFFF0, 0)))
    assert "beyond the file's end" in refused(open_registrations, path)


def group(folder: Path, **changed) -> Path:
    made = zarr.open_group(str(folder), mode="w", zarr_format=2)
    for name, array in {
        "vertices": np.zeros((2, 4, 3)),
        "faces": np.array([[0, 1, 2]]),
        "subject": np.array([1, 2]),
    }.items():
        made.create_array(name, data=array)
        told = json.loads((folder / name / ".zarray").read_text())
        (folder / name / ".zarray").write_text(json.dumps(told | changed.get(name, {})))
    return folder


@pytest.mark.parametrize(
    "changed",
    [
        {"faces": {"shape": [10**12, 3]}},
        {"faces": {"chunks": [10**10, 3]}},
        {"vertices": {"shape": [10**12, 4, 3]}},
        {"vertices": {"shape": [2, 10**9, 3]}},
        {"vertices": {"chunks": [1, 10**9, 3]}},
        {"subject": {"shape": [10**12]}},
        {"vertices": {"filters": [{"id": "pickle", "protocol": 2}]}},
        {"vertices": {"compressor": {"id": "pickle", "protocol": 2}}},
        {
            "subject": {
                "dtype": "|O",
                "filters": [{"id": "pickle", "protocol": 2}],
                "fill_value": None,
            }
        },
        {"subject": {"dtype": "|O", "filters": [{"id": "json2"}], "fill_value": None}},
    ],
)
def test_a_zarr_folder_that_claims_more_than_it_holds_or_runs_code_is_refused(tmp_path, changed):
    assert "a.zarr" in refused(open_registrations, group(tmp_path / "a.zarr", **changed))


def test_a_chunk_of_zarr_that_unpacks_without_end_is_refused(tmp_path):
    folder = group(tmp_path / "a.zarr", faces={"compressor": {"id": "zlib", "level": 1}})
    (folder / "faces" / "0.0").write_bytes(zlib.compress(bytes(200 << 20), 1))
    assert "packed piece" in refused(open_registrations, folder)
    folder = group(tmp_path / "b.zarr", faces={"compressor": {"id": "zstd", "level": 1}})
    (folder / "faces" / "0.0").write_bytes(
        b"\x28\xb5\x2f\xfd\xe0" + (10**12).to_bytes(8, "little") + b"\1\0\0"
    )
    assert "chunk of faces" in refused(open_registrations, folder)
    folder = group(
        tmp_path / "c.zarr",
        faces={"compressor": {"id": "blosc", "cname": "lz4", "clevel": 5, "shuffle": 1}},
    )
    (folder / "faces" / "0.0").write_bytes(bytes((2, 1, 33, 8)) + b"\xff\xff\xff\x7f" * 3)
    assert "chunk of faces" in refused(open_registrations, folder)


def test_a_zarr_folder_does_not_lead_elsewhere(tmp_path):
    folder = group(tmp_path / "a.zarr")
    (folder / "faces" / "0.0").unlink()
    (folder / "faces" / "0.0").symlink_to("/etc/hostname")
    assert "link to elsewhere" in refused(open_registrations, folder)


# -- the rules -------------------------------------------------------------------------------------


def test_what_a_file_may_fill_grows_with_its_own_size():
    Allowance(0).take(BASE_BYTES // 8, 1, "it")
    Allowance(10**6).take((BASE_BYTES + MAX_GROWTH * 10**6) // 8, 8, "it")
    for count, width in ((BASE_BYTES // 8 + 1, 1), (-1, 8), (10**30, 8), (1, BASE_BYTES + 1)):
        with pytest.raises(HabitusError):
            Allowance(0).take(count, width, "it")


@pytest.mark.parametrize("shape", [(-1,), (1.5,), (True,), ("3",), (1,) * 40, (None,)])
def test_a_shape_is_whole_numbers(shape):
    with pytest.raises(HabitusError):
        array_size(shape)


def test_inflating_on_probation_keeps_nothing():
    packed = zlib.compress(bytes(50_000_000), 1)
    check_inflated(packed, 50_000_000, "it")
    with pytest.raises(HabitusError):
        check_inflated(packed, 49_000_000, "it")


@pytest.mark.parametrize(
    ("name", "read"),
    [
        *READERS.items(),
        ("walk.c3d", read_captures),
        ("markers.toml", load_layout),
        ("fit.npz", open_person),
        ("body.obj", read_mesh),
        *((f"scan{ending}", read_scan) for ending in (".ply", ".glb", ".gltf")),
        ("cameras.yaml", read_description),
    ],
)
def test_pipes_and_devices_are_refused_before_they_are_read(tmp_path, name, read):
    (tmp_path / name).symlink_to("/dev/null")
    assert "a pipe or a device" in refused(read, tmp_path / name)
