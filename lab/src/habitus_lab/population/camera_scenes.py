"""People in motion before calibrated cameras, as a detector of keypoints would see them.

Detections are off by noise of 1 % of the person's height (.7 of it on the face, 1.6 on hips), half
of it lasting .2 s, with Student's tails (4 degrees of freedom), 1 % of outliers of 12 % of the
height, 10 % missing in runs, and left and right exchanged in runs of 1 % of the samples. The
detector has its own places of keypoints (`definition`, m, sd along an axis, mirrored).
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from scipy.ndimage import gaussian_filter1d

from habitus.body.model import BodyModel
from habitus.fit.cameras.shape import mirrored
from habitus.observe.camera_rig import CameraRig, RigCamera
from habitus.observe.detections import Detections
from habitus.observe.keypoints import KeypointRig, convention_names
from habitus.rotations import matrix_from_rotvec

NOISE = 0.01
SHARES = {"nose": 0.7, "eye": 0.7, "ear": 0.7, "hip": 1.6}
LASTING = 0.2
OUTLIERS, OUTLIER = 0.01, 0.12
MISSING, EXCHANGED = 0.10, 0.01
RUN = 0.15
"""Seconds of a run of missing or exchanged samples, mean."""
FOCAL, SIZE = 1400.0, (1920, 1080)


@dataclass(frozen=True, eq=False)
class CameraScene:
    """What was made: the person's body, shape and motion (y up), true cameras and keypoints (m),
    and the detections.
    """

    body: BodyModel
    betas: Float[np.ndarray, " B"]
    pose: Float[np.ndarray, "T J 3"]
    trans: Float[np.ndarray, "T 3"]
    rig: CameraRig
    keypoints: Float[np.ndarray, "T K 3"]
    detections: Detections


def ring(
    count: int, middle: Float[np.ndarray, "3"], radius: float, spread: float = 360.0
) -> CameraRig:
    """Cameras around a place (m, y up), 1 to 2 m high, looking at it."""
    cameras = []
    for k in range(count):
        angle = np.radians(20.0 + spread * k / count)
        away = radius * np.sin(angle), 0.3 + 0.6 * (k % 2), radius * np.cos(angle)
        place = middle + np.array(away)
        ahead = (middle - place) / np.linalg.norm(middle - place)
        right = np.cross(ahead, [0.0, 1.0, 0.0])
        right /= np.linalg.norm(right)
        turn = np.stack([right, np.cross(ahead, right), ahead])
        cameras.append(
            RigCamera(f"cam{k + 1}", *SIZE, np.full(2, FOCAL), np.array(SIZE) / 2.0, turn,
                      -turn @ place, np.zeros(8))
        )  # fmt: skip
    return CameraRig(tuple(cameras))


def camera_scene(
    body: BodyModel,
    pose: Float[np.ndarray, "T J 3"],
    trans: Float[np.ndarray, "T 3"],
    rate_hz: float,
    cameras: int,
    rng: np.random.Generator,
    definition: float = 0.005,
    convention: str = "body25b",
) -> CameraScene:
    """A random person of a body in a motion (y up, m), before a ring of cameras."""
    betas = np.clip(rng.normal(size=body.num_betas), -2.5, 2.5)
    names = convention_names(convention)
    rig = KeypointRig.of(body, names)
    own = mirrored(names)
    offsets = (own @ (definition * rng.normal(size=own.shape[1]))).reshape(-1, 3)
    points = rig.shaped(betas, offsets).points(pose, trans)
    middle = 0.5 * (points.min((0, 1)) + points.max((0, 1)))
    reach = float(np.linalg.norm(np.ptp(trans[:, [0, 2]], axis=0)))
    radius = max(3.5, 0.75 * reach + 2.5)
    rig_of = ring(cameras, middle, radius, 360.0 if cameras > 2 else 180.0)
    detections = detected(points, names, convention, rig_of, rate_hz, rng)
    return CameraScene(body, betas, pose, trans, rig_of, points, detections)


def detected(
    points: Float[np.ndarray, "T K 3"],
    names: tuple[str, ...],
    convention: str,
    rig: CameraRig,
    rate_hz: float,
    rng: np.random.Generator,
) -> Detections:
    """What a detector says of keypoints (m)."""
    pixels = np.moveaxis(rig.project(points), 0, 1)
    frames, cameras, count = pixels.shape[:3]
    depth = np.einsum("ci,tki->tck", rig.rotation[:, 2], points) + rig.translation[:, 2, None]
    height = 1.7 * FOCAL / depth.mean(2, keepdims=True)
    share = np.array([SHARES.get(name.rpartition("_")[2], 1.0) for name in names])
    sd = NOISE * share * height
    tails = rng.standard_t(4, pixels.shape) / np.sqrt(2.0)
    slow = gaussian_filter1d(rng.normal(size=pixels.shape), LASTING * rate_hz / 2.0, axis=0)
    slow /= max(1e-9, float(slow.std()))
    pixels = pixels + sd[..., None] * (tails + slow) / np.sqrt(2.0)
    wild = rng.random((frames, cameras, count)) < OUTLIERS
    pixels[wild] += (OUTLIER * np.broadcast_to(height, wild.shape)[wild])[:, None] * rng.normal(
        size=(int(wild.sum()), 2)
    )
    swapped = _runs((frames, cameras), EXCHANGED, rate_hz, rng)
    order = np.array([names.index(_other(name)) for name in names])
    pixels = np.where(swapped[..., None, None], pixels[:, :, order], pixels)
    gone = _runs((frames, cameras, count), MISSING, rate_hz, rng)
    inside = (pixels > 0.0).all(-1) & (pixels < np.array(SIZE)).all(-1)
    seen = inside & ~gone & np.isfinite(pixels).all(-1)
    sure = np.where(seen, np.clip(0.9 - 0.3 * rng.random(seen.shape), 0.0, 1.0), 0.0)
    pixels = np.where(seen[..., None], pixels, np.nan)
    return Detections(
        "made", convention, names, rig.names, pixels[:, :, None], sure[:, :, None], rate_hz
    )


def _other(name: str) -> str:
    if name.startswith("left_"):
        return "right_" + name[5:]
    return "left_" + name[6:] if name.startswith("right_") else name


def _runs(
    shape: tuple[int, ...], share: float, rate_hz: float, rng: np.random.Generator
) -> np.ndarray:
    """True in runs along the first axis that make up a share."""
    length = max(1, round(RUN * rate_hz))
    starts = rng.random(shape) < share / length
    return np.cumsum(starts, axis=0) - np.concatenate(
        [np.zeros((min(length, shape[0]), *shape[1:]), int),
         np.cumsum(starts, axis=0)[: max(0, shape[0] - length)]]
    ) > 0  # fmt: skip


def disturbed(rig: CameraRig, degrees: float, metres: float, rng: np.random.Generator) -> CameraRig:
    """The cameras with errors of calibration: a turn (degrees, sd an axis) and a shift (m)."""
    turns = matrix_from_rotvec(np.radians(degrees) * rng.normal(size=(len(rig.cameras), 3)))
    moved = (
        camera.moved(turn, metres * rng.normal(size=3))
        for camera, turn in zip(rig.cameras, turns, strict=True)
    )
    return replace(rig, cameras=tuple(moved))
