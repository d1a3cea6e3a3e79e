"""The result of a fit to depth views: a body, its poses in all views, what it looks like, and what
that is worth.
"""

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float

from habitus.body.model import BodyModel
from habitus.body.motion import Frames, Moving
from habitus.fit.rgbd.appearance import Appearance
from habitus.fit.rgbd.evidence import Evidence
from habitus.fit.rgbd.judge import judge
from habitus.fit.rgbd.off_model import along_normals
from habitus.fit.rgbd.sights import Sight
from habitus.fit.verdict import Verdict


@dataclass(frozen=True, eq=False)
class RgbdFit(Moving):
    """A body found from depth views: one shape, a pose and a place for each of K views.

    Metres and radians; a view's world has y up and the floor, where one was found, at 0; ``sights``
    hold what was seen, in the same world. ``appearance``: light and albedo, None without colour.
    ``evidence``: what the verdict is drawn from. ``costs``: of the last step, by term. ``skin``:
    how far the person's skin is off the body of betas, outwards along its normals (m); `vertices`
    and `measurements` have it, `surfaces` are of betas alone. View k is what a fit of markers calls
    frame k: ``vertices(k)``.
    """

    capture_name: str
    body_name: str
    body: BodyModel
    betas: Float[np.ndarray, " B"]
    pose: Float[np.ndarray, "K J 3"]
    trans: Float[np.ndarray, "K 3"]
    sights: tuple[Sight, ...]
    evidence: Evidence
    appearance: Appearance | None = None
    costs: Mapping[str, float] = field(default_factory=dict)
    stage_seconds: Mapping[str, float] = field(default_factory=dict)
    settings: Mapping[str, Any] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()
    gender: str = "neutral"
    rate_hz: float = 1.0
    up_axis: str = "+y"
    skin: Float[np.ndarray, " V"] | None = None
    soft_tissue: None = None
    dynamics: None = None

    @property
    def pose_stage(self) -> tuple[Float[np.ndarray, "K J 3"], Float[np.ndarray, "K 3"]]:
        """Pose and trans, as a motion has them."""
        return self.pose, self.trans

    @property
    def errors_mm(self) -> Float[np.ndarray, " K"]:
        """The median distance of each view's depth from the body, across its surface (mm)."""
        return np.array([view.median_mm for view in self.evidence.views])

    def vertices(self, frames: Frames = None) -> Float[np.ndarray, "*frames V 3"]:
        """The person's surface (K, V, 3) in metres, in each view's world, skin off the model
        included; (V, 3) of one view.
        """
        found = super().vertices(frames)
        return found if self.skin is None else along_normals(found, self.skin, self.body)

    @property
    def measurements(self) -> Mapping[str, float]:
        """Height, girths and lengths of the person at rest (m, kg), under
        `habitus.body.measurement_names`.
        """
        return self.evidence.measurements

    @cached_property
    def verdict(self) -> Verdict:
        """What the fit is worth: ``level`` (good, doubtful or failed) and ``reasons``, a sentence
        each.
        """
        return judge(self.evidence)

    def save(self, folder: str | os.PathLike[str]) -> None:
        """Write body.npz, body.glb, measurements.csv, metrics.json and report.html, as ``habitus
        rgbd`` does.

        Raises HabitusError where the folder cannot be written to.
        """
        import habitus

        habitus.save_rgbd(self, folder)
