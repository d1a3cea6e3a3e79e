"""What one path holds of registrations: archives, folders of meshes, FAUST's numbered files, Dyna's
sequences.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from habitus.errors import HabitusError, require_extra, shown
from habitus.io.archives import NpzArchive, checked_texts, read_npy, reason
from habitus.io.limits import MAX_NAME_LENGTH, Allowance, folder_bytes, open_file
from habitus.io.meshes import ENDINGS, read_mesh
from habitus.io.names import inside
from habitus.io.registrations.known import KEYS, KnownArrays, checked
from habitus.io.registrations.stores import h5_array, zarr_array
from habitus.io.registrations.table import known_word, read_table
from habitus.io.registrations.vertex_files import (
    MeshVertices,
    SequenceVertices,
    ZarrVertices,
    array_in_file,
    array_in_zip,
)
from habitus.mesh.registrations import Vertices

WORDS = ("subject", "sex", "set", "name", "verdict", "unit")
KNOWN = (
    "an .npz, a .zarr folder, an .h5 of sequences, a folder with registrations.csv, or one of "
    "numbered meshes as in "
    "FAUST"
)
_NUMBERED = re.compile(r"(.*?)_?(\d{3,})\.(?:ply|obj)", re.IGNORECASE)
_PEOPLE_OF = 10  # FAUST: ten registrations of each subject, one after the other


@dataclass(frozen=True, eq=False)
class Source:
    """What one path holds; ``words`` has one word a registration in each column, "" where it is not
    given.

    ``weights`` of vertices are (V,) or (N, V), None where none are given; ``known`` is what is
    known besides.
    """

    path: Path
    vertices: Vertices
    faces: Int[np.ndarray, "F 3"]
    words: Mapping[str, Sequence[str]]
    weights: Float[np.ndarray, "..."] | None = None
    known: KnownArrays = field(default_factory=dict)


def _reason(error: Exception) -> str:
    """What a library says of damage, on one line; of a missing file its name, however deep its
    folder lies.
    """
    if isinstance(error, OSError) and error.filename:
        return shown(f"{Path(error.filename).name}: {error.strerror}", 120)
    return reason(error)


def open_source(path: Path, every: int) -> Source:
    """Open one path, whatever its format; of sequences ``every`` so many frames. Raises
    HabitusError for all else.
    """
    if not path.exists():
        raise HabitusError(f"{path}: no such file; expected {KNOWN}")
    try:
        if path.is_dir():
            return _open_folder(path)
        if path.suffix == ".npz":
            return _open_npz(path)
        if path.suffix in (".h5", ".hdf5"):
            return _open_sequences(path, every)
    except HabitusError as error:
        if path.name in str(error):
            raise
        raise HabitusError(f"{path}: {error}") from error
    except Exception as error:  # the libraries' own errors change from release to release
        raise HabitusError(
            f"{path}: cannot be read ({_reason(error)}); expected registrations: write it again"
        ) from error
    raise HabitusError(f"{path}: no such format; expected {KNOWN}")


def _open_folder(path: Path) -> Source:
    if path.suffix == ".zarr" or (path / "zarr.json").exists() or (path / ".zgroup").exists():
        return _open_zarr(path)
    if (path / "registrations.csv").exists():
        return _open_table(path)
    numbered = sorted(
        (int(match.group(2)), match.group(1), file)
        for file in path.iterdir()
        if (match := _NUMBERED.fullmatch(file.name))
    )
    if not numbered:
        raise HabitusError(
            f"{path}: no registrations.csv and no numbered meshes in it; expected {KNOWN}"
        )
    files = [file for _, _, file in numbered]
    subject = [f"{prefix}_{number // _PEOPLE_OF}".lstrip("_") for number, prefix, _ in numbered]
    return _meshes(path, files, {"subject": subject, "set": ["pose"] * len(files)})


def _meshes(path: Path, files: Sequence[Path], words: Mapping[str, Sequence[str]]) -> Source:
    vertices, faces = read_mesh(files[0])
    words = {"name": [file.stem for file in files], **words}
    return _source(path, MeshVertices(tuple(files), faces, len(vertices)), faces, words)


def _open_table(path: Path) -> Source:
    words: dict[str, Sequence[str]] = dict(read_table(path / "registrations.csv"))
    if not words["subject"]:
        raise HabitusError(f"{path / 'registrations.csv'}: no rows; expected one a registration")
    if "file" in words:
        files = [path / inside(word) for word in words["file"]]
        missing = [
            file.name for file in files if not file.is_file() or file.suffix.lower() not in ENDINGS
        ]
        if missing:
            raise HabitusError(
                f"{path}: {len(missing)} files of registrations.csv (first {missing[0]}) are not "
                "there or no meshes; "
                f"expected {' or '.join(ENDINGS)} files"
            )
        if "name" not in words:
            frames = words.get("frame", [""] * len(files))
            stems = [Path(word).with_suffix("").as_posix() for word in words["file"]]
            words["name"] = [
                f"{stem}:{at}" if at else stem for stem, at in zip(stems, frames, strict=True)
            ]
        return _meshes(path, files, words)
    vertices = array_in_file(path / "vertices.npy")
    faces = read_npy(path / "faces.npy")
    if "name" not in words and "frame" in words:
        words["name"] = [
            f"{one}:{at}" for one, at in zip(words["subject"], words["frame"], strict=True)
        ]
    columns = {
        key: read_npy(file) for key in ("weights", *KEYS) if (file := path / f"{key}.npy").exists()
    }
    return _source(path, vertices, faces, words, columns.pop("weights", None), columns)


def _open_npz(path: Path) -> Source:
    with open_file(path) as file:
        archive = NpzArchive(file)
        _check_there(path, archive)
        arrays = {
            key: archive.read(key) for key in ("faces", "weights", *KEYS, *WORDS) if key in archive
        }
        vertices = array_in_zip(path, archive, "vertices")
    return _source(path, vertices, *_parted(arrays))


def _open_zarr(path: Path) -> Source:
    zarr = require_extra("zarr", "zarr folders")
    try:
        group = zarr.open_group(str(path), mode="r")
        allowance = Allowance(folder_bytes(path))
        _check_there(path, group)
        arrays = {
            key: np.asarray(zarr_array(group, path, key, allowance, whole=True)[:])
            for key in ("faces", "weights", *KEYS, *WORDS)
            if key in group
        }
        zarr_array(group, path, "vertices", allowance, whole=False)
    except HabitusError:
        raise
    except Exception as error:  # zarr's own classes of errors change from release to release
        raise HabitusError(f"{path}: no zarr group ({reason(error)}); expected {KNOWN}") from error
    return _source(path, ZarrVertices(path), *_parted(arrays))


def _parted(
    arrays: dict[str, np.ndarray],
) -> tuple[np.ndarray, dict[str, list[str]], np.ndarray | None, KnownArrays]:
    """Faces, words, weights, and what is known besides."""
    words = {key: _texts(array) for key, array in arrays.items() if key in WORDS}
    known = {key: array for key, array in arrays.items() if key in KEYS}
    return arrays["faces"], words, arrays.get("weights"), known


def _open_sequences(path: Path, every: int) -> Source:
    allowance = Allowance(path.stat().st_size)
    with require_extra("h5py", "HDF5 files").File(path, "r") as file:
        if "faces" not in file:
            have = shown(", ".join(file))
            raise HabitusError(
                f"{path}: no faces in it (it has {have}); expected faces and sequences"
            )
        faces = np.asarray(h5_array(file, "faces", allowance, whole=True)[()])
        names = [name for name in sorted(file) if name != "faces" and "_" in name]
        shapes = {name: h5_array(file, name, allowance, whole=False).shape for name in names}
    sequences = tuple(shapes)
    off = [
        name
        for name in sequences
        if len(shapes[name]) != 3 or shapes[name][1] != 3 or 0 in shapes[name]
    ]
    if off or not sequences or len({shape[0] for shape in shapes.values()}) > 1:
        what = (
            f"{shown(off[0])} has shape {shapes[off[0]]}" if off else f"{len(sequences)} sequences"
        )
        raise HabitusError(
            f"{path}: {what}; expected sequences <subject>_<sequence> of shape (V, 3, T), V the "
            "same"
        )
    frames = np.array(
        [
            (k, frame)
            for k, name in enumerate(sequences)
            for frame in range(0, shapes[name][2], every)
        ],
        dtype=np.int64,
    ).reshape(-1, 2)
    vertices = SequenceVertices(path, shapes[sequences[0]][0], sequences, frames)
    words = {
        "subject": [sequences[k].split("_")[0] for k, _ in frames],
        "name": [f"{sequences[k]}:{frame}" for k, frame in frames],
        "set": ["pose"] * len(frames),
    }
    return _source(path, vertices, faces, words)


def _check_there(path: Path, names: object) -> None:
    missing = [key for key in ("vertices", "faces", "subject") if key not in names]  # type: ignore
    if missing:
        raise HabitusError(
            f"{path}: no array {missing[0]!r} in it; expected vertices, faces and subject"
        )


def _texts(array: np.ndarray) -> list[str]:
    flat = np.atleast_1d(checked_texts(array)).ravel().tolist()
    words = (
        word.decode("utf-8", "replace") if isinstance(word, bytes) else str(word) for word in flat
    )
    return [shown(word, MAX_NAME_LENGTH) for word in words]


def _source(
    path: Path,
    vertices: Vertices | np.ndarray,
    faces: np.ndarray,
    words: Mapping[str, Sequence[str]],
    weights: np.ndarray | None = None,
    arrays: KnownArrays | None = None,
) -> Source:
    """The words of a source filled up and in one spelling, its shapes checked."""
    shape = tuple(vertices.shape)
    if len(shape) != 3 or shape[2] != 3 or 0 in shape:
        raise HabitusError(f"{path}: its vertices have shape {shape}; expected (N, V, 3)")
    if faces.ndim != 2 or faces.shape[1] != 3 or faces.dtype.kind not in "iu":
        raise HabitusError(
            f"{path}: its faces are {faces.dtype} of shape {faces.shape}; expected vertex numbers "
            "(F, 3)"
        )
    if weights is not None and (
        weights.shape not in (shape[1:2], shape[:2]) or weights.dtype.kind not in "fiub"
    ):
        raise HabitusError(
            f"{path}: its weights are {weights.dtype} of shape {weights.shape}; expected numbers "
            f"({shape[1]},) or {shape[:2]}"
        )
    count = shape[0]
    full = {}
    fillers = {"name": [f"{path.stem}:{k}" for k in range(count)]}
    for key in WORDS:
        column = words.get(key, fillers.get(key, [""] * count))
        column = list(column) * count if key == "unit" and len(column) == 1 else column
        if len(column) != count:
            raise HabitusError(
                f"{path}: {len(column)} words of {key!r} for {count} registrations; expected one "
                "each"
            )
        full[key] = [
            known_word(key, word, f"{path}: registration {k}") for k, word in enumerate(column)
        ]
    known = checked(arrays or {}, full["subject"], shape[1], str(path))
    return Source(path, vertices, faces.astype(np.int64), full, weights, known)
