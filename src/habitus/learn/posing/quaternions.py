"""Quaternions (w, x, y, z) as tuples, for compiled kernels."""

from habitus.kernels.jit import jit_inline


@jit_inline
def blend(index, signed, quaternions):
    """The weighted sum of the joints' quaternions."""
    w = x = y = z = 0.0
    for k in range(len(index)):
        q = quaternions[index[k]]
        f = signed[k]
        w = w + f * q[0]
        x = x + f * q[1]
        y = y + f * q[2]
        z = z + f * q[3]
    return w, x, y, z


@jit_inline
def product(p, q):
    """p q."""
    return (
        p[0] * q[0] - p[1] * q[1] - p[2] * q[2] - p[3] * q[3],
        p[0] * q[1] + p[1] * q[0] + p[2] * q[3] - p[3] * q[2],
        p[0] * q[2] - p[1] * q[3] + p[2] * q[0] + p[3] * q[1],
        p[0] * q[3] + p[1] * q[2] - p[2] * q[1] + p[3] * q[0],
    )


@jit_inline
def conjugate(q):
    """q*."""
    return q[0], -q[1], -q[2], -q[3]


@jit_inline
def dot4(p, q):
    """The sum of products."""
    return p[0] * q[0] + p[1] * q[1] + p[2] * q[2] + p[3] * q[3]


@jit_inline
def write_rotation(out, b, scale):
    """The rotation (3,3) of b, where scale is 1 / |b|^2."""
    w, x, y, z = b
    f = 2.0 * scale
    out[0, 0], out[1, 1], out[2, 2] = (
        1 - f * (y * y + z * z),
        1 - f * (x * x + z * z),
        1 - f * (x * x + y * y),
    )
    out[0, 1], out[1, 0] = f * (x * y - w * z), f * (x * y + w * z)
    out[0, 2], out[2, 0] = f * (x * z + w * y), f * (x * z - w * y)
    out[1, 2], out[2, 1] = f * (y * z - w * x), f * (y * z + w * x)
