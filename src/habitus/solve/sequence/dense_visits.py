"""The plain form of a visit in the whole-sequence solve, for any problem that can linearise its
frames.
"""

import numpy as np

from habitus.solve.sequence.level import FLOOR, NOISE, LevelFrames


class DenseVisits:
    """Visits from a `linearize(frames, states)` that returns own costs (F,), gradients (F, N) and
    matrices (F, N, N).

    The plain form of a visit, for any problem: inherit from it.
    """

    threads = 1
    lanes = 1

    def linearize(
        self, frames: np.ndarray, states: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Own costs (F,), gradients (F, N) and Gauss-Newton matrices (F, N, N)."""
        raise NotImplementedError

    def cost(self, frames: np.ndarray, states: np.ndarray) -> np.ndarray:
        """Own costs (F,)."""
        raise NotImplementedError

    def visit(self, level: LevelFrames, block: np.ndarray) -> None:
        """One damped Gauss-Newton step of the frames `block`, their neighbours held."""
        here = level.states[block]
        frames = level.frames[block]
        damping = level.damping[block]
        costs, gradient, matrix = self.linearize(frames, here)
        pull, stiffness = coupling(level, block)
        gradient = gradient + pull
        newton = _damped_steps(gradient, matrix, stiffness + damping[:, None])
        relaxation = level.relaxations[block][:, None]
        steps = relaxation * newton
        with np.errstate(all="ignore"):
            trial = self.cost(frames, here + steps)
            change = trial - costs + np.sum((pull + 0.5 * stiffness * steps) * steps, axis=1)
            bent = 0.5 * relaxation**2 * (gradient + damping[:, None] * newton)
            ratio = change / np.sum((relaxation * gradient - bent) * newton, axis=1)
            along = -np.sum(gradient * newton, axis=1)
            spent = damping * np.sum(newton**2, axis=1)
            size = np.sqrt(np.mean(newton[:, level.measured] ** 2, axis=1)) * undamped(along, spent)
        taken = change < NOISE * costs
        level.states[block] = np.where(taken[:, None], here + steps, here)
        level.costs[block] = np.where(taken, trial, costs)
        level.cost_decrease[block] = np.where(taken, -change, 0.0)
        level.moved[block] = np.nan_to_num(size)
        level.damping[block] = next_damping(damping, taken, ratio)


def coupling(level: LevelFrames, block: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Gradient (F, N) and diagonal curvature (F, N) of the second differences that each frame is
    part of.
    """
    near = level.states[np.clip(block[:, None] + np.arange(-2, 3), 0, len(level.states) - 1)]
    bend = near[:, 2:] - 2.0 * near[:, 1:4] + near[:, :3]
    links = level.links[block[:, None] + np.arange(3)]
    pull = links[:, 0] * bend[:, 0] - 2.0 * links[:, 1] * bend[:, 1] + links[:, 2] * bend[:, 2]
    return pull, links[:, 0] + 4.0 * links[:, 1] + links[:, 2]


def undamped(along: np.ndarray, spent: np.ndarray) -> np.ndarray:
    """How much longer a step p would be without damping d, at the curvature along it: -g.p / (-g.p
    - d p.p).
    """
    return along / np.maximum(along - spent, 1e-6 * along)


def next_damping(damping: np.ndarray, taken: np.ndarray, ratio: np.ndarray) -> np.ndarray:
    """Levenberg damping after a step: a good prediction lowers it, a refused step raises it."""
    lower = np.where(
        damping > 1e-2, damping * np.where(ratio > 0.75, 0.1, np.where(ratio > 0.25, 0.5, 2.0)), 0.0
    )
    return np.where(taken, lower, np.clip(8.0 * damping, 10.0, 1e12))


def _damped_steps(gradient: np.ndarray, matrix: np.ndarray, added: np.ndarray) -> np.ndarray:
    damped = np.array(matrix)
    diagonal = np.arange(matrix.shape[1])
    damped[:, diagonal, diagonal] += added + FLOOR
    finite = np.isfinite(np.sum(damped, axis=(1, 2)) + np.sum(gradient, axis=1))
    damped[~finite] = np.eye(matrix.shape[1])
    return -np.linalg.solve(damped, np.where(finite[:, None], gradient, 0.0)[..., None])[..., 0]
