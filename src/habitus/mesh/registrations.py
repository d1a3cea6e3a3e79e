"""The data a body model is learned from: meshes in one topology, and whose each is (S 4)."""

from collections.abc import Collection
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, Int

from habitus.errors import HabitusError
from habitus.mesh.known import Known

SETS = ("pose", "shape", "test")
SEXES = ("female", "male", "")
VERDICTS = ("good", "doubtful", "failed", "")


@runtime_checkable
class Vertices(Protocol):
    """Vertices (N, V, 3) that are fetched when asked for: an array, a mapped file, a zarr array, a
    reader of files.
    """

    @property
    def shape(self) -> tuple[int, ...]:
        """(N, V, 3)."""
        ...

    def __getitem__(self, rows: Any, /) -> Any:
        """The registrations (np.ndarray) of some rows (a whole number, a slice, or an array of
        numbers).
        """
        ...


@dataclass(frozen=True, eq=False)
class Registrations:
    """N registrations in one topology, read one by one: their vertices may lie on disk.

    ``vertices`` (N, V, 3) are in metres, in the frame of the template (y up, facing +z).
    ``subject``, ``sex`` ("female", "male" or "" where it is unknown), ``set`` ("pose": one of many
    poses of its subject, "shape": one of many subjects in about one pose, "test": kept out of the
    training) and ``name`` (for messages) have one word a registration. A vertex that is not a
    number was not seen: a hole. ``weights``, from 0 (a hole as well) to 1, say how far vertices are
    trusted, (V,) in all registrations or (N, V) in each. ``known`` is what is known of them
    besides. ``verdict`` is what `habitus register` judged each to be ("good", "doubtful", "failed"
    or "" where nothing judged it); () for none. Raises HabitusError where these do not fit
    together.
    """

    vertices: Vertices
    faces: Int[np.ndarray, "F 3"]
    subject: tuple[str, ...]
    sex: tuple[str, ...]
    set: tuple[str, ...]
    name: tuple[str, ...]
    weights: Vertices | None = None
    known: Known | None = None
    verdict: tuple[str, ...] = ()

    def __post_init__(self):
        shape = tuple(self.vertices.shape)
        if len(shape) != 3 or shape[2] != 3 or shape[1] == 0:
            raise HabitusError(
                f"the registrations' vertices have shape {shape}; expected (N, V, 3)"
            )
        for key in ("subject", "sex", "set", "name", "verdict"):
            words = getattr(self, key)
            if len(words) != shape[0] and (words or key != "verdict"):
                raise HabitusError(
                    f"{len(words)} words of {key!r} for {shape[0]} registrations; expected one each"
                )
        _check_words("sex", self.sex, SEXES, self.name)
        _check_words("set", self.set, SETS, self.name)
        if self.verdict:
            _check_words("verdict", self.verdict, VERDICTS, self.name)
        check_faces(self.faces, shape[1], "the registrations'")
        if self.weights is not None and tuple(self.weights.shape) not in (shape[1:2], shape[:2]):
            raise HabitusError(
                f"the registrations' weights have shape {tuple(self.weights.shape)}; "
                f"expected ({shape[1]},) or {shape[:2]}"
            )
        if self.known is not None:
            self.known.check(shape[0], shape[1])

    def __len__(self) -> int:
        return len(self.name)

    @property
    def num_vertices(self) -> int:
        """V."""
        return self.vertices.shape[1]

    @cached_property
    def subjects(self) -> tuple[str, ...]:
        """The distinct subjects in the order in which they first appear."""
        return tuple(dict.fromkeys(self.subject))

    @cached_property
    def subject_index(self) -> Int[np.ndarray, " N"]:
        """For each registration the place of its subject in ``subjects``."""
        place = {subject: k for k, subject in enumerate(self.subjects)}
        return np.array([place[subject] for subject in self.subject], dtype=np.int64)

    @cached_property
    def subject_sex(self) -> tuple[str, ...]:
        """For each of ``subjects`` the sex of its first registration."""
        first = dict(zip(reversed(self.subject), reversed(self.sex), strict=True))
        return tuple(first[subject] for subject in self.subjects)

    def read(self, k: int) -> Float[np.ndarray, "V 3"]:
        """The vertices (m) of registration ``k``."""
        return np.array(self.vertices[k], dtype=np.float64)

    def read_seen(self, k: int) -> tuple[Float[np.ndarray, "V 3"], Float[np.ndarray, " V"] | None]:
        """Vertices (m) of registration ``k``, zero where there are holes, and their weights; None
        where all are 1.

        Raises HabitusError for weights that are not from 0 to 1.
        """
        vertices = self.read(k)
        holes = np.isnan(vertices).any(1)
        if self.weights is None and not holes.any():
            return vertices, None
        weight = np.ones(len(vertices)) if self.weights is None else self._weight(k)
        weight[holes] = 0.0
        vertices[weight == 0] = 0.0
        return vertices, weight

    def _weight(self, k: int) -> Float[np.ndarray, " V"]:
        assert self.weights is not None
        weight = np.array(
            self.weights[k] if len(self.weights.shape) == 2 else self.weights, dtype=np.float64
        )
        if not ((weight >= 0) & (weight <= 1)).all():
            raise HabitusError(
                f"{self.name[k]}: its weights run from {weight.min():.3g} to {weight.max():.3g}; "
                "expected 0 to 1"
            )
        return weight

    @cached_property
    def weighted(self) -> bool:
        """Whether any vertex counts less than others, or is a hole; reads all registrations where
        nothing is told.
        """
        return self.weights is not None or any(
            np.isnan(self.read(k)).any() for k in range(len(self))
        )

    @property
    def failed(self) -> Bool[np.ndarray, " N"]:
        """Those that `habitus register` judged failed."""
        return np.array([word == "failed" for word in self.verdict or [""] * len(self)], bool)

    @cached_property
    def made(self) -> Bool[np.ndarray, " N"]:
        """Those whose poses are known: they were made, not scanned."""
        return (self.known or Known()).known_rows("pose", len(self))

    def where(
        self,
        *,
        set: str | Collection[str] | None = None,
        sex: str | Collection[str] | None = None,
        subject: str | Collection[str] | None = None,
    ) -> "Registrations":
        """The registrations of a set, a sex, a subject (or of several), in their order; nothing is
        read or copied.
        """
        kept = np.ones(len(self), dtype=bool)
        for words, chosen in ((self.set, set), (self.sex, sex), (self.subject, subject)):
            if chosen is not None:
                these = {chosen} if isinstance(chosen, str) else frozenset(chosen)
                kept &= np.array([word in these for word in words], dtype=bool)
        return self.take(np.flatnonzero(kept))

    def take(self, rows: Int[np.ndarray, " n"]) -> "Registrations":
        """These registrations, in this order; nothing is read or copied. Raises HabitusError for
        rows out of range.
        """
        rows = np.asarray(rows, dtype=np.int64).reshape(-1)
        if len(rows) and not (rows.min() >= 0 and rows.max() < len(self)):
            raise HabitusError(
                f"registrations {rows.min()} to {rows.max()} asked for; expected 0 to "
                f"{len(self) - 1}, or none"
            )
        words = {
            key: tuple(getattr(self, key)[k] for k in rows)
            for key in ("subject", "sex", "set", "name", "verdict")
            if getattr(self, key)
        }
        weights = self.weights
        if weights is not None and len(weights.shape) == 2:
            weights = _Rows(*_base(weights, rows))
        known = None if self.known is None else self.known.take(rows)
        return replace(
            self, vertices=_Rows(*_base(self.vertices, rows)), weights=weights, known=known, **words
        )


