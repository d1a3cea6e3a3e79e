"""Markers in numpy archives: habitus' own, those of AMASS, MoSh++ and SOMA. Nothing pickled is ever loaded."""

import io
import struct
import zipfile
import zlib
from collections.abc import Mapping

import numpy as np

from habitus.errors import HabitusError
from habitus.io.captures.points import RawPoints
from habitus.io.captures.tables import number_of

_POINTS = ("markers", "observed_markers", "markers_obs", "points", "marker_data", "positions")
_LABELS = ("labels", "marker_labels", "labels_obs", "marker_names", "names")
_RATES = ("rate_hz", "frame_rate", "mocap_framerate", "mocap_frame_rate", "framerate", "fps", "rate", "freq")
_UNITS = ("unit", "units", "length_unit", "markers_unit")
_MOST_BYTES = 1 << 30
# What zipfile, zlib and numpy raise for damaged archives; UnicodeDecodeError is a ValueError, BadZipFile an Exception.
_DAMAGE = (
    zipfile.BadZipFile,
    zlib.error,
    ValueError,
    LookupError,
    OSError,
    EOFError,
    RuntimeError,
    MemoryError,
    SyntaxError,
    TypeError,
    ArithmeticError,
    struct.error,
)


def parse_npz(content: bytes, name: str) -> RawPoints:
    """The points of an archive's bytes: an array (T, M, 3) of markers, their labels (M,), a frame rate.

    Labels may also be (T, M), one set a frame. Raises HabitusError where these are absent, do not fit together, or are
    pickled.
    """
    arrays = _Arrays(content, name)
    points = arrays.find(_POINTS)
    if points is None:
        raise HabitusError(
            f"{name}: holds no markers (it holds {', '.join(arrays.names) or 'nothing'}); expected 'markers' (T, M, 3)"
        )
    if points.ndim != 3 or 3 not in points.shape[2:] or points.dtype.kind not in "fiu":
        raise HabitusError(f"{name}: its markers are {points.dtype} {points.shape}; expected numbers (T, M, 3)")
    texts, points = _labelled(arrays, points, name)
    if points.size == 0:
        raise HabitusError(
            f"{name}: holds {points.shape[0]} frames of {points.shape[1]} markers; give a capture with markers"
        )
    rate, unit, up = arrays.find(_RATES), arrays.find(_UNITS), arrays.find(("up_axis",))
    axis = _one(up)
    return RawPoints(
        format="npz",
        labels=tuple(texts),
        points=points.astype(np.float64),
        rate_hz=number_of(_one(rate)),
        unit=_one(unit),
        up_claim=axis if axis in ("+x", "+y", "+z", "-x", "-y", "-z") else None,
        up_source="up_axis",
        subjects=tuple(filter(None, [_one(arrays.find(("subject",)))])),
        recorded=_recorded(arrays),
    )


def _labelled(arrays: "_Arrays", points: np.ndarray, name: str) -> tuple[list[str], np.ndarray]:
    """One label a column; fillers where the archive has none."""
    labels = arrays.find(_LABELS)
    if labels is None:
        texts = [f"*{i}" for i in range(points.shape[1])]
    elif labels.dtype.kind not in "US":
        raise HabitusError(f"{name}: its labels are {labels.dtype}; expected an array of texts")
    elif labels.shape == points.shape[:2]:
        texts, points = _by_label(_texts(labels), points)
    else:
        texts = _texts(labels).reshape(-1).tolist()
    if len(texts) != points.shape[1]:
        raise HabitusError(
            f"{name}: holds {points.shape[1]} markers but {len(texts)} labels; expected one label a marker"
        )
    return texts, points


class _Arrays:
    """The arrays of an archive, each checked against its own size before memory is asked for."""

    def __init__(self, content: bytes, name: str) -> None:
        self.file = name
        try:
            self._zip = zipfile.ZipFile(io.BytesIO(content))
        except _DAMAGE:
            raise HabitusError(f"{name}: not a numpy archive, or damaged; save it again with numpy.savez") from None
        self.names = [info.filename.removesuffix(".npy") for info in self._zip.infolist()]

    def find(self, names: tuple[str, ...]) -> np.ndarray | None:
        """The first of these arrays that is there."""
        name = next((name for name in names if name in self.names), None)
        if name is None:
            return None
        try:
            return self._read(name)
        except HabitusError:
            raise
        except _DAMAGE as error:
            reason = str(error).splitlines()[0] if str(error) else type(error).__name__
            raise HabitusError(f"{self.file}: its array {name!r} cannot be read ({reason}); save it again") from None

    def _read(self, name: str) -> np.ndarray:
        entry = next(info for info in self._zip.infolist() if info.filename.removesuffix(".npy") == name)
        with self._zip.open(entry) as stream:
            version = np.lib.format.read_magic(stream)
            reader = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
            shape, _, dtype = reader(stream)
        if dtype.hasobject:
            raise HabitusError(
                f"{self.file}: {name!r} is a pickled object, which could run code; save it as a plain array"
            )
        size = dtype.itemsize * int(np.prod(shape, dtype=object))
        if size > _MOST_BYTES:
            raise HabitusError(f"{self.file}: {name!r} would fill {size} bytes; expected at most {_MOST_BYTES}; cut it")
        if size > entry.file_size:
            raise HabitusError(f"{self.file}: {name!r} claims {size} bytes, has {entry.file_size}; the file is damaged")
        with self._zip.open(entry) as stream:
            return np.lib.format.read_array(stream, allow_pickle=False)


def _texts(labels: np.ndarray) -> np.ndarray:
    return np.char.decode(labels, "utf-8", "replace") if labels.dtype.kind == "S" else labels


def _one(value: np.ndarray | None) -> str | None:
    """A scalar array as text."""
    if value is None or value.size != 1 or value.dtype.kind not in "USfiu":
        return None
    return str(_texts(value).reshape(-1)[0]).strip() or None


def _by_label(labels: np.ndarray, points: np.ndarray) -> tuple[list[str], np.ndarray]:
    """Points whose columns change their label from frame to frame, sorted into one column a label."""
    names = sorted({str(label) for label in labels.reshape(-1)})
    sorted_points = np.full((len(points), len(names), 3), np.nan)
    for i, name in enumerate(names):
        frames, columns = np.nonzero(labels == name)
        sorted_points[frames[::-1], i] = points[frames[::-1], columns[::-1]]
    return names, sorted_points


def _recorded(arrays: _Arrays) -> Mapping[str, float | str]:
    found: dict[str, float | str] = {}
    for name in ("height_m", "mass_kg", "marker_diameter_m"):
        value = number_of(_one(arrays.find((name,))))
        if value is not None and value > 0:
            found[name] = value
    sex = _one(arrays.find(("sex", "gender")))
    if sex in ("female", "male"):
        found["sex"] = sex
    return found
