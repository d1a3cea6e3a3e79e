"""The parameter section of a C3D file: groups of typed values, labels, and their subjects."""

import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from habitus.errors import HabitusError

BLOCK = 512
KEY = 0x50
PROCESSORS = {84: "intel", 85: "dec", 86: "mips"}
CHARACTER = -1
BYTE = 1
INTEGER = 2
REAL = 4


@dataclass(frozen=True)
class Header:
    """The first block: counts and places that the parameters repeat, more or less truthfully."""

    points: int
    analog_words: int
    first_frame: int
    last_frame: int
    scale: float
    data_block: int
    rate_hz: float


@dataclass(frozen=True)
class Parameter:
    """One parameter: its type code, its dimensions (Fortran order), its bytes."""

    kind: int
    shape: tuple[int, ...]
    data: bytes
    processor: str

    def numbers(self) -> np.ndarray:
        """The values as a flat array; integers come as unsigned 16 bits, as counts above 32,767
        need.
        """
        if self.kind == REAL:
            return reals(self.data, self.processor)
        if self.kind == INTEGER:
            return np.frombuffer(self.data, ">u2" if self.processor == "mips" else "<u2").astype(
                np.int64
            )
        return np.frombuffer(self.data, np.uint8).astype(np.int64)

    def texts(self) -> list[str]:
        """The values as texts without padding; empty where the parameter holds numbers."""
        if self.kind != CHARACTER:
            return []
        width = self.shape[0] if self.shape else 1
        if width == 0:
            return []
        rows = len(self.data) // width
        return [_text(self.data[i * width : (i + 1) * width]) for i in range(rows)]


@dataclass(frozen=True)
class Parameters:
    """All parameters by upper-case GROUP and NAME."""

    processor: str
    groups: Mapping[str, Mapping[str, Parameter]]

    def texts(self, group: str, name: str) -> list[str]:
        """The texts of one parameter; empty where it is absent."""
        parameter = self.groups.get(group, {}).get(name)
        return parameter.texts() if parameter else []

    def numbers(self, group: str, name: str) -> np.ndarray:
        """The numbers of one parameter as a flat array; empty where it is absent or holds text."""
        parameter = self.groups.get(group, {}).get(name)
        return parameter.numbers() if parameter and parameter.kind != CHARACTER else np.empty(0)

    def number(self, group: str, name: str) -> float | None:
        """The first number of one parameter where it is there and finite."""
        values = self.numbers(group, name)
        return float(values[0]) if values.size and np.isfinite(values[0]) else None


def reals(data: bytes | np.ndarray, processor: str) -> np.ndarray:
    """32-bit floats of the three kinds of machine that ever wrote C3D: Intel, DEC (VAX F) and
    SGI/MIPS.
    """
    if processor == "mips":
        return np.frombuffer(data, ">f4").astype(np.float32)
    if processor == "intel":
        return np.frombuffer(data, "<f4")
    words = np.frombuffer(data, "<u2").reshape(-1, 2).astype(np.uint32)
    with np.errstate(invalid="ignore"):  # signalling NaNs in damaged files
        return ((words[:, 0] << 16) | words[:, 1]).view(np.float32) / np.float32(4.0)


def read_parameters(content: bytes, name: str) -> tuple[Header, Parameters]:
    """The header and the parameters of a C3D file's bytes; ``name`` is what errors call the file.

    Raises HabitusError where the bytes are no C3D file.
    """
    start = _parameter_start(content, name)
    processor = PROCESSORS.get(content[start + 3], "")
    if not processor:
        raise HabitusError(
            f"{name}: its parameters name processor type {content[start + 3]}; expected 84 "
            "(Intel), 85 (DEC) or 86 "
            "(SGI/MIPS); the file is damaged, export it again"
        )
    return _header(content, processor), Parameters(
        processor, _groups(content, start + 4, processor)
    )


def _parameter_start(content: bytes, name: str) -> int:
    if not content:
        raise HabitusError(f"{name}: the file is empty (0 bytes); export or copy it again")
    if len(content) < 2 or content[1] != KEY:
        kind = "text" if _looks_like_text(content) else "something else"
        raise HabitusError(
            f"{name}: not a C3D file (its second byte is not 0x50; it looks like {kind}); give a "
            "C3D file"
        )
    for block in (content[0], 2):
        start = (block - 1) * BLOCK
        if block >= 2 and start + 4 <= len(content) and content[start + 3] in PROCESSORS:
            return start
    if len(content) < 2 * BLOCK:
        raise HabitusError(
            f"{name}: the file ends after {len(content)} bytes, before its parameters; copy or "
            "export it again"
        )
    start = (max(content[0], 2) - 1) * BLOCK
    if start + 4 > len(content):
        raise HabitusError(
            f"{name}: its parameter section should start at byte {start}, after the file's end; "
            "export it again"
        )
    return start


def _looks_like_text(content: bytes) -> bool:
    sample = content[:200]
    return all(byte in b"\t\r\n" or byte >= 32 for byte in sample)


def _header(content: bytes, processor: str) -> Header:
    block = content[:24].ljust(24, b"\0")
    order = ">" if processor == "mips" else "<"
    points, analog, first, last = struct.unpack_from(f"{order}4H", block, 2)
    (data_block,) = struct.unpack_from(f"{order}H", block, 16)
    scale = float(reals(block[12:16], processor)[0])
    rate = float(reals(block[20:24], processor)[0])
    return Header(points, analog, first, last, scale, data_block, rate)


