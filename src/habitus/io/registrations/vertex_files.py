"""Vertices of many registrations that stay on disk until they are asked for.

All have a shape (N, V, 3), are indexed like an array along N, may be read by threads and sent to
other processes (which open the files anew), and raise HabitusError, naming the file, where
something in it cannot be read.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from habitus.errors import HabitusError, require_extra
from habitus.io.archives import NpzArchive, mapped_header
from habitus.io.limits import open_file
from habitus.io.meshes import read_mesh
from habitus.mesh.registrations import Vertices


class FileVertices:
    """What readers of vertices have in common: rows are read one by one, open files are not sent to
    other processes.
    """

    @property
    def shape(self) -> tuple[int, int, int]:
        """(N, V, 3)."""
        return self._shape()

    def _shape(self) -> tuple[int, int, int]:
        raise NotImplementedError

    def _read(self, k: int) -> np.ndarray:
        """The vertices (V, 3) of registration ``k``."""
        raise NotImplementedError

    def __getitem__(self, rows: Any) -> np.ndarray:
        chosen = np.arange(self.shape[0])[rows]
        if chosen.ndim == 0:
            return self._read(int(chosen))
        return (
            np.stack([self._read(int(k)) for k in chosen])
            if len(chosen)
            else np.zeros((0, *self.shape[1:]))
        )

    def __getstate__(self) -> dict[str, Any]:
        return {key: value for key, value in self.__dict__.items() if not key.startswith("_")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)


@dataclass(frozen=True, eq=False)
class MappedVertices(FileVertices):
    """An array that lies uncompressed in a file from ``offset`` (bytes) on, its axes given by
    ``axes``: mapped.
    """

    path: Path
    offset: int
    dtype: np.dtype
    stored: tuple[int, ...]
    order: str = "C"
    axes: tuple[int, int, int] = (0, 1, 2)

    def __post_init__(self):
        if len(self.stored) != 3:
            raise HabitusError(
                f"{self.path}: its vertices have shape {self.stored}; expected three axes: (N, V, "
                "3)"
            )
        if self.dtype.kind not in "fiu":
            raise HabitusError(f"{self.path}: its vertices are {self.dtype}; expected numbers")

    def _shape(self) -> tuple[int, int, int]:
        n, v, three = (self.stored[axis] for axis in self.axes)
        return n, v, three

    @cached_property
    def _array(self) -> np.ndarray:
        try:
            mapped = np.memmap(self.path, self.dtype, "r", self.offset, self.stored, self.order)  # type: ignore
        except (OSError, ValueError) as error:
            raise HabitusError(
                f"{self.path}: {error}; the file is not whole: copy it again"
            ) from error
        return mapped.transpose(self.axes)

    def _read(self, k: int) -> np.ndarray:
        return np.asarray(self._array[k])


@dataclass(frozen=True, eq=False)
class MeshVertices(FileVertices):
    """The vertices of mesh files, every one with the topology of the first."""

    paths: tuple[Path, ...]
    faces: Int[np.ndarray, "F 3"]
    vertices: int

    def _shape(self) -> tuple[int, int, int]:
        return len(self.paths), self.vertices, 3

    def _read(self, k: int) -> np.ndarray:
        vertices, faces = read_mesh(self.paths[k])
        if len(vertices) != self.vertices:
            raise HabitusError(
                f"{self.paths[k].name}: another topology: {len(vertices)} vertices; expected "
                f"{self.vertices}"
            )
        if not np.array_equal(faces, self.faces):
            raise HabitusError(
                f"{self.paths[k].name}: another topology: its {len(faces)} faces are not those of "
                "the other files"
            )
        return vertices


@dataclass(frozen=True, eq=False)
class SequenceVertices(FileVertices):
    """Frames of the sequences (V, 3, T) of an HDF5 file: ``frames`` lists which sequence and frame
    each row is.
    """

    path: Path
    vertices: int
    sequences: tuple[str, ...]
    frames: Int[np.ndarray, "N 2"]

    def _shape(self) -> tuple[int, int, int]:
        return len(self.frames), self.vertices, 3

    @cached_property
    def _file(self) -> Any:
        return require_extra("h5py", "HDF5 files").File(self.path, "r", rdcc_nbytes=1 << 26)

    @cached_property
    def _mapped(self) -> list[MappedVertices | None]:
        """Sequences that lie in one piece are mapped: a frame's numbers are spread over all of
        it.
        """
        mapped: list[MappedVertices | None] = []
        for name in self.sequences:
            data = self._file[name]
            offset = data.id.get_offset()
            plain = data.chunks is None and not data.external and data.dtype.isnative
            axes = (2, 0, 1)
            mapped.append(
                MappedVertices(self.path, offset, data.dtype, data.shape, axes=axes)
                if plain and offset
                else None
            )
        return mapped

    def _read(self, k: int) -> np.ndarray:
        sequence, frame = self.frames[k].tolist()
        mapped = self._mapped[sequence]
        if mapped is not None:
            return mapped[frame]
        try:
            return self._file[self.sequences[sequence]][:, :, frame]
        except (OSError, RuntimeError) as error:
            raise HabitusError(
                f"{self.path}: {self.sequences[sequence]}: {error}; copy the file again"
            ) from error


@dataclass(frozen=True, eq=False)
class ZarrVertices(FileVertices):
    """The array ``vertices`` of a zarr group."""

    path: Path

    @cached_property
    def _array(self) -> Any:
        return require_extra("zarr", "zarr folders").open_group(str(self.path), mode="r")[
            "vertices"
        ]

    def _shape(self) -> tuple[int, int, int]:
        return tuple(self._array.shape)

    def _read(self, k: int) -> np.ndarray:
        try:
            return np.asarray(self._array[k])
        except Exception as error:  # a damaged chunk may raise anything
            raise HabitusError(
                f"{self.path}: registration {k} cannot be read ({error}); copy the folder again"
            ) from error


@dataclass(frozen=True, eq=False)
class ScaledVertices(FileVertices):
    """Vertices in metres from others by a factor a row."""

    source: Vertices
    factor: Float[np.ndarray, " N"]

    def _shape(self) -> tuple[int, int, int]:
        n, v, three = self.source.shape
        return n, v, three

    def _read(self, k: int) -> np.ndarray:
        return np.asarray(self.source[k], dtype=np.float64) * self.factor[k]


@dataclass(frozen=True, eq=False)
class JoinedVertices(FileVertices):
    """The vertices of several sources, one after the other."""

    sources: tuple[Vertices, ...]

    def _shape(self) -> tuple[int, int, int]:
        return int(self.ends[-1]), self.sources[0].shape[1], 3

    @cached_property
    def ends(self) -> Int[np.ndarray, " S"]:
        """Where each source ends."""
        return np.cumsum([source.shape[0] for source in self.sources])

    def _read(self, k: int) -> np.ndarray:
        place = int(np.searchsorted(self.ends, k, side="right"))
        return np.asarray(self.sources[place][k - (int(self.ends[place - 1]) if place else 0)])


def array_in_zip(path: Path, archive: NpzArchive, name: str) -> np.ndarray | MappedVertices:
    """An array of an npz: mapped where it lies uncompressed, else read. Raises HabitusError for
    pickled ones.
    """
    place = archive.place(name)
    header = archive.header(name)
    if place is None or header.dtype.hasobject:
        return archive.read(name)
    return MappedVertices(path, place, header.dtype, header.shape, "F" if header.fortran else "C")


def array_in_file(path: Path) -> MappedVertices:
    """A ``.npy`` file, mapped. Raises HabitusError for pickled ones, OSError where there is
    none.
    """
    with open_file(path) as stream:
        header = mapped_header(stream, path)
    return MappedVertices(
        path, header.begins, header.dtype, header.shape, "F" if header.fortran else "C"
    )


def joined(sources: Sequence[Vertices]) -> Vertices:
    """One source as it is, several one after the other."""
    return sources[0] if len(sources) == 1 else JoinedVertices(tuple(sources))
