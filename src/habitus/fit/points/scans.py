"""Scans registered to a body's topology (thesis sec. 5.4): the model, then the free surface, of
all scans of a person.

1. Each scan by itself: pose and translation from nothing (`scan_start`), the best few refined
   (`scan_fitting`), hands and feet turned (`limbs`).
2. All scans together, but those whose own shape is unlike the others' (each by itself): one shape,
   a pose each, with skin offsets; of several bodies, women's and men's, the one with the least
   energy goes on:

       E = 1/2 sum_p rho(d_p) / noise^2 + 1/2 h^T Q h + 1/2 |betas|^2
           + 1/2 (theta - mean)^T P (theta - mean)

   Before the last stages hands are posed (`limbs.with_hands`), where the body has fingers.
3. The free surface of each scan (`free_surface`), and how well the scan covers it
   (`correspondences.vertex_weights`). Where a piece of the scan lies off it, limbs are searched
   again from there.
"""

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from functools import cache, partial

import numpy as np
from jaxtyping import Float

from habitus.body.hand_space import has_hands
from habitus.body.model import BodyModel
from habitus.body.prior import PosePrior
from habitus.body.state import BodyState
from habitus.errors import HabitusError
from habitus.fit.offsets import along_normals
from habitus.fit.points.clothes import hair_notes
from habitus.fit.points.correspondences import Topology, hidden_vertices, vertex_weights
from habitus.fit.points.free_surface import free_surface, new_cuts, stretched_surface, uncut
from habitus.fit.points.limb_agreement import limbs_compared
from habitus.fit.points.limbs import (
    forearm_twists,
    forearms_turned_back,
    limb_joint_deviations,
    limbs_searched_again,
    quick_energy,
    with_extremities,
    with_hands,
    with_usual_joints,
)
from habitus.fit.points.scan import Cleaned, Cloud, Scan, cleaned, turned
from habitus.fit.points.scan_evidence import compared, energy, lost_piece, part_around
from habitus.fit.points.scan_fitting import PreviousFrame, ScanFitter
from habitus.fit.points.scan_result import LIMITS, ScanFit
from habitus.fit.points.scan_stage import ScanStage
from habitus.fit.points.scan_start import Candidate, Guesser, find_start
from habitus.fit.points.scan_states import (
    Registered,
    Start,
    at_rest,
    carried,
    extended,
    joined,
)
from habitus.fit.points.settings import SCANS, ScanSettings
from habitus.fit.verdict import HANDS, HEAD, vertex_parts
from habitus.mesh.normals import vertex_normals
from habitus.parallel.workers import map_on_threads
from habitus.residuals.points import PointSolver
from habitus.rotations import UP_AXES, up_rotation

UP = ("+y", "+z", "-y", "-z", "+x", "-x")
Progress = Callable[[str, float], None]


