"""A registered scan: the free surface in the body's topology, the model under it, and what it is
worth.
"""

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float

from habitus.body.model import BodyModel
from habitus.body.state import BodyState
from habitus.fit.registration.judge import judge_scan
from habitus.fit.registration.model_stage import Cloud
from habitus.fit.registration.skin_grid import SkinGrid
from habitus.fit.verdict import Verdict


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

    def save(self, folder: str | os.PathLike[str]) -> None:
        """Write body.npz, surface.ply, model.ply, rest.ply, surface.glb, metrics.json, report.html.

        Raises HabitusError where the folder cannot be written to.
        """
        import habitus

        habitus.save_scan(self, folder)