def _groups(content: bytes, start: int, processor: str) -> dict[str, dict[str, Parameter]]:
    names: dict[int, str] = {}
    by_number: dict[int, dict[str, Parameter]] = {}
    for identity, name, parameter in _entries(content, start, processor):
        if parameter is None:
            names[identity] = name
        else:
            by_number.setdefault(identity, {}).setdefault(name, parameter)
    groups: dict[str, dict[str, Parameter]] = {}
    for identity, parameters in by_number.items():
        groups.setdefault(names.get(identity, f"#{identity}"), {}).update(parameters)
    return groups


def _entries(
    content: bytes, position: int, processor: str
) -> Iterator[tuple[int, str, Parameter | None]]:
    """Each group (parameter None) and parameter in file order, until the list ends or stops making
    sense.
    """
    order = ">h" if processor == "mips" else "<h"
    while position + 4 <= len(content):
        length = abs(struct.unpack_from("b", content, position)[0])
        identity = struct.unpack_from("b", content, position + 1)[0]
        link = position + 2 + length
        if length == 0 or link + 2 > len(content):
            return
        name = _text(content[position + 2 : link]).upper()
        (offset,) = struct.unpack_from(order, content, link)
        if identity < 0:
            yield -identity, name, None
        elif identity > 0:
            parameter = _parameter(content, link + 2, processor)
            if parameter is None:
                return
            yield identity, name, parameter
        if offset <= 0:
            return
        position = link + offset


def _parameter(content: bytes, position: int, processor: str) -> Parameter | None:
    if position + 2 > len(content):
        return None
    kind, dimensions = struct.unpack_from("bB", content, position)
    shape = tuple(content[position + 2 : position + 2 + dimensions])
    if kind not in (CHARACTER, BYTE, INTEGER, REAL) or len(shape) < dimensions or dimensions > 7:
        return None
    size = abs(kind)
    for extent in shape:
        size *= extent
    start = position + 2 + dimensions
    return (
        Parameter(kind, shape, content[start : start + size], processor)
        if start + size <= len(content)
        else None
    )


def _text(raw: bytes) -> str:
    raw = raw.split(b"\0", 1)[0].strip()
    try:
        return raw.decode("utf-8").strip()
    except UnicodeDecodeError:
        return raw.decode("latin-1").strip()


_HEIGHT = ("HEIGHT", "BODYHEIGHT", "BODY HEIGHT")
_MASS = ("BODYMASS", "BODY MASS", "MASS", "WEIGHT", "BODYWEIGHT")
_DIAMETER = ("MARKER_DIAMETER", "MARKER DIAMETER", "MARKERDIAMETER", "MARKER_DIA")
_SEX = ("SEX", "GENDER")
_AGE = ("AGE", "AGE_YEARS")
_GROUPS = ("PROCESSING", "SUBJECT", "SUBJECTS", "SEG", "ANALYSIS")


def subject_names(parameters: Parameters) -> tuple[str, ...]:
    """The names the file gives its subjects, in its order."""
    names = parameters.texts("SUBJECTS", "NAMES") or parameters.texts("SUBJECT", "NAME")
    return tuple(name for name in names if name.isprintable() and name)


def recorded_values(parameters: Parameters) -> dict[str, float | str]:
    """height_m, mass_kg, marker_diameter_m, age_years and sex, as far as the file records them and
    they make sense of a person.
    """
    values: dict[str, float | str] = {}
    height = _first(parameters, _HEIGHT)
    mass = _first(parameters, _MASS)
    diameter = _first(parameters, _DIAMETER)
    if height is not None and (metres := _metres(height, 0.4, 2.6)) is not None:
        values["height_m"] = metres
    if mass is not None and 5.0 <= mass <= 350.0:
        values["mass_kg"] = round(mass, 3)
    if diameter is not None and (metres := _metres(diameter, 0.0015, 0.06)) is not None:
        values["marker_diameter_m"] = metres
    elif (radius := _first(parameters, ("TARGET_RADIUS",))) and 0.001 <= radius <= 0.03:
        values["marker_diameter_m"] = round(2 * radius, 6)
    age = _first(parameters, _AGE)
    if age is not None and 1.0 <= age <= 120.0:
        values["age_years"] = round(age, 3)
    sex = _sex(parameters)
    if sex:
        values["sex"] = sex
    return values


def _first(parameters: Parameters, names: tuple[str, ...]) -> float | None:
    for group in _GROUPS:
        for name in names:
            value = parameters.number(group, name)
            if value is not None and value > 0:
                return value
    return None


def _metres(value: float, least: float, most: float) -> float | None:
    """The value in metres, whichever of m, cm, mm makes it lie between ``least`` and ``most``."""
    for factor in (1.0, 0.01, 0.001):
        if least <= value * factor <= most:
            return round(value * factor, 6)
    return None


def _sex(parameters: Parameters) -> str | None:
    for group in _GROUPS:
        for name in _SEX:
            for text in parameters.texts(group, name):
                word = text.lower()
                if word in ("f", "female", "woman", "w"):
                    return "female"
                if word in ("m", "male", "man"):
                    return "male"
    return None
