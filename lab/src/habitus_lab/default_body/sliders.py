"""From sliders to a body: MakeHuman's macro sliders multiply, local sliders add; both weigh linear
morph targets.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from scipy import sparse

from .sources import Source, read_target

# A macro slider of 0..1 becomes weights of neighbouring anchors; one without files (the middle
# height) adds nothing.
ANCHORS = {
    "gender": ("female", "male"),
    "age": ("baby", "child", "young", "old"),
    "muscle": ("minmuscle", "averagemuscle", "maxmuscle"),
    "weight": ("minweight", "averageweight", "maxweight"),
    "height": ("minheight", "", "maxheight"),
    "proportions": ("uncommonproportions", "", "idealproportions"),
    "cup": ("mincup", "averagecup", "maxcup"),
    "firmness": ("minfirmness", "averagefirmness", "maxfirmness"),
}
PLACES = {
    "age": (0.0, 0.1875, 0.5, 1.0)
}  # where a slider's anchors lie; the other sliders' are evenly spaced on 0..1
NOMINAL_YEARS = (
    1.0,
    10.0,
    25.0,
    90.0,
)  # of the age anchors, as MakeHuman labels them: its children are short for them
ADULTS = ("young", "old")
RACES = ("african", "asian", "caucasian")
MACRO_FOLDERS = ("macrodetails", "macrodetails/height", "macrodetails/proportions", "breast")
LOCAL_SECTIONS = (
    "arms",
    "breast",
    "buttocks",
    "feet",
    "hands",
    "head",
    "hip",
    "legs",
    "neck",
    "pelvis",
    "stomach",
    "torso",
)
FACE_SECTIONS = ("cheek", "chin", "ears", "eyebrows", "eyes", "forehead", "mouth", "nose")
# Sliders of LOCAL_SECTIONS that no measurement determines: they shift a part as a pose would, or
# are details. They only widen the population (`people.py`).
LOCAL_DETAILS = (
    "bulge",
    "nipple",
    "foot-trans",
    "head-trans",
    "head-diamond",
    "head-oval",
    "head-rectangular",
    "head-round",
    "head-triangular",
    "head-inverted",
    "head-square",
    "head-age",
    "neck-trans",
    "hip-trans",
    "torso-trans",
    "leg-valgus",
    # these move the spine's joint cubes by centimetres, away from the flesh
    "torso-scale-vert",
    "measure-waisttohip",
)
# Asymmetric sliders, whose symmetric part is nothing or a shear.
ASYMMETRIC = ("nose-trans-in-out", "mouth-trans-in-out", "head-angle", "hand-trans")
ASYMMETRIC += tuple(f"{part}-trans-in-out" for part in ("foot", "head", "hip", "neck", "torso"))


@dataclass(frozen=True)
class MorphSpace:
    """All targets over some points: the base mesh's vertices, or linear combinations of them (joint
    centres, tape rings).
    """

    base: np.ndarray  # (P, 3) metres
    macro_offsets: np.ndarray  # (K, P, 3) float32
    macro_factors: tuple[
        tuple[str, ...], ...
    ]  # per macro target, the anchors whose product weighs it
    local_names: tuple[str, ...]
    local_offsets: np.ndarray  # (L, 2, P, 3) float32: at slider -1 and at slider +1

    def at(self, matrix: sparse.spmatrix) -> MorphSpace:
        """The same sliders over other points: rows of `matrix` (Q, P) combine the present ones."""

        def combine(offsets: np.ndarray) -> np.ndarray:
            flat = offsets.reshape(-1, *offsets.shape[-2:])
            return (
                np.stack([matrix @ o for o in flat])
                .astype(np.float32)
                .reshape(*offsets.shape[:-2], -1, 3)
            )

        macro = combine(self.macro_offsets)
        local = combine(self.local_offsets)
        return MorphSpace(matrix @ self.base, macro, self.macro_factors, self.local_names, local)

    def has(self, anchor: str) -> bool:
        """Whether any macro target of this anchor was read."""
        return any(anchor in factors for factors in self.macro_factors)

    def average(self) -> np.ndarray:
        """Points (P, 3) midway between a young woman and a young man with all sliders in the
        middle.
        """
        macro = {name: np.full(2, 0.5) for name in ANCHORS} | {"gender": np.array([0.0, 1.0])}
        return (
            self.bodies(macro, np.full((2, 3), 1 / 3), np.zeros((2, len(self.local_names))))
            .mean(0)
            .astype(float)
        )

    def bodies(
        self, macro: dict[str, np.ndarray], races: np.ndarray, local: np.ndarray
    ) -> np.ndarray:
        """Points (N, P, 3) of N people; macro sliders (N,) each in 0..1, races (N, 3) summing to 1,
        local (N, L) in
        -1..1.
        """
        youngest = min(p for p, a in zip(PLACES["age"], ANCHORS["age"], strict=True) if self.has(a))
        if np.min(macro["age"]) < youngest:
            raise ValueError(
                f"age slider {np.min(macro['age']):.3f}, but the targets read begin at {youngest}"
            )
        as_torch = {
            name: torch.as_tensor(np.asarray(value, float)) for name, value in macro.items()
        }
        weights = (
            macro_anchor_weights(as_torch, torch.as_tensor(races), self.macro_factors)
            .numpy()
            .astype(np.float32)
        )
        points = np.tensordot(weights, self.macro_offsets, 1)
        points += np.tensordot(
            np.maximum(-local, 0).astype(np.float32), self.local_offsets[:, 0], 1
        )
        points += np.tensordot(np.maximum(local, 0).astype(np.float32), self.local_offsets[:, 1], 1)
        return points + self.base.astype(np.float32)


def macro_anchor_weights(
    macro: dict[str, torch.Tensor], races: torch.Tensor, factors: tuple[tuple[str, ...], ...]
) -> torch.Tensor:
    """(N, K) weight of each macro target: the product of its anchors' weights; differentiable in
    the sliders.
    """
    anchor = {race: races[:, k] for k, race in enumerate(RACES)} | {
        "universal": torch.ones_like(races[:, 0])
    }
    for slider, names in ANCHORS.items():
        anchor |= _hat_weights(
            macro[slider], names, PLACES.get(slider, tuple(np.linspace(0, 1, len(names))))
        )
    names = list(anchor)
    table = torch.stack([anchor[name] for name in names], 1)
    index = [
        [names.index(f) for f in each] + [names.index("universal")] * (6 - len(each))
        for each in factors
    ]
    return table[:, torch.tensor(index)].prod(2)


def _hat_weights(
    slider: torch.Tensor, names: tuple[str, ...], places: tuple[float, ...]
) -> dict[str, torch.Tensor]:
    """Piecewise-linear weights of anchors at `places`; beyond the ends the last piece goes on
    straight.
    """
    at = torch.tensor(places, dtype=slider.dtype)
    piece = torch.bucketize(slider.detach().contiguous(), at[1:-1], right=True)
    share = (slider - at[piece]) / (at[piece + 1] - at[piece])
    none = torch.zeros_like(share)
    weights = {
        name: torch.where(piece == k, 1 - share, none) + torch.where(piece == k - 1, share, none)
        for k, name in enumerate(names)
    }
    return {name: weight for name, weight in weights.items() if name}


def widening_sliders(names: tuple[str, ...]) -> np.ndarray:
    """(L,) True for the sliders that only widen the population: details, and the face's."""
    faces = tuple(section.removesuffix("s") for section in FACE_SECTIONS)
    return np.array(
        [name.startswith(faces) or any(word in name for word in LOCAL_DETAILS) for name in names],
        bool,
    )


