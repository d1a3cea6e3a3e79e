"""Opens registrations that are sequences of moving people, with their motion if files have it."""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from habitus.errors import HabitusError, require_extra, shown
from habitus.io.archives import NpzArchive, checked_texts, read_npy
from habitus.io.limits import Allowance, folder_bytes, open_file
from habitus.io.registrations.open import open_registrations
from habitus.io.registrations.stores import h5_array, zarr_array
from habitus.io.registrations.vertex_files import ScaledVertices, array_in_file, array_in_zip
from habitus.learn.dynamics.sequences import MovingSurface
from habitus.mesh.registrations import Registrations, Vertices

_NUMBERS = ("betas", "pose", "trans", "rate_hz", "vertex_ids")
_SPELLINGS = {
    "poses": "pose",
    "mocap_framerate": "rate_hz",
    "mocap_frame_rate": "rate_hz",
    "rate": "rate_hz",
}
_FRAME = re.compile(r"(.*?)(?::|_(?=\d{3}))(\d+)")
_STILL = "still_vertices"
_NAMES = "joint_names"
MOTION = "motion"
"""The group of an HDF5 file that holds a group a sequence, with what is known of its motion."""
KnownArrays = Mapping[str, Any]


def open_moving_surfaces(
    path: str | Path | Sequence[str | Path], *, fps: float | None = None, unit: str = "m"
) -> tuple[MovingSurface, ...]:
    """The sequences of a path, or of several, in any format of `open_registrations`; their vertices
    stay on disk.

    Registrations follow each other as frames of a sequence where their names do: ``NAME:0``,
    ``NAME:1``, ... or ``NAME_0000``, ... (an ``.npz`` without names is one sequence, an ``.h5`` has
    its own). Beside the vertices (N, V, 3) may lie ``rate_hz``, ``betas`` (B,) or (N, B), ``pose``
    (N, J, 3) or (N, 3 J), ``trans`` (N, 3), ``joint_names`` (J,) of the pose, ``vertex_ids`` (V,),
    and ``still_vertices`` (N, V, 3), the surfaces at rest in the same poses: as arrays of the
    ``.npz`` or zarr group, as ``.npy`` files of the folder; in an ``.h5`` those of each sequence in
    the group ``motion/<sequence>``. ``fps`` replaces the stored rate. Raises
    HabitusError with the file's name if the rate is missing or the data have another form.
    """
    paths = [path] if isinstance(path, str | Path) else list(path)
    if not paths:
        raise HabitusError("no registrations given; expected sequences of people in motion")
    return tuple(one for each in paths for one in _open(Path(each), fps, unit))


def _open(path: Path, rate_hz: float | None, unit: str) -> list[MovingSurface]:
    registrations = open_registrations(path, unit=unit)
    try:
        known = _known_of(path)
        return [
            _sequence(name, rows, registrations, known(name), rate_hz)
            for name, rows in _runs(registrations)
        ]
    except HabitusError as error:
        if path.name in str(error):
            raise
        raise HabitusError(f"{path}: {error}") from error


def _runs(registrations: Registrations) -> list[tuple[str, np.ndarray]]:
    """Names and rows of the sequences: frames that follow each other, of one person."""
    runs: list[tuple[str, list[int]]] = []
    before: tuple[str, str, int] | None = None
    for row, (name, subject) in enumerate(
        zip(registrations.name, registrations.subject, strict=True)
    ):
        parts = _FRAME.fullmatch(name)
        if parts is None:
            raise HabitusError(
                f"no frame number in the name {shown(name)}; expected names such as jump:17 "
                "or jump_0017"
            )
        here = (parts[1], subject, int(parts[2]))
        if before is None or here[:2] != before[:2] or here[2] != before[2] + 1:
            runs.append((parts[1], []))
        runs[-1][1].append(row)
        before = here
    return [(name, np.array(rows)) for name, rows in runs]


def _sequence(
    name: str,
    rows: np.ndarray,
    registrations: Registrations,
    known: KnownArrays,
    rate_hz: float | None,
) -> MovingSurface:
    known_arrays = {key: known[key] for key in _NUMBERS if known.get(key) is not None}
    own = known["rows"](rows)
    for key in ("betas", "pose", "trans"):
        if key in known_arrays:
            known_arrays[key] = _of_rows(
                key, np.asarray(known_arrays[key], np.float64), own, known["count"]
            )
    if "trans" in known_arrays and isinstance(registrations.vertices, ScaledVertices):
        known_arrays["trans"] = known_arrays["trans"] * registrations.vertices.factor[rows][:, None]
    rate = rate_hz or (
        float(np.asarray(known_arrays["rate_hz"]).ravel()[0]) if "rate_hz" in known_arrays else 0.0
    )
    if not 1.0 <= rate <= 1e5:
        raise HabitusError(
            f"the rate of {shown(name)} is {rate:g} Hz; give the frames per second: rate_hz, --fps"
        )
    ids = known_arrays.get("vertex_ids")
    return MovingSurface(
        name=name,
        subject=registrations.subject[int(rows[0])],
        rate_hz=rate,
        registrations=registrations.take(rows),
        betas=known_arrays.get("betas"),
        pose=known_arrays.get("pose"),
        trans=known_arrays.get("trans"),
        still=_still(known, own, registrations.vertices, rows),
        joint_names=known.get(_NAMES),
        vertex_ids=None if ids is None else np.asarray(ids, np.int64).ravel(),
    )


