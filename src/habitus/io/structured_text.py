"""TOML, JSON and XML from anybody: whatever is in the text, a table comes out or one clear
error.
"""

import json
import re
import tomllib
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, TreeBuilder
from xml.parsers import expat

from habitus.errors import HabitusError, shown
from habitus.io.limits import (
    MAX_DEPTH,
    MAX_JSON_VALUES,
    MAX_KEY_PARTS,
    MAX_TEXT_BYTES,
    MAX_TOML_BYTES,
    MAX_XML_BYTES,
    MAX_XML_ELEMENTS,
    check_count,
    check_text,
    open_file,
)

_PART = r"""(?:[A-Za-z0-9_-]++|"[^"\n]*+"|'[^'\n]*+')"""
_LONG_KEY = re.compile(
    rf"""(?<![A-Za-z0-9_-]){_PART}(?:[ \t]*+\.[ \t]*+{_PART}){{{MAX_KEY_PARTS}}}"""
)


def read_text_file(path: Path, limit: int = MAX_TEXT_BYTES) -> str:
    """The text of a file of at most ``limit`` bytes, UTF-8; a longer file is not read.

    Raises HabitusError for a longer one, OSError and UnicodeDecodeError as Python does.
    """
    check_text(path.stat().st_size, "the file", limit)
    with open_file(path) as file:
        content = file.read(limit + 1)
    check_text(len(content), "the file", limit)
    return content.decode("utf-8-sig").replace("\r\n", "\n").replace("\r", "\n")


def read_toml(text: str, limit: int = MAX_TOML_BYTES) -> dict[str, Any]:
    """The table in a TOML text of at most so many characters. Raises HabitusError where it is none.

    Dotted keys of more than 16 parts are refused: the reader takes forever over them.
    """
    check_text(len(text), "the file", limit)
    if _LONG_KEY.search(text):
        raise HabitusError(f"a dotted key of more than {MAX_KEY_PARTS} parts; expected short keys")
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError, ArithmeticError, LookupError) as error:
        raise HabitusError(_explained(error)) from error


def read_json(text: str, limit: int = MAX_TEXT_BYTES) -> Any:
    """What a JSON text of at most so many characters holds. Raises HabitusError where it is
    none.
    """
    check_text(len(text), "the file", limit)
    check_count(sum(map(text.count, ",[{")), MAX_JSON_VALUES, "values")
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        raise HabitusError(_explained(error)) from error


def read_xml(text: str, limit: int = MAX_XML_BYTES) -> Element:
    """The root of an XML text of at most so many characters. Raises HabitusError where it is none.

    Nothing is fetched and no entity is expanded: a text that declares any is refused, as is one
    nested without end.
    """
    check_text(len(text), "the file", limit)
    builder = TreeBuilder()
    parser = expat.ParserCreate()
    depth = 0
    count = 0

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal depth, count
        depth += 1
        count += 1 + len(attributes)
        if depth > MAX_DEPTH:
            raise HabitusError("nested without end")
        if count > MAX_XML_ELEMENTS:
            raise HabitusError(f"more than {MAX_XML_ELEMENTS} elements; is it another file?")
        builder.start(tag, attributes)

    def end(tag: str) -> None:
        nonlocal depth
        depth -= 1
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
