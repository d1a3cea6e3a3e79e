"""JSON and YAML that describe cameras: plain tables, OpenCV's matrices included."""

import re
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

from habitus.errors import HabitusError, require_extra, shown
from habitus.io.limits import (
    MAX_DEPTH,
    MAX_DESCRIPTION_BYTES,
    MAX_DESCRIPTION_VALUES,
    MAX_DIGITS,
)
from habitus.io.structured_text import read_json, read_text_file

ENDINGS = (".json", ".yaml", ".yml")


def read_description(path: Path) -> Any:
    """What a .json or .yaml holds. Raises HabitusError where it is neither."""
    try:
        text = read_text_file(path, MAX_DESCRIPTION_BYTES)
        return read_json(text) if path.suffix.lower() == ".json" else _yaml(text)
    except FileNotFoundError:
        raise HabitusError(f"{path}: no such file; expected camera intrinsics") from None
    except (OSError, UnicodeDecodeError) as error:
        raise HabitusError(
            f"{path}: cannot be read ({shown(error, 120)}); expected JSON or YAML"
        ) from error
    except HabitusError as error:
        raise HabitusError(f"{path}: is no {path.suffix[1:].upper()} ({error})") from error


def _yaml(text: str) -> Any:
    """Plain values of a YAML text, built from the parser's events, so that nothing is built before
    it is counted.

    Strings, numbers, lists and tables only; what an alias refers to counts again with each alias,
    and keys merged by ``<<`` are copied at once: neither can grow beyond MAX_DESCRIPTION_VALUES.
    Tags are ignored.
    """
    yaml = require_extra("yaml", "YAML files", "rgbd")
    if text.startswith("%YAML:"):  # OpenCV writes a colon there, which YAML does not know
        text = text.partition("\n")[2]
    loader = yaml.CSafeLoader if yaml.__with_libyaml__ else yaml.SafeLoader
    try:
        return _Values(yaml, yaml.parse(text, Loader=loader)).document()
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise HabitusError(shown(error, 160)) from error


class _Values:
    """The values of a stream of YAML events."""

    def __init__(self, yaml: Any, events: Iterator[Any]):
        self.yaml = yaml
        self.events = events
        self.count = 0
        self.anchors: dict[str, tuple[Any, int]] = {}  # value, number of values in it

    def document(self) -> Any:
        """The first document's value, None in an empty text."""
        for event in self.events:
            if isinstance(event, self.yaml.DocumentStartEvent):
                return self._value(next(self.events), 0)
        return None

    def _value(self, event: Any, depth: int) -> Any:
        before = self.count
        self._add(1)
        if depth > MAX_DEPTH:
            raise HabitusError("nested without end")
        if isinstance(event, self.yaml.AliasEvent):
            if event.anchor not in self.anchors:
                raise HabitusError(f"it refers to {shown(event.anchor)!r}, which is not before it")
            value, size = self.anchors[event.anchor]
            self._add(size)
            return value
        if isinstance(event, self.yaml.ScalarEvent):
            value = _scalar(event.value) if event.implicit[0] else event.value
        elif isinstance(event, self.yaml.SequenceStartEvent):
            value = list(self._sequence(depth + 1))
        else:
            value = self._mapping(depth + 1)
        if event.anchor is not None:
            self.anchors[event.anchor] = value, self.count - before
        return value

    def _sequence(self, depth: int) -> Iterator[Any]:
        while not isinstance(event := next(self.events), self.yaml.SequenceEndEvent):
            yield self._value(event, depth)

    def _mapping(self, depth: int) -> dict[Any, Any]:
        table: dict[Any, Any] = {}
        merged: dict[Any, Any] = {}
        while not isinstance(event := next(self.events), self.yaml.MappingEndEvent):
            key = self._value(event, depth)
            value = self._value(next(self.events), depth)
            if key == "<<":
                for part in value if isinstance(value, list) else [value]:
                    merged = {**(part if isinstance(part, dict) else {}), **merged}
            elif isinstance(key, dict | list):
                raise HabitusError("a list or a table as a key; expected texts")
            else:
                table[key] = value
        return {**merged, **table}

    def _add(self, count: int) -> None:
        self.count += count
        if self.count > MAX_DESCRIPTION_VALUES:
            raise HabitusError(
                f"more than {MAX_DESCRIPTION_VALUES} values, references counted as what they "
                "refer to"
            )


_WORDS = {"": None, "~": None, "null": None, "true": True, "false": False}
_INTEGER = re.compile(r"[-+]?[0-9]+")
_NUMBER = re.compile(r"[-+]?(\.?[0-9][0-9_.]*([eE][-+]?[0-9]+)?|\.(inf|nan))", re.IGNORECASE)


def _scalar(text: str) -> Any:
    """A plain scalar: None, a truth value, a number or the text itself."""
    if text.lower() in _WORDS:
        return _WORDS[text.lower()]
    if _INTEGER.fullmatch(text) and len(text) <= MAX_DIGITS:
        return int(text)
    if _NUMBER.fullmatch(text):
        with suppress(ValueError):
            return float(
                text.replace("_", "").lower().replace(".inf", "inf").replace(".nan", "nan")
            )
    return text