def _of_rows(key: str, array: np.ndarray, rows: np.ndarray, count: int) -> np.ndarray:
    """What an array tells of a sequence; betas, of which a person has one set, of its first
    frame.
    """
    if not np.isfinite(array).all():
        raise HabitusError(f"{key} holds numbers that are not finite; leave such frames out")
    if key == "betas" and array.ndim == 1:
        return array
    if len(array) != count:
        raise HabitusError(
            f"{key} has shape {array.shape} for {count} registrations; expected a row for each"
        )
    array = array[rows]
    if key == "betas":
        if np.ptp(array, axis=0).max(initial=0.0) > 1e-6:
            raise HabitusError("betas change within a sequence; expected one person's, who moves")
        return array[0]
    return array.reshape(len(array), -1, 3) if key == "pose" and array.shape[-1] % 3 == 0 else array


@dataclass(frozen=True, eq=False)
class _Still:
    """Surfaces at rest of the frames of a sequence: ``rows`` of others, in metres by a factor a
    frame.
    """

    source: Vertices
    rows: Int[np.ndarray, " T"]
    factor: Float[np.ndarray, " T"]

    @property
    def shape(self) -> tuple[int, ...]:
        return (len(self.rows), *self.source.shape[1:])

    def __getitem__(self, frame: Any) -> np.ndarray:
        return self.factor[frame] * np.asarray(self.source[int(self.rows[frame])], np.float64)


def _still(
    known: KnownArrays, own: np.ndarray, beside: Vertices, rows: np.ndarray
) -> _Still | None:
    source = known.get(_STILL)
    if source is None:
        return None
    if tuple(source.shape[1:]) != tuple(beside.shape[1:]) or own.max() >= source.shape[0]:
        raise HabitusError(
            f"{_STILL} have shape {tuple(source.shape)}; expected that of the vertices, "
            f"{tuple(beside.shape)}"
        )
    return _Still(
        source,
        own,
        beside.factor[rows] if isinstance(beside, ScaledVertices) else np.ones(len(rows)),
    )


def _known_of(path: Path) -> Callable[[str], KnownArrays]:
    """What a file states about each of its sequences, by name."""
    if path.suffix in (".h5", ".hdf5"):
        return lambda name: {**_known_in_h5(path, name), "rows": lambda rows: np.arange(len(rows))}
    if path.is_dir():
        zarr = (
            path.suffix == ".zarr" or (path / "zarr.json").exists() or (path / ".zgroup").exists()
        )
        known = _known_in_zarr(path) if zarr else _known_in_folder(path)
    else:
        known = _known_in_npz(path)
    return lambda name: {**known, "rows": lambda rows: rows}


def _known_in_npz(path: Path) -> dict[str, Any]:
    with open_file(path) as file:
        archive = NpzArchive(file)
        known: dict[str, Any] = {
            _key(name): archive.read(name)
            for name in archive.names
            if _key(name) in (*_NUMBERS, _NAMES)
        }
        if _STILL in archive:
            known[_STILL] = array_in_zip(path, archive, _STILL)
        return _in_words(known) | {"count": archive.header("vertices").shape[0]}


def _known_in_folder(path: Path) -> dict[str, Any]:
    files = {_key(file.stem): file for file in sorted(path.glob("*.npy"))}
    known: dict[str, Any] = {
        key: read_npy(files[key]) for key in (*_NUMBERS, _NAMES) if key in files
    }
    if _STILL in files:
        known[_STILL] = array_in_file(files[_STILL])
    rows = next((len(known[key]) for key in ("pose", "trans") if key in known), 0)
    return _in_words(known) | {"count": rows}


def _known_in_zarr(path: Path) -> dict[str, Any]:
    group = require_extra("zarr", "zarr folders").open_group(str(path), mode="r")
    allowance = Allowance(folder_bytes(path))
    names = [name for name in group if _key(name) in (*_NUMBERS, _NAMES)]
    known = {
        _key(name): np.asarray(zarr_array(group, path, name, allowance, whole=True)[...])
        for name in names
    }
    if _STILL in group:
        known[_STILL] = zarr_array(group, path, _STILL, allowance, whole=False)
    return _in_words(known) | {"count": group["vertices"].shape[0]}


def _known_in_h5(path: Path, sequence: str) -> dict[str, Any]:
    """Arrays of the group of a sequence; rate_hz, vertex_ids may stand in ``motion`` itself, for
    all.
    """
    known: dict[str, Any] = {}
    with require_extra("h5py", "HDF5 files").File(path, "r") as file:
        allowance = Allowance(path.stat().st_size)
        for place in (MOTION, f"{MOTION}/{sequence}"):
            for name in file.get(place, ()):
                if _key(name) in _NUMBERS:
                    known[_key(name)] = np.asarray(
                        h5_array(file, f"{place}/{name}", allowance, whole=True)[()]
                    )
        frames = file[sequence].shape[2]
    return known | {"count": frames}


def _key(name: str) -> str:
    return _SPELLINGS.get(name, name)


def _in_words(known: dict[str, Any]) -> dict[str, Any]:
    if _NAMES not in known:
        return known
    names = np.atleast_1d(checked_texts(known[_NAMES])).ravel().tolist()
    return known | {
        _NAMES: tuple(
            n.decode("utf-8", "replace") if isinstance(n, bytes) else str(n) for n in names
        )
    }
