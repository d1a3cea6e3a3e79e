"""Several sensors, one person: a shape and poses that explain all of what was observed at once.

    minimise over betas, latent markers m, pose_f and trans_f of F frames

    sum_f |x(m, state_f) - observed_f|^2 / s^2        markers    (M eq. 3, with E_S and E_I of m)
    + sum of robust squared distances / s^2           pixels and points to the skin (T eq. 4.5)
    + sum of robust squared pixels / s^2              keypoints in calibrated cameras
    + silhouettes + shape prior + pose prior          (T 4.6.1, M eqs. 6 and 7)

Shape and latent markers are shared by all; a frame is one of a capture, or belongs to a view or a
scan alone. Each sensor's own recipe gives a start (`habitus.fit.starts`): MoSh's shape stage, the
search over stances of depth views and scans where these have poses of their own. Then all terms are
minimised together, stage by stage, with reach and priors annealed; the last steps have skin offsets
(`habitus.fit.points.skin_offsets`), which explain what neighbouring pixels and points of one person
have in common. At the end each capture's whole motion is solved with the shape and the latent
markers held (M 6, the pose stage).

Markers and priors are the terms of MoSh's shape stage (`habitus.fit.markers.energy.shape_terms`),
views and scans the public terms `Depth`, `Silhouette` and `Points`, or with skin offsets what
these observe.
"""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from habitus.body.model import BodyModel
from habitus.body.prior import PosePrior
from habitus.body.state import BodyState
from habitus.errors import HabitusError
from habitus.fit.body_fit import BodyFit, FitSettings, JointStage
from habitus.fit.cameras.people import one_person
from habitus.fit.markers.energy import place, shape_terms
from habitus.fit.markers.recipe import fit_known
from habitus.fit.markers.result import MarkerFit
from habitus.fit.offsets import along_normals
from habitus.fit.points.skin_offsets import (
    SkinField,
    SkinPlanes,
    moved_back,
    skin_planes_term,
    skin_prior,
)
from habitus.fit.sensors import DetectionData, SensorData
from habitus.fit.starts import (
    MarkerStart,
    ScanPoints,
    ScanStart,
    ViewPixels,
    ViewStart,
    max_visible_markers,
    separate_scans,
    separate_views,
    shared_scans,
    shared_views,
    start_markers,
    start_scans,
    start_views,
)
from habitus.fit.verdict import Verdict
from habitus.kernels.threads import one_blas_thread
from habitus.mesh.proximity import signed_distance
from habitus.observe.latent_markers import LatentMarkers
from habitus.observe.marker_prediction import marked_body, predict
from habitus.observe.markers import attach
from habitus.residuals.keypoint_terms import Keypoints
from habitus.residuals.points import PointSolver, points_term
from habitus.residuals.shape_stage import pose_prior, shape_prior
from habitus.residuals.surface_terms import Depth, Points, Silhouette
from habitus.solve.minimize import Minimized, Stage, alternate, minimize
from habitus.solve.terms import Term, geman_mcclure_weight
from habitus.types import Progress

Values = Mapping[str, np.ndarray]


@dataclass(frozen=True, eq=False)
class Problem:
    """One person's data, each with the pose (row of the state) it belongs to: first the frames of
    captures, then views and scans with poses of their own. ``poses`` names them. field: skin
    offsets, which captures alone do not need.
    """

    body: BodyModel
    prior: PosePrior
    settings: FitSettings
    solver: PointSolver
    poses: tuple[str, ...]
    markers: MarkerStart | None
    views: tuple[ViewPixels, ...]
    scans: tuple[ScanPoints, ...]
    field: SkinField | None


