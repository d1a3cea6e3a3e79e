"""Several sensors, one person: a shape and poses that explain all of what was observed at once.

    minimise over betas, latent markers m, pose_f and trans_f of F frames

    sum_f |x(m, state_f) - observed_f|^2 / s^2        markers    (M eq. 3, with E_S and E_I of m)
    + sum of robust squared distances / s^2           pixels and points to the skin (T eq. 4.5)
    + silhouettes + shape prior + pose prior          (T 4.6.1, M eqs. 6 and 7)

One shape is shared by all; a frame is one of the capture, or belongs to a view or a scan alone.
Each sensor's own recipe gives a start: MoSh's multi-start on the capture's frames, the search over
stances of depth views and scans where these have poses of their own. Then all terms are minimised
together, stage by stage, with reach and priors annealed. At the end the capture's whole motion is
solved with the shape and the latent markers held (M 6, the pose stage).
"""

import time
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Int

from habitus.body.model import BodyModel
from habitus.body.prior import PosePrior
from habitus.errors import HabitusError
from habitus.fit.body_fit import BodyFit, FitSettings, JointStage
from habitus.fit.markers.energy import Placement, place
from habitus.fit.markers.gaps import fill_short_gaps
from habitus.fit.markers.recipe import fit_known
from habitus.fit.markers.recordings import spread_frames
from habitus.fit.markers.result import MarkerFit
from habitus.fit.markers.settings import MoshSettings
from habitus.fit.markers.shape import shape_stage
from habitus.fit.markers.start import start_frames, trunk_weights
from habitus.fit.points.depth import fit_state
from habitus.fit.points.depth_settings import STANDARD
from habitus.fit.points.prepared_views import segment
from habitus.fit.points.scans import Registrar
from habitus.fit.sensors import Cloud, MarkerData, ScanData, SegmentedView, SensorData, ViewData
from habitus.fit.subject import ShapeFit, Subject
from habitus.fit.verdict import Verdict
from habitus.kernels.threads import one_blas_thread
from habitus.mesh.normals import vertex_normals
from habitus.mesh.proximity import signed_distance
from habitus.observe.depth_views import RgbdCapture
from habitus.observe.marker_prediction import marked_body, predict
from habitus.observe.markers import LatentMarkers, attach, default_markers
from habitus.residuals import shape_stage as energy
from habitus.residuals.points import PointSolver
from habitus.residuals.surface_terms import Depth, Points, Silhouette
from habitus.rotations import matrix_from_rotvec, rotvec_from_matrix
from habitus.solve.least_squares import Tolerances
from habitus.solve.minimize import Minimized, minimize
from habitus.solve.terms import Term, geman_mcclure_weight
from habitus.types import Progress

