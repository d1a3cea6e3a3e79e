"""A registered scan: the free surface in the body's topology, the model under it, and what it is
worth.

What a registered scan is worth, by numbers that can be checked without knowing the truth.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from habitus.body.jacobians import posed_skeleton
from habitus.body.model import BodyModel
from habitus.body.state import BodyState
from habitus.fit.points.scan import Cloud
from habitus.fit.points.skin_colours import SkinGrid
from habitus.fit.points.state import ModelState
from habitus.fit.verdict import DOUBTFUL, FAILED, GOOD, Verdict, worst


@dataclass(frozen=True, eq=False)
class ScanColours:
    """What colours of several scans of a person came to.

    ``albedo`` (G, 3), linear up to a factor, is the texture all share, at the nodes of ``grid``;
    ``apart`` (G,) how far this scan's tones (log of linear colours) are from the others' there,
    ``before`` and ``after`` that over the skin (1.48 times the median) where geometry had it and
    where it is now; ``slid`` (m) how far the surface went.
    """

    grid: SkinGrid
    albedo: Float[np.ndarray, "G 3"]
    apart: Float[np.ndarray, " G"]
    before: float
    after: float
    slid: float = 0.0


@dataclass(frozen=True, eq=False)
class ScanFit:
    """One scan, registered. Metres and radians, y up; ``to_body`` (4, 4) takes the file's numbers
    there.

    ``vertices`` (V, 3) are the free surface; ``weights`` (V,), 0 to 1, say where the scan tells of
    it: 0 in holes, where it continues the model. ``betas``, shared by all scans of a person,
    ``pose`` (J, 3) and ``trans`` (3,) are the model's, ``rest_vertices`` (V, 3) the free surface
    carried back to rest. ``to_surface`` and ``to_model`` (M,) are the distances (m) of the points
    of ``cloud`` that are the body's, ``far_from_surface`` (N,) those of all. ``matched`` is their
    share, ``lost`` the share of all that lie together off the surface, ``rival`` how much worse the
    best other pose is (1: as good; None: none came close), ``pose_distance`` the pose's root mean
    square distance from the prior's mean, in standard deviations. ``cuts``: pairs of triangles that
    cut each other in the surface beyond those of the model. ``person``: False where the start was
    so far from the scan that the rest was not tried; the surface is then the model's. ``up_axis``
    is the scan's own axis that points up.
    """

    scan_name: str
    body_name: str
    body: BodyModel
    betas: Float[np.ndarray, " B"]
    pose: Float[np.ndarray, "J 3"]
    trans: Float[np.ndarray, " 3"]
    vertices: Float[np.ndarray, "V 3"]
    model_vertices: Float[np.ndarray, "V 3"]
    rest_vertices: Float[np.ndarray, "V 3"]
    weights: Float[np.ndarray, " V"]
    cloud: Cloud
    to_surface: Float[np.ndarray, " M"]
    to_model: Float[np.ndarray, " M"]
    far_from_surface: Float[np.ndarray, " N"]
    matched: float
    lost: float
    rival: float | None
    pose_distance: float
    to_body: Float[np.ndarray, "4 4"]
    up_axis: str
    person: bool = True
    notes: tuple[str, ...] = ()
    stage_seconds: Mapping[str, float] = field(default_factory=dict)
    settings: Mapping[str, Any] = field(default_factory=dict)
    colours: ScanColours | None = None
    cuts: int = 0

    @property
    def state(self) -> BodyState:
        """The model's shape, pose and place."""
        return BodyState(self.betas, self.pose, self.trans)

    @property
    def seen(self) -> float:
        """The share of vertices of which the scan tells."""
        return float(self.weights.mean())

    @cached_property
    def measurements(self) -> Mapping[str, float]:
        """What the person measures, on the free surface carried back to rest; {} for a body that is
        no person's.
        """
        return self.body.measure_rest(self.rest_vertices)

    @cached_property
    def verdict(self) -> Verdict:
        """What the registration is worth: ``level`` (good, doubtful or failed) and ``reasons``, a
        sentence each.
        """
        return judge_scan(self)


