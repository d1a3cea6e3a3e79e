"""Other bodies: vertices in their topologies, the way back, and parameters of the user's own model.

Maps of topology (`habitus.io.topologies`) say where each vertex of SMPL, SMPL-X and MHR lies on our
surface. So a fit gives their vertices, their vertices give a fit, and the user's model is solved
for the vertices that a fit gives.
"""

import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from habitus.body.model import BodyModel
from habitus.body.motion import BodyMotion, Moving
from habitus.body.recentred import recentred, recentred_arrays
from habitus.errors import HabitusError
from habitus.export.motion import write_motion
from habitus.export.npz import motion_arrays, write_arrays
from habitus.export.topology import topology_vertices
from habitus.files import whole_folder
from habitus.fit.known_points import KnownPointFit, error_mm, fit_known_points
from habitus.fit.known_points import own_surface as rest_surface
from habitus.fit.retarget.recipe import turned
from habitus.fit.verdict import Verdict
from habitus.io.models.bodies import SHIPPED, load_body
from habitus.io.people import FIT_FILE
from habitus.io.topologies import load_topology, read_vertices, topology_of
from habitus.jobs.results import Motion
from habitus.kernels.threads import one_blas_thread
from habitus.mesh.surface_map import SurfaceMap
from habitus.results.save import METRICS, write_json
from habitus.rotations import UP_AXES, matrix_from_rotvec, signed_axis, up_rotation
from habitus.types import PathLike, Progress

MODEL_BETAS = 16
"""Shape coefficients that are solved of a user's model: as many as AMASS keeps."""
FILES = (FIT_FILE, METRICS)
MAX_RATE = 1e4
REST_RATE = 30.0
"""Hz of vertices whose file names no rate."""
_JOINTS = {"smpl": "smplh", "smplx": "smplx", "mhr": "smplx"}
"""Ours that a topology's vertices move: SMPL's have fingers, the others jaw and eyes, too."""
_TRIED = 4
"""Frames by which the best of three bodies is chosen."""
_MODEL_TYPES = {24: "smpl", 52: "smplh", 55: "smplx"}


@dataclass(frozen=True, eq=False)
class RegisteredVertices:
    """Our body in the motion of another topology's vertices.

    ``distances`` (T, N; m): from the matched vertices to their places on the body. ``verdict``
    judges their mean.
    """

    motion: Motion
    topology: str
    distances: Float[np.ndarray, "T N"]
    verdict: Verdict

    @property
    def error_mm(self) -> dict[str, float]:
        """Mean and 95th percentile of the distances in mm."""
        return error_mm(self.distances)

    def save(self, folder: PathLike) -> None:
        """Write body.npz, which all commands read, and metrics.json. Raises HabitusError."""
        with whole_folder(Path(folder), FILES) as partial:
            write_motion(self.motion, partial / FIT_FILE)
            write_json(partial / METRICS, self.metrics())

    def metrics(self) -> dict[str, object]:
        """As metrics.json holds them."""
        return {
            "topology": self.topology,
            "body": self.motion.body_name,
            "frames": self.motion.num_frames,
            "error_mm": self.error_mm,
            "verdict": self.verdict.entry(),
        }


def register_vertices(
    source: PathLike,
    topology: str,
    body: str = "default",
    *,
    out: PathLike | None = None,
    unit: str = "auto",
    up: str = "auto",
    fps: float | None = None,
    own_surface: bool = False,
    progress: Progress = lambda stage, share: None,
) -> RegisteredVertices:
    """Our body from the vertices of another topology: one shape, a pose a frame.

    source: a mesh (.obj, .ply) or an npz with ``vertices`` (T, N, 3), in the order of "smpl",
    "smplx" or "mhr". body: "neutral", "female", "male", or "default": the one of these with the
    lowest error. unit: of the file, "auto": m, cm or mm by the size of a person. up: the axis that
    points up; "auto": as the file says, else the one nearest to the person's upright axis, which
    is wrong for somebody who lies. fps: frames a second, where the file names none. own_surface:
    the body's mean person becomes this one (a character, betas zero), so that what the shape space
    cannot express stays. out: a folder for body.npz and metrics.json. Raises HabitusError.
    """
    if body != "default" and body not in SHIPPED:
        raise HabitusError(f"body is {body!r}; expected default, neutral, female or male")
    if fps is not None and not 0.0 < fps < MAX_RATE:
        raise HabitusError(f"fps is {fps:g}; expected frames a second, up to {MAX_RATE:g}")
    if up != "auto" and signed_axis(up) is None:
        raise HabitusError(f"up is {up!r}; expected auto, or an axis such as +z")
    names = ("neutral", "female", "male") if body == "default" else (body,)
    bodies = [load_body(name, joints=_JOINTS.get(topology, "smplh")) for name in names]
    places = load_topology(topology, bodies[0].full or bodies[0])
    read = read_vertices(source, places.num_vertices, unit)
    with one_blas_thread():
        progress("shape", 0.0)
        some = read.vertices[np.linspace(0, len(read.vertices) - 1, _TRIED).astype(int)]
        errors = [
            _fitted(model, places, np.unique(some, axis=0)).distances.mean()
            for model in (bodies if len(bodies) > 1 else ())
        ]
        model = bodies[int(np.argmin(errors))] if errors else bodies[0]
        fit = _fitted(model, places, read.vertices, progress=progress)
        name = model.name
        if own_surface:
            surface = rest_surface(model.full or model, places, fit, read.vertices)
            model = recentred(model, surface, name)
            still = np.zeros(model.num_betas)
            fit = _fitted(model, places, read.vertices, still, progress)
    axis = _upright(up, read.up_axis, fit)
    motion = BodyMotion(
        body=model,
        betas=fit.betas,
        pose=fit.pose,
        trans=fit.trans,
        rate_hz=float(fps or read.rate_hz or REST_RATE),
        up_axis=axis,
        capture_name=read.name,
        body_name=name,
        gender=name if name in ("female", "male") else "neutral",
        made=(_said(fit, f"solved from vertices of {topology} in {Path(source).name}"),),
    )
    made = RegisteredVertices(Motion.of(motion), topology, fit.distances, fit.verdict)
    if out is not None:
        made.save(out)
    return made


