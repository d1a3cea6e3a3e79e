"""Values over a mesh carried on into its holes, as smoothly as they can be: harmonic functions."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import csr_array, diags_array, eye_array
from scipy.sparse.linalg import splu

_FAINT = 1e-9  # holds pieces of the mesh of which nothing is seen at zero


def fill_holes(
    laplacian: csr_array, seen: Bool[np.ndarray, " V"], values: Float[np.ndarray, "V ..."]
) -> Float[np.ndarray, "V ..."]:
    """``values`` where vertices are ``seen``; elsewhere the mean of the neighbours' (harmonic),
    zero on pieces unseen.

    ``laplacian`` (V, V) is the mesh's graph Laplacian: degrees on the diagonal, -1 for neighbours.
    """
    if seen.all():
        return values
    hole = np.flatnonzero(~seen)
    known = np.flatnonzero(seen)
    flat = values.reshape(len(values), -1)
    out = flat.copy()
    out[hole] = -_inverse(laplacian, hole)(laplacian[hole][:, known] @ flat[known])
    return out.reshape(values.shape)


def eliminate_holes(laplacian: csr_array, seen: Bool[np.ndarray, " V"]) -> csr_array:
    """The graph Laplacian (V, V) of the vertices that are ``seen``: its quadratic form is the whole
    one's least over values in the holes. Rows and columns of holes are zero.
    """
    hole = np.flatnonzero(~seen)
    known = np.flatnonzero(seen)
    if not len(hole):
        return laplacian
    across = laplacian[hole][:, known].tocsc()
    border = np.flatnonzero(np.diff(across.indptr))
    reach = across[:, border].toarray()
    bridges = csr_array(reach.T @ _inverse(laplacian, hole)(reach))
    place = csr_array(
        (np.ones(len(border)), (known[border], np.arange(len(border)))), (len(seen), len(border))
    )
    kept = diags_array(seen.astype(float))
    return (kept @ laplacian @ kept - place @ bridges @ place.T).tocsr()


def _inverse(
    laplacian: csr_array, hole: Int[np.ndarray, " n"]
) -> Callable[[np.ndarray], np.ndarray]:
    """Solves the Laplace equation in holes."""
    return splu((laplacian[hole][:, hole] + _FAINT * eye_array(len(hole))).tocsc()).solve
