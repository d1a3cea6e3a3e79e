"""Terms that fits to scans and depth views share, with their own normal equations (thesis secs.
4.6.1 and 5.4).

"shape"  1/2 (betas - b)^T P (betas - b)
"pose"   1/2 sum_t (theta_t - m_t)^T P (theta_t - m_t)

theta_t: pose (J, 3) of scan or view t.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from habitus.body.model import BodyModel
from habitus.body.state import BodyState
from habitus.residuals.points import PointObservations, PointSolver, points_term
from habitus.solve.terms import Quadratic, Term


def shape_prior(mean: Float[np.ndarray, " B"], precision: float) -> Term:
    """Betas about a mean, all with the same precision."""

    def residual(betas: np.ndarray) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        return betas - mean, {"betas": np.eye(len(mean))}

    return Term(residual, precision, name="shape")


def pose_prior(mean: Float[np.ndarray, "*T n"], precision: Float[np.ndarray, "n n"]) -> Term:
    """Poses (T, J, 3) about a mean, one for all or one each; n = 3 J, rad."""

    def residual(pose: np.ndarray) -> Quadratic:
        difference = pose.reshape(len(pose), -1) - mean
        slope = difference @ precision

        def derivatives() -> tuple[dict[str, np.ndarray], dict[tuple[str, str], np.ndarray]]:
            return {"pose": slope}, {
                ("pose", "pose"): np.broadcast_to(precision, (len(pose), *precision.shape))
            }

        return Quadratic(0.5 * float((difference * slope).sum()), derivatives)

    return Term(residual, name="pose")


def about_root(precision: Float[np.ndarray, "m m"]) -> Float[np.ndarray, "n n"]:
    """A precision of all joints but the root as one of all joints, the root free."""
    size = len(precision) + 3
    whole = np.zeros((size, size))
    whole[3:, 3:] = precision
    return whole


def points_around(
    solver: PointSolver, state: BodyState, frames: Sequence[PointObservations | None]
) -> Term:
    """`points_term` of one set of points a frame, whose equations at ``state`` are computed at
    once: minimisation begins there.
    """
    elsewhere = points_term(solver, frames).residual
    size = solver.body.num_betas + 3 + 3 * solver.body.num_joints
    nothing = (0.0, np.zeros(size), np.zeros((size, size)))
    found = [
        nothing if points is None else solver.at(state.betas, pose, trans, points)
        for points, pose, trans in zip(frames, state.pose, state.trans, strict=True)
    ]
    here = Quadratic(
        sum(each[0] for each in found),
        lambda: by_unknown(solver.body, [(each[1], each[2]) for each in found]),
    )

    def residual(betas: np.ndarray, pose: np.ndarray, trans: np.ndarray) -> Quadratic:
        same = map(np.array_equal, (betas, pose, trans), (state.betas, state.pose, state.trans))
        return here if all(same) else elsewhere(betas=betas, pose=pose, trans=trans)

    return Term(residual)


def by_unknown(
    body: BodyModel,
    equations: Sequence[tuple[Float[np.ndarray, " N"], Float[np.ndarray, "N N"]]],
) -> tuple[dict[str, np.ndarray], dict[tuple[str, str], np.ndarray]]:
    """Gradients and matrices over betas, trans and pose of T scans, by unknowns."""
    head = body.num_betas
    gradient, matrix = (np.stack(part) for part in zip(*equations, strict=True))
    part = {"betas": slice(head), "trans": slice(head, head + 3), "pose": slice(head + 3, None)}
    pairs = [("trans", "trans"), ("trans", "pose"), ("pose", "pose")]
    pairs += [("trans", "betas"), ("pose", "betas")]
    blocks = {(a, b): matrix[:, part[a], part[b]] for a, b in pairs}
    blocks["betas", "betas"] = matrix[:, :head, :head].sum(0)
    slopes = {name: gradient[:, where] for name, where in part.items()}
    slopes["betas"] = slopes["betas"].sum(0)
    return slopes, blocks
