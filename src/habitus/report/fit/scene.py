"""What the report's player needs of a fit: mesh, skin, motion and markers, thinned and
quantised.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from habitus.body.up import up_rotation
from habitus.export.animation import STAGES, Animation, Track, animate
from habitus.export.obj import fitted_vertices
from habitus.fit.markers.result import MarkerFit
from habitus.mesh.signed_distance import signed_distance
from habitus.parallel.blocks import thinned
from habitus.report.fit.blob import Blob
from habitus.report.fit.parts import add_guessed, add_tapes

if TYPE_CHECKING:
    from habitus.body.motion import Moving

PLAYER_HZ = 62.0  # faster captures are thinned to at most this
PLAYER_BYTES = 5_000_000  # longer ones to what fits here, before base64
MORPHS = 16
FLOOR_TOLERANCE = 0.10  # metres: soles within this of zero mean that the capture's floor is zero
FLOOR_FRAMES = 24


@dataclass(frozen=True)
class Scene:
    """What the script is told besides the arrays."""

    facts: dict[str, Any]
    stride: int


def add_scene(fit: "Moving", blob: Blob, last_stage: bool = False) -> Scene:
    """Pack the moving body, all its stages or the last one, and of a fit its markers; +y up,
    metres.
    """
    stages = STAGES if fit.soft_tissue is not None else STAGES[:1]
    stages = stages[-1:] if last_stage else stages
    stride = player_stride(fit, len(stages))
    animation = animate(fit, stages, max_morphs=MORPHS, tolerance=2e-4, stride=stride)
    _add_mesh(animation, blob)
    for stage, track in zip(stages, animation.tracks, strict=True):
        _add_track(stage, track, blob)
    if isinstance(fit, MarkerFit):
        _add_markers(fit, stages, stride, blob)
        _add_placement(fit, animation, blob)
    else:
        _add_no_markers(stages, blob)
    facts = {
        **_parts(None if last_stage else fit, animation, blob),
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
    low = low - 2.5
    high = high + 2.5  # a ghost a hundred metres away must not cost everyone else their digits
    predicted = {"pose": fit.predicted_pose_stage, "soft_tissue": fit.predicted_soft_tissue}
    points = {"observed": fit.observed_markers} | {
        f"{stage}/predicted": predicted[stage] for stage in stages
    }
    for name, places in points.items():
        blob.add_points(name, thinned(np.asarray(places), stride) @ turn, low, high, True)
    weights = np.nan_to_num(thinned(np.asarray(fit.marker_weights), stride))
    blob.add("markerWeights", np.round(255 * np.clip(weights, 0, 1)).astype("u1"), True)


def _parts(fit: "Moving | None", animation: Animation, blob: Blob) -> dict[str, Any]:
    """What is guessed and where tapes lie, of a fit."""
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
    """Latent markers on the rest surface, the nearest skin points, and the signed distances between
    them (m).
    """
    latent = np.ascontiguousarray(fit.latent_markers, np.float64)
    faces = animation.body.faces
    near = signed_distance(latent, animation.rest_vertices, faces)
    skin = np.einsum("mk,mkc->mc", near.barycentric, animation.rest_vertices[faces[near.triangle]])
    blob.add("latent", latent.astype("f4"))
    blob.add("skin", skin.astype("f4"))
    blob.add("skinDistance", near.distance.astype("f4"))


def _floor(fit: "Moving") -> float:
    """Height of the floor: zero where the capture's own zero is plausible, else where the body
    usually stands.
    """
    frames = np.unique(np.linspace(0, len(fit.pose) - 1, FLOOR_FRAMES).astype(int))
    up = up_rotation(fit.up_axis)[1]
    some = np.arange(0, fit.body.num_vertices, 3)
    lows = [float((vertices @ up).min()) for vertices in fitted_vertices(fit, frames, some)]
    usual = float(np.quantile(lows, 0.25))  # above it: jumps; below it: a bad frame or two
    return 0.0 if abs(usual) <= FLOOR_TOLERANCE else usual
