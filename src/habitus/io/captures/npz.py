"""Markers in numpy archives: habitus' own, those of AMASS, MoSh++ and SOMA. Nothing pickled is ever
loaded.
"""

from collections.abc import Mapping

import numpy as np

from habitus.errors import HabitusError, shown
from habitus.io.archives import NpzArchive
from habitus.io.captures.points import RawPoints
from habitus.io.captures.tables import number_of
from habitus.rotations import signed_axis

_POINTS = ("markers", "observed_markers", "markers_obs", "points", "marker_data", "positions")
_LABELS = ("labels", "marker_labels", "labels_obs", "marker_names", "names")
_RATES = (
    "rate_hz",
    "frame_rate",
    "mocap_framerate",
    "mocap_frame_rate",
    "framerate",
    "fps",
    "rate",
    "freq",
)
_UNITS = ("unit", "units", "length_unit", "markers_unit")


def parse_npz(content: bytes, name: str) -> RawPoints:
    """The points of an archive's bytes: an array (T, M, 3) of markers, their labels (M,), a frame
    rate.

    Labels may also be (T, M), one set a frame. Raises HabitusError where these are absent, do not
    fit together, or are pickled.
    """
    try:
        return _raw(NpzArchive(content))
    except HabitusError as error:
        raise HabitusError(f"{name}: {error}") from error


def _raw(arrays: NpzArchive) -> RawPoints:
    points = _find(arrays, _POINTS)
    if points is None:
        raise HabitusError(
            f"holds no markers (it has {shown(', '.join(arrays.names)) or 'nothing'}); expected "
            "'markers' (T, M, 3)"
        )
    if points.ndim != 3 or 3 not in points.shape[2:] or points.dtype.kind not in "fiu":
        raise HabitusError(
            f"its markers are {points.dtype} {points.shape}; expected numbers (T, M, 3)"
        )
    texts, points = _labelled(arrays, points)
    if points.size == 0:
        raise HabitusError(
            f"holds {points.shape[0]} frames of {points.shape[1]} markers; give a capture with "
            "markers"
        )
    rate = _find(arrays, _RATES)
    unit = _find(arrays, _UNITS)
    up = _find(arrays, ("up_axis",))
    return RawPoints(
        format="npz",
        labels=tuple(texts),
        points=points.astype(np.float64, copy=False),
        rate_hz=number_of(_text(rate)),
        unit=_text(unit),
        up_claim=signed_axis(_text(up)),
        up_source="up_axis",
        subjects=tuple(filter(None, [_text(_find(arrays, ("subject",)))])),
        recorded=_recorded(arrays),
    )


def _labelled(arrays: NpzArchive, points: np.ndarray) -> tuple[list[str], np.ndarray]:
    """One label a column; fillers where the archive has none."""
    labels = _find(arrays, _LABELS)
    if labels is None:
        texts = [f"*{i}" for i in range(points.shape[1])]
    elif labels.dtype.kind not in "US":
        raise HabitusError(f"its labels are {labels.dtype}; expected an array of texts")
    elif labels.shape == points.shape[:2]:
        texts, points = _by_label(_texts(labels), points)
    else:
        texts = _texts(labels).reshape(-1).tolist()
    if len(texts) != points.shape[1]:
        raise HabitusError(
            f"holds {points.shape[1]} markers but {len(texts)} labels; expected one label a marker"
        )
    return texts, points


def _find(arrays: NpzArchive, names: tuple[str, ...]) -> np.ndarray | None:
    """The first of these arrays that is there."""
    name = next((name for name in names if name in arrays), None)
    return None if name is None else arrays.read(name)


def _texts(labels: np.ndarray) -> np.ndarray:
    return np.char.decode(labels, "utf-8", "replace") if labels.dtype.kind == "S" else labels


def _text(value: np.ndarray | None) -> str | None:
    """A scalar array as text."""
    if value is None or value.size != 1 or value.dtype.kind not in "USfiu":
        return None
    return str(_texts(value).reshape(-1)[0]).strip() or None


def _by_label(labels: np.ndarray, points: np.ndarray) -> tuple[list[str], np.ndarray]:
    """Points whose columns change their label from frame to frame, sorted into one column a
    label.
    """
    names, which = np.unique(labels, return_inverse=True)
    if len(names) > 10 * labels.shape[1] + 100:
        raise HabitusError(
            f"its labels (T, M) name {len(names)} markers for {labels.shape[1]} columns; expected "
            "one set a frame"
        )
    which = which.reshape(labels.shape)
    sorted_points = np.full((len(points), len(names), 3), np.nan)
    for column in reversed(range(labels.shape[1])):
        sorted_points[np.arange(len(points)), which[:, column]] = points[:, column]
    return [str(name) for name in names], sorted_points


def _recorded(arrays: NpzArchive) -> Mapping[str, float | str]:
    values: dict[str, float | str] = {}
    for name in ("height_m", "mass_kg", "marker_diameter_m", "age_years"):
        value = number_of(_text(_find(arrays, (name,))))
        if value is not None and value > 0:
            values[name] = value
    sex = _text(_find(arrays, ("sex", "gender")))
    if sex in ("female", "male"):
        values["sex"] = sex
    return values
