"""A body whose mean person is a character: another rest surface in the template's topology (M 9.2);
whose topology a mesh has, and whether it is at rest.
"""

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from types import MappingProxyType

import numpy as np
from jaxtyping import Float, Int

from habitus.body.body_arrays import BodyArrays
from habitus.body.body_mesh import numbered
from habitus.body.model import BodyModel
from habitus.errors import HabitusError


def is_of(
    body: BodyArrays, vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "T 3"]
) -> bool:
    """Whether a mesh has a body's vertices and faces, its quads cut along either diagonal."""
    if len(vertices) != body.num_vertices or len(faces) != body.num_faces:
        return False
    may = body.faces
    if body.mesh is not None:
        may = np.concatenate([may, *(np.delete(body.mesh.quads, k, axis=1) for k in range(4))])
    return bool(np.isin(numbered(faces, len(vertices)), numbered(may, len(vertices))).all())


def misfit(body: BodyArrays, vertices: Float[np.ndarray, "V 3"]) -> float:
    """How far (m) a surface at rest is from the shapes of a body, by some of its vertices."""
    some = slice(None, None, 7)
    offset = vertices[some] - body.v_template[some]
    away = offset - offset.mean(0)
    shapes = body.shapedirs[some] - body.shapedirs[some].mean(0)
    shapes = shapes.reshape(-1, body.num_betas)
    betas = np.linalg.lstsq(shapes, away.ravel(), rcond=None)[0]
    return float(np.linalg.norm(away.ravel() - shapes @ betas))


def turned_by(body: BodyArrays, vertices: Float[np.ndarray, "V 3"]) -> float:
    """The largest angle (rad) between a bone of the trunk, arms or legs and the same one of the
    body at rest.
    """
    joints = body.joint_regressor @ vertices
    largest = 0.0
    for child, parent in enumerate(body.parents):
        name = body.joint_names[child]
        if parent < 0 or not name.endswith(
            ("knee", "ankle", "elbow", "wrist", "neck", "head", "spine3")
        ):
            continue
        a = joints[child] - joints[parent]
        b = body.joint_template[child] - body.joint_template[parent]
        cosine = a @ b / max(float(np.linalg.norm(a) * np.linalg.norm(b)), 1e-12)
        largest = max(largest, float(np.arccos(np.clip(cosine, -1.0, 1.0))))
    return largest


TURNED = np.deg2rad(30.0)
"""A bone of a character at rest lies this near to the body's own."""
HEIGHTS = (0.1, 10.0)
"""Metres that a character may be high, from sole to crown."""
FROM = "recentred_from"
"""The name, among the ``extras`` of a body, of the body that it was made of."""


def recentred(body: BodyModel, vertices: Float[np.ndarray, "V 3"], name: str) -> BodyModel:
    """The body whose template is a character: ``vertices`` (m, y up, facing +z, at rest in the
    T-pose) of its topology.

    Of the coarse level of detail or the full one. The shape space is about the character; joints
    come from the regressor; skinning and pose blend shapes are the body's. All that displaces
    vertices is as much larger as the character is taller. What was learned of people (ages, sexes,
    their mean) does not hold for it and goes. Raises HabitusError for another number of vertices,
    and for what is not at rest, not upright or not in metres.
    """
    rows, level = _level(body, len(vertices), name)
    points = np.ascontiguousarray(vertices, dtype=np.float64)
    _check(level, points, name)
    scale = float(np.ptp(points[:, 1]) / np.ptp(level.v_template[:, 1]))
    if rows is None:
        return _with_template(body, points, scale, name)
    coarse = _with_template(body, points[rows], scale, name)
    return replace(
        coarse, full_vertices=rows, finer=partial(_with_template, level, points, scale, name)
    )


def recentred_arrays(body: BodyModel) -> Mapping[str, np.ndarray]:
    """What a file must keep of a body that `recentred` made, beside the name of the one it was made
    of; else nothing.

    ``character_vertices`` (V, 3; of the full level where there is one) and ``character_base``.
    """
    if FROM not in body.extras:
        return {}
    return {
        "character_vertices": np.asarray((body.full or body).v_template),
        "character_base": np.asarray(body.extras[FROM]),
    }


def _level(body: BodyModel, count: int, name: str) -> tuple[np.ndarray | None, BodyModel]:
    """The rows of the coarse level in what has ``count`` vertices (None: it is the body itself),
    and that level.
    """
    if count == body.num_vertices:
        return None, body
    full = body.full
    if full is not None and count == full.num_vertices:
        return body.full_vertices, full
    known = " or ".join(str(level.num_vertices) for level in (body, full) if level is not None)
    raise HabitusError(
        f"{name}: {count} vertices; a character for the body {body.name} has its topology, "
        f"{known} vertices: "
        "wrap the body's mesh around it first (register), in any tool that keeps the order of "
        "vertices"
    )


def _check(body: BodyModel, points: np.ndarray, name: str) -> None:
    height = float(np.ptp(points[:, 1])) if np.isfinite(points).all() else np.nan
    if not HEIGHTS[0] <= height <= HEIGHTS[1]:
        raise HabitusError(
            f"{name}: {height:.3g} high along y; expected {HEIGHTS[0]:g} to {HEIGHTS[1]:g} "
            "metres, y up; scale it"
        )
    turned = turned_by(body, points)
    if turned > TURNED:
        raise HabitusError(
            f"{name}: a limb is {np.rad2deg(turned):.0f} degrees from the rest of {body.name}; "
            "expected a character in "
            "the T-pose, y up, facing +z; pose it so"
        )


def _with_template(body: BodyModel, points: np.ndarray, scale: float, name: str) -> BodyModel:
    return replace(
        body,
        name=name,
        v_template=points,
        shapedirs=scale * body.shapedirs,
        posedirs=None if body.posedirs is None else scale * body.posedirs,
        hinges=None if body.hinges is None else body.hinges.scaled(scale),
        expressiondirs=None if body.expressiondirs is None else scale * body.expressiondirs,
        dynamics=None if body.dynamics is None else body.dynamics.scaled(scale),
        face=None if body.face is None else body.face.scaled(scale),
        female_direction=None,
        female_rows=None,
        people_mean=None,
        people_skew=None,
        ages=None,
        age=None,
        full_vertices=None,
        finer=None,
        extras=MappingProxyType({**body.extras, FROM: np.array(body.name)}),
    )
