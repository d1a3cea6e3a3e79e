"""Predicted markers and their derivatives, compiled: the plain kernels, one frame after another, everything dense.

For a vertex i with weights w_ik, rest place t_i (shape and pose blend shapes added) and joints of world rotation G_k,
world place p_k and rest place J_k (S 3.2, equations 2 to 10):

    u_ik = w_ik (G_k (t_i - J_k) + p_k),   v_i = sum_k u_ik,   R = exp([theta]x) = I + A [theta]x + B [theta]x^2,
    M_j = G_parent(j) L(theta_j) with the left Jacobian L = I + B [theta]x + C [theta]x^2,
    dv_i / dtheta_j = -[sum over k in desc(j) of u_ik - w_ik p_j]x M_j  +  (sum_k w_ik G_k) dt_i / dtheta_j.

`habitus.observe.marker_kernels` is the fast twin.
"""

import math

import numpy as np

from habitus.kernels.jit import jit


@jit
def predict_frames(rig, pose, trans, soft_tissue, markers):
    """Markers (T, M, 3)."""
    for t in range(len(pose)):
        joints = posed_joints(rig, pose[t], trans[t], soft_tissue[t])
        corners = posed_corners(rig, joints, rest_corners(rig, pose[t], soft_tissue[t]))
        for i in range(len(rig.triangles)):
            a, _, _, q = marker_frame(rig, corners, i)[:4]
            markers[t, i] = a + q


@jit
def bases_frames(rig, pose, trans, soft_tissue, bases):
    """Bases (T, M, 3, 3) of the markers' triangles."""
    for t in range(len(pose)):
        joints = posed_joints(rig, pose[t], trans[t], soft_tissue[t])
        corners = posed_corners(rig, joints, rest_corners(rig, pose[t], soft_tissue[t]))
        for i in range(len(rig.triangles)):
            _, e, f, _ = marker_frame(rig, corners, i)
            n, tangent, s, _, _, _ = triangle_axes(e, f)
            bases[t, i, :, 0], bases[t, i, :, 1], bases[t, i, :, 2] = n, tangent, s


@jit
def linearize_frames(rig, pose, trans, soft_tissue, markers, jacobian):
    """Markers (T, M, 3) and their Jacobian (T, M, 3, N)."""
    for t in range(len(pose)):
        joints = posed_joints(rig, pose[t], trans[t], soft_tissue[t])
        rest = rest_corners(rig, pose[t], soft_tissue[t])
        corners = posed_corners(rig, joints, rest)
        slopes = np.zeros((len(corners), 3, jacobian.shape[3]))
        add_pose_slopes(rig, joints, rest, slopes)
        if rig.corner_posedirs.shape[2] > 0:
            add_posedirs_slopes(rig, joints, pose[t], slopes)
        if soft_tissue.shape[1] > 0:
            add_shape_slopes(rig, joints, slopes)
        for i in range(len(rig.triangles)):
            a, _, _, q = marker_frame(rig, corners, i)
            markers[t, i] = a + q
            carry_slopes(rig, corners, slopes, i, jacobian[t, i])


@jit
def rotation_series(squared):
    """A = sin n / n, B = (1 - cos n) / n^2, C = (n - sin n) / n^3 of n^2; by series near 0, where quotients cancel."""
    if squared > 0.25:
        n = math.sqrt(squared)
        return math.sin(n) / n, (1.0 - math.cos(n)) / squared, (n - math.sin(n)) / (squared * n)
    a, b, c = 0.0, 0.0, 0.0
    for k in range(8, 0, -1):
        a = 1.0 - a * squared / ((2 * k) * (2 * k + 1)) if k < 8 else 1.0
        b = 1.0 - b * squared / ((2 * k + 1) * (2 * k + 2)) if k < 8 else 1.0
        c = 1.0 - c * squared / ((2 * k + 2) * (2 * k + 3)) if k < 8 else 1.0
    return a, b / 2.0, c / 6.0


@jit
def rotation_and_jacobian(theta):
    """R = exp([theta]x) and its left Jacobian L: exp([theta + d]x) = exp([L d]x) R to first order; (3, 3) each."""
    a, b, c = rotation_series(theta[0] ** 2 + theta[1] ** 2 + theta[2] ** 2)
    cross = np.array([[0.0, -theta[2], theta[1]], [theta[2], 0.0, -theta[0]], [-theta[1], theta[0], 0.0]])
    square = product(cross, cross)
    return np.eye(3) + a * cross + b * square, np.eye(3) + b * cross + c * square


