"""A registration in the rest pose (S 4.2): the surface that, posed, is the registration."""

import numpy as np
from jaxtyping import Bool, Float
from scipy.sparse import csr_array

from habitus.learn.posing.rig import RestPerson, Rig
from habitus.learn.posing.surface import pose_feature, posed
from habitus.mesh.laplacian import fill_holes

_HOLD = 1e-6  # keeps what a pose squeezes flat at the general person's


def pose_normalized(
    rig: Rig,
    regressor: Float[np.ndarray, "J V"],
    general: RestPerson,
    pose: Float[np.ndarray, "J 3"],
    target: Float[np.ndarray, "V 3"],
    seen: Bool[np.ndarray, " V"] | None = None,
    laplacian: csr_array | None = None,
) -> Float[np.ndarray, "V 3"]:
    """The rest surface T (m) with W(T + B(pose), J T, pose) = target: as many equations as
    unknowns.

    Joints are regressed from T, so that vertex by vertex ``T = A^-1 (r - C j)``: 3 J equations for
    j = J T are left. The surface is placed so that its root joint is the ``general`` person's.
    Where not all vertices are ``seen``, what the surface differs by from the general person's is
    carried on into the holes (`fill_holes`, of the mesh's graph ``laplacian``): the others are
    solved for as before.
    """
    applied = posed(rig, pose)
    turn = applied.turn
    joint_jacobian = applied.joint_jacobian()
    posedirs = rig.posedirs_for(general.descriptor)
    offset = np.zeros_like(target) if posedirs is None else posedirs @ pose_feature(rig, pose)
    away = target - applied.vertices(general.template + offset, general.joints)
    target = target - (away if seen is None else away[seen]).mean(0)
    right = target - (turn @ (general.template + offset)[..., None])[..., 0]
    back = np.linalg.solve(
        turn.transpose(0, 2, 1) @ turn + _HOLD * np.eye(3), turn.transpose(0, 2, 1)
    )
    own = (back @ right[..., None])[..., 0]
    shared = back @ joint_jacobian
    if seen is not None and laplacian is not None:
        own, shared = (fill_holes(laplacian, seen, each) for each in (own, shared))
    columns = joint_jacobian.shape[-1]
    matrix = np.eye(columns) + np.tensordot(regressor, shared, 1).reshape(columns, columns)
    joints = np.linalg.solve(matrix, (regressor @ (general.template + own)).ravel())
    surface = general.template + own - shared @ joints
    return surface + (general.joints[0] - regressor[0] @ surface)
