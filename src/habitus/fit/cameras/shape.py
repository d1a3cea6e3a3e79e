"""The shape stage of keypoints: betas, the detector's own places of keypoints, and corrections of
cameras, with the poses of a few frames.

    E = 1/2 sum_fck w rho(|P_c(q_fk) - u_fck|^2)                  "pixels"
      + 1/2 |betas|^2                                             "shape"
      + 1/2 sum_f (theta_f - mean)^T P (theta_f - mean)           "pose"
      + 1/2 sum_k |d_k|^2 / s_k^2                                 "definitions"
      + 1/2 sum_c (|turn_c|^2 / a^2 + |shift_c|^2 / b^2)          "cameras"
      + 1/2 (mean distance of cameras, changed)^2 / c^2           "scale"
      + 1/2 (height - given)^2 / h^2                              "height"

q are the keypoints of `habitus.observe.keypoints`, whose d of left and right are mirror images.
Geman-McClure's rho is re-weighted before each step.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np
from jaxtyping import Float

from habitus.body.model import BodyModel
from habitus.body.prior import PosePrior
from habitus.fit.cameras.settings import CameraSettings
from habitus.observe.camera_rig import NEAR, CameraRig
from habitus.observe.keypoints import KeypointDerivatives, KeypointRig
from habitus.residuals.shape_stage import diagonal, pose_prior, shape_prior
from habitus.rotations import cross_matrix, matrix_from_rotvec
from habitus.solve.least_squares import Levenberg
from habitus.solve.minimize import Stage, alternate
from habitus.solve.terms import Term, geman_mcclure_weight


@dataclass(frozen=True, eq=False)
class CameraShape:
    """Result of the shape stage: betas (B,), places that the detector adds (K, 3; m), the corrected
    cameras with their turns and shifts (C, 6; rad, m), poses and places of its frames.
    """

    betas: Float[np.ndarray, " B"]
    offsets: Float[np.ndarray, "K 3"]
    rig: CameraRig
    corrections: Float[np.ndarray, "C 6"]
    pose: Float[np.ndarray, "F J 3"]
    trans: Float[np.ndarray, "F 3"]
    status: str
    costs: Mapping[str, float]


@dataclass(frozen=True, eq=False)
class ShapeData:
    """What the F frames of the shape stage show: pixels (F, C, K, 2) without distortion, NaN where
    missing, and their information ``weights`` (F, C, K; 1 / px^2).
    """

    rig: CameraRig
    pixels: Float[np.ndarray, "F C K 2"]
    weights: Float[np.ndarray, "F C K"]


def mirrored(names: tuple[str, ...]) -> Float[np.ndarray, "n m"]:
    """The offsets of all keypoints (3 K) from those that are free (3 K'): of a pair the left one;
    those on the middle plane stay on it.
    """
    columns: list[np.ndarray] = []
    for k, name in enumerate(names):
        side, _, plain = name.partition("_")
        for axis in range(3):
            column = np.zeros((len(names), 3))
            column[k, axis] = 1.0
            if side == "left" and f"right_{plain}" in names:
                column[names.index(f"right_{plain}"), axis] = -1.0 if axis == 0 else 1.0
            elif (side == "right" and f"left_{plain}" in names) or (
                side not in ("left", "right") and axis == 0
            ):
                continue
            columns.append(column.ravel())
    return np.stack(columns, 1)


def shape_stage(
    body: BodyModel,
    prior: PosePrior,
    rig: KeypointRig,
    data: ShapeData,
    start: CameraShape,
    settings: CameraSettings,
    reaches: tuple[float, ...],
    height: float | None,
    correct: bool,
) -> CameraShape:
    """Everything from a start, in rounds of falling ``reaches``. correct: cameras are unknowns."""
    own = mirrored(rig.names)
    spread = np.repeat(rig.definition, 3)
    sd = 1.0 / np.sqrt(((own / spread[:, None]) ** 2).sum(0))
    free = np.linalg.lstsq(own, start.offsets.ravel(), rcond=None)[0]
    unknowns = {
        "betas": start.betas.copy(),
        "offsets": free,
        "cameras": start.corrections.copy(),
        "pose": start.pose.copy(),
        "trans": start.trans.copy(),
    }
    frames = len(start.pose)
    given = prior.for_joints(body.joint_names)
    fixed = {
        "shape": shape_prior(body.num_betas, 1.0),
        "pose": pose_prior(given.mean, np.sqrt(settings.pose) * given.whitening, frames, 1.0),
        "definitions": Term(
            lambda offsets: (offsets / sd, {"offsets": np.diag(1.0 / sd)}), name="definitions"
        ),
    }
    if correct:
        fixed |= _camera_terms(data.rig, settings)
    if height is not None:
        fixed["height"] = height_term(body, height, settings.height_sd)

    def terms_at(values: dict[str, np.ndarray], stage: "Reach", step: int) -> dict[str, Term]:
        return {"pixels": data_term(rig, data, own, values, stage.reach), **fixed}

    count = np.arange(body.num_betas)
    stages = [
        Reach(
            8,
            reach=reach,
            masks={"betas": count < settings.betas},
            fixed=() if correct else ("cameras",),
            max_step={"pose": 0.5},
        )
        for reach in reaches
    ]
    solved = alternate(terms_at, unknowns, stages, steps=Levenberg(1e-4), blocks=("trans", "pose"))
    values = solved.state
    return CameraShape(
        values["betas"],
        (own @ values["offsets"]).reshape(-1, 3),
        corrected_rig(data.rig, values["cameras"]),
        values["cameras"],
        values["pose"],
        values["trans"],
        solved.status,
        solved.costs,
    )


@dataclass(frozen=True)
class Reach(Stage):
    """Some steps with one scale of the robust loss, in standard deviations."""

    reach: float = 5.0


def corrected_rig(rig: CameraRig, corrections: Float[np.ndarray, "C 6"]) -> CameraRig:
    """The cameras after their turns (rad) and shifts (m) in their own frames."""
    turns = matrix_from_rotvec(corrections[:, :3])
    cameras = (
        camera.moved(turn, shift)
        for camera, turn, shift in zip(rig.cameras, turns, corrections[:, 3:], strict=True)
    )
    return replace(rig, cameras=tuple(cameras))


def data_term(
    rig: KeypointRig,
    data: ShapeData,
    own: Float[np.ndarray, "n m"],
    values: Mapping[str, np.ndarray],
    reach: float,
) -> Term:
    """The term "pixels", with the robust weights of the state ``values``."""

    def derivatives(betas, offsets, pose, trans) -> KeypointDerivatives:
        return rig.derivatives(betas, (own @ offsets).reshape(-1, 3), pose, trans)

    here = derivatives(*(values[name] for name in ("betas", "offsets", "pose", "trans")))
    known = data.rig
    seen = np.asarray(np.isfinite(data.pixels).all(-1))
    target = np.where(seen[..., None], data.pixels, 0.0)
    first = _pixels(known, here.points, values["cameras"])[0]
    weights = np.where(seen & np.isfinite(first).all(-1), data.weights, 0.0)
    root = np.sqrt(_reweighted(weights, np.nan_to_num(first) - target, reach))[..., None]

    def residual(betas, offsets, cameras, pose, trans):
        found = derivatives(betas, offsets, pose, trans)
        pixels, slope, there = _pixels(known, found.points, cameras)
        off = root * np.where(root > 0.0, np.nan_to_num(pixels - target, nan=1e6), 0.0)

        def jacobians():
            frames, count = len(pose), len(known.cameras)
            turned = matrix_from_rotvec(cameras[:, :3]) @ known.rotation
            by_point = root[..., None] * np.einsum("fckui,cij->fckuj", slope, turned)
            out = _jacobians(found, own, by_point, frames)
            moved = np.concatenate(
                [-np.einsum("fckui,fckij->fckuj", slope, cross_matrix(there)), slope], -1
            )
            moved = (root[..., None] * moved).reshape(frames, count, -1, 6)
            table = np.zeros((*moved.shape[:3], count, 6))
            for c in range(count):
                table[:, c, :, c] = moved[:, c]
            return out | {"cameras": table.reshape(-1, 6 * count)}

        return off, jacobians

    return Term(residual, name="pixels")


def _reweighted(weights: np.ndarray, off: np.ndarray, reach: float) -> np.ndarray:
    """Weights times those of Geman-McClure's loss of ``reach`` standard deviations."""
    return weights * geman_mcclure_weight(np.sqrt(weights * (off**2).sum(-1)), reach)


def _pixels(
    rig: CameraRig, points: Float[np.ndarray, "F K 3"], corrections: Float[np.ndarray, "C 6"]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pixels (F, C, K, 2), their derivatives (F, C, K, 2, 3) by the turned point in the camera's
    frame before the shift (3 of the turn are its cross matrix), and that point.
    """
    turn = matrix_from_rotvec(corrections[:, :3])
    there = np.einsum("cij,fkj->fcki", turn @ rig.rotation, points)
    there = there + (np.einsum("cij,cj->ci", turn, rig.translation))[None, :, None]
    shifted = there + corrections[None, :, None, 3:]
    depth = np.where(shifted[..., 2] > NEAR, shifted[..., 2], np.nan)
    focal = rig.focal[None, :, None]
    plane = shifted[..., :2] / depth[..., None]
    pixels = focal * plane + rig.centre[None, :, None]
    slope = np.zeros((*pixels.shape, 3))
    scale = np.nan_to_num(focal / depth[..., None])
    slope[..., 0, 0], slope[..., 1, 1] = scale[..., 0], scale[..., 1]
    slope[..., 2] = -scale * np.nan_to_num(plane)
    return pixels, slope, there


def _jacobians(
    found: KeypointDerivatives, own: np.ndarray, by_point: np.ndarray, frames: int
) -> dict[str, Any]:
    """By betas, offsets, pose and place, from those by the keypoints (F, C, K, 2, 3)."""
    keypoints = by_point.shape[2]
    betas = np.einsum("fckri,fkib->fckrb", by_point, found.by_betas)
    pose = np.einsum("fckri,fkin->fckrn", by_point, found.by_pose)
    turned = np.einsum("fckri,fkij->fckrj", by_point, found.by_offsets)
    offsets = np.einsum("fckrj,kjm->fckrm", turned, own.reshape(keypoints, 3, -1))
    size = int(np.prod(by_point.shape[1:4]))
    return {
        "betas": betas.reshape(frames * size, -1),
        "offsets": offsets.reshape(frames * size, -1),
        "pose": diagonal(pose.reshape(frames, size, -1)),
        "trans": diagonal(by_point.reshape(frames, size, 3)),
    }


def _camera_terms(rig: CameraRig, settings: CameraSettings) -> dict[str, Term]:
    """Priors of the corrections, and of the cameras' mean distance."""
    sd = np.concatenate(
        [np.full(3, np.radians(settings.camera_turn)), np.full(3, settings.camera_shift)]
    )
    count = len(rig.cameras)
    own = np.diag(np.tile(1.0 / sd, count))
    terms = {"cameras": Term(lambda cameras: (cameras / sd, {"cameras": own}), name="cameras")}
    if count > 1:
        places = rig.places
        pairs = list(combinations(range(count), 2))
        slope = np.zeros((count, 6))
        for a, b in pairs:
            along = (places[a] - places[b]) / np.linalg.norm(places[a] - places[b])
            slope[a, 3:] -= rig.rotation[a] @ along / len(pairs)
            slope[b, 3:] += rig.rotation[b] @ along / len(pairs)
        row = slope.reshape(1, -1) / settings.camera_scale
        terms["scale"] = Term(
            lambda cameras: (row @ cameras.ravel(), {"cameras": row}), name="scale"
        )
    return terms


def height_term(body: BodyModel, height: float, sd: float) -> Term:
    """The height (m) of the rest pose, as given."""

    def residual(betas):
        rest = body.rest_vertices(betas)[:, 1]
        top, bottom = int(rest.argmax()), int(rest.argmin())
        slope = np.asarray(body.shapedirs)[top, 1] - np.asarray(body.shapedirs)[bottom, 1]
        return np.array([rest[top] - rest[bottom] - height]) / sd, {"betas": slope[None] / sd}

    return Term(residual, name="height")


def betas_of_height(body: BodyModel, height: float) -> Float[np.ndarray, " B"]:
    """The likeliest shape of a height (m): the shortest betas, to first order of the mean shape."""
    term = height_term(body, height, 1.0)
    off, slopes = term.residual(np.zeros(body.num_betas))
    slope = slopes["betas"][0]
    return -slope * off[0] / (slope @ slope)
