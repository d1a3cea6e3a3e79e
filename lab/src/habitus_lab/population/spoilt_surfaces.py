"""Depth views and scans spoilt as wholes, as wrong files and settings spoil them: what a verdict
must never call good unless the result is right all the same.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float

from habitus.fit.points.scan import Scan
from habitus.observe.camera import Camera, DepthView, RgbdCapture
from habitus_lab.population.rgbd_people import Scene

Views = tuple[DepthView, ...]
DepthSpoiling = Callable[[Views, Views], Views]
"""Views of a person, and of somebody else in the same room -> spoilt views."""
ScanSpoiling = Callable[[Scan, np.random.Generator], Scan]


def spoilt_capture(kind: str, scene: Scene, other: Scene) -> RgbdCapture:
    """The capture of a scene, spoilt by a kind of `DEPTH_FAULTS`; other: somebody else's."""
    views = DEPTH_FAULTS[kind](scene.capture.views, other.capture.views)
    return replace(scene.capture, views=views)


def _each(change: Callable[[DepthView], DepthView]) -> DepthSpoiling:
    return lambda views, others: tuple(change(view) for view in views)


def _focal(factor: float, axes: tuple[float, float] = (1.0, 1.0)) -> DepthSpoiling:
    """The depth camera's focal length is this factor too large, along the axes chosen."""
    by = torch.tensor([factor**axis for axis in axes], dtype=torch.float64)
    return _each(
        lambda v: replace(v, camera=v.camera.replace(focal_length=v.camera.focal_length * by))
    )


def _depth_scaled(factor: float) -> DepthSpoiling:
    def change(view: DepthView) -> DepthView:
        background = None if view.background is None else factor * view.background
        return replace(view, depth=factor * view.depth, background=background)

    return _each(change)


def _cameras_exchanged(views: Views, others: Views) -> Views:
    """The depth images have the colour camera's intrinsics, scaled to their size."""

    def change(view: DepthView) -> DepthView:
        assert view.colour_camera is not None
        colour = view.colour_camera
        size = torch.tensor(
            [view.camera.width / colour.width, view.camera.height / colour.height],
            dtype=torch.float64,
        )
        camera = view.camera.replace(
            focal_length=colour.focal_length * size, principal_point=colour.principal_point * size
        )
        return replace(view, camera=camera)

    return tuple(change(view) for view in views)


def _without_masks(views: Views, others: Views) -> Views:
    return tuple(replace(view, mask=np.zeros(view.depth.shape, bool)) for view in views)


def _one_mask_empty(views: Views, others: Views) -> Views:
    return (views[0], *_without_masks(views[1:], others))


def _box(views: Views, others: Views) -> Views:
    """The empty room with a box of 0.5 x 1.2 m, 2.4 m before the camera."""

    def change(view: DepthView) -> DepthView:
        assert view.background is not None
        focal = view.camera.focal_length.numpy()
        half = (focal * [0.25, 0.6] / 2.4).astype(int)
        column, row = view.camera.principal_point.numpy().astype(int)
        depth = view.background.copy()
        depth[row - half[1] : row + half[1], column - half[0] : column + half[0]] = 2.4
        return replace(view, depth=depth, colour=view.background_colour)

    return tuple(change(view) for view in views)


def _two_people(views: Views, others: Views) -> Views:
    """Somebody else stands half a metre to the side, partly before the person."""

    def change(view: DepthView, other: DepthView) -> DepthView:
        shift = int(0.5 / 2.6 * view.camera.focal_length[0])
        beside = np.roll(other.depth, shift, axis=1)
        beside[:, :shift] = 0.0
        nearer = (beside > 0) & (beside < view.depth - 0.3)
        return replace(view, depth=np.where(nearer, beside, view.depth))

    return tuple(change(*pair) for pair in zip(views, others, strict=True))


def _half_missing(views: Views, others: Views) -> Views:
    """Nothing was measured on one side of the image's middle."""

    def change(view: DepthView) -> DepthView:
        depth = view.depth.copy()
        depth[:, : int(view.camera.principal_point[0])] = 0.0
        return replace(view, depth=depth)

    return tuple(change(view) for view in views)


def _upside_down(views: Views, others: Views) -> Views:
    """The cameras hang upside down."""

    def turned(image: np.ndarray | None) -> np.ndarray | None:
        return None if image is None else np.ascontiguousarray(image[::-1, ::-1])

    def camera(one: Camera) -> Camera:
        size = torch.tensor([one.width, one.height], dtype=torch.float64)
        return one.replace(principal_point=size - one.principal_point)

    def change(view: DepthView) -> DepthView:
        plain = view.without("colour")
        depth = turned(plain.depth)
        assert depth is not None
        background = turned(plain.background)
        return replace(plain, depth=depth, background=background, camera=camera(plain.camera))

    return tuple(change(view) for view in views)


def _mirrored_view(views: Views, others: Views) -> Views:
    """The last view is its mirror image."""
    view = views[-1].without("colour")
    background = None if view.background is None else view.background[:, ::-1].copy()
    mirrored = replace(view, depth=view.depth[:, ::-1].copy(), background=background)
    return (*views[:-1], mirrored)


