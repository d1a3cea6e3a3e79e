"""The arrays and facts that the report's scripts read: mesh, skinning, motion and markers for the
player, thinned and quantised; unobserved segments and tapes; error curves, maps and joint angles,
binned so that the page of a long capture stays small.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from habitus.body.joint_angles import joint_angles
from habitus.body.skin import skin_of
from habitus.export.animation import STAGES, Animation, Track, animate
from habitus.fit.markers.result import MarkerFit
from habitus.fit.markers.solution import UNCERTAINTY
from habitus.mesh.proximity import signed_distance
from habitus.parallel.blocks import every_nth_frame, mapped
from habitus.report.shell import Blob
from habitus.results.save import marker_means
from habitus.rotations import up_rotation

if TYPE_CHECKING:
    from habitus.body.motion import Moving

SKIN = "medium"
"""The tone that the player shows where one asks for skin."""
PLAYER_HZ = 62.0
"""Frames a second that the player holds at most: a little more than screens show."""
PLAYER_BYTES = 5_000_000
"""Bytes of motion before compression and base64; longer captures are thinned to it."""
MORPHS = 16
"""Shapes that carry soft tissue and pose blend shapes in the player."""
MORPH_TOLERANCE = 2e-4
"""Metres (RMS) to which fewer morphs suffice."""
FLOOR_TOLERANCE = 0.10
"""Metres: soles within this of height zero mean that the capture's floor is zero."""
FLOOR_FRAMES = 24
"""Frames from which the height of the floor is estimated."""
PLAYER_MARGIN = 2.5
"""Metres around the root's path that marker positions are quantised in: a ghost marker a hundred
metres away must not cost all others their digits."""
PLOT_BINS = 3000
"""Points of a curve: some two a pixel on a wide screen."""
MAP_BINS = 800
"""Columns of the maps of markers over time."""
ANGLE_FRAMES = 1500
"""Frames of the joint angles' curves."""
SEEN, PARTLY_MISSING, MISSING, DISTRUSTED = range(4)
TRUSTED_WEIGHT = 0.5
"""A sample with less of a marker's full weight counts as down-weighted."""
MAP_STEP_MM = 0.4
"""One step of the 8-bit map: 254 steps reach 101.6 mm."""
GUESSED_RANGE = (0.75, 1.5)
"""The spread at which the stripes begin to show, and are full; in units of
`UncertaintySettings.guessed`."""


@dataclass(frozen=True)
class Scene:
    """What the scripts read besides the arrays: ``facts``, and how many frames of the capture make
    one of the player's.
    """

    facts: dict[str, Any]
    stride: int


def add_scene(fit: "Moving", blob: Blob, last_stage: bool = False) -> Scene:
    """Pack the moving body, in all stages or in the last one, and the markers of a marker fit; +y
    up, metres.
    """
    stages = STAGES if fit.soft_tissue is not None else STAGES[:1]
    stages = stages[-1:] if last_stage else stages
    stride = player_stride(fit, len(stages))
    animation = animate(fit, stages, max_morphs=MORPHS, tolerance=MORPH_TOLERANCE, stride=stride)
    _add_mesh(animation, blob)
    colours = _add_colours(fit, blob)
    for stage, track in zip(stages, animation.tracks, strict=True):
        _add_track(stage, track, blob)
    if isinstance(fit, MarkerFit):
        _add_markers(fit, stages, stride, blob)
        _add_placement(fit, animation, blob)
    else:
        _add_no_markers(stages, blob)
    facts = {
        **_parts(None if last_stage else fit, animation, blob),
        "skin": colours,
        "stages": list(stages),
        "rate": animation.rate_hz,
        "stride": stride,
        "parents": list(animation.body.parents),
        "jointNames": list(animation.body.joint_names),
        "floor": _floor(fit),
        "height": float(np.ptp(animation.rest_vertices[:, 1])),
        "morphResidual": animation.morph_residual,
    }
    return Scene(facts, stride)


def player_stride(fit: "Moving", stages: int) -> int:
    """How many frames of the capture make one of the player's."""
    frames, joints = fit.pose.shape[:2]
    markers = len(fit.labels) if isinstance(fit, MarkerFit) else 0
    bytes_a_frame = stages * (14 * joints + 4 * MORPHS) + markers * (6 * (1 + stages) + 1)
    return max(
        1,
        int(np.ceil(fit.rate_hz / PLAYER_HZ)),
        int(np.ceil(frames * bytes_a_frame / PLAYER_BYTES)),
    )


