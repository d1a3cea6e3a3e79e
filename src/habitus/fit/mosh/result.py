"""The result of a marker fit: state, status, residuals, timings and the settings that made it."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from habitus.body.model import BodyModel
from habitus.fit.mosh.suspects import Suspect
from habitus.observe.markers import MarkerAttachment


@dataclass(frozen=True)
class HeldOut:
    """Errors (T, H) in metres of H markers left out of everything, at the layout's default places; NaN where unseen."""

    labels: tuple[str, ...]
    pose: Float[np.ndarray, "T H"]
    soft_tissue: Float[np.ndarray, "T H"] | None


@dataclass(frozen=True)
class MarkerFit:
    """A body in motion, found from the markers of one capture.

    Metres, radians and the capture's own world frame. T frames, M markers, J joints, B betas. ``latent_markers`` (M, 3)
    lie in the body's rest space (zero pose). Where there is soft tissue, the body at frame t is
    ``body(betas + soft_tissue[t], pose[t], trans[t])``, and ``pose_stage`` holds pose and trans before it was let go.
    """

    capture_name: str
    body_name: str
    layout_name: str
    body: BodyModel
    up_axis: str
    rate_hz: float
    labels: tuple[str, ...]
    betas: Float[np.ndarray, " B"]
    latent_markers: Float[np.ndarray, "M 3"]
    attachment: MarkerAttachment
    pose: Float[np.ndarray, "T J 3"]
    trans: Float[np.ndarray, "T 3"]
    soft_tissue: Float[np.ndarray, "T B"] | None
    pose_stage: tuple[Float[np.ndarray, "T J 3"], Float[np.ndarray, "T 3"]]
    observed_markers: Float[np.ndarray, "T M 3"]
    predicted_pose_stage: Float[np.ndarray, "T M 3"]
    predicted_soft_tissue: Float[np.ndarray, "T M 3"] | None
    marker_weights: Float[np.ndarray, "T M"]
    marker_noise: Float[np.ndarray, " M"]
    flagged_frames: Bool[np.ndarray, " T"]
    suspects: tuple[Suspect, ...] = ()
    held_out: HeldOut | None = None
    costs: Mapping[str, float] = field(default_factory=dict)
    stage_seconds: Mapping[str, float | None] = field(default_factory=dict)
    startup_seconds: float = 0.0
    warnings: tuple[str, ...] = ()
    settings: Mapping[str, Any] = field(default_factory=dict)
    status: str = ""
    seed: int = 0
    gender: str = "neutral"
    recorded: Mapping[str, float | str] = field(default_factory=dict)

    @property
    def num_frames(self) -> int:
        """T."""
        return len(self.pose)

    @property
    def visible(self) -> Bool[np.ndarray, "T M"]:
        """Which samples the capture holds."""
        return np.isfinite(self.observed_markers[..., 0])

    def errors(self, stage: str = "soft_tissue") -> Float[np.ndarray, "T M"] | None:
        """Distances of observed from predicted markers in metres, NaN where missing; ``stage`` pose or soft_tissue."""
        predicted = self.predicted_pose_stage if stage == "pose" else self.predicted_soft_tissue
        return None if predicted is None else np.linalg.norm(self.observed_markers - predicted, axis=2)
