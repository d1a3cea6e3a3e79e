"""Where a fit to several sensors begins: each sensor's own recipe, on its own data.

Markers: the shape stage of `habitus.fit.markers`, then poses of single frames. Depth views and
scans with poses of their own: the fits of `habitus.fit.points`.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from habitus.body.model import BodyModel
from habitus.body.prior import PosePrior
from habitus.body.state import BodyState
from habitus.fit.body_fit import FitSettings
from habitus.fit.markers.energy import place
from habitus.fit.markers.gaps import fill_short_gaps
from habitus.fit.markers.recipe import known_subject
from habitus.fit.markers.recordings import (
    Recording,
    check_recordings,
    ever_seen,
    of_markers,
    spread_frames,
)
from habitus.fit.markers.shape import ShapeFit, Subject
from habitus.fit.markers.start import start_frames, trunk_weights
from habitus.fit.markers.suspects import exchange
from habitus.fit.points.scan_result import ScanFit
from habitus.fit.points.scans import Registrar
from habitus.fit.sensors import FrameOf, ScanData, SensorData, ViewData
from habitus.markers.layouts import MarkerLayout
from habitus.mesh.normals import vertex_normals
from habitus.observe.markers import attach, default_markers
from habitus.rotations import matrix_from_rotvec, rotvec_from_matrix


@dataclass(frozen=True, eq=False)
class MarkerStart:
    """The subject, its recordings as they are fitted, and the F frames that are solved with the
    other sensors: observed (F, M, 3), NaN where missing, weight (F,) of a marker relative to
    MoSh's.
    """

    subject: Subject
    recordings: tuple[Recording, ...]
    frames: tuple[FrameOf, ...]
    observed: Float[np.ndarray, "F M 3"]
    weight: Float[np.ndarray, " F"]
    pose: Float[np.ndarray, "F J 3"]
    trans: Float[np.ndarray, "F 3"]


def start_markers(
    body: BodyModel,
    prior: PosePrior,
    data: SensorData,
    betas: Float[np.ndarray, " B"] | None,
    settings: FitSettings,
) -> MarkerStart:
    """By MoSh's shape stage on all captures; with ``betas`` that are known, on the layout's places
    instead. Raises HabitusError where no frame holds enough markers.
    """
    assert data.layout is not None
    mosh = settings.mosh
    recordings = [each.recording for each in data.captures]
    if betas is None:
        recordings, subject = known_subject(body, prior, data.layout, recordings, mosh)
    else:
        seen = np.any([ever_seen(each.observed) for each in recordings], axis=0)
        recordings = [
            replace(each, observed=of_markers(each.observed, seen)) for each in recordings
        ]
        check_recordings(recordings)
        used = tuple(m for m, s in zip(data.layout.markers, seen, strict=True) if s)
        subject = _subject_of_shape(body, prior, replace(data.layout, markers=used), betas)
    frames: list[FrameOf] = []
    observed, weights = [], []
    for k, (recording, each) in enumerate(zip(recordings, data.captures, strict=True)):
        filled = fill_short_gaps(recording.observed, recording.rate_hz, mosh.gaps)
        filled = exchange(filled, subject.exchanged)
        chosen = each.frames
        if chosen is None:
            chosen = spread_frames(filled, settings.frames, settings.seed, mosh.spread_frames)
        numbers = np.unique([*chosen, *data.named_frames(k)]).astype(np.int64)
        frames += [FrameOf(k, int(number)) for number in numbers]
        observed.append(filled[numbers])
        # A weight per cm^2 is the inverse of a variance (MoSh sec. 6).
        own = mosh.shape.data if each.noise is None else (0.01 / each.noise) ** 2
        weights.append(np.full(len(numbers), own / mosh.shape.data))
    together = np.concatenate(observed)
    together[:, list(subject.misplaced)] = np.nan
    trunk = trunk_weights(body, place(subject.layout, body).vertices, mosh.start)
    pose, trans = start_frames(subject.rig, body.joint_names, trunk, together, prior, mosh.start)
    return MarkerStart(
        subject,
        tuple(recordings),
        tuple(frames),
        together,
        np.concatenate(weights),
        pose,
        trans,
    )


def max_visible_markers(data: SensorData) -> int:
    """Labelled markers of the fullest frame of all captures."""
    counts = [np.isfinite(each.recording.observed[..., 0]).sum(axis=1) for each in data.captures]
    return int(max((count.max(initial=0) for count in counts), default=0))


def _subject_of_shape(
    body: BodyModel, prior: PosePrior, layout: MarkerLayout, betas: Float[np.ndarray, " B"]
) -> Subject:
    """A subject of a known shape, its markers at the layout's places."""
    placement = place(layout, body)
    latent = default_markers(body, betas, placement.vertices, placement.distance)
    attachment = attach(latent, body.rest_vertices(betas), body.faces)
    pose = np.zeros((0, body.num_joints, 3))
    trans = np.zeros((0, 3))
    shape = ShapeFit(betas, latent, attachment, pose, trans, {}, "start", 0)
    return Subject(body, prior, layout, shape)