@dataclass(frozen=True, eq=False)
class Registrar:
    """A body prepared for registration, and ``others`` of its topology that may explain scans
    better; ``guesser`` makes what searches a pose from nothing, when it is needed; ``detailed``
    gives the same body with finger joints and all its betas, for the last stages.
    """

    body: BodyModel
    fitter: ScanFitter
    guesser: Callable[[], Guesser]
    others: tuple["Registrar", ...] = ()
    detailed: Callable[[], "Registrar"] | None = None

    @staticmethod
    def of(body: BodyModel, prior: PosePrior, settings: ScanSettings = SCANS) -> "Registrar":
        """To be made once a body."""
        topology = Topology.of(body.faces, body.num_vertices, hidden_vertices(body))
        fitter = ScanFitter(
            PointSolver.of(body), topology, prior.for_joints(body.joint_names), settings=settings
        )
        return Registrar(body, fitter, cache(partial(Guesser.of, fitter)))

    @property
    def settings(self) -> ScanSettings:
        """Of the recipe."""
        return self.fitter.settings

    def settled(self, fit: ScanFit) -> "Registrar":
        """With the body of a fit alone."""
        for registrar in (self, *self.others):
            if registrar.body is fit.body:
                return replace(registrar, others=(), detailed=None)
            if registrar.detailed is not None and registrar.body.name == fit.body.name:
                return registrar.detailed()
        return self

    def after(self, fit: ScanFit) -> "Registrar":
        """The same for the next frame of a sequence, coupled to this one in shape, pose and skin
        offsets.
        """
        normal = vertex_normals(fit.model_vertices, self.body.faces)
        previous = PreviousFrame(
            fit.betas, fit.pose, ((fit.vertices - fit.model_vertices) * normal).sum(1)
        )
        return replace(self, fitter=replace(self.fitter, previous=previous))

    def register(
        self,
        scans: Sequence[Scan],
        *,
        unit: str = "auto",
        up: str = "auto",
        seed: int = 0,
        previous: BodyState | None = None,
        progress: Progress = lambda stage, share: None,
    ) -> list[ScanFit]:
        """All scans of one person. ``previous``: states to begin with, one a scan: of the scan
        before in a sequence, of the same scans with another body.

        Raises HabitusError for what is no scan of a person, as far as that is known before a fit.
        """
        if up != "auto" and up not in UP:
            raise HabitusError(f"up is {up!r}; expected auto, {', '.join(UP)}")
        clock = Clock()
        progress("read", 0.0)
        with clock("clean"):
            ready = [cleaned(scan, unit, seed, self.settings.cleaning) for scan in scans]
        started: list[Registered] = []
        with clock("start"):
            for k, scan in enumerate(ready):
                progress("start", 0.1 + 0.4 * k / len(ready))
                last = None if previous is None else previous[_last(k, previous)]
                started.append(self._started(scan, up, last))
        people = [k for k, scan in enumerate(started) if scan.person]
        shapes = [self.body.rest_vertices(started[k].state.betas) for k in people]
        unlike = [k for k, off in zip(people, self._unlike(shapes), strict=True) if off]
        alike = [k for k in people if k not in unlike]
        fits: dict[int, ScanFit] = {}
        for group in filter(None, [alike, *([k] for k in unlike)]):
            together = self._fits_of([started[k] for k in group], clock, progress)
            fits.update(zip(group, together, strict=True))
        if unlike:
            shapes = [fits[k].body.rest_vertices(fits[k].betas) for k in people]
            for k, off in zip(people, self._unlike(shapes), strict=True):
                fits[k] = replace(fits[k], unlike=off if k in unlike else 0.0)
        seconds = {name: each / len(scans) for name, each in clock.seconds.items()}
        for k, scan in enumerate(started):
            if k not in fits:
                fits[k] = replace(self._result(scan), notes=_notes(scan, False, self, self))
        return [
            replace(fits[k], stage_seconds=seconds, notes=(*scan.scan.notes, *fits[k].notes))
            for k, scan in enumerate(started)
        ]

    def _fits_of(
        self, scans: Sequence[Registered], clock: "Clock", progress: Progress
    ) -> list[ScanFit]:
        """Scans of one shape fitted together."""
        progress("model", 0.5)
        with clock("model"):
            best, fitted = self._fitted_best(scans)
        progress("limbs", 0.8)
        with clock("limbs"):
            fitted = best._forearms_turned_back(best._limbs_searched(fitted))
        fits = limbs_compared([best._result(scan) for scan in fitted])
        return [
            replace(fit, notes=(*_notes(scan, True, self, best), *fit.notes))
            for scan, fit in zip(scans, fits, strict=True)
        ]

    def _unlike(self, shapes: Sequence[Float[np.ndarray, "V 3"]]) -> list[float]:
        """How far (m, RMS) each scan's shape at rest is from the median of all, where it is too far
        for one person; 0 for the others, and for all of fewer than three.
        """
        if len(shapes) < 3:
            return [0.0] * len(shapes)
        off = np.array(shapes) - np.median(shapes, 0)
        distances = np.sqrt(np.square(off).sum(2).mean(1)).tolist()
        return [each if each > self.settings.one_person else 0.0 for each in distances]

    def _started(self, scan: Cleaned, up: str, previous: BodyState | None) -> Registered:
        """A scan upright, at its start."""
        start = self._start(scan, up, previous)
        whole, cloud = turned(scan, up_rotation(start.up))
        state = start.best.state
        surface = self.fitter.vertices(state)
        cloud = self.fitter.oriented(surface, cloud)
        person = self._is_person(state, cloud)
        return Registered(whole, cloud, start, state, surface, person, scan.islands)

    def _is_person(self, state: BodyState, cloud: Cloud) -> bool:
        """Whether a start is worth a fit: what is no person leaves it far off and the body out of
        all proportion.
        """
        distances = self.fitter.matched(state, 0, cloud).distances(cloud.points)
        search = self.settings.search
        betas = state.betas
        rare = not len(betas) or np.sqrt(np.mean(betas**2)) > search.max_person_betas
        return not (rare and np.median(distances) > search.max_person_distance)

    def _start(self, scan: Cleaned, up: str, previous: BodyState | None) -> Start:
        """The best start of a scan."""
        settings = self.settings
        axes = [up] if up != "auto" else _upright(scan)
        turns = np.array([up_rotation(axis) for axis in axes])
        rough = [] if previous is None else self._followed(previous, scan, turns[0])
        rough = rough or find_start(self.guesser(), scan.cloud, turns)

        def fitted(candidate: Candidate) -> Candidate:
            cloud = turned(scan, candidate.turn)[1]
            state = self.fitter.fit(candidate.state, [cloud], settings.stages[:1])
            cloud = self._oriented(state, cloud)
            scene = self.guesser().scene(cloud)
            state = self.fitter.fit(scene.limbs(state), [cloud], settings.stages[1:])
            return Candidate(state, candidate.turn, scene.misfit(state))

        first, *others = rough[: settings.search.candidates]
        others = [candidate for candidate in others if self._differ(candidate, first)]
        tried = map_on_threads(fitted, [first, *others])
        tried.sort(key=lambda candidate: candidate.misfit)
        best = tried[0]
        cloud = turned(scan, best.turn)[1]
        state = with_extremities(self.fitter, best.state, self._oriented(best.state, cloud))
        cloud = self._oriented(state, cloud)
        placed = [replace(each, scalp_weight=settings.hair.weight) for each in settings.stages[1:]]
        state = self.fitter.fit(state, [cloud], placed)
        best = replace(best, state=with_usual_joints(self.guesser(), state, cloud, placed))
        axis = axes[int(np.argmin([np.abs(turn - best.turn).max() for turn in turns]))]
        rivals = [other.misfit / best.misfit for other in tried[1:] if self._differ(other, best)]
        return Start(best, axis, min(rivals, default=None))

    def _oriented(self, state: BodyState, cloud: Cloud) -> Cloud:
        """A scan's cloud with normals on the side of the body in a state."""
        return self.fitter.oriented(self.fitter.vertices(state), cloud)

    def _followed(
        self, previous: BodyState, scan: Cleaned, turn: Float[np.ndarray, "3 3"]
    ) -> list[Candidate]:
        """Where the scan before ended, as a start; none where that is too far off."""
        search = self.settings.search
        cloud = turned(scan, turn)[1].first(search.followed_points)
        state = self.fitter.fit(previous, [cloud], self.settings.stages[:1])
        distances = self.fitter.matched(state, 0, cloud).distances(cloud.points)
        close = (distances < search.followed_distance).mean() > search.followed_share
        return [Candidate(state, turn, np.inf)] if close else []

    def _differ(self, candidate: Candidate, other: Candidate) -> bool:
        """Whether two candidates are different poses: some joint is elsewhere."""
        joints = [
            self.body(each.state.betas, each.state.pose[0], each.state.trans[0]).joints @ each.turn
            for each in (candidate, other)
        ]
        distance = np.linalg.norm(joints[0] - joints[1], axis=1).max()
        return float(distance) > self.settings.search.distinct

    def _fitted_best(self, scans: Sequence[Registered]) -> tuple["Registrar", list[Registered]]:
        """All scans together, with the body that explains them best, in full detail.

        Which body that is shows before the last and longest stages, which it alone is given.
        """
        best, state = self._best_body(
            [scan.cloud for scan in scans], joined([scan.state for scan in scans])
        )
        begin = []
        for k, scan in enumerate(scans):
            each = state[k : k + 1]
            cloud = best._oriented(each, scan.cloud)
            if self.fitter.previous is None:
                each = with_hands(best.fitter, each, cloud)
            begin.append(replace(scan, state=each, cloud=cloud))
        return best, best._fitted(begin, self.settings.last_stages)

    def _best_body(
        self, clouds: Sequence[Cloud], start: BodyState
    ) -> tuple["Registrar", BodyState]:
        """The body that explains the scans best, in full detail; its state before the last stages.

        The two bodies of least energy take the first steps of these, where skin offsets are
        smoothest, and the one of less cost goes on: before them the neutral body, with women's and
        men's shapes among its own, explains some scans of either better than their own body does,
        though it carries skin 1 to 1.5 mm further astray.
        """
        stages = self.settings.offset_stages
        if not stages:
            return self._in_detail(start)

        def fitted(registrar: Registrar) -> tuple[float, Registrar, BodyState]:
            state = start
            if registrar is not self:
                state = carried(self.body, registrar.body, start, self.settings)
            fit = registrar.fitter.fit_with_offsets(state, clouds, stages)
            cost = energy(registrar.fitter, fit, clouds) if self.others else 0.0
            return cost, registrar, fit.state

        tried = sorted(map_on_threads(fitted, (self, *self.others)), key=lambda each: each[0])
        likely = [partial(registrar._in_detail, state) for _, registrar, state in tried[:2]]
        best = map_on_threads(lambda detailed: detailed(), likely)
        if len(best) == 1:
            return best[0]
        first = [self.settings.choice_stage]

        def cost_of(candidate: tuple["Registrar", BodyState]) -> float:
            registrar, state = candidate
            return sum(registrar.fitter.fit_with_offsets(state, clouds, first).costs.values())

        costs = map_on_threads(cost_of, best)
        return best[int(np.argmin(costs))]

    def _in_detail(self, state: BodyState) -> tuple["Registrar", BodyState]:
        """The same body with finger joints and all its betas, and its state."""
        if self.detailed is None:
            return self, state
        detailed = self.detailed()
        return detailed, extended(self.body, detailed.body, detailed.fitter.prior, state)

    def _fitted(self, scans: Sequence[Registered], stages: Sequence[ScanStage]) -> list[Registered]:
        """All scans together: states, and free surfaces."""
        clouds = [scan.cloud for scan in scans]
        fit = self.fitter.fit_with_offsets(joined([scan.state for scan in scans]), clouds, stages)
        clouds = [self.fitter.oriented(*each) for each in zip(fit.surfaces, clouds, strict=True)]
        return [
            replace(
                scan,
                cloud=clouds[k],
                state=fit.state[k : k + 1],
                surface=self._freed(self.fitter.vertices(fit.state, k), clouds[k], surface),
                status=fit.status,
                costs=dict(fit.costs),
            )
            for k, (scan, surface) in enumerate(zip(scans, fit.surfaces, strict=True))
        ]

    def _freed(
        self, model: np.ndarray, cloud: Cloud, start: np.ndarray
    ) -> Float[np.ndarray, "V 3"]:
        """The free surface of one scan, stretched where offsets along normals leave much of the
        scan off it.

        A stretched surface follows the scan, also where it cuts itself by that.
        """
        topology = self.fitter.topology
        settings = self.settings.surface
        few = cloud.first(settings.points)
        surface = free_surface(topology, model, few, settings, start=start)
        surface = self._under_cloth(surface, start)
        surface = uncut(topology, model, surface, settings)
        distances = self.fitter.distances(surface, cloud)
        lost, _ = lost_piece(cloud.points, distances, self.settings.limbs)
        if np.percentile(distances, 95) > settings.stretched or lost > settings.stretched_share:
            surface = stretched_surface(topology, surface, few, settings)
        return self._under_cloth(surface, start)

    def _under_cloth(self, surface: np.ndarray, start: np.ndarray) -> Float[np.ndarray, "V 3"]:
        """The free surface, and under loose clothes the model with its offsets, ``start``."""
        covered = self.fitter.clothes.covered[:, None]
        return covered * start + (1.0 - covered) * surface

    def _limbs_searched(self, scans: list[Registered]) -> list[Registered]:
        """Where a piece of a scan lies off its surface, limbs are searched again from there; what
        is better stays.
        """
        lost = [self._lost(scan) for scan in scans]
        for _ in range(self.settings.limbs.rounds):
            searched = [
                limbs_searched_again(self.guesser(), scan.state, scan.cloud, scan.surface)
                if share > LIMITS.lost.doubtful
                else None
                for scan, share in zip(scans, lost, strict=True)
            ]
            if all(state is None for state in searched):
                break
            begin = [
                replace(scan, state=state or scan.state)
                for scan, state in zip(scans, searched, strict=True)
            ]
            tried = self._fitted(begin, self.settings.all_offset_stages)
            left = [self._lost(scan) for scan in tried]
            if sum(left) >= sum(lost):
                break
            scans = tried
            lost = left
        return scans

    def _forearms_turned_back(self, scans: list[Registered]) -> list[Registered]:
        """Forearms that ended further twisted than people twist them are turned back by half a turn
        and fitted again; what costs less stays.
        """
        back = [forearms_turned_back(self.fitter, scan.state, scan.cloud) for scan in scans]
        if all(state is None for state in back):
            return scans
        begin = [replace(scan, state=b or scan.state) for scan, b in zip(scans, back, strict=True)]
        tried = self._fitted(begin, self.settings.last_stages)
        clouds = [scan.cloud for scan in scans]

        def cost(fitted: list[Registered]) -> float:
            return quick_energy(self.fitter, joined([scan.state for scan in fitted]), clouds)

        return min(scans, tried, key=cost)

    def _lost(self, scan: Registered) -> float:
        """The share of a scan that lies together off its surface; 0 for fingers of posed hands and
        the inside of a mouth, which no search of limbs would place.
        """
        settings = self.fitter.settings.limbs
        distances = self.fitter.distances(scan.surface, scan.cloud)
        share, place = lost_piece(scan.cloud.points, distances, settings)
        fingers = settings.lost_fingers if has_hands(self.body) else 0.0
        left = {HANDS: fingers, HEAD: settings.lost_mouth}
        return 0.0 if share < left.get(part_around(self.body, scan.surface, place), 0.0) else share

    def _result(self, scan: Registered) -> ScanFit:
        state, topology, clothes = scan.state, self.fitter.topology, self.fitter.clothes
        model = self.fitter.vertices(state)
        prior, pose = self.fitter.prior, state.pose[0]
        bent = limb_joint_deviations(self.body, prior, pose)
        rarest = int(bent.argmax())
        skin = along_normals(scan.surface, -clothes.thickness, self.body)
        hair = self.fitter.hair(state, [scan.cloud])
        grown = scan.person and hair.any()
        deviation = prior.whitening @ (pose[1:].ravel() - prior.mean)
        return ScanFit(
            scan_name=scan.scan.name,
            body_name=self.body.name,
            body=self.body,
            betas=state.betas,
            pose=state.pose[0],
            trans=state.trans[0],
            vertices=skin,
            model_vertices=model,
            rest_vertices=at_rest(self.body, state, skin - model),
            weights=(1.0 - clothes.covered)
            * vertex_weights(topology, scan.surface, scan.cloud, self.settings.surface),
            covered=clothes.covered,
            hair=hair if grown else None,
            notes=hair_notes(hair) if grown else (),
            cloud=scan.cloud,
            **compared(self.fitter, scan.cloud, scan.surface, model),
            rival=scan.start.rival,
            pose_distance=float(np.sqrt(np.mean(deviation**2))),
            rarest_joint=self.body.joint_names[rarest],
            joint_deviation=float(bent[rarest]),
            twists=forearm_twists(self.body, prior, pose),
            to_body=scan.scan.to_body,
            up_axis=scan.start.up,
            person=scan.person,
            islands=scan.islands,
            cuts=new_cuts(topology, model, scan.surface, vertex_parts(self.body)),
            status=scan.status,
            costs=scan.costs,
            settings=asdict(self.settings),
        )


class Clock:
    """Seconds of named parts."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        """Of what runs inside."""
        began = time.perf_counter()
        yield
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - began


def _last(k: int, previous: BodyState) -> slice:
    row = min(k, len(previous.pose) - 1)
    return slice(row, row + 1)


def _upright(scan: Cleaned) -> list[str]:
    """Axes that may point up: that of the floor, or any."""
    if scan.floor_up is None:
        return list(UP)
    return [max(UP, key=lambda axis: float(np.array(UP_AXES[axis])[1] @ scan.floor_up))]


def _notes(scan: Registered, person: bool, first: Registrar, best: Registrar) -> tuple[str, ...]:
    notes = []
    if scan.start.up != "+y":
        notes.append(f"its {scan.start.up} axis points up: it was turned to y up")
    if person and best is not first:
        notes.append(f"the {best.body.name} body explains the scan best; --body chooses another")
    return tuple(notes)
