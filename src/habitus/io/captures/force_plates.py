"""Force plates of C3D files: the force on the person, its centre of pressure and its free moment,
in the world of the points.

| type | channels |
|---|---|
| 2 | Fx Fy Fz Mx My Mz |
| 3 | Fx12 Fx34 Fy14 Fy23 Fz1 Fz2 Fz3 Fz4 (Kistler) |
| 4 | as 2, before a matrix of calibration |

A plate's axes are those of its corners (x from the second to the first, y from the fourth to the
first), its forces act on the person. Files disagree about the sign of forces and of the origin's
depth: forces push people up, and sensors lie below the surface.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from habitus.errors import HabitusError
from habitus.gait.contacts import ForcePlate
from habitus.io.captures.analog import Analog, read_analog
from habitus.io.captures.c3d_parameters import Parameters
from habitus.io.units import METRES, unit_of

CHANNELS = {2: 6, 3: 8, 4: 6}
MAX_PLATES = 100
MIN_SIDE, MAX_PLACE = 0.05, 1000.0
"""Metres: of a plate's sides, and of its corners from the origin."""
MAX_FORCE = 100_000.0
"""Newtons."""
LOADED = 20.0
"""Newtons: less has no centre of pressure."""
UNLOADED_SHARE = 0.1
"""Of the samples, those with the least force, from which a plate's zero is taken,"""
UNLOADED_SPREAD = 6.0
"""where they vary by no more than this (N, sd)"""
MAX_BASELINE = 150.0
"""and lie no further from zero (N): otherwise somebody stands on the plate all the time."""


def read_force_plates(content: bytes, name: str) -> tuple[ForcePlate, ...]:
    """The force plates of a C3D file's bytes; none where it has none.

    Raises HabitusError where a plate's type is not 2, 3 or 4, or where its parameters are not
    whole.
    """
    analog, _, parameters = read_analog(content, name)
    used = int(parameters.number("FORCE_PLATFORM", "USED") or 0)
    if used <= 0 or not analog.samples.size:
        return ()
    if used > MAX_PLATES:
        raise HabitusError(f"{name}: {used} force plates; expected {MAX_PLATES} at most")
    unit = METRES[unit_of(next(iter(parameters.texts("POINT", "UNITS")), None)) or "mm"]
    kinds = parameters.numbers("FORCE_PLATFORM", "TYPE").astype(int)
    corners = parameters.numbers("FORCE_PLATFORM", "CORNERS").astype(np.float64)
    origins = parameters.numbers("FORCE_PLATFORM", "ORIGIN").astype(np.float64)
    table = parameters.numbers("FORCE_PLATFORM", "CHANNEL").astype(int)
    if len(kinds) < used or corners.size < 12 * used or origins.size < 3 * used:
        raise HabitusError(
            f"{name}: {used} force plates with {len(kinds)} types, {corners.size // 12} sets of "
            f"corners and {origins.size // 3} origins; expected one of each for every plate"
        )
    width = table.size // used
    plates = []
    for k in range(used):
        kind = int(kinds[k])
        if kind not in CHANNELS:
            raise HabitusError(
                f"{name}: force plate {k + 1} is of type {kind}; types 2, 3 and 4 are read"
            )
        rows = table[k * width : k * width + CHANNELS[kind]] - 1
        if len(rows) < CHANNELS[kind] or (rows < 0).any() or (rows >= len(analog.labels)).any():
            raise HabitusError(
                f"{name}: force plate {k + 1} names channels {(rows + 1).tolist()} of "
                f"{len(analog.labels)}; expected {CHANNELS[kind]} that are there"
            )
        matrix = _calibration(parameters, k, used) if kind == 4 else None
        with np.errstate(all="ignore"):
            plate = _plate(
                k + 1,
                kind,
                unit * corners[12 * k : 12 * k + 12].reshape(4, 3),
                unit * origins[3 * k : 3 * k + 3],
                analog,
                rows,
                matrix,
            )
        _refuse_nonsense(plate, name)
        plates.append(plate)
    return tuple(plates)


def _refuse_nonsense(plate: ForcePlate, name: str) -> None:
    """Damaged files have plates of no area, in space, or with forces that nobody exerts."""
    sides = np.linalg.norm(plate.corners - np.roll(plate.corners, 1, axis=0), axis=1)
    sound = np.isfinite(plate.corners).all() and np.abs(plate.corners).max() < MAX_PLACE
    if not (sound and sides.min() > MIN_SIDE and np.isfinite(_axes(plate.corners)).all()):
        raise HabitusError(
            f"{name}: force plate {plate.number} has sides of {sides.min():.3g} to "
            f"{sides.max():.3g} m; expected a plate: check FORCE_PLATFORM:CORNERS and POINT:UNITS"
        )
    most = float(np.abs(plate.force).max(initial=0.0))
    if not most < MAX_FORCE or not np.isfinite(plate.free_moment).all():
        raise HabitusError(
            f"{name}: force plate {plate.number} shows {most:.3g} N; expected {MAX_FORCE:g} at "
            "most: check the channels' scales"
        )


