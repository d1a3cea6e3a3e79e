"""Arrays packed into one compressed base64 text with a table of contents, for a page's scripts."""

import base64
import zlib
from typing import Any

import numpy as np

MISSING = 65535
"""The 16-bit value of a coordinate that is not known."""


class Blob:
    """Collects named arrays; ``contents`` says how to read each of them back."""

    def __init__(self) -> None:
        self.contents: dict[str, dict[str, Any]] = {}
        self._chunks: list[bytes] = []
        self.size = 0

    def add(self, name: str, array: np.ndarray, steps: bool = False, **facts: Any) -> None:
        """Add an array of u1, i1, u2, i2, u4 or f4.

        ``steps`` stores integers of one or two bytes as the differences of neighbouring rows, which
        compress better where these are similar; ``facts`` are added to the table of contents.
        """
        data = np.ascontiguousarray(array)
        kind = data.dtype.newbyteorder("<").str[1:]
        if kind not in ("u1", "i1", "u2", "i2", "u4", "f4"):
            raise TypeError(
                f"{name} is {data.dtype}; the report's script reads u1, i1, u2, i2, u4 and f4"
            )
        entry = {"type": kind, "shape": list(data.shape), "start": self.size}
        self.contents[name] = entry | ({"steps": True} if steps else {}) | facts
        padded = (
            _row_steps(data)
            if steps
            else data.astype(data.dtype.newbyteorder("<"), copy=False).tobytes()
        )
        padded += b"\0" * (-len(padded) % 4)
        self._chunks.append(padded)
        self.size += len(padded)

    def add_points(
        self, name: str, points: np.ndarray, low: np.ndarray, high: np.ndarray, steps: bool = False
    ) -> None:
        """Add points (…, 3), quantised to 16 bits an axis between ``low`` and ``high`` (3,) and
        clipped there; points with NaN become MISSING.
        """
        step = np.maximum(high - low, 1e-6) / (MISSING - 1)
        with np.errstate(invalid="ignore"):
            levels = np.clip(np.round((points - low) / step), 0, MISSING - 1)
        missing = ~np.isfinite(points).all(axis=-1, keepdims=True)
        self.add(
            name,
            np.where(missing, MISSING, levels).astype("u2"),
            steps,
            low=low.tolist(),
            step=step.tolist(),
        )

    def base64(self) -> str:
        """All arrays as one text."""
        return base64.b64encode(zlib.compress(b"".join(self._chunks), 6)).decode("ascii")


def _row_steps(data: np.ndarray) -> bytes:
    """Differences of rows (modulo the type's range), the low bytes of all before the high bytes,
    which compresses well.
    """
    whole = data.view(f"u{data.itemsize}").reshape(len(data), -1)
    steps = np.diff(whole, axis=0, prepend=np.zeros_like(whole[:1])).astype(f"<u{data.itemsize}")
    return steps.reshape(-1, 1).view("u1").T.tobytes()
