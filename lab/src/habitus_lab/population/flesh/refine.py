"""Triangles split until their edges are short: contact is only felt at vertices."""

import numpy as np
from jaxtyping import Float, Int

ROUNDS = 6
# which of corners 0-2 and middles 3-5 (of edges 01, 12, 20) make the parts, by the edges that are
# split
_CORNERS = {
    (False, False, False): ((0, 1, 2),),
    (True, False, False): ((0, 3, 2), (3, 1, 2)),
    (False, True, False): ((0, 1, 4), (0, 4, 2)),
    (False, False, True): ((0, 1, 5), (5, 1, 2)),
    (True, True, False): ((3, 1, 4), (0, 3, 4), (0, 4, 2)),
    (False, True, True): ((4, 2, 5), (0, 1, 4), (0, 4, 5)),
    (True, False, True): ((0, 3, 5), (3, 1, 2), (3, 2, 5)),
    (True, True, True): ((0, 3, 5), (3, 1, 4), (5, 4, 2), (3, 4, 5)),
}


def refined(
    vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"], longest: float
) -> tuple[Float[np.ndarray, "W 3"], Int[np.ndarray, "G 3"]]:
    """The same surface with no edge longer than `longest` (m), the old vertices first; edges are
    halved.
    """
    for _ in range(ROUNDS):
        edges = np.stack([faces, np.roll(faces, -1, axis=1)], 2)
        low = edges.min(2)
        high = edges.max(2)
        long = np.linalg.norm(vertices[low] - vertices[high], axis=2) > longest
        if not long.any():
            break
        keys, index = np.unique((low * len(vertices) + high)[long], return_inverse=True)
        middle = np.zeros(faces.shape, np.int64)
        middle[long] = len(vertices) + index
        vertices = np.concatenate(
            [vertices, vertices[[keys // len(vertices), keys % len(vertices)]].mean(0)]
        )
        six = np.concatenate([faces, middle], 1)
        code = long @ [1, 2, 4]
        parts = [six[code == k][:, np.array(_CORNERS[_bits(k)])].reshape(-1, 3) for k in range(8)]
        faces = np.concatenate(parts)
    return vertices, faces


def _bits(code: int) -> tuple[bool, bool, bool]:
    return bool(code & 1), bool(code & 2), bool(code & 4)