def _add_mesh(animation: Animation, blob: Blob) -> None:
    vertices = animation.rest_vertices
    body = animation.body
    blob.add_points("vertices", vertices, vertices.min(axis=0), vertices.max(axis=0))
    blob.add("faces", body.faces.astype("u2" if len(vertices) < 65536 else "u4"))
    strongest = np.argsort(-body.skinning_value, axis=1)[:, :4]
    value = np.take_along_axis(body.skinning_value, strongest, axis=1)
    index = np.take_along_axis(body.skinning_index, strongest, axis=1)
    fill = ((0, 0), (0, 4 - value.shape[1]))
    blob.add("joints", np.pad(index, fill).astype("u2"))
    blob.add(
        "weights",
        np.pad(np.round(65535 * value / value.sum(axis=1, keepdims=True)), fill).astype("u2"),
    )
    blob.add("restJoints", animation.rest_joints.astype("f4"))
    scale = (
        np.abs(animation.morphs).max(axis=(1, 2), initial=1e-9) / 127
        if len(animation.morphs)
        else np.zeros(0)
    )
    blob.add(
        "morphs",
        np.round(animation.morphs / scale[:, None, None]).astype("i1"),
        scale=scale.tolist(),
    )


def _add_colours(fit: "Moving", blob: Blob) -> bool:
    """Three bytes a vertex of a default body: its skin, which the page shows where one asks for
    it.
    """
    full, rows = fit.finest_body, fit.body.full_vertices
    skin = skin_of(full.mesh, SKIN)
    if skin is None:
        return False
    colours = skin.colours if rows is None else skin.colours[rows]
    blob.add("colours", colours, steps=True)
    return True


def _add_track(stage: str, track: Track, blob: Blob) -> None:
    blob.add(f"{stage}/quaternions", np.round(32767 * track.quaternions).astype("i2"), True)
    blob.add(f"{stage}/root", track.joint_translations[:, 0].astype("f4"))
    others = track.joint_translations[:, 1:]
    if np.ptp(others, axis=0).max(initial=0.0) > 1e-9:
        blob.add_points(
            f"{stage}/joints", others, others.min(axis=(0, 1)), others.max(axis=(0, 1)), True
        )
    unit = 1 / 32767
    blob.add(
        f"{stage}/morphWeights", np.round(track.morph_weights / unit).astype("i2"), True, unit=unit
    )


def _add_markers(fit: MarkerFit, stages: Sequence[str], stride: int, blob: Blob) -> None:
    turn = up_rotation(fit.up_axis).T
    root = fit.trans @ turn + fit.body.rest_joints(fit.betas)[0]
    low, high = (edge(axis=0) for edge in (root.min, root.max))
    low = low - PLAYER_MARGIN
    high = high + PLAYER_MARGIN
    predicted = {"pose": fit.predicted_pose_stage, "soft_tissue": fit.predicted_soft_tissue}
    points = {"observed": fit.observed_markers} | {
        f"{stage}/predicted": predicted[stage] for stage in stages
    }
    for name, positions in points.items():
        blob.add_points(
            name, every_nth_frame(np.asarray(positions), stride) @ turn, low, high, True
        )
    weights = np.nan_to_num(every_nth_frame(np.asarray(fit.marker_weights), stride))
    blob.add("markerWeights", np.round(255 * np.clip(weights, 0, 1)).astype("u1"), True)


def _parts(fit: "Moving | None", animation: Animation, blob: Blob) -> dict[str, Any]:
    """Facts on unobserved segments and on tapes, which marker fits have."""
    if not isinstance(fit, MarkerFit):
        return {"guessed": False, "tapes": []}
    return {
        "guessed": add_guessed(fit, blob),
        "tapes": add_tapes(fit, animation.rest_vertices, blob),
    }


def _add_no_markers(stages: Sequence[str], blob: Blob) -> None:
    for name in ("observed", *(f"{stage}/predicted" for stage in stages)):
        blob.add_points(name, np.zeros((0, 0, 3)), np.zeros(3), np.ones(3))
    blob.add("markerWeights", np.zeros((0, 0), "u1"))
    for name, shape in (("latent", (0, 3)), ("skin", (0, 3)), ("skinDistance", (0,))):
        blob.add(name, np.zeros(shape, "f4"))


