"""Arrays packed into one compressed base64 text with a small table of contents, for the script of
the report.
"""

import base64
import zlib
from typing import Any

import numpy as np

MISSING = 65535


class Blob:
    """Collects named arrays; ``contents`` tells the script how to read each one back."""

    def __init__(self) -> None:
        self.contents: dict[str, dict[str, Any]] = {}
        self._chunks: list[bytes] = []
        self.size = 0

    def add(self, name: str, array: np.ndarray, steps: bool = False, **how: Any) -> None:
        """An array as it is (little-endian u1, i1, u2, i2, u4 or f4).

        ``steps`` packs integers of one or two bytes whose neighbouring rows are alike by the rows'
        differences.
        """
        data = np.ascontiguousarray(array)
        kind = data.dtype.newbyteorder("<").str[1:]
        if kind not in ("u1", "i1", "u2", "i2", "u4", "f4"):
            raise TypeError(
                f"{name} is {data.dtype}; the report's script reads u1, i1, u2, i2, u4 and f4"
            )
        told = {"type": kind, "shape": list(data.shape), "start": self.size}
        self.contents[name] = told | ({"steps": True} if steps else {}) | how
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
        """Points (…, 3) in 16 bits an axis between ``low`` and ``high`` (clipped there); NaN
        becomes MISSING.
        """
        step = np.maximum(high - low, 1e-6) / (MISSING - 1)
        with np.errstate(invalid="ignore"):
            places = np.clip(np.round((points - low) / step), 0, MISSING - 1)
        missing = ~np.isfinite(points).all(axis=-1, keepdims=True)
        self.add(
            name,
            np.where(missing, MISSING, places).astype("u2"),
            steps,
            low=low.tolist(),
            step=step.tolist(),
        )

    def base64(self) -> str:
        """All arrays as one text."""
        return base64.b64encode(zlib.compress(b"".join(self._chunks), 6)).decode("ascii")


def _row_steps(data: np.ndarray) -> bytes:
    """Differences of rows (modulo the type's range), the low bytes of all before the high ones:
    these compress well.
    """
    whole = data.view(f"u{data.itemsize}").reshape(len(data), -1)
    steps = np.diff(whole, axis=0, prepend=np.zeros_like(whole[:1])).astype(f"<u{data.itemsize}")
    return steps.reshape(-1, 1).view("u1").T.tobytes()
