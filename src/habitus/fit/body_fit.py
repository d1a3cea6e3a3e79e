"""Settings and result of a fit to several sensors (`habitus.fit.problem`)."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from jaxtyping import Float

from habitus.body.model import BodyModel
from habitus.body.state import BodyState, BodySurface
from habitus.errors import HabitusError
from habitus.fit.markers.result import MarkerFit
from habitus.fit.markers.settings import MoshSettings
from habitus.fit.verdict import Verdict


@dataclass(frozen=True)
class JointStage:
    """Some steps of all sensors together.

    reach (m): distance at which a pixel or a point counts a quarter; markers have three times that.
    prior: what the priors of pose, shape and marker places are multiplied by. matching, stride: of
    depth pixels. rounds: how often markers are attached and weighed anew; iterations: steps in
    each.
    """

    reach: float
    prior: float
    matching: str = "nearest"
    stride: int = 4
    rounds: int = 1
    iterations: int = 8


@dataclass(frozen=True)
class FitSettings:
    """Settings of a fit to several sensors.

    frames: of the capture that are solved with the other sensors. betas, pose, placement: weights
    of the shape prior, of the pose prior and of the latent markers' places: MoSh's (M 6).
    depth_share: of each full-size pixel's certainty, as neighbours err alike (`RgbdSettings`);
    outline_share: the same of silhouettes. scan_points: how many points of a scan are fitted;
    scan_worth: as how many independent ones they count. enough_markers: labelled markers from which
    on a capture alone gives the start's shape. motion: whether the whole capture is solved at the
    end, by ``mosh``, which has its settings.
    """

    stages: tuple[JointStage, ...] = (
        JointStage(0.10, 10.0, iterations=6),
        JointStage(0.06, 2.0, iterations=6),
        JointStage(0.03, 1.0, "pixel", 2, rounds=2, iterations=10),
    )
    frames: int = 12
    betas: float = 1.0
    pose: float = 0.25
    placement: float = 0.25
    surface: float = 100.0
    depth_share: float = 0.02
    outline_share: float = 0.1
    scan_points: int = 3000
    scan_worth: float = 1500.0
    enough_markers: int = 8
    motion: bool = True
    mosh: MoshSettings = field(default_factory=MoshSettings)
    seed: int = 0


@dataclass(frozen=True, eq=False)
class BodyFit:
    """One person from several sensors: betas (B,), pose (F, J, 3) and trans (F, 3) of F poses.

    poses: what each of the F poses is of. Those of a capture's frames, and of views and scans that
    name a frame, are in the capture's world; those of a view of its own in the camera's frame;
    those of a scan of its own in metres with y up. latent_markers (M, 3): where markers sit at
    rest. status, costs, iterations: of the last stage; costs by term sum to the energy. residuals:
    distances (m) by sensor: of markers, of pixels from the surface, of points from the surface.
    motion: the whole capture, where there is one. verdicts: by sensor, where its own recipe judges
    it.
    """

    body: BodyModel
    betas: Float[np.ndarray, " B"]
    pose: Float[np.ndarray, "F J 3"]
    trans: Float[np.ndarray, "F 3"]
    poses: tuple[str, ...]
    status: str
    costs: Mapping[str, float]
    iterations: int
    residuals: Mapping[str, Float[np.ndarray, " n"]]
    latent_markers: Float[np.ndarray, "M 3"] | None = None
    motion: MarkerFit | None = None
    verdicts: Mapping[str, Verdict] = field(default_factory=dict)
    seconds: Mapping[str, float] = field(default_factory=dict)

    @property
    def state(self) -> BodyState:
        """Betas, pose and trans of all poses."""
        return BodyState(self.betas, self.pose, self.trans)

    def surface(self, pose: int | str = 0) -> BodySurface:
        """The posed body of one pose, by number or by name (`poses`)."""
        if isinstance(pose, str) and pose not in self.poses:
            raise HabitusError(f"no pose is named {pose!r}; there are {', '.join(self.poses)}")
        k = self.poses.index(pose) if isinstance(pose, str) else pose
        return self.body(self.betas, self.pose[k], self.trans[k])

    def vertices(self, pose: int | str = 0) -> Float[np.ndarray, "V 3"]:
        """The surface (m) of one pose."""
        return np.asarray(self.surface(pose).vertices)

    def joints(self, pose: int | str = 0) -> Float[np.ndarray, "J 3"]:
        """The joints (m) of one pose."""
        return np.asarray(self.surface(pose).joints)

    @cached_property
    def measurements(self) -> Mapping[str, float]:
        """Height, girths and the like of the body at rest (m)."""
        return self.body.measure_rest(self.body.rest_vertices(self.betas))

    @property
    def residuals_mm(self) -> dict[str, dict[str, float]]:
        """Median and 95th percentile of each sensor's residuals in mm."""
        return {
            name: {
                "median": 1e3 * float(np.median(off)),
                "p95": 1e3 * float(np.percentile(off, 95)),
            }
            for name, off in self.residuals.items()
            if len(off)
        }
