"""Reads organised point clouds (PCL's .pcd): one frame of a depth camera, a point for each pixel.

The camera's intrinsics are not in the file; the points of a pinhole camera give them: u = f x / z +
c, by least squares over all pixels. Data are ascii, binary or binary_compressed (LZF: a byte and a
run of literals, or 2 to 3 bytes for a copy of what was unpacked before).
"""

from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from habitus.errors import HabitusError, shown
from habitus.io.limits import MAX_IMAGE_PIXELS, read_file
from habitus.io.names import plain_name
from habitus.kernels.jit import jit_noalloc
from habitus.observe.camera import Camera, DepthView, RgbdCapture
from habitus.types import PathLike

MAX_HEADER_BYTES = 4096
MAX_WIDTH = 64
"""Bytes of one point."""
MAX_OFF = 1.0
"""Pixels (median) that points may be off the pixels of a pinhole camera."""
_TYPES = {
    ("F", 4): "<f4", ("F", 8): "<f8", ("U", 1): "<u1", ("U", 2): "<u2", ("U", 4): "<u4",
    ("I", 1): "<i1", ("I", 2): "<i2", ("I", 4): "<i4",
}  # fmt: skip


def read_pcd(source: PathLike) -> RgbdCapture:
    """The frame in a .pcd file, with its colours where it has them. Raises HabitusError for files
    that are no organised cloud of a pinhole camera.
    """
    path = Path(source)
    try:
        content = read_file(path)
    except OSError as error:
        raise HabitusError(
            f"{path}: {shown(error.strerror or error)}; expected a .pcd file"
        ) from error
    try:
        fields, size, form, start = _header(content[:MAX_HEADER_BYTES])
        table = _table(content[start:], fields, size[0] * size[1], form)
        points = np.stack([table[name].reshape(size[::-1]) for name in "xyz"], -1).astype(float)
    except (ValueError, KeyError, IndexError) as error:
        raise HabitusError(
            f"{path}: is no point cloud that is understood; expected PCD 0.7 with x, y, z and a "
            "point for each pixel (HEIGHT over 1)"
        ) from error
    camera = _camera(points, str(path))
    depth = np.where(np.isfinite(points).all(-1) & (points[..., 2] > 0), points[..., 2], 0.0)
    colours = next((table[name] for name in ("rgba", "rgb") if name in table), None)
    colour = None if colours is None else _colour(colours).reshape(*size[::-1], 3)
    name = plain_name(path.stem)
    view = DepthView(depth, camera, colour, None if colour is None else camera, name=name)
    note = f"{path.name}: intrinsics by its points: focal length {camera.focal_length[0]:.1f} px"
    return RgbdCapture(name, (view,), (note,))


def _header(text: bytes) -> tuple[list[tuple[str, str]], tuple[int, int], str, int]:
    """Fields with their types, (width, height), the form of the data, and where they begin."""
    lines: dict[str, list[str]] = {}
    start = 0
    while "DATA" not in lines:
        end = text.index(b"\n", start)
        words = text[start:end].decode("ascii", "replace").split()
        start = end + 1
        if words and not words[0].startswith("#"):
            lines[words[0]] = words[1:]
    width, height = int(lines["WIDTH"][0]), int(lines["HEIGHT"][0])
    counts = lines.get("COUNT", ["1"] * len(lines["FIELDS"]))
    if width < 2 or height < 2 or width * height > MAX_IMAGE_PIXELS or set(counts) != {"1"}:
        raise ValueError
    kinds = zip(lines["TYPE"], map(int, lines["SIZE"]), strict=True)
    fields = list(zip(lines["FIELDS"], (_TYPES[kind] for kind in kinds), strict=True))
    if sum(np.dtype(kind).itemsize for _, kind in fields) > MAX_WIDTH:
        raise ValueError
    return fields, (width, height), lines["DATA"][0], start


def _table(
    data: bytes, fields: list[tuple[str, str]], count: int, form: str
) -> dict[str, np.ndarray]:
    """Columns by name."""
    kinds = np.dtype([(name, kind) for name, kind in fields])
    if form == "ascii":
        rows = np.array(data.decode("ascii").split(), dtype=np.float64).reshape(-1, len(fields))
        if len(rows) != count:
            raise ValueError
        return {name: rows[:, k].astype(kind) for k, (name, kind) in enumerate(fields)}
    if form == "binary":
        rows = np.frombuffer(data, kinds, count)
        return {name: rows[name] for name, _ in fields}
    if form != "binary_compressed":
        raise ValueError
    packed, unpacked = np.frombuffer(data, "<u4", 2)
    if unpacked != count * kinds.itemsize or packed > len(data) - 8:
        raise ValueError
    out = np.empty(int(unpacked), np.uint8)
    if _unpack_lzf(np.frombuffer(data, np.uint8, int(packed), 8), out) != len(out):
        raise ValueError
    columns = {}
    start = 0
    for name, kind in fields:
        columns[name] = out[start : start + count * np.dtype(kind).itemsize].view(kind)
        start += count * np.dtype(kind).itemsize
    return columns


@jit_noalloc
def _unpack_lzf(packed: np.ndarray, out: np.ndarray) -> int:
    """Fill ``out``; the number of bytes written, -1 for data that are no LZF or do not fit."""
    i = o = 0
    while i < len(packed):
        control = int(packed[i])
        i += 1
        if control < 32:
            length = control + 1
            if i + length > len(packed) or o + length > len(out):
                return -1
            for k in range(length):
                out[o + k] = packed[i + k]
            i += length
            o += length
            continue
        length = control >> 5
        if length == 7:
            if i >= len(packed):
                return -1
            length += int(packed[i])
            i += 1
        if i >= len(packed):
            return -1
        start = o - ((control & 31) << 8) - int(packed[i]) - 1
        i += 1
        length += 2
        if start < 0 or o + length > len(out):
            return -1
        for k in range(length):
            out[o + k] = out[start + k]
        o += length
    return o


def _camera(points: Float[np.ndarray, "H W 3"], name: str) -> Camera:
    """The pinhole camera whose pixels these points are."""
    height, width = points.shape[:2]
    rows, columns = np.nonzero(np.isfinite(points).all(-1) & (points[..., 2] > 0))
    if len(rows) < 100:
        raise HabitusError(f"{name}: {len(rows)} points; expected a depth image's")
    seen = points[rows, columns].astype(float)
    focal, middle, off = [], [], []
    for across, pixel in ((0, columns + 0.5), (1, rows + 0.5)):
        slope = np.column_stack([seen[:, across] / seen[:, 2], np.ones(len(seen))])
        solved = np.linalg.lstsq(slope, pixel, rcond=None)[0]
        focal.append(float(solved[0]))
        middle.append(float(solved[1]))
        off.append(float(np.median(np.abs(slope @ solved - pixel))))
    if min(focal) <= 0.0 or max(off) > MAX_OFF:
        raise HabitusError(
            f"{name}: its points are no pinhole camera's pixels (off by {max(off):.3g} px); "
            "expected the camera's own frame, x right, y down, z forward, in metres"
        )
    return Camera.of(width, height, focal, middle)


def _colour(packed: np.ndarray) -> UInt8[np.ndarray, "N 3"]:
    """Red, green and blue of packed numbers (0xaarrggbb)."""
    numbers = np.ascontiguousarray(packed).view(np.uint32)
    return np.stack([(numbers >> shift & 255).astype(np.uint8) for shift in (16, 8, 0)], -1)
