"""Depth cameras as the literature measured them: what they make of a true depth image.

Structured light (Kinect v1): depth is quantised disparity (Khoshelham and Elberink 2012: z = f b /
d in steps of 1/8 pixel), its noise grows with z², pixels are laterally off by 0.8 and more at
slanted surfaces (Nguyen, Izadi and Lovell 2012), surfaces that the projector beside the camera does
not reach have no depth, nor have grazing ones; noise is alike over the window in which patterns are
compared, and part of it stays where it is from shot to shot. Time of flight (Azure Kinect):
millimetres of noise that grow slowly (Tölgyessy, Dekan, Chovanec and Hubinský 2021), mixed depths
at borders ("flying pixels"), holes at grazing angles.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from scipy.ndimage import gaussian_filter, map_coordinates

from habitus.errors import HabitusError


@dataclass(frozen=True)
class DepthSensor:
    """A kind of depth camera. Pixels and metres; angles in degrees.

    ``axial`` (a, b, c): sd of depth a + b (z - c)². ``window``: pixels over which noise is alike.
    ``fixed``: sd of the part (pixels of disparity) that stays from shot to shot. ``lateral``:
    pixels (sd) that a value comes from beside its own. ``disparity_step`` 0: not quantised.
    ``flying``: pixels around a border whose depths mix. ``grazing``: cosine below which a surface
    sends nothing back, and half of the time at twice that.
    """

    name: str
    width: int
    height: int
    focal: float
    near: float
    far: float
    axial: tuple[float, float, float]
    lateral: float
    window: float
    baseline: float = 0.0
    disparity_step: float = 0.0
    fixed: float = 0.0
    flying: float = 0.0
    grazing: float = 0.1
    colour_baseline: float = 0.025
    unit: float = 0.001


SENSORS = {
    "kinect-v1": DepthSensor(
        "kinect-v1", 640, 480, 585.0, 0.5, 5.0, (0.0012, 0.0019, 0.4), 0.7, 0.6,
        baseline=0.075, disparity_step=0.125, fixed=0.02, grazing=0.12,
    ),
    "azure-kinect": DepthSensor(
        "azure-kinect", 640, 576, 504.0, 0.5, 5.46, (0.0011, 0.0003, 0.5), 0.3, 0.8,
        flying=1.2, grazing=0.08, colour_baseline=0.032,
    ),
}  # fmt: skip


def smaller(sensor: DepthSensor, scale: float) -> DepthSensor:
    """The same with images whose sides are ``scale`` times as long; what is in pixels follows,
    depth stays as fine.
    """
    return replace(
        sensor,
        width=round(sensor.width * scale),
        height=round(sensor.height * scale),
        focal=sensor.focal * scale,
        disparity_step=sensor.disparity_step * scale,
        fixed=sensor.fixed * scale,
    )


def sense(
    sensor: DepthSensor,
    depth: Float[np.ndarray, "H W"],
    cosine: Float[np.ndarray, "H W"],
    rng: np.random.Generator,
    pattern: int = 0,
) -> Float[np.ndarray, "H W"]:
    """What the sensor reports (m; 0: nothing) of a true depth image (m; infinite where there is
    nothing).

    cosine: of the angle between view and surface, per pixel. pattern: which unit of the sensor,
    whose fixed noise it has. HabitusError: images of another size than the sensor's.
    """
    size = (sensor.height, sensor.width)
    if depth.shape != size or cosine.shape != size:
        raise HabitusError(
            f"depth is {depth.shape}, cosine {cosine.shape}; {sensor.name} has {size}"
        )
    hit = np.isfinite(depth)
    seen = hit & (depth > sensor.near) & (depth < sensor.far)
    if sensor.baseline:
        seen &= ~shadow(depth, sensor.focal, sensor.baseline)
    seen &= rng.random(size) < np.clip(np.abs(cosine) / sensor.grazing - 1.0, 0.0, 1.0)
    true = np.where(hit, depth, sensor.far)
    true = _blended(true, sensor.flying, rng)
    jittered = _beside(true, sensor.lateral, rng)
    a, b, c = sensor.axial
    spread = a + b * (jittered - c) ** 2
    noise = spread * _alike(rng, size, sensor.window)
    measured = jittered + noise
    if sensor.disparity_step:
        measured = _quantised(sensor, jittered, noise, spread, pattern)
    step = np.round(measured / sensor.unit) * sensor.unit
    return np.where(seen & (step > sensor.near) & (step < sensor.far), step, 0.0)


def _quantised(
    sensor: DepthSensor, depth: np.ndarray, noise: np.ndarray, spread: np.ndarray, pattern: int
):
    """Depth out of disparity in steps: what rounding adds is part of the spread that was
    measured.
    """
    scale = sensor.focal * sensor.baseline
    rounding = depth**2 / scale * sensor.disparity_step / np.sqrt(12.0)
    noise = noise * np.sqrt(np.maximum(1.0 - (rounding / spread) ** 2, 0.05))
    stays = sensor.fixed * _alike(np.random.default_rng(pattern), depth.shape, 6.0)
    disparity = scale / np.maximum(depth + noise, 1e-3) + stays
    return scale / (np.round(disparity / sensor.disparity_step) * sensor.disparity_step).clip(1e-3)


def shadow(depth: Float[np.ndarray, "H W"], focal: float, baseline: float) -> np.ndarray:
    """Pixels that a projector ``baseline`` metres to the right of the camera does not reach:
    something nearer is in its way. A row is looked at as the projector sees it.
    """
    columns = np.arange(depth.shape[1])[None]
    near = np.where(np.isfinite(depth), depth, 1e6)
    at = columns - focal * baseline / near  # where the projector sees what a pixel shows
    found = np.zeros(depth.shape, bool)
    order = np.minimum.accumulate(at[:, ::-1], axis=1)[:, ::-1]  # the least from here to the right
    found[:, :-1] = order[:, 1:] < at[:, :-1]
    return found


def _alike(rng: np.random.Generator, size: tuple[int, int], window: float) -> np.ndarray:
    """Noise of variance 1, alike over ``window`` pixels."""
    white = gaussian_filter(rng.normal(size=size), window)
    return white / max(float(white.std()), 1e-9)


def _beside(depth: np.ndarray, lateral: float, rng: np.random.Generator) -> np.ndarray:
    """Each pixel's value from beside it, on nearest pixels: borders fray and depths do not mix."""
    rows, columns = np.indices(depth.shape)
    at = [grid + lateral * rng.normal(size=depth.shape) for grid in (rows, columns)]
    return map_coordinates(depth, at, order=0, mode="nearest")


def _blended(depth: np.ndarray, reach: float, rng: np.random.Generator) -> np.ndarray:
    """Depths across borders mixed, as one pixel receives light of both."""
    if not reach:
        return depth
    mixed = gaussian_filter(depth, reach / 2)
    return np.where(
        np.abs(mixed - depth) > 0.02, depth + (mixed - depth) * rng.random(depth.shape), depth
    )