def _add_placement(fit: MarkerFit, animation: Animation, blob: Blob) -> None:
    """Latent markers on the rest surface, their closest points on the skin, and the signed
    distances between the two (m).
    """
    latent = np.ascontiguousarray(fit.latent_markers, np.float64)
    faces = animation.body.faces
    closest = signed_distance(latent, animation.rest_vertices, faces)
    corners = animation.rest_vertices[faces[closest.triangle]]
    skin = np.einsum("mk,mkc->mc", closest.barycentric, corners)
    blob.add("latent", latent.astype("f4"))
    blob.add("skin", skin.astype("f4"))
    blob.add("skinDistance", closest.distance.astype("f4"))


def _floor(fit: "Moving") -> float:
    """Height of the floor: zero where the soles are usually near zero, else the height at which
    they usually are.
    """
    frames = np.unique(np.linspace(0, len(fit.pose) - 1, FLOOR_FRAMES).astype(int))
    up = up_rotation(fit.up_axis)[1]
    some = np.arange(0, fit.body.num_vertices, 3)
    lows = [
        float((vertices @ up).min())
        for surface in fit.surfaces(frames, some)
        for vertices in surface.vertices
    ]
    # above the quantile: jumps; below it: a bad frame or two
    usual = float(np.quantile(lows, 0.25))
    return 0.0 if abs(usual) <= FLOOR_TOLERANCE else usual


def add_guessed(fit: MarkerFit, blob: Blob) -> bool:
    """Pack how uncertain each joint's segment is over time, 0 to 255; True where any segment is
    ever unobserved (`UncertaintySettings.guessed`).
    """
    edges, spread = fit.guessed
    low, high = (share * UNCERTAINTY.guessed for share in GUESSED_RANGE)
    blob.add("guessed", np.round(255 * np.clip((spread - low) / (high - low), 0, 1)).astype("u1"))
    blob.add("guessedFrames", edges.astype("u4"))
    return bool((spread > UNCERTAINTY.guessed).any())


def add_tapes(fit: MarkerFit, rest: np.ndarray, blob: Blob) -> list[dict[str, Any]]:
    """Pack the points (m) of the measuring tapes on the body at rest (V, 3); gives each tape's name
    and number of points, in their order. A body without tapes has none.
    """
    kit = fit.body.measuring_kit
    tapes = kit.tapes if kit else ()
    rings = [(tape.name, ring.tape(rest)) for tape in tapes for ring in tape.rings]
    points = np.concatenate([np.zeros((0, 3)), *(ring for _, ring in rings)])
    blob.add("tapes", points.astype("f4"))
    return [{"name": f"{name}_circumference_m", "points": len(ring)} for name, ring in rings]


def add_plots(fit: MarkerFit, blob: Blob) -> dict[str, Any]:
    """Pack error curves (mm) and the maps of markers over time; gives the facts to read them."""
    frames = len(fit.pose)
    stages = [s for s in ("pose", "soft_tissue") if fit.errors(s) is not None]
    edges = bin_edges(frames, PLOT_BINS)
    for stage in stages:
        mean, worst = mapped(_frame_errors, np.asarray(fit.errors(stage))).T
        blob.add(f"{stage}/meanError", bin_means(mean, edges).astype("f4"))
        blob.add(f"{stage}/worstError", _reduce(np.fmax, worst, edges).astype("f4"))
    blob.add(
        "visible",
        np.add.reduceat(fit.visible.sum(axis=1), edges).astype("f4") / _lengths(edges, frames),
    )
    blob.add("flagged", np.maximum.reduceat(np.asarray(fit.flagged_frames, "u1"), edges))
    map_edges = bin_edges(frames, MAP_BINS)
    worst = 1e3 * _reduce(np.fmax, np.asarray(fit.errors(stages[-1])), map_edges)
    steps = np.clip(np.round(np.nan_to_num(worst) / MAP_STEP_MM), 0, 254)
    blob.add("errorMap", np.where(np.isfinite(worst), steps, 255).astype("u1").T)
    blob.add("gapMap", _packed(gap_states(fit, map_edges).T))
    return {
        "plotFrames": edges.tolist() if len(edges) < frames else None,
        "mapBins": len(map_edges),
        "mapStep": MAP_STEP_MM,
        "markerMeans": {
            stage: _tenths(marker_means(np.asarray(fit.errors(stage)))) for stage in stages
        },
        "downWeighted": _down_weighted(fit),
        "missing": [round(float(share), 4) for share in 1 - fit.visible.mean(axis=0)],
    }