def fit_sensors(
    body: BodyModel,
    prior: PosePrior,
    data: SensorData,
    settings: FitSettings | None = None,
    terms: Mapping[str, Term] | None = None,
    progress: Progress = lambda stage, share: None,
) -> BodyFit:
    """One person from all that was observed.

    prior: of poses, matched by joint names. terms: more terms, by name, of betas, pose (F, J, 3)
    and trans (F, 3), which join the others; the first poses are those of the captures' frames, in
    their order, then those of views and of scans of their own. Raises HabitusError where there is
    nothing to fit, for frames that a capture does not have, and as each sensor's own recipe does.
    """
    settings = settings or FitSettings()
    data.check()
    if not settings.stages:
        raise HabitusError("the settings have no stages; expected one at least")
    prior = prior.for_joints(body.joint_names)
    with one_blas_thread():
        clock = [time.perf_counter()]
        progress("start", 0.0)
        problem, state, verdicts = start(body, prior, data, settings)
        seen = keypoint_terms(problem, data.detections)
        clock.append(time.perf_counter())
        result = _together(problem, state, _joined(seen, terms or {}), progress)
        state = result.values
        offset = None if problem.field is None else problem.field.offset(state["skin"])
        clock.append(time.perf_counter())
        progress("motion", 0.7)
        motions = _motions(problem, result, clock[-1] - clock[0]) if settings.motion else ()
        clock.append(time.perf_counter())
    names = ("start", "together", "motion")
    return BodyFit(
        body=body,
        betas=state["betas"],
        pose=state["pose"],
        trans=state["trans"],
        poses=problem.poses,
        status=result.status,
        costs=result.costs,
        residuals=residuals(problem, state, offset),
        skin_offset=offset,
        latent_markers=state.get("latent_markers"),
        motions=motions,
        verdicts={**verdicts, **verdicts_of(motions)},
        seconds=dict(zip(names, np.diff(clock).tolist(), strict=True)),
    )


# ---- start ---------------------------------------------------------------------------------------


def start(
    body: BodyModel, prior: PosePrior, data: SensorData, settings: FitSettings
) -> tuple[Problem, Values, dict[str, Verdict]]:
    """The problem, betas, latent markers and poses to begin with, and verdicts on scans.

    The shape is that of the sensor that sees most of it: scans, then captures with enough markers,
    then depth views.
    """
    scans = start_scans(body, prior, data, settings)
    views = start_views(body, data, settings)
    betas = None if scans is None else scans.betas
    if betas is None and views is not None and max_visible_markers(data) < settings.enough_markers:
        betas = views.betas
    markers = None
    if data.captures:
        markers = start_markers(body, prior, data, betas, settings)
        betas = markers.subject.betas
    if betas is None:
        assert views is not None
        betas = views.betas
    parts = [] if markers is None else [(markers.pose, markers.trans)]
    parts += [] if views is None else [(views.pose, views.trans)]
    parts += [] if scans is None else [(each.pose[None], each.trans[None]) for each in scans.fits]
    pose, trans = (np.concatenate(part) for part in zip(*parts, strict=True))
    state = {"betas": betas, "pose": pose, "trans": trans}
    if markers is not None:
        state["latent_markers"] = markers.subject.shape.latent_markers
    surfaces = bool(data.views or data.scans)
    frames = 0 if markers is None else len(markers.frames)
    own = 0 if views is None else len(views.views)
    problem = Problem(
        body=body,
        prior=prior,
        settings=settings,
        solver=PointSolver.of(body),
        poses=_pose_names(markers, views, scans, len(data.captures)),
        markers=markers,
        views=(*separate_views(views, frames, settings), *shared_views(data, markers, settings)),
        scans=(
            *separate_scans(data, scans, frames + own, settings),
            *shared_scans(data, markers, settings),
        ),
        field=SkinField.of(body, settings.depth) if surfaces and settings.skin_steps else None,
    )
    verdicts = {} if scans is None else {each.scan_name: each.verdict for each in scans.fits}
    return problem, state, verdicts


