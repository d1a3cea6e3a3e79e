"""Forward substitution with a sparse factor and many right-hand sides, compiled."""

from habitus.kernels.jit import jit


@jit
def substitute_forward(start, row, value, right):
    """right (V, n) becomes L^-1 right; L (V, V) is unit lower triangular, in compressed columns."""
    for j in range(len(start) - 1):
        for e in range(start[j], start[j + 1]):
            i = row[e]
            if i > j:
                for k in range(right.shape[1]):
                    right[i, k] -= value[e] * right[j, k]