def _fitted(
    model: BodyModel,
    places: SurfaceMap,
    vertices: Float[np.ndarray, "T N 3"],
    betas: np.ndarray | None = None,
    progress: Progress = lambda stage, share: None,
) -> KnownPointFit:
    kept = np.flatnonzero(places.matched)
    full = model.full or model
    given = places.face[kept], places.barycentric[kept], vertices[:, kept]
    return fit_known_points(full, *given, betas=betas, progress=progress)


def _said(fit: KnownPointFit, what: str) -> str:
    error = fit.error_mm
    return f"{what}: {error['mean']:.1f} mm off on average, 95 % {error['p95']:.1f} mm"


def _upright(asked: str, declared: str | None, fit: KnownPointFit) -> str:
    """The axis that points up."""
    given = signed_axis(asked)
    if given is not None:
        return given
    axis = signed_axis(declared)
    if axis is not None:
        return axis
    body = matrix_from_rotvec(fit.pose[:, 0])[:, :, 1].mean(0)
    axes = {name: np.array(UP_AXES[name], float)[1] for name in UP_AXES}
    return max(axes, key=lambda name: float(axes[name] @ body))


@dataclass(frozen=True, eq=False)
class SolvedModel:
    """A motion in the user's own model: ``motion`` (its betas, pose, trans), and how far (m) its
    vertices are from our surface (T, N).
    """

    motion: Motion
    topology: str
    distances: Float[np.ndarray, "T N"]
    verdict: Verdict

    @property
    def error_mm(self) -> dict[str, float]:
        """Mean and 95th percentile of the distances in mm."""
        return error_mm(self.distances)

    def save(self, path: PathLike) -> None:
        """Write the npz in AMASS's names: ``poses`` (T, 3 J), ``trans``, ``betas``, ``gender``,
        ``mocap_framerate``; z up; ``error_mm`` mean and 95 %. Raises HabitusError.
        """
        motion = BodyMotion.of(self.motion)
        arrays: Mapping[str, np.ndarray] = motion_arrays(motion) | {
            "made": np.array(motion.made, dtype=np.str_),
            "error_mm": np.array(list(self.error_mm.values())),
            **recentred_arrays(motion.body),
        }
        write_arrays(path, arrays)


def solve_model(
    moving: Moving,
    model: BodyModel | PathLike,
    *,
    betas: int = MODEL_BETAS,
    progress: Progress = lambda stage, share: None,
) -> SolvedModel:
    """Betas, pose and trans of the user's SMPL, SMPL-H or SMPL-X for a motion of ours, z up.

    model: a body, or its file (npz, pkl), with 6,890 or 10,475 vertices. betas: how many are
    solved. Every vertex of the model is drawn to its place on our surface; expression and hand
    components stay out, hands are full rotations. Raises HabitusError for another topology.
    """
    ours = model if isinstance(model, BodyModel) else load_body(os.fspath(model))
    ours = ours.with_betas(min(betas, ours.num_betas))
    upright = turned(BodyMotion.of(moving), up_rotation("+z").T @ up_rotation(moving.up_axis))
    places = load_topology(topology_of(ours.num_vertices), upright.finest_body)
    kept = np.flatnonzero(places.matched)
    vertices = topology_vertices(upright, places, np.arange(upright.num_frames))[:, kept]
    face, share = points_of(ours, kept)
    with one_blas_thread():
        fit = fit_known_points(ours, face, share, vertices, progress=progress)
    motion = replace(
        upright,
        body=ours,
        betas=fit.betas,
        pose=fit.pose,
        trans=fit.trans,
        up_axis="+z",
        soft_tissue=None,
        dynamics=None,
        face=None,
        body_name=_MODEL_TYPES.get(ours.num_joints, ours.name),
        made=(*upright.made, _said(fit, f"{ours.name} solved from our surface")),
    )
    return SolvedModel(Motion.of(motion), places.name, fit.distances, fit.verdict)


def points_of(body: BodyModel, vertices: np.ndarray) -> tuple[np.ndarray, Float[np.ndarray, "N 3"]]:
    """A face at each vertex, and one for the corner that it is."""
    face = np.full(body.num_vertices, -1)
    corner = np.zeros(body.num_vertices, np.int64)
    for k in range(3):
        face[body.faces[:, k]] = np.arange(body.num_faces)
        corner[body.faces[:, k]] = k
    if (face[vertices] < 0).any():
        raise HabitusError(f"{body.name} has vertices without a face; get the file again")
    return face[vertices], np.eye(3)[corner[vertices]]