@dataclass(frozen=True, eq=False)
class ScanStart:
    """What the recipe of scans made of those with a pose of their own: metres, y up."""

    fits: tuple[ScanFit, ...]

    @property
    def betas(self) -> Float[np.ndarray, " B"]:
        """Of the person."""
        return next((fit for fit in self.fits if fit.person), self.fits[0]).betas


def start_scans(
    body: BodyModel, prior: PosePrior, data: SensorData, settings: FitSettings
) -> ScanStart | None:
    """All scans with a pose of their own, registered together; None without such."""
    scans = [each.scan for each in data.scans if each.at is None]
    if not scans:
        return None
    registrar = Registrar.of(body, prior, settings=settings.scans)
    fits = registrar.register(scans, unit=data.unit, up=data.up, seed=settings.seed)
    return ScanStart(tuple(fits))


@dataclass(frozen=True, eq=False)
class ViewStart:
    """What the recipe of depth views made of the K with a pose of their own: poses in the cameras'
    frames, the views with their cameras at the origin, masks, and noise where the views give it.
    """

    betas: Float[np.ndarray, " B"]
    pose: Float[np.ndarray, "K J 3"]
    trans: Float[np.ndarray, "K 3"]
    views: tuple[ViewData, ...]
    masks: tuple[Bool[np.ndarray, "_ _"], ...]
    noise: tuple[float | None, ...]


def start_views(body: BodyModel, data: SensorData, settings: FitSettings) -> ViewStart | None:
    """All views with a pose of their own, fitted together; None without such."""
    own = [
        replace(each, view=each.view.in_camera_frame()) for each in data.views if each.at is None
    ]
    if not own:
        return None
    from habitus.fit.points.depth import fit_state  # needs PyTorch, as views do
    from habitus.observe.camera import RgbdCapture

    capture = RgbdCapture("views", tuple(each.view for each in own)).without("colour")
    # One step with skin offsets is enough for a start: the joint fit has its own.
    fit = fit_state(capture, body, replace(settings.depth, skin_steps=1))
    moved = [
        into_frame(body, fit.state[k : k + 1], view.turn, view.shift)
        for k, view in enumerate(fit.prepared_views)
    ]
    pose, trans = (np.stack(part) for part in zip(*moved, strict=True))
    masks = tuple(view.mask for view in fit.prepared_views)
    noise = tuple(view.noise for view in fit.prepared_views)
    return ViewStart(fit.state.betas, pose, trans, tuple(own), masks, noise)


