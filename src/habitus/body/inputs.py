"""What a body may be given, read into arrays of one kind: short betas, poses by joint name, vertex
numbers.
"""

from collections.abc import Mapping
from difflib import get_close_matches

import numpy as np
from jaxtyping import Float, Int

from habitus.arrays import Kind, broadcast_shapes, to_numpy
from habitus.errors import HabitusError
from habitus.types import Array, ArrayLike


def read_betas(
    values: ArrayLike, kind: Kind, count: int, name: str, body: str
) -> Float[Array, "*batch B"]:
    """``count`` shape coefficients, with zeros for those that are not given; HabitusError where
    there are more.
    """
    betas = kind.array(values)
    missing = count - betas.shape[-1] if betas.ndim else -1
    if missing < 0:
        raise HabitusError(
            f"{name} has shape {tuple(betas.shape)}; expected (*batch, {count}) or fewer for {body}"
        )
    return (
        kind.xp.concatenate([betas, kind.zeros(*betas.shape[:-1], missing)], -1)
        if missing
        else betas
    )


def read_dynamics(values: ArrayLike, kind: Kind, count: int, body: str) -> Float[Array, "*batch D"]:
    """As `read_betas`, of dynamic blend shapes; HabitusError that says so where the body has
    none.
    """
    given = kind.array(values)
    if not count and given.shape[-1:] != (0,):
        raise HabitusError(
            f"dynamics of shape {tuple(given.shape)} given to {body}, which has no dynamic blend "
            "shapes; take a body "
            "that has some, or learn them: habitus train-dynamics"
        )
    return read_betas(given, kind, count, "dynamics", body)


def read_pose(
    values: ArrayLike | Mapping[str, ArrayLike] | None,
    kind: Kind,
    joint_names: tuple[str, ...],
    body: str,
) -> Float[Array, "*batch J 3"]:
    """Rotation vectors (rad) of all joints, from those of all or those of some by name; the others
    are zero.
    """
    if values is None:
        return kind.zeros(len(joint_names), 3)
    if not isinstance(values, Mapping):
        return read_vectors(values, kind, (len(joint_names), 3), "pose", body)
    if unknown := [name for name in values if name not in joint_names]:
        near = get_close_matches(str(unknown[0]), joint_names, cutoff=0.4) or joint_names
        raise HabitusError(f"{body} has no joint {unknown[0]!r}; did you mean {', '.join(near)}?")
    named = {
        name: read_vectors(value, kind, (3,), f"pose[{name!r}]", body)
        for name, value in values.items()
    }
    batch = broadcast_shapes(*(value.shape[:-1] for value in named.values()))
    rest = kind.zeros(3)
    return kind.xp.stack(
        [kind.xp.broadcast_to(named.get(name, rest), (*batch, 3)) for name in joint_names], -2
    )


def read_vectors(
    values: ArrayLike, kind: Kind, last: tuple[int, ...], name: str, body: str
) -> Array:
    """Numbers whose last axes are ``last``; HabitusError where they are not."""
    array = kind.array(values)
    if tuple(array.shape[-len(last) :]) != last:
        expected = ", ".join(map(str, last))
        raise HabitusError(
            f"{name} has shape {tuple(array.shape)}; expected (*batch, {expected}) for {body}"
        )
    return array


def read_vertices(values: ArrayLike, count: int, body: str) -> Int[np.ndarray, " N"]:
    """Vertex numbers of a body with ``count``; HabitusError where they are none of its."""
    ids = to_numpy(values)
    if ids.ndim != 1 or (len(ids) and ids.dtype.kind not in "iu"):
        raise HabitusError(
            f"vertices are {ids.dtype} of shape {ids.shape}; expected vertex numbers (N,); of a "
            "mask, its nonzero()"
        )
    if len(ids) and not (ids.min() >= 0 and ids.max() < count):
        raise HabitusError(
            f"vertices run from {ids.min()} to {ids.max()}; {body} has vertices 0 to {count - 1}"
        )
    return ids.astype(np.int64)
