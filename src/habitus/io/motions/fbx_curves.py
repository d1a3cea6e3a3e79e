"""Animation curves of FBX: keys with constant, linear and cubic segments, sampled at any time.

Tangents as ufbx reads them (Samuli Raivio, MIT): stored slopes for tangents that a user set,
slopes from the neighbours for automatic ones (and for the rare tension-continuity-bias ones,
whose values are not evaluated); weighted tangents are Bezier segments.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from habitus.errors import HabitusError
from habitus.io.motions.fbx_nodes import FbxNode

_CONSTANT, _LINEAR = 0x2, 0x4
_NEXT = 0x100
_USER = 0x400
_CLAMP, _FREE_OF_TIME, _PROGRESSIVE = 0x1000, 0x2000, 0x4000
_WEIGHTED, _NEXT_WEIGHTED = 0x1000000, 0x2000000
_THIRD = 1.0 / 3.0


@dataclass(frozen=True, eq=False)
class Curve:
    """K keys: times (ticks of the file's clock), values, flags, and per key the slope that leaves
    it, the slope that arrives at the next, and the weights of both.
    """

    times: Int[np.ndarray, " K"]
    values: Float[np.ndarray, " K"]
    flags: Int[np.ndarray, " K"]
    slopes: Float[np.ndarray, "K 2"]
    weights: Float[np.ndarray, "K 2"]

    def at(self, times: Float[np.ndarray, " T"], second: float) -> Float[np.ndarray, " T"]:
        """Values at times (ticks), constant before the first key and after the last."""
        left = np.clip(np.searchsorted(self.times, times, side="right") - 1, 0, len(self.times) - 1)
        right = np.minimum(left + 1, len(self.times) - 1)
        span = (self.times[right] - self.times[left]).astype(np.float64)
        share = np.clip((times - self.times[left]) / np.where(span > 0, span, 1.0), 0.0, 1.0)
        one, other = self.values[left], self.values[right]
        linear = one + share * (other - one)
        flags = self.flags[left]
        held = np.where((flags & _NEXT) != 0, np.where(share > 0.0, other, one), one)
        out = np.where((flags & _CONSTANT) != 0, held, linear)
        cubic = ((flags & (_CONSTANT | _LINEAR)) == 0) & (share > 0.0) & (share < 1.0)
        if cubic.any():
            out[cubic] = self._cubic(left[cubic], right[cubic], share[cubic], span[cubic] / second)
        return out

    def _cubic(
        self, left: np.ndarray, right: np.ndarray, share: np.ndarray, seconds: np.ndarray
    ) -> np.ndarray:
        """Bezier segments: the parameter at each time by Newton's method, then the value."""
        out, into = self.weights[left].T
        t = share.copy()
        for _ in range(30):
            time = 3 * (1 - t) ** 2 * t * out + 3 * (1 - t) * t**2 * (1 - into) + t**3
            slope = 3 * (1 - t) ** 2 * out + 6 * (1 - t) * t * (1 - into - out) + 3 * t**2 * into
            t = np.clip(t - (time - share) / np.maximum(slope, 1e-6), 0.0, 1.0)
        start, end = self.values[left], self.values[right]
        leaving = start + self.slopes[left, 0] * out * seconds
        arriving = end - self.slopes[left, 1] * into * seconds
        return (
            (1 - t) ** 3 * start
            + 3 * (1 - t) ** 2 * t * leaving
            + 3 * (1 - t) * t**2 * arriving
            + t**3 * end
        )


def curve_of(node: FbxNode, second: float) -> Curve | None:
    """The curve of an AnimationCurve; None without keys. second: ticks. Raises HabitusError."""
    parts = {each.name: each for each in node.nodes}
    if "KeyTime" not in parts or "KeyValueFloat" not in parts:
        return None
    times = parts["KeyTime"].array().astype(np.int64)
    values = parts["KeyValueFloat"].array().astype(np.float64)
    if not len(times):
        return None
    if len(times) != len(values) or not (np.abs(values) < 1e9).all():
        raise HabitusError(f"{len(values)} finite values expected for {len(times)} keys")
    if (np.diff(times) <= 0).any() or (np.abs(times) > 1 << 58).any():
        raise HabitusError("times of keys do not increase; export the file again")
    flags, data = _attributes(parts, len(times))
    slopes = data[:, :2].astype(np.float64)
    weights = np.full((len(times), 2), _THIRD)
    bits = np.ascontiguousarray(data[:, 2]).view("<u4")
    for k, (flag, raw) in enumerate(
        ((_WEIGHTED, bits & 0xFFFF), (_NEXT_WEIGHTED, bits >> np.uint32(16)))
    ):
        on = (flags & flag) != 0
        weights[on, k] = np.clip(1e-4 * raw[on], 0.0, 1.0)
    slopes = np.where(np.isfinite(slopes) & (np.abs(slopes) < 1e12), slopes, 0.0)
    seconds = (times - times[0]) / second
    return Curve(times, values, flags, _automatic(seconds, values, flags, slopes), weights)


def _attributes(parts: dict[str, FbxNode], count: int) -> tuple[np.ndarray, np.ndarray]:
    """Flags (K,) and data (K, 4) of each key, expanded from runs; linear where absent."""
    names = ("KeyAttrFlags", "KeyAttrDataFloat", "KeyAttrRefCount")
    if any(name not in parts for name in names):
        return np.full(count, _LINEAR), np.zeros((count, 4), "<f4")
    flags, data, runs = (parts[name].array() for name in names)
    if data.dtype.kind == "i":  # text files may hold floats as the bits of whole numbers
        data = data.astype("<i4").view("<f4")
    data = data.astype("<f4")
    if len(data) != 4 * len(flags) or len(runs) != len(flags) or (runs < 0).any():
        raise HabitusError("attributes of keys have different lengths; export the file again")
    if int(runs.sum()) != count:
        raise HabitusError(f"attributes of {int(runs.sum())} keys for {count}; export it again")
    return np.repeat(flags.astype(np.int64), runs), np.repeat(data.reshape(-1, 4), runs, axis=0)


def _automatic(
    times: np.ndarray, values: np.ndarray, flags: np.ndarray, slopes: Float[np.ndarray, "K 2"]
) -> Float[np.ndarray, "K 2"]:
    """Stored slopes, with computed ones for automatic tangents."""
    auto = (flags & (_CONSTANT | _LINEAR | _USER)) == 0
    if not auto.any() or len(times) < 2:
        return slopes
    rise = np.diff(values) / np.diff(times)
    before, after = np.concatenate([rise[:1], rise]), np.concatenate([rise, rise[-1:]])
    step = np.diff(times)
    share = np.full(len(times), 0.5)
    share[1:-1] = step[:-1] / (step[:-1] + step[1:])
    whole = (1.0 - share) * after + share * before
    whole[1:-1] = (values[2:] - values[:-2]) / (times[2:] - times[:-2])
    mixed = 0.5 * whole + 0.5 * (before * (1.0 - share) + after * share)
    slope = np.where((flags & _FREE_OF_TIME) != 0, whole, mixed)
    sign = np.where(slope >= 0.0, 1.0, -1.0)
    most = np.minimum(
        np.maximum(sign * before / _THIRD, 0.0), np.maximum(sign * after / _THIRD, 0.0)
    )
    most[[0, -1]] = 0.0
    progressive = (flags & _PROGRESSIVE) != 0
    slope = np.where(progressive, sign * np.minimum(sign * slope, most), slope)
    flat = np.zeros(len(times), bool)
    flat[1:] |= values[1:] == values[:-1]
    flat[:-1] |= values[:-1] == values[1:]
    slope = np.where(((flags & _CLAMP) != 0) & flat, 0.0, slope)
    out = slopes.copy()
    out[auto, 0] = slope[auto]
    arriving = np.flatnonzero(auto[1:])
    out[arriving, 1] = slope[arriving + 1]
    return out