def age_slider(years: np.ndarray) -> np.ndarray:
    """MakeHuman's age slider for nominal years: 25 is 0.5, 90 is 1; children's bodies need a table
    instead.
    """
    return np.interp(years, NOMINAL_YEARS, PLACES["age"])


def read_morphs(source: Source, ages: tuple[str, ...] = ADULTS) -> MorphSpace:
    """Read the macro targets of some age anchors and the chosen local ones, over all vertices of
    the base mesh.

    Targets are made symmetric: a few of MakeHuman's are off by millimetres.
    """
    targets = source.folder / "targets"
    factors, macro_files = _macro_files(targets, ages)
    names, local = local_offsets(source, LOCAL_SECTIONS + FACE_SECTIONS, ASYMMETRIC)
    return MorphSpace(
        base=source.vertices,
        macro_offsets=np.stack([_symmetric_sum(source, [p]) for p in macro_files]),
        macro_factors=factors,
        local_names=names,
        local_offsets=local,
    )


def local_offsets(
    source: Source, sections: tuple[str, ...], skipped: tuple[str, ...]
) -> tuple[tuple[str, ...], np.ndarray]:
    """Local sliders of some sections, but for names with a `skipped` word in them, and their
    offsets (L, 2, 19158, 3) float32 at -1 and at +1, symmetric.
    """
    names, files = _local_files(source.folder / "targets", sections, skipped)
    pairs = [np.stack([_symmetric_sum(source, side) for side in sides]) for sides in files]
    return names, np.stack(pairs)


def _symmetric_sum(source: Source, paths: list[Path]) -> np.ndarray:
    moved = np.zeros(source.vertices.shape, np.float32)
    for path in paths:
        moved = moved + read_target(path, len(source.vertices)).astype(np.float32)
    return 0.5 * (moved + moved[source.mirror] * np.array([-1, 1, 1], np.float32))


def _macro_files(
    targets: Path, ages: tuple[str, ...]
) -> tuple[tuple[tuple[str, ...], ...], list[Path]]:
    known = {name for names in ANCHORS.values() for name in names} | set(RACES) | {"universal"}
    known -= set(ANCHORS["age"]) - set(ages)
    factors = []
    files = []
    for folder in MACRO_FOLDERS:
        for path in sorted((targets / folder).glob("*.target.gz")):
            parts = tuple(path.name.removesuffix(".target.gz").split("-"))
            if len(parts) > 2 and set(parts) <= known:
                factors.append(parts)
                files.append(path)
    return tuple(factors), files


def _local_files(
    targets: Path, chosen: tuple[str, ...], skipped: tuple[str, ...]
) -> tuple[tuple[str, ...], list[tuple[list[Path], list[Path]]]]:
    sections = json.loads((targets / "target.json").read_text())
    names = []
    files = []
    for section in chosen:
        for category in sections[section]["categories"]:
            if any(word in category["name"] for word in skipped):
                continue
            sides = category.get("opposites") or {"positive-unsided": category["targets"][0]}
            down, up = (
                [
                    targets / section / f"{v}.target.gz"
                    for k, v in sides.items()
                    if k.startswith(sign) and v
                ]
                for sign in ("negative", "positive")
            )
            names.append(category["name"])
            files.append((down, up))
    return tuple(names), files
