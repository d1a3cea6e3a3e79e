"""Folds (`habitus.body.pose_features`) as blend shapes of a file, named by joint and angle."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from habitus.body.model import BodyModel
from habitus.export.correctives import Block, Drivers, features


def folds(
    body: BodyModel,
    betas: Float[np.ndarray, " B"],
    motions: Sequence[Float[np.ndarray, "_ J 3 3"]],
    sample: Float[np.ndarray, "_ J 3 3"] | None,
) -> list[Block]:
    """A block for each joint with hinge channels, of a person: a blend shape a channel, called
    after the angle where it begins, its coefficient the channel's weight.

    They stand over ``posedirs`` that are `Hinges.without_linear`.
    """
    if body.hinges is None:
        return []
    person = body.hinges.for_person(betas)
    blocks = []
    for joint in np.unique(person.joint):
        own = np.flatnonzero(person.joint == joint)
        driven = Drivers(person.rows[own], person.bias[own], np.full(len(own), 2.0))
        shapes = person.directions[:, :, own, 0]
        moved = np.flatnonzero(shapes.any((1, 2)))
        terms, usual = (
            tuple(driven.weights(features(each, joint)[:, None]) for each in some)
            for some in (motions, () if sample is None else (sample,))
        )
        ends = fold_names(driven.rows, driven.bias)
        name = body.joint_names[joint]
        blocks.append(Block(name, moved, shapes[moved], terms, ends, driven, *usual))
    return blocks


def softened(
    body: BodyModel,
    motions: Sequence[Float[np.ndarray, "_ J 3 3"]],
    soft: Sequence[Float[np.ndarray, "_ B"]],
) -> tuple[Float[np.ndarray, "V 3 n"], tuple[Float[np.ndarray, "_ n"], ...]]:
    """What soft tissue adds to a shape moves vertices by ``shapedirs`` and by its folds' part that
    is multiplied with betas: directions, and their coefficients, a motion each.
    """
    hinges = body.hinges
    if hinges is None or not hinges.num_shapes:
        return body.shapedirs, tuple(soft)
    driven = Drivers(hinges.rows, hinges.bias, np.full(hinges.num_channels, 2.0))
    terms = []
    for rotations, change in zip(motions, soft, strict=True):
        entries = (rotations[:, hinges.joint] - np.eye(3)).reshape(len(rotations), -1, 9)
        products = driven.weights(entries)[..., None] * change[:, None, : hinges.num_shapes]
        terms.append(np.concatenate([change, products.reshape(len(change), -1)], axis=1))
    directions = hinges.directions[..., 1:].reshape(body.num_vertices, 3, -1)
    return np.concatenate([body.shapedirs, directions], axis=2), tuple(terms)


def fold_names(rows: Float[np.ndarray, "C 9"], bias: Float[np.ndarray, " C"]) -> tuple[str, ...]:
    """``fold_135`` for each channel of a joint by the angle where it begins, in degrees; ``fold_1``
    and on where two are alike.
    """
    angles = [round(angle) for angle in beginning(rows, bias)]
    alike = len(set(angles)) < len(angles)
    return tuple(f"fold_{k + 1 if alike else angle}" for k, angle in enumerate(angles))


def beginning(
    rows: Float[np.ndarray, "*batch 9"], bias: Float[np.ndarray, "*#batch"] | float
) -> Float[np.ndarray, "*batch"]:
    """The least angle (degrees) by which any rotation makes row . vec(R - I) as large as ``bias``;
    180 where none does.

    With a unit quaternion q, row . vec(R - I) - bias = q K q, and q_0 is the cosine of half the
    angle. The most that q_0^2 can be where q K q >= 0 is, by duality, the least of the largest
    eigenvalues of e_0 e_0^T + x K over x >= 0, which are convex in x.
    """
    m = rows.reshape(*rows.shape[:-1], 3, 3)
    turned = np.swapaxes(m, -1, -2)
    k = np.zeros((*rows.shape[:-1], 4, 4))
    skew = m - turned
    k[..., 0, 1:] = np.stack([skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]], axis=-1)
    k[..., 1:, 0] = k[..., 0, 1:]
    trace = np.trace(m, axis1=-2, axis2=-1)[..., None, None]
    k[..., 1:, 1:] = m + turned - 2 * trace * np.eye(3)
    k -= np.asarray(bias)[..., None, None] * np.eye(4)
    first = np.diag([1.0, 0, 0, 0])

    def largest(x: np.ndarray) -> np.ndarray:
        return np.linalg.eigvalsh(first + x[..., None, None] * k)[..., -1]

    high = 1e4 / np.abs(k).max(axis=(-2, -1))
    low = np.zeros_like(high)
    for _ in range(100):
        a, b = (2 * low + high) / 3, (low + 2 * high) / 3
        smaller = largest(a) < largest(b)
        low, high = np.where(smaller, low, a), np.where(smaller, b, high)
    most = np.clip(largest(low), 0.0, 1.0)
    return np.asarray(np.degrees(2 * np.arccos(np.sqrt(most))))
