"""Following one person through a stream of markers: who leaves is let go, who returns is found
again (M 6).
"""

from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from habitus.body.prior import PosePrior
from habitus.fit.markers.assembly import Subject
from habitus.fit.markers.causal import CausalFrame, CausalSolver
from habitus.fit.markers.recordings import FEWEST_MARKERS
from habitus.fit.markers.settings import MoshSettings, sequence_settings
from habitus.fit.markers.start import start_frame
from habitus.fit.markers.suspects import exchange

State = Literal["nobody", "started", "tracked", "held"]
GONE_S = 0.5
"""Seconds without enough markers after which a person has left: motion is no longer carried on."""
LOOK_S = 0.2
"""Seconds for which more markers are waited for before a start, and for which a body may be astray.
"""
ASTRAY = 0.06
"""Metres that half of the markers may be off the body before it is begun anew."""
BETTER = 0.7
"""A new beginning is taken where its cost is below this share of the old one's."""


class LiveFrame(NamedTuple):
    """What a stream's frame told: pose (J, 3) rad, trans (3,) m, its cost, and how far each marker
    is off (M,) m.

    state: "tracked"; "started" in the first frame of somebody who comes, or where a body that was
    astray begins anew; "held" where too few markers are seen for a moment and the motion is carried
    on; "nobody" where nobody is seen: pose and trans are NaN then. distances: of the markers in
    use, NaN where missing.
    """

    pose: Float[np.ndarray, "J 3"]
    trans: Float[np.ndarray, " 3"]
    cost: float
    state: State
    distances: Float[np.ndarray, " M"]


class Tracker:
    """Fits a person of known shape frame by frame; for one stream and one thread.

    prior: for the body's joints. rate_hz: of the stream.
    """

    def __init__(self, subject: Subject, prior: PosePrior, settings: MoshSettings, rate_hz: float):
        self._subject = subject
        self._prior = prior
        self._settings = settings
        self._gone = max(1, round(GONE_S * rate_hz))
        self._look = max(1, round(LOOK_S * rate_hz))
        self._solver: CausalSolver | None = None
        self._blind = self._waited = self._astray = 0

    def step(self, observed: Float[np.ndarray, "M 3"]) -> LiveFrame:
        """The next frame; ``observed`` in metres, NaN where missing, all of them for a frame that
        was lost.
        """
        observed = exchange(observed[None], self._subject.exchanged)[0]
        observed[list(self._subject.misplaced)] = np.nan
        seen = int(np.isfinite(observed[:, 0]).sum())
        self._blind = 0 if seen >= FEWEST_MARKERS else self._blind + 1
        if self._blind > self._gone:
            self._solver = None
        if self._solver is None:
            return self._begin(observed, seen)
        found = self._solver.step(observed)
        if self._blind:
            return self._told(found, observed, "held")
        frame = self._told(found, observed, "tracked")
        self._astray = (
            self._astray + 1 if 2 * np.count_nonzero(frame.distances > ASTRAY) > seen else 0
        )
        return (
            self._anew(observed, frame)
            if self._astray and self._astray % self._look == 0
            else frame
        )

    def rehearse(self) -> None:
        """To be called while nothing comes, so that the next frame takes less time; it changes
        nothing.
        """
        if self._solver is not None:
            self._solver.rehearse()

    def _begin(self, observed: np.ndarray, seen: int) -> LiveFrame:
        """The first frame of a person, when half of the markers are seen, or for some time enough
        of them.
        """
        self._waited = self._waited + 1 if seen >= FEWEST_MARKERS else 0
        if not self._waited or (seen < len(observed) / 2 and self._waited < self._look):
            return _nobody(self._subject, len(observed))
        self._waited = self._astray = 0
        self._solver = self._started(observed)
        return self._told(self._solver.step(observed), observed, "started")

    def _anew(self, observed: np.ndarray, frame: LiveFrame) -> LiveFrame:
        """The better one of the track and a new beginning."""
        other = self._started(observed)
        found = other.step(observed)
        if found.cost > BETTER * frame.cost:
            return frame
        self._solver = other
        self._astray = 0
        return self._told(found, observed, "started")

    def _told(self, found: CausalFrame, observed: np.ndarray, state: State) -> LiveFrame:
        assert self._solver is not None
        distances = np.sqrt(np.square(self._solver.markers() - observed).sum(axis=1))
        return LiveFrame(found.pose, found.trans, found.cost, state, distances)

    def _started(self, observed: np.ndarray) -> CausalSolver:
        rig = self._subject.rig
        names = ("root", *self._prior.joint_names)
        pose, trans = start_frame(rig, self._subject.shape.pose, names, observed)
        scales = np.full(len(observed), self._settings.robust_scale[1])
        return CausalSolver(
            rig, self._prior, pose, trans, sequence_settings(self._settings), scales
        )


def _nobody(subject: Subject, markers: int) -> LiveFrame:
    joints = subject.rig.num_joints
    return LiveFrame(
        np.full((joints, 3), np.nan), np.full(3, np.nan), 0.0, "nobody", np.full(markers, np.nan)
    )
