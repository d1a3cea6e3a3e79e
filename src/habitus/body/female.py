"""The classifiers of sex that a body carries: log odds of a woman, weights . betas + bias."""

import numpy as np
from jaxtyping import Float

Direction = tuple[Float[np.ndarray, " B"], float]
Rows = tuple[Float[np.ndarray, "B B"], Float[np.ndarray, " B"]]


def of_fewer(
    direction: Direction | None, rows: Rows | None, count: int
) -> tuple[Direction | None, Rows | None]:
    """The classifier of the first ``count`` betas, and those of fewer still: the one that was
    fitted to so many.

    Where none was, the weights of the others are left out, which leaves it less right and too sure.
    """
    if rows is None:
        return (None, None) if direction is None else ((direction[0][:count], direction[1]), None)
    weights, bias = rows
    return (weights[count - 1, :count], float(bias[count - 1])), (
        weights[:count, :count],
        bias[:count],
    )
