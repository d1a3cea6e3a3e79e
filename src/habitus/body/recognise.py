"""Whose surface a mesh is, and whether it is at rest."""

import numpy as np
from jaxtyping import Float, Int

from habitus.body.body_arrays import BodyArrays
from habitus.body.mesh import numbered


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
    found = 0.0
    for child, parent in enumerate(body.parents):
        name = body.joint_names[child]
        if parent < 0 or not name.endswith(
            ("knee", "ankle", "elbow", "wrist", "neck", "head", "spine3")
        ):
            continue
        a = joints[child] - joints[parent]
        b = body.joint_template[child] - body.joint_template[parent]
        cosine = a @ b / max(float(np.linalg.norm(a) * np.linalg.norm(b)), 1e-12)
        found = max(found, float(np.arccos(np.clip(cosine, -1.0, 1.0))))
    return found
