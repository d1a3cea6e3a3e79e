"""The pose stage and the soft-tissue stage: poses of a whole sequence of a known body and markers
(M 5 and 6).

`habitus.fit.markers.sequence_terms` has it as a dictionary of terms; the kernels implement those.

    cost = 1/2 ( l_D sum_ti w_ti rho_i(|x_i(t) - m_ti|^2) + l_theta (theta - mu)^T P (theta - mu)
                 + l_u |theta_t - 2 theta_{t-1} + theta_{t-2}|^2 + l_Delta |beta_t|^2 )

over pose, trans and, in the soft-tissue stage, beta_t (M equations 3, 7, 8 and 10). MoSh solves
frame after frame; here all frames are solved together (`habitus.solve.sequence.solver`), the
optimum that the paper's filter approximates. rho is Geman-McClure's s^2 d^2 / (s^2 + d^2) with a
scale s per marker, or the square where s is infinite.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from habitus.body.prior import PosePrior
from habitus.fit.markers.marker_sequence import marker_sequence
from habitus.fit.markers.settings import SequenceSettings
from habitus.observe.marker_prediction import MarkedBody
from habitus.solve.sequence.solver import solve_sequence


@dataclass(frozen=True)
class SequenceResult:
    """What a stage found.

    pose (T, J, 3) rad, trans (T, 3) m, soft_tissue (T, B) or None; costs by term and frame_costs
    (T,) without the acceleration, all as in the module's formula; weights (T, M): the given ones
    times the robust ones; status and iterations of `habitus.solve.sequence.solver`; history of the
    total cost.
    """

    pose: Float[np.ndarray, "T J 3"]
    trans: Float[np.ndarray, "T 3"]
    soft_tissue: Float[np.ndarray, "T B"] | None
    costs: dict[str, float]
    frame_costs: Float[np.ndarray, " T"]
    weights: Float[np.ndarray, "T M"]
    status: str
    iterations: int
    history: tuple[float, ...]


def fit_sequence(
    marked: MarkedBody,
    observed: Float[np.ndarray, "T M 3"],
    weights: Float[np.ndarray, "T M"] | None,
    scales: Float[np.ndarray, " M"] | None,
    prior: PosePrior,
    start_pose: Float[np.ndarray, "T J 3"],
    start_trans: Float[np.ndarray, "T 3"],
    settings: SequenceSettings | None = None,
    soft_tissue: Float[np.ndarray, "T B"] | None = None,
) -> SequenceResult:
    """Pose and trans of T frames; with `soft_tissue` (T, B) to start from, the changes of shape
    beta_t as well.

    observed: metres, NaN where missing. weights: of each observation, 1 if None. scales: s of each
    marker in metres, None for squares. prior: mean (3 (J - 1),) and precision, root left out.
    Without acceleration each frame is alone.
    """
    settings = settings or SequenceSettings()
    betas = 0 if soft_tissue is None else np.shape(soft_tissue)[1]
    problem = marker_sequence(marked, observed, weights, scales, prior, settings, betas)
    start = problem.pack(start_pose, start_trans, soft_tissue)
    apart = settings.acceleration == 0.0
    options = replace(settings.options, strides=(1,), relaxation=1.0) if apart else settings.options
    solution = solve_sequence(problem, start, slice(3, problem.pose_end), options)
    costs, weights = problem.terms(solution.states, solution.frame_costs)
    pose, trans, soft = problem.unpack(solution.states)
    return SequenceResult(
        pose=pose,
        trans=trans,
        soft_tissue=soft,
        costs=costs | {"acceleration": solution.coupling_cost},
        frame_costs=solution.frame_costs,
        weights=weights,
        status=solution.status,
        iterations=solution.iterations,
        history=solution.history,
    )
