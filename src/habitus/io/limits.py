"""How much a file may claim: the one place that decides what memory and time a reader spends on a
file's word.

A count in a header costs its writer ten bytes and its reader a hundred gigabytes. So no reader sets
up what a file claims before it has asked here whether a file of that size can honestly hold it.
Rules are relative to the bytes that are really there; where compressed, sparse or repeated data may
honestly grow, they may grow to a tenfold of the file and 128 MB more, all of one file together.
TOML, JSON and XML are read here: whatever is in the text, a table comes out or one clear error.
"""

import errno
import json
import re
import stat
import tomllib
import zlib
from pathlib import Path
from typing import Any, BinaryIO
from xml.etree.ElementTree import Element, TreeBuilder
from xml.parsers import expat

from habitus.errors import HabitusError, shown

BASE_BYTES = 1 << 27
MAX_GROWTH = 10
MAX_TEXT_BYTES = 1 << 26  # of a table
MAX_TOML_BYTES = 1 << 21  # of a table in TOML, which is read at 1 MB a second
MAX_LAYOUT_BYTES = 1 << 20  # of a layout file
MAX_XML_BYTES = 1 << 24  # of an XML file: whole OpenSim models are layouts, too
MAX_XML_ELEMENTS = 200_000
MAX_DESCRIPTION_BYTES = 1 << 20  # of a description of cameras or keypoints
MAX_DESCRIPTION_VALUES = 20_000  # in YAML, references counted as what they refer to
MAX_JSON_VALUES = 2_000_000
MAX_KEY_PARTS = 16  # of a dotted key
MAX_DEPTH = 100  # of elements in one another
MAX_DIGITS = 300  # of a whole number: more are no number of 64 bits, nor a floating one
MAX_PICKLE_STEPS = 1_000_000
MAX_JOINTS = 2048
MAX_LABELS = 500  # of a layout
MAX_PLACED_MARKERS = 200  # of an OpenSim marker set: each is looked up among the landmarks, 10 ms
MAX_NAMES = 1 << 16
MAX_NAME_LENGTH = 200
MAX_NODES = 4096  # of a scene in a glTF file
MAX_IMAGE_PIXELS = 50_000_000  # of one image of a camera
MAX_IMAGE_BYTES = 1 << 29  # of all images of a depth folder, or all pictures of a scan, unpacked


def open_file(path: Path) -> BinaryIO:
    """A file to be read from its beginning.

    Raises OSError for pipes, devices and sockets, of which reading may never end, and as Python
    does.
    """
    mode = path.stat().st_mode
    if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
        raise OSError(errno.EINVAL, "a pipe or a device, which may have no end")
    return path.open("rb")


def read_file(path: Path) -> bytes:
    """The content of a file. Raises OSError as `open_file` does."""
    with open_file(path) as file:
        return file.read()


class Allowance:
    """What one file may still fill of the memory, by the ``stored`` bytes that it really has."""

    def __init__(self, stored: int, base: int = BASE_BYTES):
        self.limit = base + MAX_GROWTH * max(0, stored)
        self._left = self.limit

    def take(self, count: int, width: int, what: str) -> None:
        """Ask for ``count`` numbers of ``width`` bytes, 8 at least, as readers compute with.

        Raises HabitusError where ``what`` claims more than is left.
        """
        self.take_bytes(count * max(8, width), what)

    def take_bytes(self, size: int, what: str) -> None:
        """Ask for ``size`` bytes. Raises HabitusError where ``what`` claims more than is left."""
        if size < 0 or size > self._left:
            raise HabitusError(
                f"{what} would fill {_size(size)}; a file of this size may fill "
                f"{_size(self.limit)} in all; "
                "it is damaged or malicious: get it again"
            )
        self._left -= size


def check_present(claimed: int, present: int, what: str) -> None:
    """Raise HabitusError where ``what`` claims more bytes than the file has for it."""
    if not 0 <= claimed <= present:
        raise HabitusError(
            f"{what} claims {_size(claimed)}, the file has {_size(present)}; it is damaged, get "
            "it anew"
        )


def check_table(rows: int, width: int, cells: int, name: str) -> None:
    """Raise HabitusError where the header of the table ``name`` promises far more columns than its
    rows have cells.
    """
    if rows * width > max(1_000_000, 20 * cells):
        raise HabitusError(
            f"{name}: its header promises {width} columns that its rows do not have; export it "
            "again"
        )


def check_text(size: int, name: str, max_bytes: int = MAX_TEXT_BYTES) -> None:
    """Raise HabitusError where a text file is longer than any that a person or a program would
    write.
    """
    if size > max_bytes:
        raise HabitusError(
            f"{name}: {_size(size)} of text; expected at most {_size(max_bytes)}; is it another "
            "file?"
        )


def check_count(count: int, limit: int, what: str) -> None:
    """Raise HabitusError where a file has more of ``what`` than ``limit``."""
    if count > limit:
        raise HabitusError(f"{count} {what}; expected at most {limit}; is it another file?")


def check_joints(count: int) -> None:
    """Raise HabitusError for a tree of more joints than any body has; tables of joint by joint
    follow from them.
    """
    if count > MAX_JOINTS:
        raise HabitusError(f"{count} joints; expected at most {MAX_JOINTS}")


def array_size(shape: tuple[int, ...]) -> int:
    """How many numbers an array has, however large. Raises HabitusError for lengths that are
    none.
    """
    if not all(type(n) is int and n >= 0 for n in shape) or len(shape) > 32:
        raise HabitusError(f"a shape of {shown(shape)}; expected whole numbers; get the file again")
    count = 1
    for n in shape:
        count *= n
    return count


def check_inflated(packed: bytes, max_bytes: int, what: str, wbits: int = 15) -> None:
    """Inflate deflated bytes piece by piece, keeping nothing; raise HabitusError where they grow
    beyond ``max_bytes``.
    """
    machine = zlib.decompressobj(wbits)
    total = 0
    while packed and not machine.eof:
        total += len(machine.decompress(packed, 1 << 20))
        check_present(total, max_bytes, f"a packed piece of {what}")
        packed = machine.unconsumed_tail


def folder_bytes(folder: Path) -> int:
    """The bytes of all files in a folder."""
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


def _size(count: int) -> str:
    if count < 10_000:
        return f"{count} bytes"
    return (
        f"{count / 1e6:.3g} MB"
        if count < 1e9
        else f"{count / 1e9:.3g} GB"
        if count < 1e18
        else "more than 10⁹ GB"
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
