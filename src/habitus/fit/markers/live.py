"""A live marker fit (MoSh sec. 6): the shape from some frames first, then the pose of each frame as
it arrives; a person who leaves is released, and found again on return; a verdict on the last
second.

`Tracker` and `Quality` serve whatever shows a person: markers here (`MarkerSight`), keypoints in
`habitus.fit.cameras.live`.
"""

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Generic, Literal, NamedTuple, Protocol, TypeVar

import numpy as np
from jaxtyping import Float, Int

from habitus.body.model import BodyModel
from habitus.body.prior import PosePrior
from habitus.errors import HabitusError
from habitus.fit.markers.causal import CausalFrame, CausalSolver
from habitus.fit.markers.judge import LIMITS, SENTENCES
from habitus.fit.markers.recordings import (
    MIN_MARKERS,
    Recording,
    ever_seen,
    of_markers,
    spread_frames,
)
from habitus.fit.markers.result import MarkerFit
from habitus.fit.markers.settings import LiveSettings, MoshSettings, sequence_settings
from habitus.fit.markers.shape import ShapeFit, Subject
from habitus.fit.markers.start import start_frame
from habitus.fit.markers.subject import fit_subject
from habitus.fit.markers.suspects import exchange
from habitus.fit.verdict import (
    DOUBTFUL,
    FAILED,
    GOOD,
    Bound,
    Reason,
    Verdict,
    above,
    verdict_of,
    worst,
)
from habitus.markers.layouts import MarkerLayout


def subject_of(
    body: BodyModel,
    prior: PosePrior,
    layout: MarkerLayout,
    recording: Recording,
    settings: MoshSettings,
) -> Subject:
    """The subject of some frames, by the shape stage, on the markers that are seen in any of them;
    recording: its markers in the layout's order.

    Raises HabitusError where no frame holds enough markers.
    """
    seen = ever_seen(recording.observed)
    kept = tuple(marker for marker, s in zip(layout.markers, seen, strict=True) if s)
    recording = replace(recording, observed=of_markers(recording.observed, seen))
    return fit_subject(body, prior, replace(layout, markers=kept), [recording], settings)


def saved_subject(
    fit: MarkerFit, prior: PosePrior, layout: MarkerLayout, settings: MoshSettings
) -> Subject:
    """The subject of an earlier fit; layout: of the labels in use, all of which the fit has."""
    columns = [fit.labels.index(label) for label in layout.labels]
    attachment = replace(
        fit.attachment,
        triangles=fit.attachment.triangles[columns],
        coefficients=fit.attachment.coefficients[columns],
    )
    frames = spread_frames(fit.observed_markers, settings.frames, settings.seed)
    shape = ShapeFit(
        betas=fit.betas,
        latent_markers=fit.latent_markers[columns],
        attachment=attachment,
        pose=fit.pose[frames],
        trans=fit.trans[frames],
        costs={},
        status="saved",
        iterations=0,
    )
    return Subject(fit.body, prior.for_joints(fit.body.joint_names), layout, shape)


State = Literal["nobody", "started", "tracked", "held"]


class LiveFrame(NamedTuple):
    """The fit of one frame of a stream: pose (J, 3) rad, trans (3,) m, its cost, and the distance
    (M,) of each marker from the body, m.

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


class Solver(Protocol):
    """Follows one person from frame to frame; for one stream and one thread."""

    def step(self, observed: np.ndarray, /) -> CausalFrame:
        """Fit the next frame."""
        ...

    def distances(self, observed: np.ndarray, /) -> Float[np.ndarray, " M"]:
        """Of what the last frame shows from the body (m), NaN where missing."""
        ...

    def rehearse(self) -> None:
        """Compute the last frame once more; nothing changes."""
        ...


SolverT = TypeVar("SolverT", bound=Solver)


class Sight(Protocol[SolverT]):
    """A person of known shape as a stream shows them, by ``num_observations`` M; ``least`` of them
    keep track of the person.
    """

    num_joints: int
    num_observations: int
    least: int

    def own(self, observed: np.ndarray, solver: SolverT | None, /) -> np.ndarray:
        """What of a frame is the person's; of the one whom ``solver`` follows, if any."""
        ...

    def seen(self, own: np.ndarray, /) -> int:
        """How many of the M it is."""
        ...

    def start(self, own: np.ndarray, /) -> SolverT | None:
        """A solver whose first frame this is; None where the frame does not tell a place."""
        ...


