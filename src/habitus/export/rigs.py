"""Rigs by name: the bones that other programs' retargeters expect, as tables in ``assets/rigs``.

A table names the bones of the SMPL family's joints, bones between two joints (``[between]``: from,
to, where along the way), bones at ends (``[tips]``), a bone on the floor (``root``), and how far
the arms hang below the horizontal at rest (``arms_down``, degrees). ``{side}`` and ``{Side}`` stand
for left and right, ``{s}`` for l and r, ``{k}`` for 1 to 3. They hold names alone, no assets.
"""

import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from itertools import product
from typing import Any

from habitus.errors import HabitusError, shown

RIGS = ("humanoid", "manny", "mixamo", "rokoko", "vrm")
_SIDES = (
    {"side": "left", "Side": "Left", "s": "l"},
    {"side": "right", "Side": "Right", "s": "r"},
)


@dataclass(frozen=True)
class Between:
    """A bone that moves with joint ``start``, at a fraction of the way to its child ``end``."""

    name: str
    start: str
    end: str
    fraction: float


@dataclass(frozen=True)
class Rig:
    """Bones by name. ``bones``: of joints; ``tips``: beyond joints; ``root``: on the floor."""

    name: str
    title: str
    root: str
    bones: Mapping[str, str]
    between: tuple[Between, ...] = ()
    tips: Mapping[str, str] | None = None
    arms_down: float = 0.0


def rig_named(name: str) -> Rig:
    """The rig of a table in ``assets/rigs``. Raises HabitusError for another name."""
    if name not in RIGS:
        raise HabitusError(f"rig is {shown(name)}; expected one of {', '.join(RIGS)}")
    return _read(name)


@cache
def _read(name: str) -> Rig:
    text = (files("habitus.assets") / "rigs" / f"{name}.toml").read_text(encoding="utf-8")
    table: dict[str, Any] = tomllib.loads(text)
    between = tuple(
        Between(name, start, end, float(row[2]))
        for bone, row in table.get("between", {}).items()
        for name, start, end in _expanded(bone, row[0], row[1])
    )
    return Rig(
        name,
        table["title"],
        table["root"],
        _names(table["bones"]),
        between,
        _names(table.get("tips", {})),
        float(table.get("arms_down", 0.0)),
    )


def _names(rows: Mapping[str, str]) -> dict[str, str]:
    return {joint: name for row in rows.items() for joint, name in _expanded(*row)}


def _expanded(*texts: str) -> Iterator[tuple[str, ...]]:
    """Texts with their placeholders filled, once for each combination that they name."""
    whole = "".join(texts).lower()
    sides = _SIDES if "{s" in whole else ({},)
    numbers = ("1", "2", "3") if "{k}" in whole else ("",)
    for side, k in product(sides, numbers):
        yield tuple(text.format(**side, k=k) for text in texts)