@jit
def product(left, right):
    """The product of two 3 x 3 matrices."""
    out = np.zeros((3, 3))
    for i in range(3):
        for j in range(3):
            out[i, j] = left[i, 0] * right[0, j] + left[i, 1] * right[1, j] + left[i, 2] * right[2, j]
    return out


@jit
def turn(matrix, x, y, z):
    """A 3 x 3 matrix times the vector (x, y, z)."""
    return np.array(
        [
            matrix[0, 0] * x + matrix[0, 1] * y + matrix[0, 2] * z,
            matrix[1, 0] * x + matrix[1, 1] * y + matrix[1, 2] * z,
            matrix[2, 0] * x + matrix[2, 1] * y + matrix[2, 2] * z,
        ]
    )


@jit
def cross(p, q):
    """The cross product of two vectors."""
    return np.array([p[1] * q[2] - p[2] * q[1], p[2] * q[0] - p[0] * q[2], p[0] * q[1] - p[1] * q[0]])


@jit
def dot(p, q):
    """The dot product of two vectors."""
    return p[0] * q[0] + p[1] * q[1] + p[2] * q[2]


@jit
def posed_joints(rig, pose, trans, soft_tissue):
    """World rotations G (J, 3, 3), places p (J, 3), turning axes M (J, 3, 3) and rest places (J, 3) of the joints."""
    count = len(rig.parents)
    turned, place, axes = np.empty((count, 3, 3)), np.empty((count, 3)), np.empty((count, 3, 3))
    rest = rig.rest_joints.copy()
    for k in range(len(soft_tissue)):
        rest += rig.joint_shapedirs[:, :, k] * soft_tissue[k]
    for j in range(count):
        rotation, left = rotation_and_jacobian(pose[j])
        parent = rig.parents[j]
        if parent < 0:
            turned[j], axes[j], place[j] = rotation, left, rest[j] + trans
        else:
            bone = rest[j] - rest[parent]
            turned[j], axes[j] = product(turned[parent], rotation), product(turned[parent], left)
            place[j] = place[parent] + turn(turned[parent], bone[0], bone[1], bone[2])
    return turned, place, axes, rest


