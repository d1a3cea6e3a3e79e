"""Which faults `mosh_faults.py` plants, and where: drawn at random, in any capture.

    python benchmarks/mosh_fault_kinds.py    # lists them

Each takes a scene, its markers so far, a random generator and the columns that are spoilt already,
and gives the spoilt markers and the columns that it spoilt.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from habitus.fit.markers.drift import limb_axes, limb_of
from habitus.fit.markers.result import MarkerFit
from habitus.io.captures.read import Capture
from habitus_lab.population import marker_faults as faults

Spoilt = tuple[np.ndarray, list[int]]


@dataclass(frozen=True)
class Scene:
    """A clean capture (cropped), its fit, and the capture's columns that the layout uses."""

    capture: Capture
    clean: MarkerFit
    columns: list[int]

    @property
    def frames(self) -> int:
        """How many."""
        return len(self.capture.markers)

    def seconds(self, length: float) -> slice:
        """So many seconds in the middle."""
        count = min(round(length * self.capture.rate_hz), self.frames // 2)
        return slice((self.frames - count) // 2, (self.frames - count) // 2 + count)

    def pick(self, rng: np.random.Generator, used: Sequence[int]) -> int:
        """A marker that is not spoilt yet, seen for most of the time and not named in the clean
        fit.
        """
        named = {suspect.label for suspect in self.clean.suspects}
        seen = np.isfinite(self.capture.markers[..., 0]).mean(axis=0)
        free = [
            k
            for k in self.columns
            if k not in used and seen[k] > 0.9 and self.capture.labels[k] not in named
        ]
        return int(rng.choice(free))

    def neighbours(self, marker: int, used: Sequence[int]) -> list[int]:
        """Other markers from 5 to 30 cm off, nearest first."""
        apart = np.nanmedian(
            np.linalg.norm(self.capture.markers - self.capture.markers[:, [marker]], axis=2), axis=0
        )
        return [
            k
            for k in np.argsort(apart)
            if 0.05 < apart[k] < 0.3 and k in self.columns and k not in used
        ]


def swap(
    scene: Scene,
    markers: np.ndarray,
    rng: np.random.Generator,
    used: Sequence[int] = (),
    frames=None,
) -> Spoilt:
    """Two neighbours carry each other's label for a quarter of the time, or in given frames."""
    first = scene.pick(rng, used)
    other = []
    while not other:
        first = scene.pick(rng, used)
        other = [
            k
            for k in scene.neighbours(first, used)
            if k in {scene.pick(rng, used) for _ in range(200)}
        ]
    if frames is None:
        start = int(rng.integers(scene.frames // 6, scene.frames // 2))
        frames = slice(start, start + scene.frames // 4)
    return faults.swapped(markers, first, other[0], frames), [first, int(other[0])]


def exchange(
    scene: Scene, markers: np.ndarray, rng: np.random.Generator, used: Sequence[int] = ()
) -> Spoilt:
    """Two neighbours carry each other's label throughout."""
    return swap(scene, markers, rng, used, slice(None))


def exchange_sides(
    scene: Scene, markers: np.ndarray, rng: np.random.Generator, used: Sequence[int] = ()
) -> Spoilt:
    """A marker and its partner on the other side carry each other's label throughout."""
    places = scene.clean.latent_markers
    apart = np.linalg.norm(places[:, None] * (-1.0, 1.0, 1.0) - places, axis=2)
    labels = scene.clean.labels
    column = {label: scene.capture.labels.index(label) for label in labels}
    pairs = {
        column[labels[i]]: column[labels[j]]
        for i, j in enumerate(np.argmin(apart, axis=1).tolist())
        if apart[i, j] < 0.05 and np.linalg.norm(places[i] - places[j]) > 0.05
    }
    for _ in range(1000):
        if (first := scene.pick(rng, used)) in pairs:
            return faults.swapped(markers, first, pairs[first]), [first, pairs[first]]
    return markers, []  # no marker has a partner


def fall(
    scene: Scene, markers: np.ndarray, rng: np.random.Generator, used: Sequence[int] = ()
) -> Spoilt:
    """A marker falls to the ground somewhere in the middle."""
    marker = scene.pick(rng, used)
    frame = int(rng.integers(scene.frames // 4, 3 * scene.frames // 4))
    return faults.fallen(markers, marker, frame, scene.capture.rate_hz, scene.capture.up_axis), [
        marker
    ]


def haunt(
    scene: Scene, markers: np.ndarray, rng: np.random.Generator, used: Sequence[int] = ()
) -> Spoilt:
    """Three reflections 10 to 30 cm off, each for a twenty-fifth of the time."""
    marker = scene.pick(rng, used)
    for _ in range(3):
        start = int(rng.integers(scene.frames * 9 // 10))
        length = max(5, scene.frames // 25)
        offset = rng.normal(size=3)
        offset *= rng.uniform(0.1, 0.3) / np.linalg.norm(offset)
        markers = faults.ghost(markers, marker, slice(start, start + length), offset)
    return markers, [marker]


def mislabel(
    scene: Scene, markers: np.ndarray, rng: np.random.Generator, used: Sequence[int] = ()
) -> Spoilt:
    """Midway between two neighbours of a marker at least 20 cm away."""
    while True:
        marker = scene.pick(rng, used)
        other = scene.pick(rng, used)
        near = scene.neighbours(other, [marker])
        if not near:
            continue
        spoilt = faults.wrong_label(markers, marker, (other, near[0]))
        away = np.nanmedian(np.linalg.norm(spoilt[:, marker] - markers[:, marker], axis=1))
        if 0.2 < away < 0.8:
            return spoilt, [marker]


def slide(
    scene: Scene, markers: np.ndarray, rng: np.random.Generator, used: Sequence[int] = ()
) -> Spoilt:
    """6 cm along the skin, in the axes of the limb that carries the marker."""
    fit = scene.clean
    marker = scene.pick(rng, used)
    k = fit.labels.index(scene.capture.labels[marker])
    turns = limb_axes(fit.body, fit.pose)[:, limb_of(fit.body, fit.attachment)[k]]
    a, b, c = fit.body.rest_vertices(fit.betas)[fit.attachment.triangles[k]]
    outward = np.cross(b - a, c - a)
    outward /= np.linalg.norm(outward)
    way = rng.normal(size=3)
    way -= (way @ outward) * outward
    return faults.drifting(markers, marker, turns, 0.06 * way / np.linalg.norm(way)), [marker]


def lose(
    scene: Scene, markers: np.ndarray, rng: np.random.Generator, used: Sequence[int] = ()
) -> Spoilt:
    """A fifth of all samples lost."""
    return faults.lost(markers, 0.2, rng), []


def all_gone(seconds: float) -> "Planter":
    """Nothing is seen for so long."""
    return lambda scene, markers, rng, used=(): (
        faults.gap(markers, slice(None), scene.seconds(seconds)),
        [],
    )


def limb_gone(seconds: float) -> "Planter":
    """A marker and its five nearest."""

    def planter(
        scene: Scene, markers: np.ndarray, rng: np.random.Generator, used: Sequence[int] = ()
    ) -> Spoilt:
        marker = scene.pick(rng, used)
        which = np.array([marker, *scene.neighbours(marker, used)[:5]])
        return faults.gap(markers, which, scene.seconds(seconds)), []

    return planter


def four(
    scene: Scene, markers: np.ndarray, rng: np.random.Generator, used: Sequence[int] = ()
) -> Spoilt:
    """A swap, a fallen marker, a ghost and a drift, of different markers."""
    used = list(used)
    for kind in (swap, fall, haunt, slide):
        markers, planted = kind(scene, markers, rng, used)
        used += planted
    return markers, used


Planter = Callable[[Scene, np.ndarray, np.random.Generator, Sequence[int]], Spoilt]
KINDS: dict[str, Planter] = {
    "swap": swap,
    "exchange": exchange,
    "fallen": fall,
    "ghost": haunt,
    "wrong label": mislabel,
    "drift": slide,
    "four": four,
    "lost 20 %": lose,
    "gap 0.5 s": all_gone(0.5),
    "gap 2 s": all_gone(2.0),
    "limb gap 0.5 s": limb_gone(0.5),
    "limb gap 2 s": limb_gone(2.0),
    "wrong side": exchange_sides,
}


if __name__ == "__main__":
    for name, planter in KINDS.items():
        print(f"{name:14s} {planter.__doc__ or 'nothing, or a limb, is seen for so long'}")
