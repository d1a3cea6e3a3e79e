"""Scans to the template (T 5.4): the model, then the free surface, of all scans of a person.

1. Each scan by itself: pose and place from nothing (`start`), the likeliest few refined, the best
   kept.
2. All scans together: one shape, a pose each, with skin that is off the model (`offset_stage`); of
   several bodies,
   women's and men's, the one that explains the scans best goes on (`bodies`).
3. Each scan's free surface (`free_surface`), and where the scan tells of it (`weights`). Where a
   piece of the scan lies
   off it, limbs are tried again from there.

Women's and men's bodies: a scan tells which of several bodies of one topology explains it, and
that one is fitted.

    E = 1/2 sum_p rho(d_p) / noise^2 + 1/2 h^T Q h + 1/2 |betas|^2 + 1/2 (theta - mean)^T P (theta -
    mean)

is what `offset_stage` makes small: what is left of the scan, skin off the model, shape and pose.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from habitus.body.model import BodyModel
from habitus.body.prior import PosePrior
from habitus.errors import HabitusError
from habitus.fit.points.correspondences import Topology, hidden_vertices, nearest, vertex_weights
from habitus.fit.points.free_surface import free_surface, new_cuts, stretched_surface, uncut
from habitus.fit.points.limbs import away_from, found_limbs, with_extremities
from habitus.fit.points.scan import Cleaned, Cloud, Scan, cleaned, turned
from habitus.fit.points.scan_fitting import OFFSET_STEPS as STEPS
from habitus.fit.points.scan_fitting import (
    FrameBefore,
    ModelFitter,
    ModelStep,
    field_precision,
    fit_with_offsets,
    offset_spread,
)
from habitus.fit.points.scan_result import BETAS, LOST, MODEL, ScanFit, at_rest, lost_share
from habitus.fit.points.scan_start import Candidate, Guesser, find_start
from habitus.fit.points.state import ModelState
from habitus.mesh.normals import vertex_normals
from habitus.residuals.points import PointSolver
from habitus.rotations import UP_AXES, matrix_from_rotvec, up_rotation

UP = ("+y", "+z", "-y", "-z", "+x", "-x")
FREE_POINTS = 20_000
TRIED = 2
SINGLE = (ModelStep(4, 2000, 0.08, 0.01, 0.2, 10), ModelStep(5, 3000, 0.05, 0.005, 0.1, 24))
STRETCHED = 0.0018
"""Metres from which on a twentieth of the scan off the surface calls for more than offsets along
normals.
"""
MATCHED = 0.05
FOLLOWED, ENOUGH = 5000, 0.9
"""Points, and the share of them that has to match for a scan to go on from the one before."""
MENDED = 2
"""Times at most that lost limbs are looked for again."""


@dataclass(frozen=True, eq=False)
class Registrar:
    """A body made ready to be registered to scans, and ``others`` of its topology that may explain
    them better.
    """

    body: BodyModel
    fitter: ModelFitter
    guesser: Guesser
    others: tuple["Registrar", ...] = ()

    @staticmethod
    def of(body: BodyModel, prior: PosePrior, others: Sequence[BodyModel] = ()) -> "Registrar":
        """To be made once a body."""
        topology = Topology.of(body.faces, body.num_vertices, hidden_vertices(body))
        fitter = ModelFitter(PointSolver.of(body), topology, prior.for_joints(body.joint_names))
        more = tuple(Registrar.of(other, prior) for other in others)
        return Registrar(body, fitter, Guesser.of(fitter), more)

    def settled(self, fit: ScanFit) -> "Registrar":
        """With the body of a fit alone."""
        return replace(next(one for one in (self, *self.others) if one.body is fit.body), others=())

    def after(self, fit: ScanFit) -> "Registrar":
        """The same for the next frame of a sequence, coupled to this one in shape, pose, and skin
        off the model.
        """
        normal = vertex_normals(fit.model_vertices, self.body.faces)
        before = FrameBefore(
            fit.betas, fit.pose, ((fit.vertices - fit.model_vertices) * normal).sum(1)
        )
        return replace(self, fitter=replace(self.fitter, before=before))

    def register(
        self,
        scans: Sequence[Scan],
        *,
        unit: str = "auto",
        up: str = "auto",
        seed: int = 0,
        previous: ModelState | None = None,
        progress: Callable[[str, float], None] = lambda stage, share: None,
    ) -> list[ScanFit]:
        """All scans of one person. ``previous``: states to begin with, one a scan: of the scan
        before in a sequence, of the same scans with another body.

        Raises HabitusError for what is no scan of a person, as far as that is known before a fit.
        """
        if up != "auto" and up not in UP:
            raise HabitusError(f"up is {up!r}; expected auto, {', '.join(UP)}")
        begun = time.perf_counter()
        seconds = {}
        progress("read", 0.0)
        ready = [cleaned(scan, unit, seed) for scan in scans]
        seconds["clean"] = time.perf_counter() - begun
        starts = []
        for k, one in enumerate(ready):
            progress("start", 0.1 + 0.4 * k / len(ready))
            starts.append(
                self._start(
                    one,
                    up,
                    None if previous is None else previous.one(min(k, len(previous.pose) - 1)),
                )
            )
        seconds["start"] = time.perf_counter() - begun - sum(seconds.values())
        progress("model", 0.5)
        placed = [
            turned(one, up_rotation(axis)) for one, (_, axis, _) in zip(ready, starts, strict=True)
        ]
        states = [start.state for start, _, _ in starts]
        clouds = [
            self.fitter.oriented(state, cloud)
            for state, (_, cloud) in zip(states, placed, strict=True)
        ]
        surfaces = [self.fitter.vertices(state) for state in states]
        people = [k for k, cloud in enumerate(clouds) if self._is_person(states[k], cloud)]
        best = self
        if people:
            own = [clouds[k] for k in people]
            best, state, free = self._fitted_best(_joined([states[k] for k in people]), own)
            seconds["model"] = time.perf_counter() - begun - sum(seconds.values())
            progress("limbs", 0.8)
            state, free = best._mended(state, own, free)
            seconds["limbs"] = time.perf_counter() - begun - sum(seconds.values())
            for i, k in enumerate(people):
                states[k], surfaces[k] = state.one(i), free[i]
        found = []
        for k, (whole, _) in enumerate(placed):
            own = best if k in people else self
            one = own._result(whole, clouds[k], states[k], surfaces[k], starts[k])
            said = (
                ()
                if own is self
                else (f"the {own.body.name} body explains the scan best; --body chooses another",)
            )
            took = {name: each / len(scans) for name, each in seconds.items()}
            found.append(
                replace(one, person=k in people, stage_seconds=took, notes=(*one.notes, *said))
            )
        return found

    def _is_person(self, state: ModelState, cloud: Cloud) -> bool:
        """Whether a start is worth a fit: what is no person leaves it far off and the body out of
        all proportion.
        """
        apart = cloud.points - self.fitter.matched(state, 0, cloud).place
        odd = np.sqrt(np.mean(state.betas**2)) > BETAS[1] if len(state.betas) else True
        return not (odd and np.median(np.linalg.norm(apart, axis=1)) > MODEL[0])

    def _start(
        self, one: Cleaned, up: str, previous: ModelState | None
    ) -> tuple[Candidate, str, float | None]:
        """The best start of a scan, its up axis, and how much worse the best other one is."""
        axes = [up] if up != "auto" else _upright(one)
        turns = np.array([up_rotation(axis) for axis in axes])
        rough = [] if previous is None else self._followed(previous, one, turns[0])
        rough = rough or find_start(self.guesser, one.cloud, turns)
        tried = []
        for candidate in rough[:TRIED]:
            if tried and not self._apart(candidate, rough[0]):
                continue
            cloud = turned(one, candidate.turn)[1]
            state = self.fitter.fit(candidate.state, [cloud], SINGLE[:1])
            cloud = self.fitter.oriented(state, cloud)
            state = self.fitter.fit(self.guesser.scene(cloud).limbs(state), [cloud], SINGLE[1:])
            tried.append(Candidate(state, candidate.turn, self.guesser.scene(cloud).misfit(state)))
        tried.sort(key=lambda candidate: candidate.misfit)
        best = tried[0]
        cloud = turned(one, best.turn)[1]
        state = with_extremities(self.fitter, best.state, self.fitter.oriented(best.state, cloud))
        best = replace(
            best, state=self.fitter.fit(state, [self.fitter.oriented(state, cloud)], SINGLE[1:])
        )
        axis = axes[int(np.argmin([np.abs(turn - best.turn).max() for turn in turns]))]
        others = [other.misfit / best.misfit for other in tried[1:] if self._apart(other, best)]
        return best, axis, min(others, default=None)

    def _followed(
        self, previous: ModelState, one: Cleaned, turn: Float[np.ndarray, "3 3"]
    ) -> list[Candidate]:
        """Where the scan before ended, as a start; none where that is too far off."""
        cloud = turned(one, turn)[1].first(FOLLOWED)
        state = self.fitter.fit(previous, [cloud], SINGLE[:1])
        found = self.fitter.matched(state, 0, cloud)
        fits = np.linalg.norm(cloud.points - found.place, axis=1) < MATCHED
        return [Candidate(state, turn, np.inf)] if fits.mean() > ENOUGH else []

    def _apart(self, one: Candidate, other: Candidate) -> bool:
        """Whether two candidates are different poses: some joint is elsewhere."""
        joints = [
            self.body(each.state.betas, each.state.pose[0], each.state.trans[0]).joints @ each.turn
            for each in (one, other)
        ]
        return float(np.linalg.norm(joints[0] - joints[1], axis=1).max()) > 0.12

    def _fitted_best(
        self, state: ModelState, clouds: Sequence[Cloud]
    ) -> tuple["Registrar", ModelState, list[Float[np.ndarray, "V 3"]]]:
        """All scans together: with the body that explains them best, its state, and free surfaces.

        Which that is shows before the last and longest steps, which it alone is given.
        """
        if not self.others:
            return self, *self._fitted(state, clouds)
        begun = [
            (self, state),
            *((other, carried(self.body, other.body, state)) for other in self.others),
        ]
        tried = [
            (one, *fit_with_offsets(one.fitter, begin, clouds, STEPS[:-1])) for one, begin in begun
        ]
        best, state, _ = min(tried, key=lambda one: energy(one[0].fitter, one[1], clouds, one[2]))
        return best, *best._fitted(state, clouds, STEPS[-1:])

    def _fitted(
        self, state: ModelState, clouds: Sequence[Cloud], schedule: Sequence[ModelStep] = STEPS
    ) -> tuple[ModelState, list[Float[np.ndarray, "V 3"]]]:
        """All scans together: state, and free surfaces."""
        state, surfaces = fit_with_offsets(self.fitter, state, clouds, schedule)
        each = zip(clouds, surfaces, strict=True)
        return state, [
            self._freed(self.fitter.vertices(state, k), *one) for k, one in enumerate(each)
        ]

    def _freed(
        self, model: np.ndarray, cloud: Cloud, start: np.ndarray
    ) -> Float[np.ndarray, "V 3"]:
        """The free surface of one scan, stretched where offsets along normals leave much of the
        scan off it.

        A surface that has to be stretched follows the scan, also where it cuts itself by that.
        """
        topology = self.fitter.topology
        few = cloud.first(FREE_POINTS)
        surface = uncut(topology, model, free_surface(topology, model, few, start=start))
        if np.percentile(away_from(self.guesser, cloud, surface), 95) > STRETCHED:
            return stretched_surface(topology, surface, few)
        return surface

    def _mended(
        self, state: ModelState, clouds: Sequence[Cloud], surfaces: list[Float[np.ndarray, "V 3"]]
    ) -> tuple[ModelState, list[Float[np.ndarray, "V 3"]]]:
        """Where a piece of a scan lies off its surface, limbs are tried once more from there; what
        is better stays.
        """
        lost = [self._lost(cloud, surface) for cloud, surface in zip(clouds, surfaces, strict=True)]
        for _ in range(MENDED):
            found = {
                k: found_limbs(self.guesser, state.one(k), clouds[k], surfaces[k], SINGLE)
                for k, share in enumerate(lost)
                if share > LOST[0]
            }
            if all(one is None for one in found.values()):
                break
            tried = _joined([found.get(k) or state.one(k) for k in range(len(clouds))])
            tried, free = self._fitted(tried, clouds)
            left = [self._lost(cloud, surface) for cloud, surface in zip(clouds, free, strict=True)]
            if sum(left) >= sum(lost):
                break
            state = tried
            surfaces = free
            lost = left
        return state, surfaces

    def _lost(self, cloud: Cloud, surface: Float[np.ndarray, "V 3"]) -> float:
        return lost_share(cloud.points, away_from(self.guesser, cloud, surface))

    def _result(
        self,
        whole: Scan,
        cloud: Cloud,
        state: ModelState,
        surface: Float[np.ndarray, "V 3"],
        start: tuple[Candidate, str, float | None],
    ) -> ScanFit:
        model = self.fitter.vertices(state)
        there, near = (
            nearest(self.fitter.topology, each, cloud.points, cloud.normals)
            for each in (surface, model)
        )
        to_surface, to_model = (
            np.linalg.norm(cloud.points - each.place, axis=1) for each in (there, near)
        )
        fits = (to_model < MATCHED) & (near.cosine > 0.3)
        off = self.fitter.prior.whitening @ (state.pose[0, 1:].ravel() - self.fitter.prior.mean)
        counted = (
            (to_surface < MATCHED) & (np.abs(there.cosine) > 0.3)
            if fits.any()
            else np.ones(len(fits), bool)
        )
        return ScanFit(
            scan_name=whole.name,
            body_name=self.body.name,
            body=self.body,
            betas=state.betas,
            pose=state.pose[0],
            trans=state.trans[0],
            vertices=surface,
            model_vertices=model,
            rest_vertices=at_rest(self.body, state, surface - model),
            weights=vertex_weights(self.fitter.topology, surface, cloud),
            cloud=cloud,
            to_surface=to_surface[counted],
            to_model=to_model[counted],
            far_from_surface=to_surface,
            matched=float(fits.mean()),
            lost=lost_share(cloud.points, to_surface),
            rival=start[2],
            pose_distance=float(np.sqrt(np.mean(off**2))),
            to_body=whole.to_body,
            up_axis=start[1],
            notes=_notes(whole, start[1]),
            cuts=new_cuts(self.fitter.topology, model, surface),
        )


def _joined(states: Sequence[ModelState]) -> ModelState:
    """One state of several scans; the shape is the mean."""
    return ModelState(
        np.mean([one.betas for one in states], axis=0),
        np.concatenate([one.pose for one in states]),
        np.concatenate([one.trans for one in states]),
    )


def _upright(one: Cleaned) -> list[str]:
    """Axes that may point up: that of the floor, or any."""
    if one.floor_up is None:
        return list(UP)
    return [max(UP, key=lambda axis: float(np.array(UP_AXES[axis])[1] @ one.floor_up))]


def _notes(scan: Scan, axis: str) -> tuple[str, ...]:
    return (
        scan.notes
        if axis == "+y"
        else (*scan.notes, f"its {axis} axis points up: it was turned to y up")
    )


ALIKE = 0.005
"""Metres (sd) within which another body's vertices are put on the first one's; its betas are held
as people's are.
"""


def carried(body: BodyModel, other: BodyModel, state: ModelState) -> ModelState:
    """A state of one body as one of another of its topology: the same poses, and the shape that is
    most alike.
    """
    mean = np.zeros(other.num_betas)
    count = other.num_vertices
    wanted = body.rest_vertices(state.betas) - other.rest_vertices(mean)
    slopes = np.asarray(other.shapedirs, float).reshape(3 * count, -1)
    slopes = np.concatenate(
        [slopes, np.tile(np.eye(3), (count, 1))], 1
    )  # betas, and the whole moved
    held = ALIKE**2 * np.concatenate([np.ones(other.num_betas), np.zeros(3)])
    found = np.linalg.solve(slopes.T @ slopes + np.diag(held), slopes.T @ wanted.ravel())
    betas = found[:-3]
    moved = found[-3:]
    first = body.rest_joints(state.betas)[0]
    second = other.rest_joints(betas)[0]
    turned = np.array(
        [matrix_from_rotvec(pose[0]) @ (moved - first + second) for pose in state.pose]
    )
    return ModelState(betas, state.pose, state.trans + first - second + turned)


def energy(
    fitter: ModelFitter,
    state: ModelState,
    clouds: Sequence[Cloud],
    surfaces: Sequence[Float[np.ndarray, "V 3"]],
) -> float:
    """E of all scans at surfaces (m) that lie off the model along its normals."""
    total = 0.5 * float(state.betas @ state.betas)
    for k, (cloud, surface) in enumerate(zip(clouds, surfaces, strict=True)):
        model = fitter.vertices(state, k)
        offset = ((surface - model) * vertex_normals(model, fitter.topology.faces)).sum(1)
        held = field_precision(fitter.topology, model, offset_spread(fitter.body))
        off = state.pose[k, 1:].ravel() - fitter.prior.mean
        total += 0.5 * float(offset @ (held @ offset)) + 0.5 * float(
            off @ fitter.prior.precision @ off
        )
        total += _left(fitter, cloud.first(STEPS[-1].points), surface)
    return total


def _left(fitter: ModelFitter, cloud: Cloud, surface: Float[np.ndarray, "V 3"]) -> float:
    """What a surface leaves of a scan, by Geman and McClure's function of the distance."""
    place = nearest(fitter.topology, surface, cloud.points, cloud.normals).place
    square = ((cloud.points - place) ** 2).sum(1)
    reach = STEPS[-1].reach ** 2
    return 0.5 / STEPS[-1].noise ** 2 * float((square * reach / (square + reach)).sum())
