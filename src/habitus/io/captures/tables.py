"""Numbers out of text: what the TRC, CSV and TSV readers share."""

from collections.abc import Sequence
from contextlib import suppress

import numpy as np
from jaxtyping import Float

from habitus.errors import HabitusError
from habitus.io.limits import check_table


def read_text(content: bytes, name: str) -> str:
    """The text of a file in UTF-8 (with or without a mark), UTF-16 or Latin-1.

    Raises HabitusError where the file is empty or no text.
    """
    wide = content[:2] in (b"\xff\xfe", b"\xfe\xff")
    if b"\0" in content[:4096] and not wide:
        raise HabitusError(
            f"{name}: a binary file where text was expected; check the file's ending"
        )
    try:
        text = content.decode(
            "utf-16" if wide else "utf-8-sig", errors="replace" if wide else "strict"
        )
    except UnicodeDecodeError:
        text = content.decode("latin-1")
    if not text.strip():
        raise HabitusError(f"{name}: the file is empty; export or copy it again")
    return text


def number_table(
    rows: Sequence[Sequence[str]], width: int, name: str
) -> Float[np.ndarray, "rows width"]:
    """Cells as numbers: rows are cut or filled to ``width``, and whatever is no number becomes NaN.

    Raises HabitusError where the file ``name`` promises far more columns than its rows have.
    """
    check_table(len(rows), width, sum(map(len, rows)), name)
    blank = [""] * width
    cells = [cell or "nan" for row in rows for cell in (*row[:width], *blank[len(row) :])]
    try:
        values = np.array(cells, dtype=np.float64)
    except ValueError:
        values = np.array([_number(cell) for cell in cells], dtype=np.float64)
    return values.reshape(len(rows), width)


def _number(cell: str) -> float:
    with suppress(ValueError):
        return float(cell)
    with suppress(ValueError):
        return float(cell.strip().replace(",", "."))
    return float("nan")


def number_of(cell: str | None) -> float | None:
    """One cell as a finite number, or None."""
    value = _number(cell) if cell else float("nan")
    return value if np.isfinite(value) else None


def is_count(cell: str) -> bool:
    """Whether a cell is a frame number: digits, perhaps written as 12.0."""
    cell = cell.strip()
    return cell.removesuffix(".0").isdecimal()


def fill_frames(
    numbers: Float[np.ndarray, " T"], points: Float[np.ndarray, "T N 3"]
) -> tuple[Float[np.ndarray, "T2 N 3"], tuple[str, ...]]:
    """Frames that the file leaves out, by its frame numbers, put back as missing, so that time
    stays honest.
    """
    steps = np.diff(numbers)
    if len(steps) == 0 or not np.isfinite(steps).all():
        return points, ()
    if (steps <= 0).any():
        return points, (
            "the file's frame numbers do not rise everywhere: its order of frames is kept",
        )
    with np.errstate(over="ignore"):
        rounded = np.rint(steps / steps.min())
    if not rounded.sum() < 10 * len(points):
        return points, (
            "the file's frame numbers leave out too many frames: they are not followed",
        )
    whole = rounded.astype(np.int64)
    count = int(whole.sum()) + 1
    if count == len(points):
        return points, ()
    filled = np.full((count, *points.shape[1:]), np.nan)
    filled[np.concatenate([[0], np.cumsum(whole)])] = points
    return filled, (f"{count - len(points)} frames that the file leaves out are kept as missing",)


def mean_rate(times: Float[np.ndarray, " T"], frames: int) -> float | None:
    """Frames a second from the times in seconds of the first and last of ``frames``; None where
    they do not rise.
    """
    if frames < 2 or not times[-1] > times[0]:
        return None
    rate = (frames - 1) / (times[-1] - times[0])
    return float(rate) if np.isfinite(rate) else None


def agreed_rate(claimed: float | None, timed: float | None) -> tuple[float | None, tuple[str, ...]]:
    """The rate the file claims, unless its own column of times says otherwise by more than 2 %."""
    if claimed is None or claimed <= 0:
        return timed, ()
    if timed is None or abs(timed - claimed) <= 0.02 * claimed:
        return claimed, ()
    return timed, (f"the file says {claimed:g} Hz, its times say {timed:g} Hz, which is used",)