MEDIAN, P95 = (0.0015, 0.004), (0.006, 0.020)
"""Metres: scan to surface, from which on it is doubtful, and failed."""
MODEL = (0.008, 0.020)
"""Metres: scan to model, median."""
MATCHED = (0.93, 0.80)
"""The share of the scan that the model explains (within 5 cm, normals alike)."""
BETAS = (1.9, 2.8)
"""Root mean square of the betas: 1 is usual."""
POSE = (2.2, 3.5)
"""Root mean square of the pose in the prior's standard deviations."""
LEAST_SEEN = (0.6, 0.15)
LOST = (0.0025, 0.006)
"""The share of the scan that lies off the surface in one place: half a hand is 0.5 %."""
CUTS = (40, 800)
"""Pairs of triangles that cut each other in the surface and not in the model: skin that belongs
elsewhere.
"""
MOST_BALLS = 1000
LOST_AWAY, LOST_WIDE = 0.006, 0.06
"""Metres: how far off the surface, and in how large a ball."""


def judge_scan(fit: Any) -> Verdict:
    """The verdict on a `habitus.fit.points.scan_result.ScanFit`."""
    if not fit.person:
        return Verdict(
            FAILED,
            (
                "nothing in the scan has the form of a person: no more than a rough start was "
                "fitted.",
            ),
        )
    betas = float(np.sqrt(np.mean(np.square(fit.betas)))) if len(fit.betas) else 0.0
    median, p95 = (float(np.percentile(fit.to_surface, share)) for share in (50, 95))
    findings = [
        _above(
            float(np.median(fit.to_model)),
            MODEL,
            "the model is {:.1f} mm from the scan (median)",
            1e3,
        ),
        _below(fit.matched, MATCHED, "only {:.0f} % of the scan is a surface of the body", 100.0),
        _above(median, MEDIAN, "the surface is {:.1f} mm from the scan (median)", 1e3),
        _above(p95, P95, "a twentieth of the scan is {:.0f} mm or more from the surface", 1e3),
        _above(
            fit.lost,
            LOST,
            "{:.1f} % of the scan lie together off the surface: a hand or foot is elsewhere",
            100.0,
        ),
        _above(
            fit.cuts, CUTS, "the surface cuts itself {:.0f} times: a hand or foot is elsewhere", 1.0
        ),
        _above(betas, BETAS, "the shape is {:.1f} times as far from the mean as people are", 1.0),
        _above(
            fit.pose_distance,
            POSE,
            "the pose is {:.1f} times as far from the mean as poses are",
            1.0,
        ),
        _below(
            fit.seen,
            LEAST_SEEN,
            "the scan shows {:.0f} % of the body; the rest continues the model",
            100.0,
        ),
    ]
    if fit.rival is not None and fit.rival < 1.05:
        findings.append((DOUBTFUL, "another pose fits nearly as well"))
    told = sorted((one for one in findings if one[0] != GOOD), key=lambda one: one[0] != FAILED)
    return Verdict(worst([level for level, _ in findings]), tuple(f"{text}." for _, text in told))


def lost_share(points: Float[np.ndarray, "N 3"], away: Float[np.ndarray, " N"]) -> float:
    """The share of a scan's points that lie off the surface (``away``, m) in the place where most
    of them do.
    """
    return lost_piece(points, away)[0]


def lost_piece(
    points: Float[np.ndarray, "N 3"], away: Float[np.ndarray, " N"]
) -> tuple[float, Float[np.ndarray, " 3"]]:
    """That share, and the place (m)."""
    off = points[away > LOST_AWAY]
    if len(off) == 0:
        return 0.0, points.mean(0)
    few = off[:: max(1, len(off) // MOST_BALLS)]
    balls = cKDTree(off).query_ball_point(few, LOST_WIDE, return_length=True)
    return float(balls.max() / len(points)), few[balls.argmax()]


def _above(value: float, limits: tuple[float, float], text: str, unit: float) -> tuple[str, str]:
    level = FAILED if not value <= limits[1] else DOUBTFUL if value > limits[0] else GOOD
    return level, text.format(unit * value)


def _below(value: float, limits: tuple[float, float], text: str, unit: float) -> tuple[str, str]:
    level = FAILED if not value >= limits[1] else DOUBTFUL if value < limits[0] else GOOD
    return level, text.format(unit * value)


def at_rest(
    body: BodyModel, state: ModelState, offset: Float[np.ndarray, "V 3"]
) -> Float[np.ndarray, "V 3"]:
    """The person at rest: the model's, with a posed surface's offset from the posed model turned
    back.
    """
    skeleton = posed_skeleton(body, body.rest_joints(state.betas), state.pose[0])
    turn = np.einsum(
        "vk,vkij->vij", body.skinning_value, skeleton.motions[body.skinning_index][..., :3]
    )
    return body.rest_vertices(state.betas) + np.linalg.solve(turn, offset[..., None])[..., 0]
