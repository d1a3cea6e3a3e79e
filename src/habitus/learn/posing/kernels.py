"""Compiled posing for training: quaternions (w, x, y, z) as tuples, and loops over vertices for
blended rotations and translations and their pose Jacobians.
"""

import numpy as np

from habitus.kernels.jit import jit, jit_inline


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


@jit_inline
def _move(motion, point):
    x = point[0]
    y = point[1]
    z = point[2]
    return (
        motion[0, 0] * x + motion[0, 1] * y + motion[0, 2] * z + motion[0, 3],
        motion[1, 0] * x + motion[1, 1] * y + motion[1, 2] * z + motion[1, 3],
        motion[2, 0] * x + motion[2, 1] * y + motion[2, 2] * z + motion[2, 3],
    )


@jit
def apply_blends(turn, rest, translation_blend, index, translations):
    """turn_v rest_v + sum_k carry_vk shift_k (V,3)."""
    out = np.empty_like(rest)
    for v in range(len(rest)):
        for a in range(3):
            total = (
                turn[v, a, 0] * rest[v, 0] + turn[v, a, 1] * rest[v, 1] + turn[v, a, 2] * rest[v, 2]
            )
            for k in range(index.shape[1]):
                joint = index[v, k]
                for b in range(3):
                    total += translation_blend[v, k, a, b] * translations[joint, b]
            out[v, a] = total
    return out


@jit
def translation_jacobian(translation_blend, index, maps):
    """sum_k carry_vk maps_k (V,3,C)."""
    out = np.zeros((len(index), 3, maps.shape[2]))
    for v in range(len(index)):
        for k in range(index.shape[1]):
            joint = index[v, k]
            for a in range(3):
                for b in range(3):
                    factor = translation_blend[v, k, a, b]
                    if factor != 0.0:
                        for c in range(maps.shape[2]):
                            out[v, a, c] += factor * maps[joint, b, c]
    return out


@jit
def dual_quaternion_blends(index, signed, quaternions):
    """Blended rotations (V,3,3) and the matrices (V,K,3,3) that take joints' translations c_k to a
    vertex'.

    With b = sum w_k q_k, ``signed`` weights w, the vertex' translation is vec(sum w_k c_k q_k b*) /
    |b|^2, and the vector part of c (s, u) is (s I - [u]x) c.
    """
    vertices, influences = index.shape
    turn = np.empty((vertices, 3, 3))
    blends = np.empty((vertices, influences, 3, 3))
    for v in range(vertices):
        b = blend(index[v], signed[v], quaternions)
        scale = 1.0 / dot4(b, b)
        write_rotation(turn[v], b, scale)
        for k in range(influences):
            joint = index[v, k]
            q = (
                quaternions[joint, 0],
                quaternions[joint, 1],
                quaternions[joint, 2],
                quaternions[joint, 3],
            )
            s, x, y, z = product(q, conjugate(b))
            f = scale * signed[v, k]
            matrix = blends[v, k]
            matrix[0, 0], matrix[0, 1], matrix[0, 2] = f * s, f * z, -f * y
            matrix[1, 0], matrix[1, 1], matrix[1, 2] = -f * z, f * s, f * x
            matrix[2, 0], matrix[2, 1], matrix[2, 2] = f * y, -f * x, f * s
    return turn, blends


@jit
def linear_pose_jacobian(index, value, rest, motions, positions, parents, axes, out):
    """Add to out (V,3,J,3) how vertices move as joint j turns by axes_j[:, m]: the turn times the
    lever (LBS).

    The lever of joint j is sum_k w_k (R_k rest + c_k - p_j) over the joints k that hang on j.
    """
    lever = np.zeros((len(parents), 3))
    for v in range(len(index)):
        for k in range(index.shape[1]):
            w = value[v, k]
            joint = index[v, k]
            if w != 0.0:
                x, y, z = _move(motions[joint], rest[v])
                while joint >= 0:
                    lever[joint, 0] += w * (x - positions[joint, 0])
                    lever[joint, 1] += w * (y - positions[joint, 1])
                    lever[joint, 2] += w * (z - positions[joint, 2])
                    joint = parents[joint]
        for k in range(index.shape[1]):
            joint = index[v, k]
            while joint >= 0:
                x = lever[joint, 0]
                y = lever[joint, 1]
                z = lever[joint, 2]
                for m in range(3):
                    a = axes[joint, 0, m]
                    b = axes[joint, 1, m]
                    c = axes[joint, 2, m]
                    out[v, 0, joint, m] += b * z - c * y
                    out[v, 1, joint, m] += c * x - a * z
                    out[v, 2, joint, m] += a * y - b * x
                lever[joint, 0] = lever[joint, 1] = lever[joint, 2] = (
                    0.0  # counted once, and clean for the next
                )
                joint = parents[joint]