def keypoint_terms(problem: Problem, sensors: Sequence[DetectionData]) -> dict[str, Term]:
    """A term for each sensor: of its frames, those nearest in time to the poses of its capture.

    Raises HabitusError where none of the poses was seen.
    """
    terms = {}
    for k, each in enumerate(sensors):
        assert problem.markers is not None
        rate = problem.markers.recordings[each.capture].rate_hz
        seen, count = each.detections.rate_hz, each.detections.num_frames
        frames, rows = [], []
        for row, (capture, frame) in enumerate(problem.markers.frames):
            nearest = round((frame / rate - each.delay) * seen)
            if capture == each.capture and 0 <= nearest < count:
                frames.append(nearest)
                rows.append(row)
        if not rows:
            raise HabitusError(
                f"{each.detections.name}: none of the capture's frames that are solved lies within "
                f"the {count} frames of the keypoints; check the delay, or give frames"
            )
        person, cameras = one_person(each.detections, each.cameras)
        name = "keypoints" if len(sensors) == 1 else f"keypoints {k}"
        term = Keypoints.of(problem.body, person, cameras, frames, rows)
        terms[name] = Term(term, name=name)
    return terms


def _pose_names(
    markers: MarkerStart | None, views: ViewStart | None, scans: ScanStart | None, captures: int
) -> tuple[str, ...]:
    names = [] if markers is None else [pose_name(*at, captures) for at in markers.frames]
    if views is not None:
        names += [each.view.name or f"view {k}" for k, each in enumerate(views.views)]
    return (*names, *(() if scans is None else (each.scan_name for each in scans.fits)))


def pose_name(capture: int, frame: int, captures: int) -> str:
    """The name of a capture's frame among the poses of a fit."""
    return f"frame {frame}" if captures == 1 else f"capture {capture} frame {frame}"


# ---- all sensors together ------------------------------------------------------------------------


def _together(
    problem: Problem, state: Values, terms: Mapping[str, Term], progress: Progress
) -> Minimized:
    """All stages; marker attachments and robust weights are renewed in each round. Skin offsets
    come last.
    """
    settings = problem.settings
    result = None
    for k, stage in enumerate(settings.stages):
        progress("together", 0.4 + 0.3 * k / len(settings.stages))
        for _ in range(stage.rounds):
            result = minimize(
                joint_terms(problem, state, stage, terms),
                dict(state),
                "levenberg",
                blocks=("trans", "pose"),
                max_iterations=stage.iterations,
                tolerances=settings.tolerances,
                max_step=settings.max_step,
                stretch=False,
            )
            state = result.values
    assert result is not None
    if problem.field is None:
        return result
    return alternate(
        lambda values, stage, step: skin_terms(problem, values, terms),
        {**state, "skin": np.zeros(problem.field.count)},
        [Stage(settings.skin_steps, max_step=settings.max_step, until=settings.tolerances)],
        blocks=("trans", "pose"),
    )


def joint_terms(
    problem: Problem, state: Values, stage: JointStage, more: Mapping[str, Term]
) -> dict[str, Term]:
    """The energy, with marker attachments and robust marker weights of this state."""
    terms = {
        **_markers_and_priors(problem, state, stage),
        **_surface_terms(problem, stage),
    }
    return _joined(terms, more)


def _joined(terms: dict[str, Term], more: Mapping[str, Term]) -> dict[str, Term]:
    for name in more:
        if name in terms:
            raise HabitusError(f"your term {name!r} is named as one of the fit is; rename it")
    return {**terms, **more}


