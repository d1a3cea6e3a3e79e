"""C3D files: reading the points of one, and writing a capture as one.

Reading is our own (see c3d_parameters): only the points are touched, so hours of analog channels
cost nothing, and no count in a damaged file can ask for more memory than the file has bytes.
Writing is ezc3d's.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from habitus.errors import HabitusError
from habitus.io.captures.c3d_parameters import (
    BLOCK,
    Header,
    Parameters,
    read_parameters,
    reals,
    recorded_values,
    subject_names,
)
from habitus.io.captures.points import RawPoints
from habitus.parallel.blocks import mapped
from habitus.rotations import signed_axis

NOT_MARKERS = ("ANGLES", "FORCES", "MOMENTS", "POWERS", "SCALARS", "MODELED_MARKERS", "REACTIONS")


@dataclass(frozen=True)
class DataPlace:
    """Where the frames lie and how they are laid out."""

    start: int
    points: int
    analog_words: int
    frames: int
    scale: float

    @property
    def word(self) -> int:
        """Bytes of one value: 4 where the scale is negative (real numbers), 2 otherwise
        (integers).
        """
        return 4 if self.scale < 0 else 2

    @property
    def stride(self) -> int:
        """Bytes of one frame: four values a point, then the analog samples."""
        return self.word * (4 * self.points + self.analog_words)


def parse_c3d(content: bytes, name: str) -> RawPoints:
    """The points of a C3D file's bytes; ``name`` is what errors call the file.

    Raises HabitusError where the bytes are no C3D file or hold no point trajectories.
    """
    header, parameters = read_parameters(content, name)
    place = _data_place(header, parameters, len(content))
    _refuse_pointless(place, header, parameters, name)
    available = max(0, (len(content) - place.start) // place.stride)
    warnings = []
    if available == 0:
        raise HabitusError(
            f"{name}: its frames should start at byte {place.start} but the file has "
            f"{len(content)} bytes; "
            "it was cut off, copy it again"
        )
    if available < place.frames:
        warnings.append(f"the file ends early: {available} of {place.frames} frames are in it")
    points = _read_frames(content, place, min(place.frames, available), parameters.processor)
    labels, label_warnings = _labels(parameters, place.points)
    rate, rate_warnings = _rate(header, parameters)
    up = parameters.texts("POINT", "Y_SCREEN")
    return RawPoints(
        format="c3d",
        labels=labels,
        points=points,
        rate_hz=rate,
        unit=next((unit for unit in parameters.texts("POINT", "UNITS") if unit), None),
        up_claim=signed_axis(up[0]) if up else None,
        up_source="POINT:Y_SCREEN",
        groups=_groups(parameters),
        subjects=subject_names(parameters),
        recorded=recorded_values(parameters),
        warnings=(*warnings, *label_warnings, *rate_warnings),
    )


def find_data(content: bytes, name: str) -> tuple[DataPlace, Header, Parameters]:
    """Where the frames of a C3D file's bytes lie, with points or without, its header and its
    parameters.
    """
    header, parameters = read_parameters(content, name)
    place = _data_place(header, parameters, len(content))
    available = max(0, (len(content) - place.start) // max(1, place.stride))
    return replace(place, frames=min(place.frames, available)), header, parameters


def find_points(content: bytes, name: str) -> tuple[DataPlace, str]:
    """Where the points of a C3D file's bytes lie, as `parse_c3d` reads them, and the processor that
    wrote them.
    """
    place, header, parameters = find_data(content, name)
    _refuse_pointless(place, header, parameters, name)
    return place, parameters.processor


def _refuse_pointless(place: DataPlace, header: Header, parameters: Parameters, name: str) -> None:
    if place.points == 0:
        channels = int(parameters.number("ANALOG", "USED") or header.analog_words)
        rotations = int(parameters.number("ROTATION", "USED") or 0)
        others = [f"{channels} analog channels (EMG, force plates)"] * bool(channels)
        others += [f"{rotations} segment rotations"] * bool(rotations)
        held = f"only {' and '.join(others)}" if others else "no data of another kind either"
        raise HabitusError(
            f"{name}: holds no marker trajectories (0 points), {held}; give a capture with markers"
        )
    if place.frames <= 0:
        raise HabitusError(f"{name}: holds {place.points} points but 0 frames; export it again")


def _data_place(header: Header, parameters: Parameters, size: int) -> DataPlace:
    """The layout that fits the file's size, where header and parameters disagree; the header's
    first of all.
    """
    starts = _distinct(header.data_block, parameters.number("POINT", "DATA_START"), least=2)
    counts = _distinct(header.points, parameters.number("POINT", "USED"), least=0)
    analog = _distinct(header.analog_words, _analog_words(header, parameters), least=0)
    scales = [
        s for s in (header.scale, parameters.number("POINT", "SCALE")) if s and np.isfinite(s)
    ]
    frames = _frame_counts(header, parameters)
    best: tuple[float, DataPlace] | None = None
    choices = product(starts or [3], counts or [0], analog or [0], frames or [0], scales or [-1.0])
    for start, count, words, length, scale in choices:
        place = DataPlace((start - 1) * BLOCK, count, words, length, scale)
        spare = size - place.start - place.frames * place.stride
        misfit = 0.0 if 0 <= spare < 2 * BLOCK else abs(spare)
        if best is None or misfit < best[0]:
            best = misfit, place
    assert best is not None
    return best[1]


def _distinct(*values: float | None, least: int) -> list[int]:
    whole = [int(value) for value in values if value is not None and value >= least]
    return list(dict.fromkeys(whole))


def _analog_words(header: Header, parameters: Parameters) -> float | None:
    used = parameters.number("ANALOG", "USED")
    rate = parameters.number("ANALOG", "RATE")
    frame_rate = parameters.number("POINT", "RATE") or header.rate_hz
    if used is None or rate is None or not frame_rate or not frame_rate > 0:
        return None
    return used * max(1, round(min(rate / frame_rate, 1e4)))


def _frame_counts(header: Header, parameters: Parameters) -> list[int]:
    """Every claim about the number of frames, the widest field first: the older ones stop at
    65,535.
    """
    first = parameters.numbers("TRIAL", "ACTUAL_START_FIELD")
    last = parameters.numbers("TRIAL", "ACTUAL_END_FIELD")
    trial = _wide(last) - _wide(first) + 1 if first.size and last.size else None
    return _distinct(
        trial,
        parameters.number("POINT", "LONG_FRAMES"),
        parameters.number("POINT", "FRAMES"),
        header.last_frame - header.first_frame + 1,
        least=1,
    )


def _wide(words: np.ndarray) -> float:
    return float(words[0] + (words[1] * 65536 if words.size > 1 else 0))


def _read_frames(content: bytes, place: DataPlace, frames: int, processor: str) -> np.ndarray:
    """(T, N, 3) float64 in the file's unit; NaN where the residual is negative."""
    block = np.frombuffer(content, np.uint8, frames * place.stride, place.start).reshape(
        frames, place.stride
    )
    return mapped(lambda rows: _points(rows, place, processor), block)