class MarkerSolver:
    """`CausalSolver`, as a `Solver`."""

    def __init__(self, solver: CausalSolver):
        self._solver = solver
        self.step = solver.step
        self.rehearse = solver.rehearse

    def distances(self, observed: Float[np.ndarray, "M 3"]) -> Float[np.ndarray, " M"]:
        """Of the markers from where the body has them (m)."""
        return np.sqrt(np.square(self._solver.markers() - observed).sum(axis=1))


class MarkerSight:
    """A subject as markers (M, 3) show it, in metres, NaN where missing."""

    least = MIN_MARKERS

    def __init__(self, subject: Subject, settings: MoshSettings):
        self._subject = subject
        self._settings = settings
        self.num_joints = subject.rig.num_joints
        self.num_observations = subject.rig.num_markers

    def own(
        self, observed: Float[np.ndarray, "M 3"], solver: MarkerSolver | None
    ) -> Float[np.ndarray, "M 3"]:
        """All markers, labels put right, misplaced ones left out."""
        observed = exchange(observed[None], self._subject.exchanged)[0]
        observed[list(self._subject.misplaced)] = np.nan
        return observed

    def seen(self, own: Float[np.ndarray, "M 3"]) -> int:
        """How many markers there are."""
        return int(np.isfinite(own[:, 0]).sum())

    def start(self, own: Float[np.ndarray, "M 3"]) -> MarkerSolver:
        """From the best of many starts."""
        subject, settings = self._subject, self._settings
        names = ("root", *subject.prior.joint_names)
        pose, trans = start_frame(subject.rig, subject.shape.pose, names, own)
        scales = np.full(len(own), settings.robust_scale[1])
        return MarkerSolver(
            CausalSolver(
                subject.rig,
                subject.prior,
                pose,
                trans,
                sequence_settings(settings),
                scales,
                live=settings.live,
            )
        )


class Tracker(Generic[SolverT]):
    """Fits a person of known shape frame by frame; for one stream and one thread.

    rate_hz: of the stream.
    """

    def __init__(self, sight: Sight[SolverT], settings: LiveSettings, rate_hz: float):
        self._sight = sight
        self._settings = settings
        self._gone = max(1, round(settings.gone * rate_hz))
        self._wait = max(1, round(settings.wait_s * rate_hz))
        self._solver: SolverT | None = None
        self._blind = self._waited = self._astray = 0
        self.own: np.ndarray | None = None
        """What of the last frame was the person's."""

    @property
    def solver(self) -> SolverT | None:
        """Of the person who is followed; None while there is nobody."""
        return self._solver

    def step(self, observed: np.ndarray) -> LiveFrame:
        """The next frame; of markers ``observed`` (M, 3) in metres, NaN where missing, all of them
        for a frame that was lost.
        """
        own = self.own = self._sight.own(observed, self._solver)
        seen = self._sight.seen(own)
        self._blind = 0 if seen >= self._sight.least else self._blind + 1
        if self._blind > self._gone:
            self._solver = None
        if self._solver is None:
            return self._begin(own, seen)
        solved = self._solver.step(own)
        if self._blind:
            return _frame(self._solver, solved, own, "held")
        frame = _frame(self._solver, solved, own, "tracked")
        self._astray = (
            self._astray + 1
            if 2 * np.count_nonzero(frame.distances > self._settings.astray) > seen
            else 0
        )
        return (
            self._restarted(own, frame)
            if self._astray and self._astray % self._wait == 0
            else frame
        )

    def rehearse(self) -> None:
        """To be called while nothing comes, so that the next frame takes less time; it changes
        nothing.
        """
        if self._solver is not None:
            self._solver.rehearse()

    def _begin(self, own: np.ndarray, seen: int) -> LiveFrame:
        """The first frame of a person, when half of what there is is seen, or for some time enough
        of it.
        """
        count = self._sight.num_observations
        self._waited = self._waited + 1 if seen >= self._sight.least else 0
        if not self._waited or (
            seen < self._settings.complete * count and self._waited < self._wait
        ):
            return _nobody(self._sight.num_joints, count)
        solver = self._sight.start(own)
        if solver is None:
            return _nobody(self._sight.num_joints, count)
        self._waited = self._astray = self._blind = 0
        self._solver = solver
        return _frame(solver, solver.step(own), own, "started")

    def _restarted(self, own: np.ndarray, frame: LiveFrame) -> LiveFrame:
        """The better one of the track and a new beginning."""
        other = self._sight.start(own)
        if other is None:
            return frame
        solved = other.step(own)
        if solved.cost > self._settings.better * frame.cost:
            return frame
        self._solver = other
        self._astray = 0
        return _frame(other, solved, own, "started")