def _background_shifted(views: Views, others: Views) -> Views:
    """The camera was moved after the empty room was taken."""

    def change(view: DepthView) -> DepthView:
        assert view.background is not None
        moved = np.roll(
            view.background, (view.camera.height // 20, view.camera.width // 12), (0, 1)
        )
        return replace(view, background=moved + 0.05, background_colour=None)

    return tuple(change(view) for view in views)


def _noisy(views: Views, others: Views) -> Views:
    rng = np.random.default_rng(0)
    return tuple(
        replace(view, depth=view.depth + 0.06 * rng.normal(size=view.depth.shape)) for view in views
    )


DEPTH_FAULTS: Mapping[str, DepthSpoiling] = {
    "focal length x 1.3": _focal(1.3),
    "focal length / 1.3": _focal(1.0 / 1.3),
    "stretched 1.3 upwards": _focal(1.0 / 1.3, (0.0, 1.0)),
    "cameras exchanged": _cameras_exchanged,
    "another person in one view": lambda views, others: (*views[:-1], others[-1]),
    "all masks empty": _without_masks,
    "one mask empty": _one_mask_empty,
    "depth x 1000": _depth_scaled(1000.0),
    "depth / 1000": _depth_scaled(0.001),
    "a box": _box,
    "two people": _two_people,
    "half of each image missing": _half_missing,
    "upside down": _upside_down,
    "one view mirrored": _mirrored_view,
    "background of another place": _background_shifted,
    "6 cm of noise": _noisy,
}


def _points(change: Callable[[Float[np.ndarray, "N 3"]], Float[np.ndarray, "N 3"]]) -> ScanSpoiling:
    return lambda scan, rng: replace(scan, points=change(scan.points), normals=None, faces=None)


def _kept(keep: Callable[[Float[np.ndarray, "N 3"]], np.ndarray]) -> ScanSpoiling:
    return _points(lambda points: points[keep(points)])


def _upper(points: np.ndarray, share: float) -> np.ndarray:
    low, high = points[:, 1].min(), points[:, 1].max()
    return points[:, 1] > low + (1.0 - share) * (high - low)


def _beside(distance: float) -> ScanSpoiling:
    """The same person again, turned round, so far (m) beside."""

    def spoil(scan: Scan, rng: np.random.Generator) -> Scan:
        other = scan.points * [-1.0, 1.0, -1.0] + [distance, 0.0, 0.1]
        return replace(scan, points=np.concatenate([scan.points, other]), normals=None, faces=None)

    return spoil


def _cube(scan: Scan, rng: np.random.Generator) -> Scan:
    points = rng.uniform(-0.5, 0.5, (20_000, 3))
    axis = rng.integers(0, 3, len(points))
    points[np.arange(len(points)), axis] = 0.5 * rng.choice([-1.0, 1.0], len(points))
    return replace(scan, points=points * [1.0, 1.7, 1.0], normals=None, faces=None)


def _chair(scan: Scan, rng: np.random.Generator) -> Scan:
    """A seat, a back and four legs."""
    parts = [([-0.25, 0.45, -0.25], [0.25, 0.5, 0.25]), ([-0.25, 0.5, -0.25], [0.25, 1.1, -0.2])]
    parts += [([x, 0, z], [x + 0.05, 0.45, z + 0.05]) for x in (-0.25, 0.2) for z in (-0.25, 0.2)]
    points = [rng.uniform(low, high, (4000, 3)) for low, high in parts]
    return replace(scan, points=np.concatenate(points), normals=None, faces=None)


def _with_noise(scan: Scan, rng: np.random.Generator) -> Scan:
    points = scan.points + 0.03 * rng.normal(size=scan.points.shape)
    return replace(scan, points=points, normals=None, faces=None)


SCAN_FAULTS: Mapping[str, ScanSpoiling] = {
    "a cube": _cube,
    "a chair": _chair,
    "two people": _beside(1.2),
    "two people who touch": _beside(0.35),
    "left half missing": _kept(lambda points: points[:, 0] > np.median(points[:, 0])),
    "lower half missing": _kept(lambda points: _upper(points, 0.5)),
    "head missing": _kept(lambda points: ~_upper(points, 0.14)),
    "stretched 1.3 upwards": _points(lambda points: points * [1.0, 1.3, 1.0]),
    "stretched 1.3 across": _points(lambda points: points * [1.3, 1.0, 1.0]),
    "squeezed 0.7 in depth": _points(lambda points: points * [1.0, 1.0, 0.7]),
    "scaled by 0.001": _points(lambda points: 0.001 * points),
    "scaled by 0.6": _points(lambda points: 0.6 * points),
    "scaled by 1.4": _points(lambda points: 1.4 * points),
    "3 cm of noise": _with_noise,
    "upside down": _points(lambda points: points * [-1.0, -1.0, 1.0]),
    "mirrored": _points(lambda points: points * [-1.0, 1.0, 1.0]),
}
"""Of scans in metres with y up. A mirror image of a person is a scan of a person: nothing shows it.
"""