def _points(block: np.ndarray, place: DataPlace, processor: str) -> np.ndarray:
    """The same of the bytes of some frames (T, stride)."""
    frames = len(block)
    block = np.ascontiguousarray(block[:, : 4 * place.points * place.word])
    if place.word == 4:
        values = reals(block.reshape(-1), processor).reshape(frames, place.points, 4)
        with np.errstate(invalid="ignore"):  # signalling NaNs in damaged files
            points = values[..., :3].astype(np.float64)
            flags = values[..., 3]
    else:
        values = np.frombuffer(block, ">i2" if processor == "mips" else "<i2").reshape(
            frames, place.points, 4
        )
        points = values[..., :3] * place.scale
        flags = values[..., 3]
    points[flags < 0] = np.nan
    return points


def _labels(parameters: Parameters, count: int) -> tuple[tuple[str, ...], list[str]]:
    labels: list[str] = []
    for name in _numbered(parameters, "LABELS"):
        labels += parameters.texts("POINT", name)
    labels = labels[: max(count, len(labels))]
    if len(labels) >= count:
        extra = [label for label in labels[count:] if label]
        warnings = [f"{len(extra)} labels without points are left out"] if extra else []
        return tuple(labels[:count]), warnings
    warning = (
        f"{count} points but {len(labels)} labels: the last {count - len(labels)} points "
        "are unlabelled"
    )
    return (*labels, *(f"*{i}" for i in range(len(labels), count))), [warning]


def _numbered(parameters: Parameters, name: str) -> Iterator[str]:
    """NAME, NAME2, NAME3, … as far as they go: one parameter holds 255 texts at most."""
    names = parameters.groups.get("POINT", {})
    yield from (text for text in (name, *(f"{name}{i}" for i in range(2, 100))) if text in names)


def _groups(parameters: Parameters) -> dict[str, str]:
    return {
        label: group
        for group in (*NOT_MARKERS, *parameters.texts("POINT", "TYPE_GROUPS")[::2])
        for name in _numbered(parameters, group)
        for label in parameters.texts("POINT", name)
        if label
    }


def _rate(header: Header, parameters: Parameters) -> tuple[float | None, list[str]]:
    claims = [
        parameters.number("POINT", "RATE"),
        header.rate_hz,
        parameters.number("TRIAL", "CAMERA_RATE"),
    ]
    good = [rate for rate in claims if rate is not None and 0.1 < rate < 1e5]
    if not good:
        return None, []
    differ = abs(good[0] - good[-1]) > 0.01 * good[0]
    return good[0], [
        f"the file names two rates, {good[0]:g} and {good[-1]:g} Hz; {good[0]:g} Hz is used"
    ] if differ else []
