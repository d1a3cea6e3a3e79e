"""Reads measurements of a person as pattern programs, SeamlyMe and `habitus measure` write them.

| file | written by | unit |
|---|---|---|
| .smis, .vit | SeamlyMe (Seamly2D), Tape (Valentina) | said in it |
| .yaml, .yml | GarmentCode: a table ``body`` | cm, degrees |
| .json | FreeSewing: its names, also within ``measurements`` or ``measies`` | mm, degrees |
| .json, .csv | `habitus measure` | m, kg, degrees |
"""

import csv
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from habitus.body.measurement_names import DEFINITIONS
from habitus.errors import HabitusError, shown
from habitus.io.limits import (
    MAX_DESCRIPTION_BYTES,
    MAX_NAMES,
    check_count,
    read_json,
    read_text_file,
    read_xml,
)
from habitus.io.measurement_names import FREESEWING, GARMENTCODE, SEAMLY, PatternProgram
from habitus.types import PathLike

_UNITS = {"mm": 0.001, "cm": 0.01, "inch": 0.0254}
_LINE = re.compile(r"(\s*)([A-Za-z_][A-Za-z0-9_]*)\s*:\s*([^#\s]*)\s*(?:#.*)?")
_MAX_NAME = 60
_EXPECTED = ".smis or .vit (Seamly2D, Valentina), .yaml (GarmentCode), .json (FreeSewing, habitus)"


@dataclass(frozen=True)
class MeasurementFile:
    """What a file says: ``values`` by our names (m, kg, degrees), and the program it is of.
    ``unused`` are names that no measurement of ours has, formulas among them. ``sex`` is "" where
    it is not said.
    """

    program: str
    values: Mapping[str, float]
    unused: tuple[str, ...] = ()
    sex: str = ""


def read_measurements(path: PathLike) -> MeasurementFile:
    """The measurements in a file. Zeros, which programs write for what was not taken, are left out.

    Raises HabitusError for a file that is none of these, and for one without any measurement.
    """
    source = Path(path)
    reader = {
        ".smis": _seamly,
        ".vit": _seamly,
        ".yaml": _garmentcode,
        ".yml": _garmentcode,
        ".json": _json,
        ".csv": _csv,
    }.get(source.suffix.lower())
    if reader is None:
        raise HabitusError(f"{path}: no file of measurements; expected {_EXPECTED} or .csv")
    try:
        found = reader(read_text_file(source, MAX_DESCRIPTION_BYTES))
    except OSError as error:
        raise HabitusError(
            f"{path}: {shown(error.strerror or error)}; expected a file of measurements"
        ) from error
    except UnicodeDecodeError as error:
        raise HabitusError(f"{path}: is no text; expected {_EXPECTED}") from error
    except HabitusError as error:
        raise HabitusError(f"{path}: {error}") from error
    if not found.values:
        unknown = f" ({', '.join(found.unused[:3])} are not known)" if found.unused else ""
        raise HabitusError(f"{path}: holds no measurement{unknown}; expected {_EXPECTED}")
    return found


def _seamly(text: str) -> MeasurementFile:
    root = read_xml(text)
    if root.tag in ("smms", "vst"):
        raise HabitusError(
            "is a table of several sizes; expected one person's: export a size as .smis or .vit"
        )
    if root.tag not in ("smis", "vit"):
        raise HabitusError(f"its root is {shown(root.tag, 40)}; expected smis or vit")
    unit = (root.findtext("unit") or "cm").strip()
    if unit not in _UNITS:
        raise HabitusError(f"its unit is {shown(unit, 40)}; expected mm, cm or inch")
    table = {m.get("name", ""): m.get("value", "") for m in root.iterfind("body-measurements/m")}
    sex = (root.findtext("personal/gender") or "").strip()
    found = _translated(table, SEAMLY, _UNITS[unit])
    sex = sex if sex in ("female", "male") else ""
    return MeasurementFile(found.program, found.values, found.unused, sex)


def _garmentcode(text: str) -> MeasurementFile:
    """The table that GarmentCode writes: a number a line. Anything else of YAML is refused."""
    table: dict[str, str] = {}
    for number, line in enumerate(text.splitlines(), 1):
        if not line.strip() or line.lstrip().startswith("#") or line.strip() == "---":
            continue
        match = _LINE.fullmatch(line)
        if match is None:
            raise HabitusError(f"line {number}: {shown(line.strip(), 40)}; expected NAME: NUMBER")
        _, name, value = match.groups()
        if value:
            table[name] = value
        elif name != "body":
            raise HabitusError(f"line {number}: {shown(name, 40)} has no number")
    skipped = {name for name in table if name.startswith("_") or name == "arm_pose_angle"}
    kept = {name: value for name, value in table.items() if name not in skipped}
    return _translated(kept, GARMENTCODE, GARMENTCODE.unit)


def _json(text: str) -> MeasurementFile:
    table = read_json(text)
    for key in ("measurements", "measies"):
        if isinstance(table, dict) and isinstance(table.get(key), dict):
            table = table[key]
    if not isinstance(table, dict):
        raise HabitusError("is no table; expected names with numbers")
    if any(name in DEFINITIONS for name in table):
        return _ours(table)
    return _translated(table, FREESEWING, FREESEWING.unit)


def _csv(text: str) -> MeasurementFile:
    try:
        rows = list(csv.DictReader(text.splitlines()))
    except csv.Error as error:
        raise HabitusError(shown(error, 120)) from error
    if rows and not {"name", "value"} <= rows[0].keys():
        raise HabitusError("its columns are not those of habitus measure; expected name and value")
    return _ours({str(row["name"]): row["value"] for row in rows})


def _ours(table: Mapping[str, Any]) -> MeasurementFile:
    program = PatternProgram("habitus", {name: name for name in DEFINITIONS}, 1.0, ())
    return _translated(table, program, 1.0)


def _translated(table: Mapping[str, Any], program: PatternProgram, unit: float) -> MeasurementFile:
    """The numbers of a table by our names; of two names for one measurement the first."""
    check_count(len(table), MAX_NAMES, "measurements")
    values: dict[str, float] = {}
    unused = []
    for name, said in table.items():
        ours = program.names.get(name)
        value = _number(said)
        if ours is None or value is None:
            unused.append(shown(name, _MAX_NAME))
            continue
        scale = unit if ours.endswith("_m") else 1.0
        if value > 0.0:
            values.setdefault(ours, scale * value)
    return MeasurementFile(program.title, values, tuple(unused))


def _number(said: Any) -> float | None:
    """A finite number; None for formulas, words and tables."""
    if isinstance(said, bool) or not isinstance(said, (int, float, str)):
        return None
    try:
        value = float(said)
    except (ValueError, OverflowError):
        return None
    return value if math.isfinite(value) and abs(value) < 1e6 else None
