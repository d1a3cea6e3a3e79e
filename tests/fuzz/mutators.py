"""Ways to spoil a file: bits, pieces, numbers, lines and cells, members of archives. Each takes
(rng, bytes).
"""

import io
import random
import re
import struct
import zipfile
from collections.abc import Callable, Sequence

Mutator = Callable[[random.Random, bytes], bytes]

_NUMBERS = [
    0,
    1,
    2,
    3,
    7,
    127,
    128,
    255,
    256,
    32767,
    32768,
    65535,
    65536,
    2**31 - 1,
    2**31,
    2**32 - 1,
    2**62,
    2**63 - 1,
]
_WORDS = [
    b"",
    b"0",
    b"-1",
    b"1",
    b"3",
    b"255",
    b"65535",
    b"4294967295",
    b"18446744073709551616",
    b"1e9",
    b"1e308",
    b"1e999",
    b"nan",
    b"inf",
    b"-inf",
    b"0x10",
    b"1_000",
    b"9" * 30,
    b"9" * 5000,
    b"true",
    b"null",
    b"None",
    b"\0",
    b"\x1b[31m",
    b"\xff\xfe",
    "‮".encode(),
    "𝕏".encode(),
    b"[/x]",
    b"<b>",
    b"'",
    b'"',
    b'"""',
    b"\\",
    b"\r",
    b"\t",
    b",",
    b";",
    b"[" * 3000,
    b"{" * 3000,
    b"a." * 3000,
    b"X" * 3000,
    b"_ " * 3000,
]
_PICKLED = [
    b"]p400000000\n",
    b"r\xff\xff\xff\x0f",
    b"cos\nsystem\n",
    b"cbuiltins\neval\n",
    b"cnumpy\nload\n",
    b"}" * 50,
    b"R",
    b"b",
    b"s",
    b"u",
    b"(",
    b"t",
    b"\x85" * 300,
    b"2" * 50,
    b"l",
    b"\x81",
    b"\x93",
    b"i",
    b"o",
    b"Pid\n",
    b"Q",
    b"\x97",
    b"\x82\x01",
    b"X\xff\xff\xff\x7f",
    b"\x8e" + b"\xff" * 8,
    b"T\xff\xff\xff\xff",
    b"cchumpy.ch\nCh\n",
    b"N",
    b".",
]
_HEADERS = [
    "{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000,), }",
    "{'descr': '<f8', 'fortran_order': False, 'shape': (-1, 3), }",
    "{'descr': '<f8', 'fortran_order': True, 'shape': (0, 3), }",
    "{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000, 0, 3), }",
    "{'descr': '|O', 'fortran_order': False, 'shape': (2,), }",
    "{'descr': '|V0', 'fortran_order': False, 'shape': (1000000000,), }",
    "{'descr': '<U0', 'fortran_order': False, 'shape': (1000000000,), }",
    "{'descr': '<U500000000', 'fortran_order': False, 'shape': (1,), }",
    "{'descr': [('a', '<f8'), ('b', '<i4')], 'fortran_order': False, 'shape': (3,), }",
    "{'descr': ('<f8', (3,)), 'fortran_order': False, 'shape': (4,), }",
    "{'descr': '<M8[s]', 'fortran_order': False, 'shape': (4,), }",
    "{'descr': '<c16', 'fortran_order': False, 'shape': (4, 3), }",
    "{'descr': '<f8', 'fortran_order': 3, 'shape': [1], }",
    "{'descr': '<f8', 'fortran_order': False, 'shape': (True, 1L), }",
    "{" * 400,
    "(" * 2000,
    "''' \n",
]


def mutate(rng: random.Random, content: bytes, others: Sequence[bytes] = ()) -> bytes:
    """A spoilt copy of a file: one to four mutations, after its kind or of its bytes; ``others``
    lend pieces.
    """
    for _ in range(rng.choice((1, 1, 1, 2, 2, 4))):
        content = rng.choice(_fitting(content))(rng, content)
    if others and rng.random() < 0.03:
        content = _splice(rng, content, rng.choice(others))
    return content