@jit
def rest_corners(rig, pose, soft_tissue):
    """Corners (U, 3) in the rest pose with soft tissue and pose blend shapes added (S equations 8 and 9)."""
    rest = rig.rest_corners.copy()
    for k in range(len(soft_tissue)):
        rest += rig.corner_shapedirs[:, :, k] * soft_tissue[k]
    for j in range(1, len(rig.parents) if rig.corner_posedirs.shape[2] > 0 else 0):
        rotation, _ = rotation_and_jacobian(pose[j])
        for i in range(len(rest)):
            for c in range(3):
                for e in range(9):
                    change = rotation[e // 3, e % 3] - (1.0 if e % 4 == 0 else 0.0)
                    rest[i, c] += rig.corner_posedirs[i, c, 9 * (j - 1) + e] * change
    return rest


@jit
def carried(joints, rest, k):
    """G_k (t - J_k) + p_k: where joint k alone would take the rest place t (3,)."""
    turned, place, _, joint_rest = joints
    bone = rest - joint_rest[k]
    return place[k] + turn(turned[k], bone[0], bone[1], bone[2])


@jit
def posed_corners(rig, joints, rest):
    """Corners (U, 3) in the world by linear blend skinning (S equation 7)."""
    corners = np.zeros_like(rest)
    for i in range(len(rest)):
        for k in range(rig.weights.shape[1]):
            corners[i] += rig.weights[i, k] * carried(joints, rest[i], rig.influences[i, k])
    return corners


@jit
def blended_rotation(rig, joints, i):
    """sum_k w_ik G_k (3, 3): how corner i moves with its rest place."""
    blend = np.zeros((3, 3))
    for k in range(rig.weights.shape[1]):
        blend += rig.weights[i, k] * joints[0][rig.influences[i, k]]
    return blend


@jit
def add_pose_slopes(rig, joints, rest, slopes):
    """Add d corner / d (trans, pose) by rigid motion to the first columns of `slopes` (U, 3, N)."""
    _, place, axes, _ = joints
    for i in range(len(rest)):
        slopes[i, 0, 0] = slopes[i, 1, 1] = slopes[i, 2, 2] = 1.0
        for k in range(rig.weights.shape[1]):
            weight, j = rig.weights[i, k], rig.influences[i, k]
            here = carried(joints, rest[i], j)
            while j >= 0 and weight != 0.0:
                arm = weight * (here - place[j])
                for m in range(3):
                    slopes[i, :, 3 + 3 * j + m] += cross(axes[j, :, m], arm)
                j = rig.parents[j]


@jit
def add_posedirs_slopes(rig, joints, pose, slopes):
    """Add what the pose blend shapes contribute: (sum_k w_ik G_k) P_ij vec([L e_m]x R) for axis m of joint j."""
    blends = np.empty((len(slopes), 3, 3))
    for i in range(len(slopes)):
        blends[i] = blended_rotation(rig, joints, i)
    for j in range(1, len(rig.parents)):
        rotation, left = rotation_and_jacobian(pose[j])
        for m in range(3):
            change = np.empty((3, 3))
            for c in range(3):
                change[:, c] = cross(left[:, m], rotation[:, c])
            for i in range(len(slopes)):
                offset = np.zeros(3)
                for e in range(9):
                    offset += rig.corner_posedirs[i, :, 9 * (j - 1) + e] * change[e // 3, e % 3]
                slopes[i, :, 3 + 3 * j + m] += turn(blends[i], offset[0], offset[1], offset[2])


@jit
def add_shape_slopes(rig, joints, slopes):
    """Add d corner / d betas to the last columns: (sum_k w_ik G_k) S_i + sum_k w_ik (dp_k - G_k dJ_k)."""
    turned = joints[0]
    first = 3 + 3 * len(rig.parents)
    for b in range(slopes.shape[2] - first):
        moved = joint_shape_slopes(rig, turned, b)
        for i in range(len(slopes)):
            for k in range(rig.weights.shape[1]):
                j = rig.influences[i, k]
                d = rig.corner_shapedirs[i, :, b] - rig.joint_shapedirs[j, :, b]
                slopes[i, :, first + b] += rig.weights[i, k] * (turn(turned[j], d[0], d[1], d[2]) + moved[j])


@jit
def joint_shape_slopes(rig, turned, b):
    """How the joints' places (J, 3) move with shape direction b: dp_j = dp_parent + G_parent d(J_j - J_parent)."""
    moved = np.empty((len(rig.parents), 3))
    for j in range(len(rig.parents)):
        parent = rig.parents[j]
        if parent < 0:
            moved[j] = rig.joint_shapedirs[j, :, b]
        else:
            d = rig.joint_shapedirs[j, :, b] - rig.joint_shapedirs[parent, :, b]
            moved[j] = moved[parent] + turn(turned[parent], d[0], d[1], d[2])
    return moved


@jit
def triangle_axes(e, f):
    """n, t and s of a triangle with the sides e = b - a and f = c - a, then 1 / |e|, f . t and f . s."""
    inverse = 1.0 / math.sqrt(dot(e, e))
    t, n = e * inverse, cross(e, f)
    n /= math.sqrt(dot(n, n))
    s = cross(n, t)
    return n, t, s, inverse, dot(f, t), dot(f, s)


@jit
def marker_frame(rig, corners, i):
    """Corner a, the sides e and f, and q = c_n n + c_t t + c_s s of marker i, which stands at a + q."""
    a, b, c = rig.triangles[i]
    e, f = corners[b] - corners[a], corners[c] - corners[a]
    n, t, s, _, _, _ = triangle_axes(e, f)
    place = rig.coefficients[i]
    return corners[a], e, f, place[0] * n + place[1] * t + place[2] * s


@jit
def carry_slopes(rig, corners, slopes, i, jacobian):
    """The Jacobian (3, N) of marker i from its corners':

    dx = da + (n x q)(s . de) / |e| + (t x q)(n . df - (f_t / |e|) n . de) / f_s - (s x q)(n . de) / |e|.
    """
    a, b, c = rig.triangles[i]
    _, e, f, q = marker_frame(rig, corners, i)
    n, t, s, inverse, along, across = triangle_axes(e, f)
    nq, tq, sq = cross(n, q), cross(t, q), cross(s, q)
    for column in range(jacobian.shape[1]):
        da = slopes[a, :, column]
        de, df = slopes[b, :, column] - da, slopes[c, :, column] - da
        lift = dot(n, de) * inverse
        twist = (dot(n, df) - along * lift) / across
        jacobian[:, column] = da + nq * (dot(s, de) * inverse) + tq * twist - sq * lift
