# SPDX-License-Identifier: GPL-3.0-or-later
"""Measurements of a body, and the likeliest body with some of them: habitus' own tapes and its own
sums, in NumPy.

Every point that a tape or a yardstick looks at moves along straight lines with the person's
coefficients c = (1, shares of the ages' mean people, betas times the age's factor of the shapes);
`blender/build.py` packs these lines.
"""

import numpy as np

from .core import Body

NAMES = ("height", "weight", "chest", "waist", "hip", "inseam")
"""m, kg, and girths in m."""
PRECISION, DIRECTIONS = 0.002, 180
_STEPS, _SMALL, _LONGEST, _FAR = 30, 1e-3, 2.0, 18.0


def measure(body: Body, betas: np.ndarray, age: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """The measurements `NAMES` (6,), and their slopes along the betas (6, B)."""
    shares, _, shape = body.grown(age)
    c = np.concatenate([[1.0], shares, shape * body.padded(betas)])
    sole, crown, crotch = (
        _end(body.arrays[name], c, sign)
        for name, sign in (("sole", -1), ("crown", 1), ("crotch", -1))
    )
    lengths = [
        (crown[0] - sole[0], crown[1] - sole[1]),
        *(_girth(body.arrays, name, shares, c) for name in ("chest", "waist", "hip")),
        (crotch[0] - sole[0], crotch[1] - sole[1]),
    ]
    height, chest, waist, hip, inseam = (
        (value, shape * way[1 + len(shares) :]) for value, way in lengths
    )
    weight = _weight(body, betas, age, waist, height)
    measured = height, weight, chest, waist, hip, inseam
    return np.array([value for value, _ in measured]), np.array([way for _, way in measured])


def _end(points: np.ndarray, c: np.ndarray, sign: int) -> tuple[float, np.ndarray]:
    """The highest (1) or lowest (-1) of points (K, C), and its slope along c."""
    k = int(np.argmax(sign * (points @ c)))
    return float(points[k] @ c), points[k]


def _girth(arrays: dict, name: str, shares: np.ndarray, c: np.ndarray) -> tuple[float, np.ndarray]:
    """Of a tape as it lies on the adult, or between how it lies on the two nearest ages' mean
    people.
    """
    parts = [(share, k + 1) for k, share in enumerate(shares) if share > 0] or [(1.0, 0)]
    parts_of_tape = [(share, *_tape(arrays[f"tape_{name}_{k}"], c)) for share, k in parts]
    return sum(share * value for share, value, _ in parts_of_tape), sum(
        share * slope for share, _, slope in parts_of_tape
    )


def _tape(points: np.ndarray, c: np.ndarray) -> tuple[float, np.ndarray]:
    """The perimeter of the convex hull of points (K, 2, C): its mean width, times pi."""
    angle = np.arange(DIRECTIONS) * (np.pi / DIRECTIONS)
    ways = np.stack([np.cos(angle), np.sin(angle)])
    along = (points @ c) @ ways
    least, most = along.argmin(0), along.argmax(0)
    slope = np.einsum("dac,ad->c", points[most] - points[least], ways)
    return np.pi * float(np.ptp(along, axis=0).mean()), np.pi / DIRECTIONS * slope


def _weight(
    body: Body,
    betas: np.ndarray,
    age: float,
    waist: tuple[float, np.ndarray],
    height: tuple[float, np.ndarray],
) -> tuple[float, np.ndarray]:
    """The mass (kg) of what the skin holds, and its slopes along the betas.

    The density of adults of unknown age falls with waist over height, as in habitus.
    """
    points = body.rest(betas, age)
    quads = body.arrays["faces"]
    triangles = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    a, b, c = (points[triangles[:, k]] for k in range(3))
    pushes = np.zeros_like(points)
    for k, (first, second) in enumerate(((b, c), (c, a), (a, b))):
        shadow = np.cross(first, second) / 6
        for axis in range(3):
            pushes[:, axis] += np.bincount(triangles[:, k], shadow[:, axis], len(points))
    shape = body.grown(age)[2]
    share = float(body.arrays["volume_share"])
    volume = share * float(np.einsum("nc,nc->", points, pushes)) / 3
    slopes = share * shape * np.tensordot(pushes, body.arrays["shapedirs"], 2)
    density, lean, fall, least, most = body.arrays["densities"].tolist()
    if age > 0:
        return density * volume, density * slopes
    ratio = waist[0] / height[0]
    density = lean + fall * float(np.clip(ratio, least, most))
    bent = fall * (least < ratio < most) * (waist[1] - ratio * height[1]) / height[0]
    return density * volume, density * slopes + volume * bent


def tailored(body: Body, wanted: dict, age: float = 0.0) -> np.ndarray:
    """The betas (B,) of the likeliest person of an age with some measurements, {name of NAMES: m or
    kg}.

    Betas are normal with unit variance about the mean person's, a measurement is known to 0.2 %:
    Gauss-Newton steps of the conditional mean, as habitus' body_from_measurements takes them.
    Raises ValueError for people such as nobody is.
    """
    adult = age <= 0 or age >= 18
    mean = (
        body.arrays["people_mean"]
        if adult and "people_mean" in body.arrays
        else np.zeros(body.num_betas)
    )
    rows = [NAMES.index(name) for name in wanted]
    values = np.array([wanted[name] for name in wanted], np.float64)
    noise, betas = PRECISION * values, mean.copy()
    for _ in range(_STEPS if rows else 0):
        measured, slopes = (each[rows] for each in measure(body, betas, age))
        gain = np.linalg.solve(slopes @ slopes.T + np.diag(noise**2), slopes).T
        step = mean + gain @ (values - measured + slopes @ (betas - mean)) - betas
        betas = betas + step * min(1.0, _LONGEST / max(float(np.abs(step).max()), 1e-12))
        if np.abs(step).max() < _SMALL or np.linalg.norm(betas) > _FAR:
            break
    if rows:
        left = (values - measure(body, betas, age)[0][rows]) / noise
        if np.sum((betas - mean) ** 2) + np.sum(left**2) > body.arrays["rarest"][len(rows) - 1]:
            raise ValueError("there is nobody with these measurements")
    return betas