def _fitting(content: bytes) -> list[Mutator]:
    """Half of the mutations are of bytes whatever the file, half keep to its structure."""
    anything: list[Mutator] = [
        flip,
        overwrite,
        cut,
        doubled,
        moved,
        truncated,
        binary_number,
        inserted,
        stretched,
    ]
    if content[:2] == b"PK":
        return [*anything, *[zip_member] * 12]
    if content[:6] == b"\x93NUMPY":
        return [*anything, *[npy_header] * 4, *[npy_shape] * 4]
    if content[:1] in (b"\x80", b"(") and b"numpy" in content:
        return [*anything, *[pickled] * 6]
    if content and sum(
        byte in b"\t\r\n" or 32 <= byte < 127 for byte in content[:2000]
    ) > 0.9 * len(content[:2000]):
        return [
            flip,
            cut,
            truncated,
            inserted,
            *[text_number] * 4,
            *[lines] * 3,
            *[cells] * 4,
            word,
            word,
        ]
    return anything


def _span(rng: random.Random, size: int, most: int = 400) -> tuple[int, int]:
    start = rng.randint(0, size)
    return start, min(size, start + rng.randint(0, rng.choice((4, 40, most))))


def flip(rng: random.Random, content: bytes) -> bytes:
    """Some bits turned."""
    spoilt = bytearray(content)
    for _ in range(rng.choice((1, 1, 2, 8))):
        if spoilt:
            spoilt[_place(rng, len(spoilt))] ^= 1 << rng.randrange(8)
    return bytes(spoilt)


def _place(rng: random.Random, size: int) -> int:
    """Anywhere, and often at the beginning, where headers are."""
    return rng.randrange(min(size, rng.choice((16, 128, 1024, size, size))))


def overwrite(rng: random.Random, content: bytes) -> bytes:
    """A run of bytes set."""
    start, end = _span(rng, len(content))
    return (
        content[:start]
        + rng.choice((b"\0", b"\xff", b" ", bytes([rng.randrange(256)]))) * (end - start)
        + content[end:]
    )


def cut(rng: random.Random, content: bytes) -> bytes:
    """A piece taken out."""
    start, end = _span(rng, len(content))
    return content[:start] + content[end:]


def doubled(rng: random.Random, content: bytes) -> bytes:
    """A piece repeated."""
    start, end = _span(rng, len(content))
    return content[:end] + content[start:end] * rng.choice((1, 1, 2, 20)) + content[end:]


def moved(rng: random.Random, content: bytes) -> bytes:
    """A piece copied over another place."""
    return _splice(rng, content, content)


def _splice(rng: random.Random, content: bytes, other: bytes) -> bytes:
    start, end = _span(rng, len(other))
    piece = other[start:end]
    at = rng.randint(0, len(content))
    return content[:at] + piece + content[at + len(piece) * rng.randint(0, 1) :]


def truncated(rng: random.Random, content: bytes) -> bytes:
    """Cut off somewhere."""
    return content[: rng.randint(0, len(content))]


def inserted(rng: random.Random, content: bytes) -> bytes:
    """A word that means something somewhere, put in anywhere."""
    at = rng.randint(0, len(content))
    return content[:at] + rng.choice(_WORDS) + content[at:]


def stretched(rng: random.Random, content: bytes) -> bytes:
    """Much of nothing at the end."""
    return content + rng.choice((b"\0", b"\xff", b"\n")) * rng.choice((1, 512, 5000))


def binary_number(rng: random.Random, content: bytes) -> bytes:
    """A binary number replaced by an odd one."""
    form = rng.choice(("<B", "<H", ">H", "<I", ">I", "<Q", "<f", "<d"))
    if form[1] in "fd":
        raw = struct.pack(form, rng.choice((0.0, -1.0, 1e30, float("nan"), float("inf"), 1e-40)))
    else:
        raw = struct.pack(form, rng.choice(_NUMBERS) % 2 ** (8 * struct.calcsize(form)))
    at = _place(rng, max(1, len(content) - len(raw)))
    return content[:at] + raw + content[at + len(raw) :]


def text_number(rng: random.Random, content: bytes) -> bytes:
    """A number in a text replaced by an odd one."""
    found = list(re.finditer(rb"-?\d+(\.\d+)?", content[: rng.choice((300, 3000, len(content)))]))
    if not found:
        return inserted(rng, content)
    start, end = rng.choice(found).span()
    odd = (
        str(rng.choice(_NUMBERS) * rng.choice((1, -1))).encode()
        if rng.random() < 0.5
        else rng.choice(_WORDS)
    )
    return content[:start] + odd + content[end:]