@dataclass(frozen=True, eq=False)
class _Rows:
    """Some rows of vertices that lie elsewhere, fetched when asked for."""

    source: Vertices
    rows: Int[np.ndarray, " n"]

    @property
    def shape(self) -> tuple[int, ...]:
        return (len(self.rows), *self.source.shape[1:])

    def __getitem__(self, rows: Any) -> np.ndarray:
        chosen = self.rows[rows]
        if isinstance(chosen, np.ndarray):
            return np.asarray(self.source[chosen])
        return np.asarray(self.source[int(chosen)])


def _base(
    vertices: Vertices, rows: Int[np.ndarray, " n"]
) -> tuple[Vertices, Int[np.ndarray, " n"]]:
    """The vertices that a choice of a choice comes down to."""
    return (
        (vertices.source, vertices.rows[rows]) if isinstance(vertices, _Rows) else (vertices, rows)
    )


def _check_words(
    key: str, words: tuple[str, ...], allowed: tuple[str, ...], names: tuple[str, ...]
) -> None:
    for word, name in zip(words, names, strict=True):
        if word not in allowed:
            raise HabitusError(
                f"{name}: its {key} is {word!r}; expected one of {', '.join(map(repr, allowed))}"
            )


def check_faces(faces: Int[np.ndarray, "F 3"], vertices: int, whose: str) -> None:
    """Raise HabitusError unless faces are triangles (F, 3) of vertex numbers below ``vertices``."""
    faces = np.asarray(faces)
    if faces.ndim != 2 or faces.shape[1] != 3 or len(faces) == 0 or faces.dtype.kind not in "iu":
        raise HabitusError(
            f"{whose} faces are {faces.dtype} of shape {faces.shape}; expected vertex numbers (F, "
            "3)"
        )
    if faces.min() < 0 or faces.max() >= vertices:
        raise HabitusError(
            f"{whose} faces name vertices {faces.min()} to {faces.max()}; expected 0 to "
            f"{vertices - 1}"
        )