def gap_states(fit: MarkerFit, edges: np.ndarray) -> np.ndarray:
    """(bins, M) in the bins that begin at the frames ``edges``: SEEN, PARTLY_MISSING, MISSING
    throughout, or DISTRUSTED in some frame.
    """
    visible = fit.visible
    low = _distrusted(fit) & visible
    seen = np.logical_or.reduceat(visible, edges)
    distrusted = np.logical_or.reduceat(low, edges)
    whole = np.logical_and.reduceat(visible, edges)
    return np.select(
        [~seen, distrusted, ~whole], [MISSING, DISTRUSTED, PARTLY_MISSING], SEEN
    ).astype("u1")


def _packed(states: np.ndarray) -> np.ndarray:
    """Numbers 0 to 3, row by row, four to a byte, the first in its lowest bits."""
    flat = np.pad(states.ravel(), (0, -states.size % 4)).reshape(-1, 4)
    return (flat << np.arange(0, 8, 2, dtype="u1")).sum(axis=1).astype("u1")


def add_angles(fit: MarkerFit, blob: Blob) -> list[dict[str, Any]]:
    """Pack joint angles of at most ANGLE_FRAMES frames, in tenths of degrees; gives the name and
    side of each row. A body with none of the joints has no rows.
    """
    frames = bin_edges(len(fit.pose), ANGLE_FRAMES)
    angles = joint_angles(fit.body, fit.betas, fit.pose[frames])
    rows = [
        (name, side, values) for name, sides in angles.items() for side, values in sides.items()
    ]
    if rows:
        tenths = 10 * np.column_stack([values for *_, values in rows])
        blob.add("angles", np.round(np.clip(tenths, -32768, 32767)).astype("i2"), True)
        blob.add("angleFrames", frames.astype("u4"))
    return [{"name": name, "side": side} for name, side, _ in rows]


def _distrusted(fit: MarkerFit) -> np.ndarray:
    return mapped(lambda part: part < TRUSTED_WEIGHT, np.asarray(fit.marker_weights))


def _down_weighted(fit: MarkerFit) -> list[float]:
    """Share of each marker's visible frames in which it was down-weighted."""
    visible = fit.visible
    low = _distrusted(fit) & visible
    return [
        round(float(share), 4) for share in low.sum(axis=0) / np.maximum(visible.sum(axis=0), 1)
    ]


def _frame_errors(metres: np.ndarray) -> np.ndarray:
    """(T, 2): mean and largest error (mm) over the visible markers of each frame, NaN where none is
    visible.
    """
    errors = 1e3 * metres
    seen = np.isfinite(errors)
    count = seen.sum(axis=1)
    mean = np.where(seen, errors, 0).sum(axis=1) / np.maximum(count, 1)
    worst = np.where(seen, errors, -1).max(axis=1, initial=-1)
    return np.where(count[:, None] > 0, np.stack([mean, worst], axis=1), np.nan)


def bin_edges(frames: int, bins: int) -> np.ndarray:
    """First frame of each of at most ``bins`` bins."""
    return np.unique(np.linspace(0, frames, min(frames, bins), endpoint=False).astype(np.int64))


def _lengths(edges: np.ndarray, frames: int) -> np.ndarray:
    return np.diff(np.append(edges, frames)).astype("f4")


def bin_means(values: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Mean of the finite values in each bin, NaN where a bin holds none."""
    known = np.isfinite(values)
    count = np.add.reduceat(known.astype(np.int64), edges)
    total = np.add.reduceat(np.where(known, values, 0), edges)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def _reduce(ufunc: np.ufunc, values: np.ndarray, edges: np.ndarray) -> np.ndarray:
    return values if len(edges) == len(values) else ufunc.reduceat(values, edges, axis=0)


def _tenths(metres: np.ndarray) -> list[float | None]:
    return [round(1e3 * float(m), 2) if np.isfinite(m) else None for m in metres]
