"""Files of a depth capture: JSON and YAML that describe cameras (plain tables, OpenCV's matrices
included), depth and colour images (16-bit PNG, 8-bit PNG and JPEG).
"""

import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, UInt8

from habitus.errors import HabitusError, require_extra, shown
from habitus.io.archives import reason
from habitus.io.limits import (
    MAX_DEPTH,
    MAX_DESCRIPTION_BYTES,
    MAX_DESCRIPTION_VALUES,
    MAX_DIGITS,
    MAX_IMAGE_BYTES,
    MAX_IMAGE_PIXELS,
    Allowance,
    read_file,
    read_json,
    read_text_file,
)

DESCRIPTION_ENDINGS = (".json", ".yaml", ".yml")


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


IMAGE_ENDINGS = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".pgm")
_KEPT_MODES = ("L", "RGB", "RGBA", "I", "I;16", "I;16B", "I;16L", "F")


def read_image(path: Path) -> np.ndarray:
    """The numbers of an image (H, W) or (H, W, C) as they are stored. Raises HabitusError."""
    with _opened(path) as image:
        if image.mode not in _KEPT_MODES:
            image = image.convert("L" if image.mode in ("1", "LA", "La") else "RGB")
        return np.array(image)


def check_images(paths: Iterable[Path]) -> None:
    """Raise HabitusError, before any image is decoded, where one is none, or where all together
    would fill more memory than files of their size may.
    """
    paths = tuple(dict.fromkeys(paths))
    sizes = [path.stat().st_size if path.is_file() else 0 for path in paths]
    allowance = Allowance(sum(sizes), MAX_IMAGE_BYTES)
    for path in paths:
        with _opened(path) as image:
            width = max(4 if image.mode[:1] in "IF" else 1, len(image.getbands()))
            allowance.take_bytes(image.width * image.height * width, "with this image, all views")


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """An image of which only the header is read; whatever a damaged one raises is a
    HabitusError.
    """
    require_extra("PIL", "image files", "rgbd")
    from PIL import Image

    try:
        # From memory, since a read of a damaged chunk's length then ends where the file does.
        with Image.open(BytesIO(read_file(path))) as image:
            if image.width * image.height > MAX_IMAGE_PIXELS:
                raise HabitusError(
                    f"{image.width} x {image.height} pixels; expected a camera's image"
                )
            yield image
    except FileNotFoundError:
        raise HabitusError(f"{path}: no such file; expected an image") from None
    except HabitusError as error:
        raise HabitusError(f"{path}: {error}") from error
    except Exception as error:  # a damaged file may raise anything
        raise HabitusError(
            f"{path}: cannot be read as an image ({reason(error)}); get it again"
        ) from error


def read_depth(path: Path, metres: float) -> Float[np.ndarray, "H W"]:
    """Depth in metres, 0 where there is none: whole numbers of 16 bits times ``metres``, or
    floating numbers.

    Raises HabitusError for colour images and for 8 bits, which hold no depth.
    """
    image = read_image(path)
    if image.ndim != 2 or image.dtype.itemsize < 2:
        kind = (
            f"{image.shape[2]} channels" if image.ndim == 3 else f"{8 * image.dtype.itemsize} bits"
        )
        raise HabitusError(
            f"{path}: has {kind}; expected depth in one channel of 16 bits, as a PNG"
        )
    with np.errstate(invalid="ignore"):
        depth = image.astype(np.float32) * np.float32(metres)
    return np.where(np.isfinite(depth) & (depth > 0.0), depth, np.float32(0.0))


def read_colour(path: Path) -> UInt8[np.ndarray, "h w 3"]:
    """Colours of 8 bits; grey images become three equal channels. Raises HabitusError."""
    image = read_image(path)
    if image.dtype.kind == "f":
        raise HabitusError(f"{path}: has floating-point numbers; expected colours of 8 or 16 bits")
    if image.dtype.itemsize > 1:
        scaled = image.astype(np.float64) / np.iinfo(image.dtype).max * 255
        image = scaled.clip(0.0, 255.0).astype(np.uint8)
    if image.ndim == 2:
        image = np.repeat(image[..., None], 3, axis=2)
    return np.ascontiguousarray(image[..., :3].astype(np.uint8))


def read_mask(path: Path) -> Bool[np.ndarray, "H W"]:
    """Where an image is not black. Raises HabitusError."""
    image = read_image(path)
    flat = image if image.ndim == 2 else image[..., :3].max(-1)
    return flat > flat.max(initial=0) / 2