def skin_terms(problem: Problem, state: Values, more: Mapping[str, Term]) -> dict[str, Term]:
    """The energy with skin offsets, all correspondences those of this state."""
    field = problem.field
    assert field is not None
    settings = problem.settings
    stage = settings.stages[-1]
    whole = BodyState(state["betas"], state["pose"], state["trans"])
    outer = {"view": field.offset(state["skin"]) + field.layer, "scan": field.offset(state["skin"])}

    def surfaces(row: int, sensor: str) -> tuple[np.ndarray, np.ndarray]:
        here = (whole.betas, whole.pose[row], whole.trans[row])
        model = np.asarray(problem.body(*here).vertices)
        return model, along_normals(model, outer[sensor], problem.body)

    def planes(row: int, term: Depth | Points, model: np.ndarray, seen: np.ndarray) -> Term:
        points = term.matched(seen).points
        held = SkinPlanes.of(field, whole, row, state["skin"], points, model, seen)
        return skin_planes_term(problem.body, [held], field.count)

    terms = {**_markers_and_priors(problem, state, stage), "skin": skin_prior(field.count)}
    for k, each in enumerate(problem.views):
        model, seen = surfaces(each.row, "view")
        across = replace(_depth(problem, each, stage), min_cosine=settings.depth.min_cosine)
        outline = moved_back(
            _silhouette(problem, each, stage).matched(seen).points, model, seen, problem.body
        )
        terms[f"depth {k}"] = planes(each.row, across, model, seen)
        terms[f"silhouette {k}"] = points_term(
            problem.solver, [outline if n == each.row else None for n in range(len(whole.pose))]
        )
    for k, scan in enumerate(problem.scans):
        exact = replace(_points(problem, scan, stage), slide=0.0)
        terms[f"scan {k}"] = planes(scan.row, exact, *surfaces(scan.row, "scan"))
    return _joined(terms, more)


def _markers_and_priors(problem: Problem, state: Values, stage: JointStage) -> dict[str, Term]:
    """The energy of MoSh's shape stage on the frames of captures, or its priors alone."""
    body = problem.body
    prior = problem.prior
    settings = problem.settings
    # The full pose prior: MoSh's shape stage takes a quarter of it, for frames of many markers.
    weight = replace(settings.mosh.shape, pose=settings.mosh.pose.pose)
    count = len(state["pose"])
    if problem.markers is None:
        return {
            "betas": shape_prior(body.num_betas, stage.prior * weight.betas),
            "pose": pose_prior(prior.mean, prior.whitening, count, stage.prior * weight.pose),
        }
    markers = problem.markers
    observed = np.full((count, *markers.observed.shape[1:]), np.nan)
    observed[: len(markers.observed)] = markers.observed
    rest = body.rest_vertices(state["betas"])
    latent = LatentMarkers(body, attach(state["latent_markers"], rest, body.faces).triangles)
    filled = np.nan_to_num(observed)
    names = ("betas", "latent_markers", "pose", "trans")
    off = np.linalg.norm(latent(**{name: state[name] for name in names}) - filled, axis=2)
    weights = np.isfinite(observed[..., 0]) * geman_mcclure_weight(
        off, settings.marker_reach * stage.reach
    )
    weights[: len(markers.weight)] *= markers.weight[:, None]
    placement = place(markers.subject.layout, body)
    mosh = replace(settings.mosh, shape=weight)
    terms = shape_terms(body, latent, placement, filled, weights, prior, mosh, stage.prior)
    renamed = {"data": "markers", "start": "placement"}
    return {renamed.get(name, name): term for name, term in terms.items()}


def _surface_terms(problem: Problem, stage: JointStage) -> dict[str, Term]:
    terms: dict[str, Term] = {}
    for k, each in enumerate(problem.views):
        terms[f"depth {k}"] = Term(_depth(problem, each, stage))
        terms[f"silhouette {k}"] = Term(_silhouette(problem, each, stage))
    for k, scan in enumerate(problem.scans):
        terms[f"scan {k}"] = Term(_points(problem, scan, stage))
    return terms


def _depth(problem: Problem, each: ViewPixels, stage: JointStage) -> Depth:
    settings = problem.settings.depth
    return Depth(
        problem.solver,
        each.data.view.camera,
        each.data.view.depth,
        each.mask,
        frame=each.row,
        matching=stage.matching,
        noise=each.noise,
        model_sd=settings.model_sd,
        reach=stage.reach,
        slide=settings.slide,
        share=settings.skin_depth,  # of the recipe's last steps
        stride=stage.stride,
    )