Values = dict[str, np.ndarray]


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
    and trans (F, 3), which join the others; the first poses are those of the capture's frames, in
    their order, then those of views and of scans of their own. Raises HabitusError where there is
    nothing to fit, for frames that a capture does not have, and as each sensor's own recipe does.
    """
    settings = settings or FitSettings()
    _check(data)
    with one_blas_thread():
        problem = _Problem(body, prior.for_joints(body.joint_names), data, settings, terms or {})
        return problem.solve(progress)


def _check(data: SensorData) -> None:
    if data.markers is None and not data.views and not data.scans:
        raise HabitusError("no sensor was given; expected markers, depth views or scans")
    if data.markers is None and data.frames:
        raise HabitusError(
            f"frames {', '.join(map(str, data.frames))} are named without a capture; leave frames "
            "out, or give the markers too"
        )
    if data.markers is not None:
        count = len(data.markers.recording.observed)
        wrong = [k for k in (*data.frames, *(data.markers.frames or ())) if not 0 <= k < count]
        if wrong:
            raise HabitusError(f"frame {wrong[0]} is named; the capture has 0 to {count - 1}")


@dataclass(frozen=True, eq=False)
class _Markers:
    """The capture's frames that are solved with the others: observed (F, M, 3), NaN where missing,
    of the first F poses.
    """

    data: MarkerData
    placement: Placement
    frames: Int[np.ndarray, " F"]
    observed: Float[np.ndarray, "F M 3"]

    @staticmethod
    def of(body: BodyModel, data: SensorData, settings: FitSettings) -> "_Markers | None":
        """With markers that are never seen left out, and short gaps filled."""
        markers = data.markers
        if markers is None:
            return None
        seen = np.isfinite(markers.recording.observed[..., 0]).any(axis=0)
        labels = [markers.layout.markers[k] for k in np.flatnonzero(seen)]
        markers = replace(
            markers,
            layout=replace(markers.layout, markers=tuple(labels)),
            recording=replace(markers.recording, observed=markers.recording.observed[:, seen]),
        )
        filled = fill_short_gaps(markers.recording.observed, markers.recording.rate_hz)
        chosen = markers.frames
        if chosen is None:
            chosen = tuple(spread_frames(filled, settings.frames, settings.seed).tolist())
        frames = np.unique([*chosen, *data.frames]).astype(np.int64)
        return _Markers(markers, place(markers.layout, body), frames, filled[frames])

    @property
    def enough(self) -> int:
        """Labelled markers of the fullest frame."""
        return int(np.isfinite(self.observed[..., 0]).sum(1).max())

    def start(
        self, body: BodyModel, prior: PosePrior, betas: np.ndarray | None, settings: MoshSettings
    ) -> ShapeFit:
        """By MoSh's own shape stage, or, with a shape that is known, poses alone on the layout's
        places.
        """
        shape = np.zeros(body.num_betas) if betas is None else betas
        latent = default_markers(body, shape, self.placement.vertices, self.placement.distance)
        attachment = attach(latent, body.rest_vertices(shape), body.faces)
        rig = marked_body(body, shape, attachment)
        trunk = trunk_weights(body, self.placement.vertices)
        pose, trans = start_frames(rig, body.joint_names, trunk, self.observed, prior)
        if betas is None:
            return shape_stage(body, self.placement, self.observed, prior, pose, trans, settings)
        return ShapeFit(betas, latent, attachment, pose, trans, {}, "start", 0)


class _Problem:
    """Body, data and settings, and from them starts, terms and the result."""

    def __init__(
        self,
        body: BodyModel,
        prior: PosePrior,
        data: SensorData,
        settings: FitSettings,
        terms: Mapping[str, Term],
    ) -> None:
        self.body = body
        self.prior = prior
        self.data = data
        self.settings = settings
        self.own_terms = dict(terms)
        self.solver = PointSolver.of(body)
        self.markers = _Markers.of(body, data, settings)
        self.views: list[SegmentedView] = []
        self.clouds: list[Cloud] = []
        self.verdicts: dict[str, Verdict] = {}
        self.poses: list[str] = []

    def solve(self, progress: Progress) -> BodyFit:
        """Start, joint stages, motion."""
        clock = [time.perf_counter()]
        progress("start", 0.0)
        state = self._start()
        clock.append(time.perf_counter())
        result = None
        for k, stage in enumerate(self.settings.stages):
            progress("together", 0.4 + 0.3 * k / len(self.settings.stages))
            for _ in range(stage.rounds):
                result = self._descend(state, stage)
                state = result.values
        if result is None:
            raise HabitusError("the settings have no stages; expected one at least")
        clock.append(time.perf_counter())
        progress("motion", 0.7)
        motion = self._motion(state, result, clock[-1] - clock[0])
        clock.append(time.perf_counter())
        names = ("start", "together", "motion")
        return BodyFit(
            self.body,
            state["betas"],
            state["pose"],
            state["trans"],
            tuple(self.poses),
            result.status,
            result.costs,
            result.iterations,
            self._residuals(state),
            state.get("latent_markers"),
            motion,
            self.verdicts if motion is None else {**self.verdicts, "markers": motion.verdict},
            dict(zip(names, np.diff(clock).tolist(), strict=True)),
        )

    # ---- start ----------------------------------------------------------------------------------

    def _start(self) -> Values:
        """Betas, latent markers and poses, each sensor's by its own recipe; the shape by the one
        that sees most of it: scans, then a capture with enough markers, then depth.
        """
        own = [self._start_scan(scan) for scan in self.data.scans if scan.frame is None]
        views = [_in_own_frame(view) for view in self.data.views if view.frame is None]
        shown = self._start_views(views) if views else None
        betas = own[0][0] if own else None
        markers = self.markers
        shape = None
        if markers is not None:
            few = markers.enough < self.settings.enough_markers
            known = shown[0] if betas is None and few and shown is not None else betas
            shape = markers.start(self.body, self.prior, known, self.settings.mosh)
            betas = shape.betas if betas is None else betas
        if betas is None:
            assert shown is not None
            betas = shown[0]
        poses, places = [], []
        if shape is not None:
            assert markers is not None
            poses.extend(shape.pose)
            places.extend(shape.trans)
            self.poses += [f"frame {k}" for k in markers.frames]
        for k, view in enumerate(views):
            assert shown is not None
            poses.append(shown[1][k])
            places.append(shown[2][k])
            self.poses.append(view.view.name or f"view {k}")
            self._add_view(view, len(poses) - 1, shown[3][k])
        for _, pose, trans, cloud in own:
            poses.append(pose)
            places.append(trans)
            self.poses.append(cloud.data.scan.name)
            self.clouds.append(replace(cloud, row=len(poses) - 1))
        self._add_shared()
        state = {"betas": betas, "pose": np.stack(poses), "trans": np.stack(places)}
        return state if shape is None else {**state, "latent_markers": shape.latent_markers}

    def _add_shared(self) -> None:
        """Views and scans of the capture's frames: they start from the markers' poses."""
        for view in self.data.views:
            if view.frame is not None:
                self._add_view(view, self._row(view.frame), segment(view.view).mask)
        for scan in self.data.scans:
            if scan.frame is not None:
                self.clouds.append(self._cloud(scan, self._row(scan.frame)))

    def _row(self, frame: int) -> int:
        assert self.markers is not None
        return int(np.flatnonzero(self.markers.frames == frame)[0])

    def _cloud(self, data: ScanData, row: int) -> Cloud:
        """Some points of a scan, and their normals where it has any that point outward."""
        scan = data.scan
        normals = scan.normals if scan.oriented else None
        if normals is None and scan.faces is not None:
            normals = vertex_normals(scan.points, scan.faces)
        some = np.random.default_rng(self.settings.seed).permutation(len(scan.points))
        some = some[: self.settings.scan_points]
        chosen = None if normals is None else np.asarray(normals)[some]
        return Cloud(data, scan.points[some], chosen, row)

    def _add_view(self, view: ViewData, row: int, mask: np.ndarray) -> None:
        noise = 1.5e-3 if view.noise is None else view.noise
        self.views.append(SegmentedView(view, mask, noise, row))

    def _start_views(self, views) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[np.ndarray]]:
        """Betas, poses, places in the cameras' frames, and masks, by the recipe of depth views."""
        capture = RgbdCapture("views", tuple(each.view for each in views)).without("colour")
        found = fit_state(capture, self.body, replace(STANDARD, skin_steps=1))
        state = found.state
        moved = [
            _in_frame(
                self.body, state.betas, state.pose[k], state.trans[k], sight.turn, sight.shift
            )
            for k, sight in enumerate(found.sights)
        ]
        pose, trans = (np.stack(part) for part in zip(*moved, strict=True))
        return state.betas, pose, trans, [sight.mask for sight in found.sights]

    def _start_scan(self, scan: ScanData) -> tuple[np.ndarray, np.ndarray, np.ndarray, Cloud]:
        """Betas, pose, trans and points in metres with y up, by the recipe of scans."""
        registrar = Registrar.of(self.body, self.prior)
        given = {"unit": scan.unit, "up": scan.up, "seed": self.settings.seed}
        found = registrar.register([scan.scan], **given)[0]
        self.verdicts[scan.scan.name] = found.verdict
        some = found.cloud.first(self.settings.scan_points)
        return found.betas, found.pose, found.trans, Cloud(scan, some.points, some.normals, 0)

    # ---- terms ----------------------------------------------------------------------------------

    def _descend(self, state: Values, stage: JointStage) -> Minimized:
        """Some steps of all terms together."""
        return minimize(
            self.terms(state, stage),
            state,
            "levenberg",
            blocks=("trans", "pose"),
            max_iterations=stage.iterations,
            tolerances=Tolerances(cost=1e-4, step=1e-6),
            max_step={"pose": 0.4, "trans": 0.3, "betas": 1.5},
            stretch=False,
        )

    def terms(self, state: Values, stage: JointStage) -> dict[str, Term]:
        """The energy, with marker attachments and robust marker weights of this state."""
        settings = self.settings
        prior = self.prior
        terms = {
            **self._marker_terms(state, stage),
            **self._view_terms(stage),
            **self._scan_terms(stage),
            "betas": energy.shape_prior(self.body.num_betas, stage.prior * settings.betas),
            "pose": energy.pose_prior(
                prior.mean, prior.whitening, len(state["pose"]), stage.prior * settings.pose
            ),
        }
        twice = set(terms) & set(self.own_terms)
        if twice:
            raise HabitusError(
                f"a term of yours is named {sorted(twice)[0]!r}, as one of the fit is; rename it"
            )
        return {**terms, **self.own_terms}

    def _marker_terms(self, state: Values, stage: JointStage) -> dict[str, Term]:
        """E_D, E_S and E_I of the shape stage (M eqs. 3 to 5), on the capture's frames."""
        if self.markers is None:
            return {}
        placement = self.markers.placement
        observed = np.full((len(state["pose"]), *self.markers.observed.shape[1:]), np.nan)
        observed[: len(self.markers.observed)] = self.markers.observed
        rest = self.body.rest_vertices(state["betas"])
        triangles = attach(state["latent_markers"], rest, self.body.faces).triangles
        latent = LatentMarkers(self.body, triangles)
        filled = np.nan_to_num(observed)
        off = np.linalg.norm(latent(**state) - filled, axis=2)
        weights = np.isfinite(observed[..., 0]) * geman_mcclure_weight(off, 3.0 * stage.reach)
        lam = self.settings
        per_cm2 = 1.0 / (energy.per_m2(1.0) * self.markers.data.noise**2)
        return {
            "markers": energy.data(latent, filled, weights, per_cm2),
            "surface": energy.surface_distance(
                self.body, placement.distance, placement.distance_spread, lam.surface
            ),
            "placement": energy.start_place(
                self.body,
                placement.vertices,
                placement.distance,
                placement.place_spread,
                stage.prior * lam.placement,
            ),
        }

    def _view_terms(self, stage: JointStage) -> dict[str, Term]:
        terms: dict[str, Term] = {}
        for k, each in enumerate(self.views):
            view = each.data.view
            common = {"frame": each.row, "stride": stage.stride}
            terms[f"depth {k}"] = Term(
                Depth(
                    self.solver,
                    view.camera,
                    view.depth,
                    each.mask,
                    matching=stage.matching,
                    noise=each.noise,
                    reach=stage.reach,
                    share=self.settings.depth_share,
                    **common,
                )
            )
            known = each.mask | (view.depth > 0.0)
            share = self.settings.outline_share
            terms[f"silhouette {k}"] = Term(
                Silhouette(self.solver, view.camera, each.mask, known, share=share, **common)
            )
        return terms

    def _scan_terms(self, stage: JointStage) -> dict[str, Term]:
        terms: dict[str, Term] = {}
        for k, each in enumerate(self.clouds):
            share = min(1.0, self.settings.scan_worth / len(each.points))
            terms[f"scan {k}"] = Term(
                Points(
                    self.solver,
                    each.points,
                    each.normals,
                    each.row,
                    each.data.noise,
                    stage.reach,
                    share=share,
                )
            )
        return terms

    # ---- result ---------------------------------------------------------------------------------

    def _residuals(self, state: Values) -> dict[str, np.ndarray]:
        """Distances (m) by sensor."""
        found: dict[str, np.ndarray] = {}
        if self.markers is not None:
            rest = self.body.rest_vertices(state["betas"])
            attachment = attach(state["latent_markers"], rest, self.body.faces)
            rig = marked_body(self.body, state["betas"], attachment)
            count = len(self.markers.observed)
            predicted = predict(rig, state["pose"][:count], state["trans"][:count])
            off = np.linalg.norm(predicted - self.markers.observed, axis=2)
            found["markers"] = off[np.isfinite(off)]
        for k, each in enumerate(self.views):
            depth = Depth(self.solver, each.data.view.camera, each.data.view.depth, each.mask)
            found[f"depth {k}"] = self._distance(state, each.row, depth.targets)
        for k, each in enumerate(self.clouds):
            found[f"scan {k}"] = self._distance(state, each.row, each.points)
        return found

    def _distance(self, state: Values, row: int, points: np.ndarray) -> np.ndarray:
        surface = self.body(state["betas"], state["pose"][row], state["trans"][row]).vertices
        return np.abs(signed_distance(points, np.asarray(surface), self.body.faces).distance)

    def _motion(self, state: Values, result: Minimized, seconds: float) -> MarkerFit | None:
        """Pose and soft-tissue stage of the whole capture, shape and latent markers held."""
        if self.markers is None or not self.settings.motion:
            return None
        rest = self.body.rest_vertices(state["betas"])
        attachment = attach(state["latent_markers"], rest, self.body.faces)
        count = len(self.markers.observed)
        shape = ShapeFit(
            state["betas"],
            state["latent_markers"],
            attachment,
            state["pose"][:count],
            state["trans"][:count],
            result.costs,
            result.status,
            result.iterations,
        )
        data = self.markers.data
        subject = Subject(self.body, self.prior, data.layout, shape, seconds=seconds)
        return fit_known(data.recording, subject, self.settings.mosh)


def _in_own_frame(view: ViewData) -> ViewData:
    """The view with its camera at the origin: its own frame is the world of its pose."""
    still = torch.zeros(3, dtype=torch.float64)
    camera = view.view.camera.to(torch.float64).replace(rotation=still, translation=still)
    return replace(view, view=replace(view.view, camera=camera))


def _in_frame(
    body: BodyModel,
    betas: np.ndarray,
    pose: np.ndarray,
    trans: np.ndarray,
    turn: np.ndarray,
    shift: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """A pose of the world turn x + shift as one of the frame x."""
    root = np.asarray(body.rest_joints(betas))[0]
    moved = pose.copy()
    moved[0] = rotvec_from_matrix(turn.T @ matrix_from_rotvec(pose[0]))
    return moved, turn.T @ (root + trans - shift) - root
