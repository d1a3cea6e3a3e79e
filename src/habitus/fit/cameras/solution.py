"""The result of a fit to keypoints of cameras: a body in motion, the cameras as corrected, and how
far the body's keypoints are from the detected ones.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from jaxtyping import Bool, Float

from habitus.body.model import BodyModel
from habitus.body.motion import BodyMotion
from habitus.observe.camera_rig import CameraRig
from habitus.observe.keypoints import KeypointRig

if TYPE_CHECKING:
    from habitus.fit.cameras.shape import CameraShape


@dataclass(frozen=True, eq=False)
class CameraSolution(BodyMotion):
    """One person in motion. T frames, from ``first_frame`` of the detections on; C cameras, K
    keypoints.

    observed (T, C, K, 2): pixels without the lens' distortion, sides put back, at the frames'
    times; confidence (T, C, K). ``keypoint_places`` (K, 3): what the fit added to the places of the
    table, in their bones' frames (m). cameras: as corrected; corrections (C, 6): turns (rad) and
    shifts (m) in each camera's frame; late (C,): seconds. ``size_px`` (T, C): the person's height
    in the images. exchanged (T, C): where left and right were put back. ``triangulated`` (T, K, 3):
    of one camera those of the first poses. given_height: the height that was given (m), None
    without one. first_number: the first frame's in the files' own numbers.
    """

    keypoint_names: tuple[str, ...] = ()
    convention: str = ""
    cameras: CameraRig | None = None
    given_cameras: CameraRig | None = None
    corrections: Float[np.ndarray, "C 6"] = field(default_factory=lambda: np.zeros((0, 6)))
    late: Float[np.ndarray, " C"] = field(default_factory=lambda: np.zeros(0))
    observed: Float[np.ndarray, "T C K 2"] = field(default_factory=lambda: np.zeros((0, 0, 0, 2)))
    confidence: Float[np.ndarray, "T C K"] = field(default_factory=lambda: np.zeros((0, 0, 0)))
    size_px: Float[np.ndarray, "T C"] = field(default_factory=lambda: np.zeros((0, 0)))
    exchanged: Bool[np.ndarray, "T C"] = field(default_factory=lambda: np.zeros((0, 0), bool))
    keypoint_places: Float[np.ndarray, "K 3"] = field(default_factory=lambda: np.zeros((0, 3)))
    triangulated: Float[np.ndarray, "T K 3"] = field(default_factory=lambda: np.zeros((0, 0, 3)))
    given_height: float | None = None
    first_frame: int = 0
    first_number: int = 0
    status: str = ""
    costs: Mapping[str, float] = field(default_factory=dict)
    stage_seconds: Mapping[str, float] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()

    @classmethod
    def solved(
        cls,
        body: BodyModel,
        shape: "CameraShape",
        keypoints: KeypointRig,
        pose: np.ndarray,
        trans: np.ndarray,
        rate_hz: float,
        first_frame: int,
        sight: Any,
        pixels: np.ndarray,
        points: np.ndarray,
        given_rig: CameraRig,
        detections: Any,
        up_axis: str,
        height: float | None,
        status: str,
        number: int,
        total: int,
        seconds: float,
    ) -> Self:
        """From the recipe's parts; person ``number`` of ``total``."""
        name = detections.name if total == 1 else f"{detections.name}-{number + 1}"
        views = "cameras" if len(given_rig.cameras) > 1 else "camera"
        return cls(
            body=body,
            betas=shape.betas,
            pose=pose,
            trans=trans,
            rate_hz=rate_hz,
            up_axis=up_axis,
            capture_name=name,
            body_name=body.name,
            made=(f"fitted to {detections.convention} of {len(given_rig.cameras)} {views}",),
            keypoint_names=keypoints.names,
            convention=detections.convention,
            cameras=shape.rig,
            given_cameras=given_rig,
            corrections=shape.corrections,
            late=sight.late,
            observed=pixels,
            confidence=sight.confidence,
            size_px=sight.size,
            exchanged=sight.exchanged,
            keypoint_places=shape.offsets,
            triangulated=points,
            given_height=height,
            first_frame=first_frame,
            first_number=detections.first_number + first_frame,
            status=status,
            costs=dict(shape.costs),
            stage_seconds={"fit": seconds},
            warnings=(*detections.notes, *given_rig.notes),
        )

    @cached_property
    def keypoints(self) -> Float[np.ndarray, "T K 3"]:
        """The body's keypoints (m), where the detector puts them."""
        rig = KeypointRig.of(self.body, self.keypoint_names, self.convention)
        return rig.shaped(self.betas, self.keypoint_places).points(self.pose, self.trans)

    @cached_property
    def predicted(self) -> Float[np.ndarray, "T C K 2"]:
        """The body's keypoints in the corrected cameras (px, without distortion)."""
        assert self.cameras is not None
        return np.moveaxis(self.cameras.project(self.keypoints), 0, 1)

    @cached_property
    def errors_px(self) -> Float[np.ndarray, "T C K"]:
        """Distances of detected keypoints from the body's, NaN where none was detected."""
        off = np.linalg.norm(self.predicted - self.observed, axis=-1)
        return np.where(self.confidence > 0.0, off, np.nan)

    @cached_property
    def height(self) -> float:
        """Of the body at rest (m)."""
        rest = self.body.rest_vertices(self.betas)[:, 1]
        return float(rest.max() - rest.min())

    @cached_property
    def measurements(self) -> Mapping[str, float]:
        """Height, girths and the like (m, kg). Keypoints tell of lengths: girths and the mass are
        the shape prior's.
        """
        return self.body.measure(self.betas)

    @cached_property
    def acceleration(self) -> float:
        """Root mean square acceleration of the joints (m/s^2)."""
        if len(self.pose) < 3:
            return 0.0
        second = np.diff(self.joints(), 2, axis=0) * self.rate_hz**2
        return float(np.sqrt((second**2).sum(-1).mean()))