def _silhouette(problem: Problem, each: ViewPixels, stage: JointStage) -> Silhouette:
    view = each.data.view
    return Silhouette(
        problem.solver,
        view.camera,
        each.mask,
        each.mask | (view.depth > 0.0),
        frame=each.row,
        share=problem.settings.outline_share,
        stride=stage.stride,
    )


def _points(problem: Problem, each: ScanPoints, stage: JointStage) -> Points:
    settings = problem.settings.scans
    return Points(
        problem.solver,
        each.points,
        each.normals,
        frame=each.row,
        noise=each.noise,
        reach=stage.reach,
        slide=settings.stages[-1].slide,
        share=min(1.0, settings.effective_points / len(each.points)),
    )


# ---- result --------------------------------------------------------------------------------------


def residuals(
    problem: Problem, state: Values, offset: Float[np.ndarray, " V"] | None
) -> dict[str, Float[np.ndarray, " n"]]:
    """Distances (m) by sensor; those of pixels and points from the skin with its offset."""
    body = problem.body
    by_term: dict[str, np.ndarray] = {}
    if problem.markers is not None:
        rest = body.rest_vertices(state["betas"])
        rig = marked_body(body, state["betas"], attach(state["latent_markers"], rest, body.faces))
        count = len(problem.markers.frames)
        predicted = predict(rig, state["pose"][:count], state["trans"][:count])
        off = np.linalg.norm(predicted - problem.markers.observed, axis=2)
        by_term["markers"] = off[np.isfinite(off)]
    whole = BodyState(state["betas"], state["pose"], state["trans"])
    for k, each in enumerate(problem.views):
        depth = Depth(problem.solver, each.data.view.camera, each.data.view.depth, each.mask)
        by_term[f"depth {k}"] = distances_to(body, whole[each.row], depth.targets, offset)
    for k, scan in enumerate(problem.scans):
        by_term[f"scan {k}"] = distances_to(body, whole[scan.row], scan.points, offset)
    return by_term


def distances_to(
    body: BodyModel,
    state: BodyState,
    points: Float[np.ndarray, "P 3"],
    offset: Float[np.ndarray, " V"] | None = None,
) -> Float[np.ndarray, " P"]:
    """Distances (m) of points from the skin of one pose, with its offset along normals (m)."""
    surface = np.asarray(body(state.betas, state.pose, state.trans).vertices)
    if offset is not None:
        surface = along_normals(surface, offset, body)
    return np.abs(signed_distance(points, surface, body.faces).distance)


def verdicts_of(motions: Sequence[MarkerFit]) -> dict[str, Verdict]:
    """The verdicts on captures, by sensor."""
    several = len(motions) > 1
    return {f"markers {k}" if several else "markers": e.verdict for k, e in enumerate(motions)}


def _motions(problem: Problem, result: Minimized, seconds: float) -> tuple[MarkerFit, ...]:
    """Pose and soft-tissue stage of the whole captures, shape and latent markers held."""
    markers = problem.markers
    if markers is None:
        return ()
    state = result.values
    count = len(markers.frames)
    rest = problem.body.rest_vertices(state["betas"])
    shape = replace(
        markers.subject.shape,
        betas=state["betas"],
        latent_markers=state["latent_markers"],
        attachment=attach(state["latent_markers"], rest, problem.body.faces),
        pose=state["pose"][:count],
        trans=state["trans"][:count],
        costs=result.costs,
        status=result.status,
        iterations=result.iterations,
    )
    subject = replace(markers.subject, shape=shape, seconds=seconds)
    return tuple(fit_known(each, subject, problem.settings.mosh) for each in markers.recordings)
