"""PNG files, written with what Python has."""

import struct
import zlib

import numpy as np
from jaxtyping import UInt8

_COLOURS = {3: 2, 4: 6}
"""PNG's number of a pixel of so many channels."""
_PALETTE = 3


def png(image: UInt8[np.ndarray, "H W C"]) -> bytes:
    """A PNG file's content; three channels, or four with how opaque a pixel is."""
    height, width, channels = image.shape
    values = np.ascontiguousarray(image).reshape(height, -1)
    values = np.diff(
        values, axis=0, prepend=np.zeros_like(values[:1])
    )  # filter 2: each row less the one above
    rows = np.concatenate([np.full((height, 1), 2, np.uint8), values], 1)
    return _file(width, height, 8, _COLOURS[channels], [], rows)


def small_png(levels: UInt8[np.ndarray, "H W"], palette: UInt8[np.ndarray, "16 3"]) -> bytes:
    """A PNG file's content of sixteen colours, half a byte a pixel before it is packed; the first
    is nothing at all.
    """
    height, width = levels.shape
    even = np.pad(levels, ((0, 0), (0, width % 2)))
    packed = (even[:, ::2] << 4 | even[:, 1::2]).astype(np.uint8)
    rows = np.concatenate([np.zeros((height, 1), np.uint8), packed], 1)
    before = [(b"PLTE", np.ascontiguousarray(palette).tobytes()), (b"tRNS", b"\0")]
    return _file(width, height, 4, _PALETTE, before, rows)


def _file(
    width: int,
    height: int,
    bits: int,
    kind: int,
    before: list[tuple[bytes, bytes]],
    rows: np.ndarray,
) -> bytes:
    header = struct.pack(">IIBBBBB", width, height, bits, kind, 0, 0, 0)
    chunks = [
        (b"IHDR", header),
        *before,
        (b"IDAT", zlib.compress(rows.tobytes(), 9)),
        (b"IEND", b""),
    ]
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))
        for name, data in chunks
    )
