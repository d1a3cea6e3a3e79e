"""Writes measurements as pattern programs read them (`habitus.io.measurement_names`): GarmentCode's
YAML, SeamlyMe's .smis and .vit, FreeSewing's JSON.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from xml.etree import ElementTree

from habitus.errors import HabitusError
from habitus.files import write_text
from habitus.io.measurement_names import FREESEWING, GARMENTCODE, PROGRAMS
from habitus.types import PathLike

_VERSIONS = {".smis": "0.3.4", ".vit": "0.3.3"}
_ARM_POSE = 0.0
"""Degrees of the arms of a body at rest below the level, which GarmentCode wants to know."""


def program_of(path: PathLike) -> str:
    """The pattern program that a file is for, by its ending; "" where its ending says nothing."""
    ending = Path(path).suffix.lower()
    names = [name for name, each in PROGRAMS.items() if ending in each.endings]
    return names[0] if names and ending != ".json" else ""


def write_measurements(
    values: Mapping[str, float], path: PathLike, program: str, sex: str = ""
) -> tuple[str, ...]:
    """Write measurements (m, kg, degrees, by our names) for a pattern program: "garmentcode",
    "seamly" or "freesewing". sex: "female", "male", or "" where it is not known.

    Returns the program's names that are not among them. Raises HabitusError for another program or
    ending, and where there is nothing to write.
    """
    target = Path(path)
    if program not in PROGRAMS:
        raise HabitusError(f"format is {program!r}; expected one of {', '.join(PROGRAMS)}")
    known = PROGRAMS[program]
    ending = target.suffix.lower()
    if ending not in known.endings:
        raise HabitusError(
            f"cannot write {target.name} for {known.title}: expected a name in "
            f"{', '.join(known.endings)}"
        )
    table = {
        name: values[ours] / (known.unit if ours.endswith("_m") else 1.0)
        for name, ours in known.names.items()
        if ours in values
    }
    if len(table) < 2:
        raise HabitusError(f"nothing to write for {known.title}; expected a body that has tapes")
    if known is GARMENTCODE:
        text = _garmentcode(table)
    else:
        text = _freesewing(table) if known is FREESEWING else _seamly(table, ending, sex)
    write_text(target, text)
    return tuple(name for name in known.names if name not in table)


def _garmentcode(table: Mapping[str, float]) -> str:
    rows = {**table, "arm_pose_angle": _ARM_POSE}
    return "body:\n" + "".join(f"  {name}: {rows[name]:.4f}\n" for name in sorted(rows))


def _freesewing(table: Mapping[str, float]) -> str:
    settings = {"units": "metric", "measurements": {n: round(v, 2) for n, v in table.items()}}
    return json.dumps(settings, indent=2) + "\n"


def _seamly(table: Mapping[str, float], ending: str, sex: str) -> str:
    root = ElementTree.Element(ending[1:])
    texts = (("version", _VERSIONS[ending]), ("read-only", "false"), ("notes", ""),
             ("unit", "cm"), ("pm_system", "998"))  # fmt: skip
    for name, text in texts:
        ElementTree.SubElement(root, name).text = text
    personal = ElementTree.SubElement(root, "personal")
    who = (("family-name", ""), ("given-name", ""), ("birth-date", "1800-01-01"),
           ("gender", sex or "unknown"), ("email", ""))  # fmt: skip
    for name, text in who:
        ElementTree.SubElement(personal, name).text = text
    rows = ElementTree.SubElement(root, "body-measurements")
    for name, value in table.items():
        ElementTree.SubElement(rows, "m", name=name, value=f"{value:.2f}")
    ElementTree.indent(root, "    ")
    head = '<?xml version="1.0" encoding="UTF-8"?>\n'
    return head + ElementTree.tostring(root, "unicode") + "\n"
