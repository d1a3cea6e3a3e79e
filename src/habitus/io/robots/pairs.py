"""Tables of which link of a robot is which segment of a body: TOML files, some of them shipped."""

from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from habitus.body.robot import Robot
from habitus.errors import HabitusError, listed, shown
from habitus.fit.retarget.robot_pairs import (
    DIRECTIONS,
    SEGMENTS,
    Capsule,
    RobotPairs,
    Segment,
    Sole,
)
from habitus.io.layouts.toml import sides
from habitus.io.limits import MAX_DESCRIPTION_BYTES, read_text_file, read_toml
from habitus.types import PathLike

TABLES = ("segments", "soles", "capsules")
MOST = 1.0  # metres from a link's origin


def shipped_pairs() -> list[str]:
    """Names of the tables that come with the package."""
    folder = resources.files("habitus.assets") / "robots"
    return sorted(entry.name[:-5] for entry in folder.iterdir() if entry.name.endswith(".toml"))


def read_pairs(source: PathLike) -> RobotPairs:
    """A table of pairs: the name of a shipped one, or a TOML file. Raises HabitusError."""
    if str(source) in shipped_pairs():
        file = resources.files("habitus.assets") / "robots" / f"{source}.toml"
        return _pairs(read_toml(file.read_text("utf-8")), str(source))
    path = Path(source)
    try:
        table = read_toml(read_text_file(path, MAX_DESCRIPTION_BYTES), MAX_DESCRIPTION_BYTES)
        return _pairs(table, path.stem)
    except OSError as error:
        raise HabitusError(
            f"{path}: {shown(error.strerror or error)}; expected a table of pairs (TOML) or one of "
            f"{listed(shipped_pairs())}"
        ) from error
    except (HabitusError, UnicodeDecodeError) as error:
        raise HabitusError(f"{path}: {shown(error, 200)}") from error


def pairs_for(robot: Robot) -> RobotPairs:
    """The shipped table all of whose links the robot has. Raises HabitusError where none fits."""
    for name in shipped_pairs():
        pairs = read_pairs(name)
        if not pairs.missing(robot):
            return pairs
    raise HabitusError(
        f"no shipped table fits the robot {robot.name} (there are {listed(shipped_pairs())}); "
        "write one of 20 lines and give it with --pairs (docs/robots.md)"
    )


def _pairs(table: dict[str, Any], name: str) -> RobotPairs:
    unknown = sorted(set(table) - {*TABLES, "name", "title", "velocity"})
    if unknown:
        raise HabitusError(f"{shown(unknown[0])}: unknown; expected {listed(TABLES)} or velocity")
    parts = {kind: _both_sides(table.get(kind, {}), kind) for kind in TABLES}
    for segment in parts["segments"]:
        if segment not in SEGMENTS:
            raise HabitusError(
                f"segments.{shown(segment)}: unknown; expected {listed(SEGMENTS, 20)}"
            )
    if set(parts["soles"]) != {"left", "right"}:
        raise HabitusError("soles: expected a left and a right one")
    velocity = table.get("velocity", np.inf)
    if not isinstance(velocity, int | float) or not velocity > 0:
        raise HabitusError(f"velocity = {shown(velocity)}; expected rad/s above 0")
    return RobotPairs(
        name=shown(table.get("name", name)),
        segments={
            key: _segment(f"segments.{key}", given) for key, given in parts["segments"].items()
        },
        soles=(_sole("left", parts["soles"]["left"]), _sole("right", parts["soles"]["right"])),
        capsules={
            key: _capsule(f"capsules.{key}", given) for key, given in parts["capsules"].items()
        },
        velocity=float(velocity),
    )


def _both_sides(table: Any, kind: str) -> dict[str, dict[str, Any]]:
    """Entries with "[left|right]" in their keys once for each side: names take their side's word,
    and y of places and directions changes its sign on the right.
    """
    if not isinstance(table, dict) or not all(isinstance(each, dict) for each in table.values()):
        raise HabitusError(f"{kind}: expected tables such as torso = {{ link = ... }}")
    out = {}
    for key, given in table.items():
        for side, name in enumerate(sides(key)):
            out[name] = {part: _on_side(value, side) for part, value in given.items()}
    return out


def _on_side(value: Any, side: int) -> Any:
    """A name by its side's word, a place or direction with y of the other sign on the right."""
    if isinstance(value, str):
        return sides(value)[min(side, len(sides(value)) - 1)]
    if side and isinstance(value, list):
        if len(value) == 3 and not any(isinstance(each, list) for each in value):
            x, y, z = value
            return [x, -y if isinstance(y, int | float) else y, z]
        return [_on_side(each, side) for each in value]
    return value


def _segment(where: str, given: dict[str, Any]) -> Segment:
    _check_keys(where, given, ("link", "weight", *DIRECTIONS))
    directions = {}
    for kind in DIRECTIONS:
        if kind in given:
            way = _places(where, kind, [given[kind]])[0]
            length = float(np.linalg.norm(way))
            if not length > 1e-6:
                raise HabitusError(f"{where}.{kind}: no direction")
            directions[kind] = way / length
    if not directions:
        raise HabitusError(f"{where}: no direction; expected one of {listed(DIRECTIONS)}")
    if "along" in directions and SEGMENTS[where.partition(".")[2]][1] is None:
        raise HabitusError(f"{where}.along: this segment has no end; expected up, left or forward")
    weight = given.get("weight", 1.0)
    if not isinstance(weight, int | float) or not 0.0 <= weight < 1e6:
        raise HabitusError(f"{where}.weight = {shown(weight)}; expected a number from 0")
    return Segment(_link(where, given), directions, float(weight))


def _sole(side: str, given: dict[str, Any]) -> Sole:
    where = f"soles.{side}"
    _check_keys(where, given, ("link", "heel", "toes"))
    heel = _places(where, "heel", given.get("heel"))
    return Sole(_link(where, given), heel, _places(where, "toes", given.get("toes")))


def _capsule(where: str, given: dict[str, Any]) -> Capsule:
    _check_keys(where, given, ("link", "from", "to", "radius"))
    start = _places(where, "from", [given.get("from", [0.0, 0.0, 0.0])])[0]
    end = _places(where, "to", [given["to"]])[0] if "to" in given else start
    radius = given.get("radius")
    if not isinstance(radius, int | float) or not 0.0 < radius < MOST:
        raise HabitusError(f"{where}.radius = {shown(radius)}; expected metres above 0")
    return Capsule(_link(where, given), np.stack([start, end]), float(radius))


def _check_keys(where: str, given: dict[str, Any], known: tuple[str, ...]) -> None:
    unknown = sorted(set(given) - set(known))
    if unknown:
        raise HabitusError(f"{where}.{shown(unknown[0])}: unknown; expected {listed(known)}")


def _link(where: str, given: dict[str, Any]) -> str:
    link = given.get("link")
    if not isinstance(link, str) or not link:
        raise HabitusError(f"{where}.link = {shown(link)}; expected the name of a link")
    return link


def _places(where: str, key: str, given: Any) -> Float[np.ndarray, "n 3"]:
    try:
        values = np.atleast_2d(np.array(given, dtype=float))
    except (TypeError, ValueError):
        values = np.zeros((0, 3))
    if values.shape != (len(values), 3) or not 0 < len(values) <= 100:
        raise HabitusError(f"{where}.{key} = {shown(given)}; expected x, y, z")
    if not (np.abs(values) <= MOST).all():
        raise HabitusError(f"{where}.{key}: more than {MOST:g} m from the link; expected metres")
    return values