@jit
def dual_pose_jacobian(
    index, signed, rest, moved, quaternions, translations, positions, parents, axes, out
):
    """The same with dual quaternions; ``moved`` (V,3) are the posed vertices.

    With b the blended real part and e the blended dual part, dx = 2/|b|^2 [vec(b' y b*) + vec(e
    b'*) - x (b . b') + vec(e' b*)]; turning by w about p makes w r / 2 and (w d + (p x w) r) / 2 of
    real r and dual d.
    """
    real = np.zeros((len(parents), 4))
    dual = np.zeros((len(parents), 4))
    for v in range(len(index)):
        for k in range(index.shape[1]):
            w = signed[v, k]
            joint = index[v, k]
            q = (
                w * quaternions[joint, 0],
                w * quaternions[joint, 1],
                w * quaternions[joint, 2],
                w * quaternions[joint, 3],
            )
            d = product(
                (
                    0.0,
                    0.5 * translations[joint, 0],
                    0.5 * translations[joint, 1],
                    0.5 * translations[joint, 2],
                ),
                q,
            )
            while joint >= 0:
                for i in range(4):
                    real[joint, i] += q[i]
                    dual[joint, i] += d[i]
                joint = parents[joint]
        b = (real[0, 0], real[0, 1], real[0, 2], real[0, 3])
        e = (dual[0, 0], dual[0, 1], dual[0, 2], dual[0, 3])
        back = conjugate(b)
        turned = product((0.0, rest[v, 0], rest[v, 1], rest[v, 2]), back)
        f = 2.0 / dot4(b, b)
        for k in range(index.shape[1]):
            joint = index[v, k]
            while joint >= 0:
                r = (real[joint, 0], real[joint, 1], real[joint, 2], real[joint, 3])
                d = (dual[joint, 0], dual[joint, 1], dual[joint, 2], dual[joint, 3])
                if r[0] != 0.0 or r[1] != 0.0 or r[2] != 0.0 or r[3] != 0.0:
                    px = positions[joint, 0]
                    py = positions[joint, 1]
                    pz = positions[joint, 2]
                    for m in range(3):
                        x = 0.5 * axes[joint, 0, m]
                        y = 0.5 * axes[joint, 1, m]
                        z = 0.5 * axes[joint, 2, m]
                        dr = product((0.0, x, y, z), r)
                        dd = product((0.0, x, y, z), d)
                        ds = product((0.0, py * z - pz * y, pz * x - px * z, px * y - py * x), r)
                        first = product(dr, turned)
                        second = product(e, conjugate(dr))
                        third = product(
                            (dd[0] + ds[0], dd[1] + ds[1], dd[2] + ds[2], dd[3] + ds[3]), back
                        )
                        along = dot4(b, dr)
                        for a in range(3):
                            out[v, a, joint, m] += f * (
                                first[a + 1] + second[a + 1] + third[a + 1] - moved[v, a] * along
                            )
                for i in range(4):
                    real[joint, i] = dual[joint, i] = 0.0
                joint = parents[joint]


@jit
def blend_shape_jacobian(turn, posedirs, slope, out):
    """Add to out (V,3,J,3) what pose blend shapes do as joints turn: turn_v P_v df; slope is
    (J-1,k,3).
    """
    joints = slope.shape[0]
    count = slope.shape[1]
    for v in range(len(turn)):
        for j in range(joints):
            for m in range(3):
                x = y = z = 0.0
                for i in range(count):
                    s = slope[j, i, m]
                    x += posedirs[v, 0, j * count + i] * s
                    y += posedirs[v, 1, j * count + i] * s
                    z += posedirs[v, 2, j * count + i] * s
                for a in range(3):
                    out[v, a, j + 1, m] += turn[v, a, 0] * x + turn[v, a, 1] * y + turn[v, a, 2] * z
