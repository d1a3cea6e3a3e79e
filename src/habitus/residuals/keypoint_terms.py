"""The public term of keypoints: what a detector found in the pictures of calibrated cameras, beside
other terms.

    f = 1/2 sum_fck w_fck rho(|P_c(q_fk(betas, pose, trans)) - u_fck|^2)

q are keypoints on bones (`habitus.observe.keypoints`), w the information of a detection (1 / px^2)
and rho(s) = s / (1 + w s / h^2), Geman-McClure's of h standard deviations. Cost, gradient and
Gauss-Newton matrix are explicit.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from habitus.body.model import BodyModel
from habitus.errors import HabitusError
from habitus.observe.camera_rig import NEAR, CameraRig
from habitus.observe.detections import Detections
from habitus.observe.keypoints import KeypointDerivatives, KeypointRig
from habitus.solve.terms import Quadratic


@dataclass(frozen=True, eq=False)
class Keypoints:
    """Detected keypoints (P, C, K, 2; px without distortion, NaN where missing) of P of the poses.

    weights (P, C, K): information, 1 / px^2. rows (P): of ``pose`` and ``trans``; all, in order,
    without them. reach: of the robust loss, in standard deviations. `of` makes one from detections.
    """

    rig: KeypointRig
    cameras: CameraRig
    pixels: Float[np.ndarray, "P C K 2"]
    weights: Float[np.ndarray, "P C K"]
    rows: Sequence[int] | None = None
    reach: float = 5.0

    @staticmethod
    def of(
        body: BodyModel,
        detections: Detections,
        cameras: CameraRig,
        frames: Sequence[int] | None = None,
        rows: Sequence[int] | None = None,
        person: int = 0,
        reach: float = 5.0,
    ) -> "Keypoints":
        """From what `habitus.read_detections` and `habitus.read_calibration` read.

        frames: of the detections; all without them. person: which of each frame's. Noise is that of
        the table assets/keypoints.toml, for the person's size in each camera's images.
        """
        chosen = slice(None) if frames is None else list(frames)
        seen = detections.of_cameras(cameras.names)
        if not 0 <= person < seen.people:
            raise HabitusError(f"person is {person}; the detections have 0 to {seen.people - 1}")
        pixels = np.moveaxis(cameras.ideal(np.moveaxis(seen.pixels[chosen, :, person], 1, 0)), 0, 1)
        there = np.isfinite(pixels).all(-1) & (seen.confidence[chosen, :, person] > 0.0)
        at = np.where(there[..., None], pixels, np.nan)
        size = np.zeros(pixels.shape[:2])
        for index in zip(*np.nonzero(there.any(-1)), strict=True):
            own = at[index][there[index]]
            size[index] = np.linalg.norm(np.ptp(own, axis=0))
        typical = np.array([np.median(own[own > 0]) if (own > 0).any() else 1.0 for own in size.T])
        rig = KeypointRig.of(body, seen.names, seen.convention)
        sd = np.maximum(typical, 20.0)[None, :, None] * rig.noise
        return Keypoints(rig, cameras, at, np.where(there, 1.0 / sd**2, 0.0), rows, reach)

    def __call__(
        self,
        betas: Float[np.ndarray, " B"],
        pose: Float[np.ndarray, "F J 3"],
        trans: Float[np.ndarray, "F 3"],
    ) -> Quadratic:
        """The cost of a state, with its derivatives."""
        rows = np.arange(len(pose)) if self.rows is None else np.asarray(self.rows, int)
        if len(rows) != len(self.pixels):
            raise HabitusError(
                f"keypoints of {len(self.pixels)} frames for {len(rows)} poses; name their rows"
            )
        none = np.zeros((len(self.rig.names), 3))
        found = self.rig.derivatives(betas, none, pose[rows], trans[rows])
        there = np.einsum("cij,fkj->fcki", self.cameras.rotation, found.points)
        there = there + self.cameras.translation[:, None]
        ahead = there[..., 2] > NEAR
        depth = np.where(ahead, there[..., 2], 1.0)
        focal = self.cameras.focal[:, None]
        plane = there[..., :2] / depth[..., None]
        seen = np.asarray(np.isfinite(self.pixels).all(-1))
        target = np.where(seen[..., None], self.pixels, 0.0)
        off = focal * plane + self.cameras.centre[:, None] - target
        weights = np.where(seen, self.weights, 0.0)
        squared = np.where(ahead, weights * (off**2).sum(-1), np.inf)
        share = 1.0 / (1.0 + squared / self.reach**2)
        cost = 0.5 * np.where(ahead, share * np.where(ahead, squared, 0.0), self.reach**2)
        total = float(np.where(weights > 0.0, cost, 0.0).sum())

        def derivatives() -> tuple[dict[str, np.ndarray], dict[tuple[str, str], np.ndarray]]:
            scale = focal / depth[..., None]
            slope = np.zeros((*off.shape, 3))
            slope[..., 0, 0], slope[..., 1, 1] = scale[..., 0], scale[..., 1]
            slope[..., 2] = -scale * plane
            by_point = np.einsum("fckui,cij->fckuj", slope, self.cameras.rotation)
            half = np.where(ahead, weights * share**2, 0.0)
            information = np.einsum("fck,fckui,fckuj->fkij", half, by_point, by_point)
            pull = np.einsum("fck,fckui,fcku->fki", half, by_point, off)
            return _blocks(found, information, pull, rows, len(pose))

        return Quadratic(total, derivatives)


def _blocks(
    found: KeypointDerivatives,
    information: np.ndarray,
    pull: np.ndarray,
    rows: np.ndarray,
    count: int,
) -> tuple[dict[str, np.ndarray], dict[tuple[str, str], np.ndarray]]:
    """Gradients and Gauss-Newton blocks of points with an information (f, k, 3, 3) and a pull."""
    ways = {
        "betas": found.by_betas,
        "trans": np.broadcast_to(np.eye(3), (*pull.shape[:2], 3, 3)),
        "pose": found.by_pose,
    }
    slopes = {name: np.einsum("fkin,fki->fn", way, pull) for name, way in ways.items()}
    informed = {name: np.einsum("fkij,fkjn->fkin", information, way) for name, way in ways.items()}
    pairs = [("trans", "trans"), ("trans", "pose"), ("pose", "pose")]
    pairs += [("trans", "betas"), ("pose", "betas"), ("betas", "betas")]
    blocks = {(a, b): np.einsum("fkin,fkim->fnm", ways[a], informed[b]) for a, b in pairs}

    def spread(table: np.ndarray) -> np.ndarray:
        whole = np.zeros((count, *table.shape[1:]))
        np.add.at(whole, rows, table)
        return whole

    gradient = {name: spread(each) for name, each in slopes.items()}
    gradient["betas"] = slopes["betas"].sum(0)
    matrix = {pair: spread(each) for pair, each in blocks.items()}
    matrix["betas", "betas"] = blocks["betas", "betas"].sum(0)
    return gradient, matrix