def lines(rng: random.Random, content: bytes) -> bytes:
    """Lines lost, doubled, exchanged."""
    rows = content.split(b"\n")
    one = rng.randrange(len(rows))
    other = rng.randrange(len(rows))
    action = rng.randrange(4)
    if action == 0:
        del rows[one]
    elif action == 1:
        rows[one:one] = [rows[one]] * rng.choice((1, 3, 50))
    elif action == 2:
        rows[one], rows[other] = rows[other], rows[one]
    else:
        rows[one] = rows[one] + rows[other]
    return b"\n".join(rows)


def cells(rng: random.Random, content: bytes) -> bytes:
    """Cells lost, doubled, exchanged in one line or in all."""
    rows = content.split(b"\n")
    separator = max((b"\t", b",", b" ", b"="), key=content.count)
    row = rng.randrange(len(rows))
    column = rng.randrange(8)
    action = rng.randrange(4)
    for i in range(len(rows)) if rng.random() < 0.2 else [row]:
        parts = rows[i].split(separator)
        at = column % len(parts)
        if action == 0:
            del parts[at]
        elif action == 1:
            parts.insert(at, rng.choice(parts))
        elif action == 2:
            parts[at] = rng.choice(_WORDS)
        else:
            rng.shuffle(parts)
        rows[i] = separator.join(parts)
    return b"\n".join(rows)


def word(rng: random.Random, content: bytes) -> bytes:
    """A word replaced by another one of the file, or by one that means something."""
    found = list(re.finditer(rb"[\w\"'.-]+", content))
    if not found:
        return inserted(rng, content)
    start, end = rng.choice(found).span()
    return content[:start] + rng.choice([rng.choice(found)[0], rng.choice(_WORDS)]) + content[end:]


def pickled(rng: random.Random, content: bytes) -> bytes:
    """Steps of a pickle put in or over others."""
    at = rng.randint(0, len(content))
    piece = rng.choice(_PICKLED)
    return content[:at] + piece + content[at + rng.choice((0, 1, len(piece))) :]


def npy_header(rng: random.Random, content: bytes) -> bytes:
    """Another header on an array."""
    size = int.from_bytes(content[8:10], "little")
    header = rng.choice(_HEADERS).encode().ljust(size - 1)[: rng.choice((65000, size - 1))] + b"\n"
    return content[:8] + struct.pack("<H", len(header)) + header + content[10 + size :]


def npy_shape(rng: random.Random, content: bytes) -> bytes:
    """A number or word of an array's header changed, its length kept right."""
    size = int.from_bytes(content[8:10], "little")
    header = (
        rng.choice((text_number, word, flip))(rng, content[10 : 10 + size].rstrip()).strip(b"\n")[
            :60000
        ]
        + b" \n"
    )
    return content[:8] + struct.pack("<H", len(header)) + header + content[10 + size :]


def zip_member(rng: random.Random, content: bytes) -> bytes:
    """A member of an archive spoilt, exchanged, renamed, lost or doubled; the archive itself stays
    sound.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            members = [(name, archive.read(name)) for name in archive.namelist()]
            kind = archive.infolist()[0].compress_type if members else zipfile.ZIP_STORED
    except Exception:
        return flip(rng, content)
    if not members:
        return content
    at = rng.randrange(len(members))
    action = rng.random()
    name, data = members[at]
    if action < 0.7:
        members[at] = name, rng.choice(_fitting(data))(rng, data)
    elif action < 0.8:
        members[at] = name, rng.choice(members)[1]
    elif action < 0.9:
        members[at] = (
            rng.choice((rng.choice(members)[0], name[:-4], "../" + name, "x" * 5000)),
            data,
        )
    else:
        del members[at]
    written = io.BytesIO()
    with zipfile.ZipFile(written, "w", rng.choice((kind, kind, zipfile.ZIP_DEFLATED))) as archive:
        for name, data in dict(members).items():
            archive.writestr(name, data)
    return written.getvalue()
