"""Arrow matrices: unknowns shared by all, then equal blocks that meet only through the shared ones.

    H = [ shared   border_1ᵀ … border_Fᵀ ]
        [ border_1 block_1               ]
        [ …                 …            ]
        [ border_F             block_F   ]

Solved by Cholesky of the blocks and of the Schur complement: F (N³ + G N²) + G³ in place of (G + F
N)³ operations.
"""

from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg
from jaxtyping import Bool, Float, Int


@dataclass(frozen=True)
class ArrowMatrix:
    """A symmetric matrix of G shared unknowns and F blocks of N: shared (G, G), border (F, N, G),
    blocks (F, N, N).

    order (G + F N,): which unknown each row belongs to, where vectors are ordered otherwise.
    """

    shared: Float[np.ndarray, "G G"]
    border: Float[np.ndarray, "F N G"]
    blocks: Float[np.ndarray, "F N N"]
    order: Int[np.ndarray, " n"] | None = None

    @property
    def data(self) -> Float[np.ndarray, " n"]:
        """All stored numbers."""
        return np.concatenate([self.shared.ravel(), self.border.ravel(), self.blocks.ravel()])

    def diagonal(self) -> Float[np.ndarray, " n"]:
        """The diagonal, (G + F N,)."""
        return self._unsorted(
            np.concatenate([np.diagonal(self.shared), np.einsum("fnn->fn", self.blocks).ravel()])
        )

    def __matmul__(self, vector: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        """H v."""
        size = len(self.shared)
        vector = self._sorted(vector)
        head = vector[:size]
        tail = vector[size:].reshape(self.blocks.shape[:2])
        top = self.shared @ head + np.einsum("fng,fn->g", self.border, tail, optimize=True)
        below = self.border @ head + (self.blocks @ tail[..., None])[..., 0]
        return self._unsorted(np.concatenate([top, below.ravel()]))

    def _sorted(self, vector: np.ndarray) -> np.ndarray:
        return vector if self.order is None else vector[self.order]

    def _unsorted(self, vector: np.ndarray) -> np.ndarray:
        if self.order is None:
            return vector
        out = np.empty_like(vector)
        out[self.order] = vector
        return out

    def held(self, held: Bool[np.ndarray, " n"]) -> "ArrowMatrix":
        """The matrix with the identity's rows and columns in place of those that are held."""
        held = self._sorted(held)
        size = len(self.shared)
        head = ~held[:size]
        tail = ~held[size:].reshape(self.blocks.shape[:2])
        shared = self.shared * head[:, None] * head
        blocks = self.blocks * tail[:, :, None] * tail[:, None, :]
        shared[np.diag_indices(size)] += ~head
        np.einsum("fnn->fn", blocks)[...] += ~tail
        return replace(
            self, shared=shared, border=self.border * tail[:, :, None] * head, blocks=blocks
        )

    def dense(self) -> Float[np.ndarray, "n n"]:
        """The same matrix, written out."""
        size = len(self.shared)
        width = self.blocks.shape[1]
        out = np.zeros((size + self.blocks.shape[0] * width,) * 2)
        out[:size, :size] = self.shared
        for k, (border, block) in enumerate(zip(self.border, self.blocks, strict=True)):
            rows = slice(size + k * width, size + (k + 1) * width)
            out[rows, :size], out[:size, rows], out[rows, rows] = border, border.T, block
        if self.order is None:
            return out
        places = np.argsort(self.order)
        return out[np.ix_(places, places)]

    def solve(
        self, damping: Float[np.ndarray, " n"], right: Float[np.ndarray, " n"]
    ) -> Float[np.ndarray, " n"]:
        """(H + diag(damping))⁻¹ right. Raises scipy.linalg.LinAlgError where that is not positive
        definite.
        """
        size = len(self.shared)
        width = self.blocks.shape[1]
        right = self._sorted(right)
        damping = self._sorted(damping)
        top = right[:size]
        rest = right[size:].reshape(-1, width)
        schur = self.shared + np.diag(damping[:size])
        added = damping[size:].reshape(-1, width)
        blocks = self.blocks.copy()
        np.einsum("fnn->fn", blocks)[...] += added
        np.linalg.cholesky(blocks)  # raises where one is not positive definite
        solved = np.linalg.solve(blocks, np.concatenate([self.border, rest[..., None]], axis=2))
        across = self.border.reshape(rest.size, size).T
        flat = solved.reshape(rest.size, size + 1)
        head = scipy.linalg.cho_solve(
            scipy.linalg.cho_factor(
                schur - across @ flat[:, :size], lower=True, check_finite=False
            ),
            top - across @ flat[:, size],
        )
        return self._unsorted(np.concatenate([head, flat[:, size] - flat[:, :size] @ head]))