def into_frame(
    body: BodyModel,
    state: BodyState,
    turn: Float[np.ndarray, "3 3"],
    shift: Float[np.ndarray, " 3"],
) -> tuple[Float[np.ndarray, "J 3"], Float[np.ndarray, " 3"]]:
    """Pose and trans of a state of one pose in the world turn x + shift, in the frame x."""
    pose, trans = state.pose[0].copy(), state.trans[0]
    root = np.asarray(body.rest_joints(state.betas))[0]
    pose[0] = rotvec_from_matrix(turn.T @ matrix_from_rotvec(pose[0]))
    return pose, turn.T @ (root + trans - shift) - root


@dataclass(frozen=True, eq=False)
class ViewPixels:
    """A view, the person's pixels, sd of depth over its square (1 / m), and the pose (row of the
    state) it shows.
    """

    data: ViewData
    mask: Bool[np.ndarray, "H W"]
    noise: float
    row: int


@dataclass(frozen=True, eq=False)
class ScanPoints:
    """Some points of a scan (m) and their normals, their noise (m), and the pose (row of the state)
    they show.
    """

    points: Float[np.ndarray, "P 3"]
    normals: Float[np.ndarray, "P 3"] | None
    noise: float
    row: int


def separate_views(
    start: ViewStart | None, first: int, settings: FitSettings
) -> tuple[ViewPixels, ...]:
    """Views with poses of their own, the rows of the state from ``first`` on."""
    if start is None:
        return ()
    return tuple(
        ViewPixels(data, mask, _view_noise(data, noise, settings), first + k)
        for k, (data, mask, noise) in enumerate(
            zip(start.views, start.masks, start.noise, strict=True)
        )
    )


def shared_views(
    data: SensorData, markers: MarkerStart | None, settings: FitSettings
) -> tuple[ViewPixels, ...]:
    """Views of captures' frames, which start from the markers' poses."""
    views = [each for each in data.views if each.at is not None]
    if markers is None or not views:
        return ()
    from habitus.fit.points.prepared_views import segment  # needs PyTorch, as views do

    segments = [segment(each.view) for each in views]
    return tuple(
        ViewPixels(each, part.mask, _view_noise(each, part.noise, settings), _row(markers, each))
        for each, part in zip(views, segments, strict=True)
    )


def _view_noise(data: ViewData, measured: float | None, settings: FitSettings) -> float:
    """What is given, else what the view's empty room shows, else the recipe's."""
    known = [noise for noise in (data.noise, measured) if noise is not None]
    return known[0] if known else settings.depth.noise


def separate_scans(
    data: SensorData, start: ScanStart | None, first: int, settings: FitSettings
) -> tuple[ScanPoints, ...]:
    """Scans with poses of their own, the rows of the state from ``first`` on."""
    if start is None:
        return ()
    last = settings.scans.stages[-1]
    own = [each for each in data.scans if each.at is None]
    clouds = [fit.cloud.first(last.points) for fit in start.fits]
    return tuple(
        ScanPoints(cloud.points, cloud.unit_normals, each.noise or last.noise, first + k)
        for k, (each, cloud) in enumerate(zip(own, clouds, strict=True))
    )


def shared_scans(
    data: SensorData, markers: MarkerStart | None, settings: FitSettings
) -> tuple[ScanPoints, ...]:
    """Scans of captures' frames: some points, and their normals where any point outward."""
    last = settings.scans.stages[-1]
    scans = []
    for each in data.scans:
        if each.at is None or markers is None:
            continue
        scan = each.scan
        normals = scan.normals if scan.oriented else None
        if normals is None and scan.faces is not None:
            normals = vertex_normals(scan.points, scan.faces)
        some = np.random.default_rng(settings.seed).permutation(len(scan.points))[: last.points]
        chosen = None if normals is None else np.asarray(normals)[some]
        noise = each.noise or last.noise
        scans.append(ScanPoints(scan.points[some], chosen, noise, _row(markers, each)))
    return tuple(scans)


def _row(markers: MarkerStart, data: ViewData | ScanData) -> int:
    assert data.at is not None
    return markers.frames.index(data.at)