def _frame(solver: Solver, solved: CausalFrame, own: np.ndarray, state: State) -> LiveFrame:
    return LiveFrame(solved.pose, solved.trans, solved.cost, state, solver.distances(own))


def _nobody(joints: int, count: int) -> LiveFrame:
    return LiveFrame(
        np.full((joints, 3), np.nan), np.full(3, np.nan), 0.0, "nobody", np.full(count, np.nan)
    )


def marker_tracker(
    subject: Subject, settings: MoshSettings, rate_hz: float
) -> Tracker[MarkerSolver]:
    """What follows a subject by markers."""
    return Tracker(MarkerSight(subject, settings), settings.live, rate_hz)


@dataclass(frozen=True)
class QualityLimits:
    """What a verdict on the last second looks at. mean_mm, p95_mm: of the distances from the body;
    outlier: metres from which on the median of one label's is named; complete: share of what there
    is that should be seen; sentences: of the reasons "nobody" and "live few", "live errors", "live
    outliers", "live missing".
    """

    mean_mm: Bound
    p95_mm: Bound
    outlier: float
    complete: float
    sentences: Mapping[str, str]

    @staticmethod
    def of_markers(settings: MoshSettings) -> "QualityLimits":
        """Those of a fit to markers."""
        return QualityLimits(
            LIMITS.mean_mm,
            LIMITS.p95_mm,
            settings.suspects.large_residual,
            settings.live.complete,
            SENTENCES,
        )


_NAMED = 3