def _calibration(parameters: Parameters, k: int, used: int) -> Float[np.ndarray, "6 6"] | None:
    """A plate's matrix (row: component, column: channel), stored column by column."""
    flat = parameters.numbers("FORCE_PLATFORM", "CAL_MATRIX").astype(np.float64)
    return flat[36 * k : 36 * k + 36].reshape(6, 6).T if flat.size >= 36 * used else None


def _axes(corners: Float[np.ndarray, "4 3"]) -> Float[np.ndarray, "3 3"]:
    """x, y and z of a plate as the file has them, as columns."""
    x = corners[0] - corners[1]
    z = np.cross(x, corners[0] - corners[3])
    x, z = x / np.linalg.norm(x), z / np.linalg.norm(z)
    return np.column_stack([x, np.cross(z, x), z])


def _up(axes: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3"]:
    """The plate's normal along which the world's upward axis grows, whether z points down or up."""
    normal = axes[:, 2]
    return normal * np.sign(normal[np.abs(normal).argmax()])


def _plate(
    number: int,
    kind: int,
    corners: Float[np.ndarray, "4 3"],
    origin: Float[np.ndarray, "3"],
    analog: Analog,
    rows: np.ndarray,
    matrix: np.ndarray | None,
) -> ForcePlate:
    channels = np.nan_to_num(analog.samples[:, rows])
    if matrix is not None:
        channels = channels @ matrix.T
    channels, notes = _zeroed(channels, kind, number)
    unit = 1.0 if analog.units[rows[-1]].strip().lower() in ("nm", "n.m", "n*m") else 0.001
    force, moment = _kistler(channels, origin) if kind == 3 else _surface(channels, origin, unit)
    axes = _axes(corners)
    force, moment = force @ axes.T, moment @ axes.T
    up = _up(axes)
    if (force @ up).sum() < 0.0:
        force, moment = -force, -moment
    centre = corners.mean(0)
    vertical = force @ up
    loaded = vertical > LOADED
    with np.errstate(all="ignore"):
        arm = np.cross(up, moment) / vertical[:, None]
        free = (moment - np.cross(arm, force)) @ up
    pressure = np.where(loaded[:, None], centre + arm, np.nan)
    return ForcePlate(
        number,
        corners,
        force,
        pressure,
        np.where(loaded, free, 0.0)[:, None] * up,
        analog.rate_hz,
        kind,
        tuple(notes),
    )


def _zeroed(
    channels: Float[np.ndarray, "S n"], kind: int, number: int
) -> tuple[Float[np.ndarray, "S n"], Sequence[str]]:
    """Channels less what they show while nobody stands on the plate."""
    vertical = channels[:, 4:8].sum(1) if kind == 3 else channels[:, 2]
    if np.ptp(vertical) == 0.0:
        return channels, [f"force plate {number}: all samples are alike; it was not connected"]
    share = (0.5 * UNLOADED_SHARE, 1.0 - 0.5 * UNLOADED_SHARE)
    ends = np.quantile(vertical, share)  # forces push up or down, as the file has it
    middle = float(ends[np.abs(ends).argmin()])
    near = np.abs(vertical - middle) < 3.0 * UNLOADED_SPREAD
    if (
        near.mean() < 0.5 * UNLOADED_SHARE
        or vertical[near].std() > UNLOADED_SPREAD
        or abs(middle) > MAX_BASELINE
    ):
        return channels, [f"force plate {number} is never unloaded; its zero is the file's"]
    return channels - np.median(channels[near], axis=0), []


def _surface(
    channels: Float[np.ndarray, "S 6"], origin: Float[np.ndarray, "3"], unit: float
) -> tuple[np.ndarray, np.ndarray]:
    """Force (N) and moment (Nm) about the middle of the surface, in the plate's axes. ``origin``:
    vector from the sensors to the surface (m); z points down, so that its z is negative. Files with
    a positive z hold the opposite vector.
    """
    force, moment = channels[:, :3], unit * channels[:, 3:]
    below = origin if origin[2] > 0.0 else -origin
    return force, moment + np.cross(below, force)


def _kistler(
    channels: Float[np.ndarray, "S 8"], origin: Float[np.ndarray, "3"]
) -> tuple[np.ndarray, np.ndarray]:
    """The same from Kistler's eight forces; ``origin``: the sensors' distances along x and y and
    their depth, signs aside.
    """
    x12, x34, y14, y23, z1, z2, z3, z4 = channels.T
    a, b, depth = np.abs(origin) * [1.0, 1.0, -1.0]
    force = np.stack([x12 + x34, y14 + y23, z1 + z2 + z3 + z4], 1)
    moment = np.stack(
        [
            b * (z1 + z2 - z3 - z4) + force[:, 1] * depth,
            a * (-z1 + z2 + z3 - z4) - force[:, 0] * depth,
            b * (x34 - x12) + a * (y14 - y23),
        ],
        1,
    )
    return force, moment
