"""TOML, JSON and XML from anybody: whatever is in the text, a table comes out or one clear
error.
"""

import json
import re
import tomllib
from typing import Any
from xml.etree.ElementTree import Element, TreeBuilder
from xml.parsers import expat

from habitus.errors import HabitusError, shown
from habitus.io.limits import MAX_DEPTH, MAX_KEY_PARTS, MAX_TEXT_BYTES, check_text

_PART = r"""(?:[A-Za-z0-9_-]++|"[^"\n]*+"|'[^'\n]*+')"""
_LONG_KEY = re.compile(
    rf"""(?<![A-Za-z0-9_-]){_PART}(?:[ \t]*+\.[ \t]*+{_PART}){{{MAX_KEY_PARTS}}}"""
)


def read_toml(text: str, most: int = MAX_TEXT_BYTES) -> dict[str, Any]:
    """The table in a TOML text of at most so many characters. Raises HabitusError where it is none.

    Dotted keys of more than 16 parts are refused: the reader takes forever over them.
    """
    check_text(len(text), "the file", most)
    if _LONG_KEY.search(text):
        raise HabitusError(f"a dotted key of more than {MAX_KEY_PARTS} parts; expected short keys")
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError, ArithmeticError, LookupError) as error:
        raise HabitusError(_explained(error)) from error


def read_json(text: str, most: int = MAX_TEXT_BYTES) -> Any:
    """What a JSON text of at most so many characters holds. Raises HabitusError where it is
    none.
    """
    check_text(len(text), "the file", most)
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        raise HabitusError(_explained(error)) from error


def read_xml(text: str, most: int = MAX_TEXT_BYTES) -> Element:
    """The root of an XML text of at most so many characters. Raises HabitusError where it is none.

    Nothing is fetched and no entity is expanded: a text that declares any is refused, as is one
    nested without end.
    """
    check_text(len(text), "the file", most)
    builder = TreeBuilder()
    parser = expat.ParserCreate()
    depth = [0]

    def start(tag: str, attributes: dict[str, str]) -> None:
        depth[0] += 1
        if depth[0] > MAX_DEPTH:
            raise HabitusError("nested without end")
        builder.start(tag, attributes)

    def end(tag: str) -> None:
        depth[0] -= 1
        builder.end(tag)

    def refuse(*declared: object) -> None:
        raise HabitusError(f"it declares the entity {shown(declared[0], 40)}; expected plain XML")

    parser.buffer_text = True
    parser.StartElementHandler = start
    parser.EndElementHandler = end
    parser.CharacterDataHandler = builder.data
    parser.EntityDeclHandler = refuse
    try:
        parser.Parse(text.lstrip("\ufeff"), True)
    except (expat.ExpatError, ValueError) as error:
        raise HabitusError(_explained(error)) from error
    return builder.close()


def _explained(error: Exception) -> str:
    return "nested without end" if isinstance(error, RecursionError) else shown(error, 160)