class Quality:
    """Verdict on the frames of the last second. labels: of the N markers, or of ``what`` else is
    observed; rate_hz: of the stream.
    """

    what = "markers"

    def __init__(self, labels: tuple[str, ...], rate_hz: float, limits: QualityLimits):
        self.labels = labels
        self._limits = limits
        self._last: deque[LiveFrame] = deque(maxlen=max(1, round(rate_hz)))

    def add(self, frame: LiveFrame) -> None:
        """The next frame."""
        self._last.append(frame)

    @property
    def seen(self) -> int:
        """How many markers the last frame has."""
        return int(np.isfinite(self._last[-1].distances).sum()) if self._last else 0

    @property
    def mean_mm(self) -> float:
        """Of the distances between markers and body over the last second, NaN where there are
        none.
        """
        distances = self._distances()
        return (
            1e3 * float(distances[np.isfinite(distances)].mean())
            if np.isfinite(distances).any()
            else float("nan")
        )

    @property
    def verdict(self) -> Verdict:
        """``good``, ``doubtful`` or ``failed``, with its reasons."""
        if not self._last or self._last[-1].state == "nobody":
            return verdict_of([Reason(FAILED, "nobody")], self._limits.sentences)
        distances = self._distances()
        reasons = [reason for reason in self.reasons(distances) if reason.level != GOOD]
        return verdict_of(reasons, self._limits.sentences)

    def reasons(self, distances: Float[np.ndarray, "F N"]) -> list[Reason]:
        """By the distances (m) of the last second, NaN where missing."""
        return [self._errors(distances), self._missing(distances)]

    def _distances(self) -> np.ndarray:
        """(F, N) of the last second's frames that show somebody."""
        shown = [frame.distances for frame in self._last if frame.state in ("tracked", "started")]
        return np.array(shown).reshape(-1, len(self.labels))

    def _errors(self, distances: np.ndarray) -> Reason:
        seen = np.isfinite(distances)
        if not seen.any():
            return Reason(FAILED, "live few")
        mean = 1e3 * distances[seen].mean()
        p95 = 1e3 * np.percentile(distances[seen], 95)
        limits = self._limits
        level = worst([above(mean, limits.mean_mm), above(p95, limits.p95_mm)])
        medians = _medians(distances)
        far = np.flatnonzero(medians > limits.outlier)
        if not len(far):
            return Reason(level, "live errors", {"mean": mean})
        named = ", ".join(f"{self.labels[k]} {1e3 * medians[k]:.0f} mm" for k in far[:_NAMED])
        more = f" and {len(far) - _NAMED} more" if len(far) > _NAMED else ""
        values = {"mean": mean, "named": named + more}
        return Reason(worst([level, DOUBTFUL]), "live outliers", values)

    def _missing(self, distances: np.ndarray) -> Reason:
        share = float(np.isfinite(distances).mean()) if distances.size else 0.0
        level = DOUBTFUL if share < self._limits.complete else GOOD
        return Reason(level, "live missing", {"share": share})


def _medians(distances: np.ndarray) -> np.ndarray:
    """(N,) of each marker that is seen, 0 elsewhere."""
    out = np.zeros(distances.shape[1])
    seen = np.isfinite(distances).any(axis=0)
    out[seen] = np.nanmedian(distances[:, seen], axis=0)
    return out


class LiveFit:
    """Follows one person's markers: ``step`` fits the next frame from itself and the two before it.

    ``labels`` name the M markers that ``step`` takes, in their order; ``layout`` names the N that
    are used, which are those in ``columns`` (N,). ``betas`` (B,) and ``latent_markers`` (N, 3) are
    the subject's. For one stream and one thread.
    """

    def __init__(
        self,
        subject: Subject,
        labels: Sequence[str],
        columns: Int[np.ndarray, " N"],
        settings: MoshSettings,
        rate_hz: float,
    ):
        self.body = subject.body
        self.layout = subject.layout
        self.labels = tuple(labels)
        self.betas = subject.shape.betas
        self.latent_markers = subject.shape.latent_markers
        self._columns = columns
        self._tracker = marker_tracker(subject, settings, rate_hz)

    def step(self, markers: Float[np.ndarray, "M 3"]) -> LiveFrame:
        """Pose (J, 3) in rad, trans (3,) in m and cost of the next frame, in the markers' own world
        frame.

        markers: those of ``labels``, in metres, NaN where missing. Pose and trans are NaN where
        nobody is seen: before a first frame shows enough markers (half of them, or four for a
        while), and when they were missing for half a second; who returns is found again. Raises
        HabitusError where the shape is another.
        """
        given = np.asarray(markers, dtype=np.float64)
        if given.shape != (len(self.labels), 3):
            raise HabitusError(
                f"markers have shape {given.shape}; expected ({len(self.labels)}, 3), one row a "
                "label"
            )
        return self._tracker.step(
            np.where((self._columns >= 0)[:, None], given[self._columns], np.nan)
        )
