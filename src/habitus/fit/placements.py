"""Where people put markers, learned from fits of many captures: means and spreads by empirical
Bayes (beside M 4.1).

What is learned from is a held-out marker: it had no say in the body that it is seen on, so that
where it sits is told without the layout's own pull. Every person counts once a label. Offsets are
added up as

    place  +  label at that place  +  person at that place  +  this person's label there  +  this marker

whose five variances are found from all people together, so that a mean moves from the layout's
place only as far as the people who tell it agree, and as places usually do. What people do by
themselves is Student-t: a belt worn low, or a marker on a wand, moves nobody else's.
"""  # noqa: E501

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import astuple, dataclass, replace
from itertools import groupby

import numpy as np
from jaxtyping import Float
from scipy.optimize import minimize

from habitus.body.model import BodyModel
from habitus.fit.markers.energy import place
from habitus.markers.layouts import Marker, MarkerLayout
from habitus.markers.placements import (
    PlacementPrior,
    UsualPlace,
    is_free,
    label_keys,
    mirrored,
    sideless,
)
from habitus.mesh.proximity import signed_distance
from habitus.observe.marker_prediction import marked_body, predict
from habitus.observe.markers import MarkerAttachment, attach, default_markers, triangle_bases


@dataclass(frozen=True)
class PlacementSettings:
    """Settings of learned placements. Variances are squares of the layout's spreads."""

    min_frames: int = 3
    """A marker that is seen in fewer is left out: a median of two is no better than either."""
    freedom: float = 4.0
    """Degrees of freedom of the Student-t of what people do by themselves."""
    rounds: int = 4
    """Alternations of variances and trust; converged by then."""
    same: float = 5e-4
    """Metres: a label whose usual place differs less from its place's mean has no entry."""
    variances: tuple[float, float] = (1e-4, 10.0)
    """Smallest and largest variance: below and above, the likelihood is flat."""


PLACEMENTS = PlacementSettings()


@dataclass(frozen=True)
class Seen:
    """Where a person's marker sat: metres from the layout's place in body space at rest, x away
    from the middle.

    twin: where the fit that did not see it found the same label of the other side, likewise; None
    without one.
    """

    person: str
    place: str
    label: str
    marker: Marker
    offset: tuple[float, float, float]
    twin: tuple[float, float, float] | None = None


def offsets_at_rest(
    body: BodyModel,
    betas: Float[np.ndarray, " B"],
    pose: Float[np.ndarray, "F J 3"],
    trans: Float[np.ndarray, "F 3"],
    layout: MarkerLayout,
    observed: Float[np.ndarray, "F H 3"],
    settings: PlacementSettings = PLACEMENTS,
) -> Float[np.ndarray, "H 3"]:
    """Where markers that a fit did not see sit, from the layout's places, carried back to the body
    at rest, metres.

    Medians over frames of what is left in the basis of the triangle that carries the place; NaN
    where hardly seen.
    """
    placement = place(layout, body)
    rest = body.rest_vertices(betas)
    start = default_markers(body, betas, placement.vertices, placement.distance)
    at = attach(start, rest, body.faces)
    count = len(layout)
    steps = [at.coefficients, *(at.coefficients + axis for axis in np.eye(3))]
    tripods = MarkerAttachment(np.tile(at.triangles, (4, 1)), np.concatenate(steps))
    points = predict(marked_body(body, betas, tripods), pose, trans).reshape(-1, 4, count, 3)
    left = np.einsum("fahi,fhi->fha", points[:, 1:] - points[:, :1], observed - points[:, 0])
    few = np.isfinite(left[..., 0]).sum(axis=0) < settings.min_frames
    middle = np.array(
        [np.full(3, np.nan) if few[h] else np.nanmedian(left[:, h], axis=0) for h in range(count)]
    )
    return np.einsum("hij,hj->hi", triangle_bases(rest, at.triangles).basis, middle)


def seen(
    person: str,
    layout: MarkerLayout,
    offsets: Float[np.ndarray, "H 3"],
    whole: MarkerLayout,
    twins: Float[np.ndarray, "H 3"] | None = None,
) -> list[Seen]:
    """What offsets of a layout's markers tell. whole: the layout as it comes, which knows each
    label's twin.

    The layout's labels are a capture's, the names of the whole layout among their aliases. twins:
    where the fit found those of the other side, mirrored to this one; zeros where there is none.
    """
    keys = label_keys(whole)
    samples = []
    twins = np.zeros_like(offsets) if twins is None else twins
    for marker, offset, twin in zip(layout.markers, offsets, twins, strict=True):
        name = next((label for label in (*marker.aliases[:1], marker.label) if label in keys), None)
        if marker.landmarks and name is not None and np.isfinite(offset).all():
            here = tuple(mirrored(marker, offset).tolist())
            other = tuple(mirrored(marker, twin).tolist())
            samples.append(
                Seen(
                    person,
                    sideless(marker.place),
                    keys[name],
                    marker,
                    here,
                    other if twin.any() else None,
                )
            )
    return samples


@dataclass(frozen=True)
class Variances:
    """Of offsets, in squares of the layout's spreads.

    Of places, of labels at a place; of a person's markers at a place, of theirs with one label, and
    of each marker.
    """

    place: float = 0.06
    label: float = 0.03
    person: float = 0.2
    person_label: float = 0.15
    marker: float = 0.1


@dataclass(frozen=True)
class _Group:
    """All that was seen at one place: one row a person, label and side, the mean of its captures.

    trust (N,): of the person's rows; few people are far off with everything, and say little of
    others.
    """

    place: str
    markers: tuple[Marker, ...]
    offsets: Float[np.ndarray, "N 3"]
    labels: np.ndarray
    people: np.ndarray
    trust: Float[np.ndarray, " N"]

    @property
    def scale(self) -> Float[np.ndarray, " N"]:
        """(N,) how unsure the layout is of each marker, metres."""
        return np.array(
            [np.hypot(marker.place_spread, marker.distance_spread) for marker in self.markers]
        )

    def shared(self, variances: Variances) -> Float[np.ndarray, "N N"]:
        """Covariance of what all people share."""
        label = variances.label * (self.labels[:, None] == self.labels)
        return np.outer(self.scale, self.scale) * (variances.place + label)

    def of_people(self, variances: Variances) -> Float[np.ndarray, "N N"]:
        """Covariance of what people do by themselves."""
        person = self.people[:, None] == self.people
        labels = variances.person_label * (self.labels[:, None] == self.labels)
        each = person * (variances.person + labels) + variances.marker * np.eye(len(person))
        return np.outer(self.scale, self.scale) * each / np.sqrt(np.outer(self.trust, self.trust))


def learned(
    everything: Sequence[Seen], body: BodyModel, settings: PlacementSettings = PLACEMENTS
) -> PlacementPrior:
    """The prior of people's markers. body: the one that they were seen on."""
    groups, variances = _robustly(_groups(everything), settings)
    means = {group.place: _mean(group, variances) for group in groups}
    places: dict[str, UsualPlace] = {}
    labels: dict[tuple[str, str], UsualPlace] = {}
    for group in groups:
        places[group.place] = _usual(group, None, variances, body)
        for label in map(str, np.unique(group.labels)):
            usual = _usual(group, label, variances, body)
            if _distance(usual, places[group.place]) >= settings.same:
                labels[group.place, label] = usual
    return PlacementPrior(
        places,
        labels,
        (_twin_share(everything, means, False), _twin_share(everything, means, True)),
    )


def _twin_share(everything: Iterable[Seen], means: Mapping[str, np.ndarray], free: bool) -> float:
    """The share of what a fit finds its twin off (beside the mean) that a marker it did not see is
    off; robustly.

    Not the correlation of the two: a body that is fitted to the twin gives way to it. 0 without
    twins.
    """
    both = [
        (group.offset, group.twin, means[group.place])
        for group in everything
        if group.twin is not None and is_free(group.marker) == free
    ]
    own = np.array([np.subtract(offset, mean) for offset, _, mean in both]).reshape(-1, 3)
    twin = np.array([np.subtract(twin, mean) for _, twin, mean in both]).reshape(-1, 3)
    shares = np.linspace(0.0, 1.0, 101)
    return float(
        shares[np.argmin([np.linalg.norm(own - share * twin, axis=1).sum() for share in shares])]
    )


def _mean(group: _Group, variances: Variances) -> Float[np.ndarray, " 3"]:
    towards = group.scale * np.median(group.scale) * variances.place
    return towards @ np.linalg.solve(
        group.shared(variances) + group.of_people(variances), group.offsets
    )


def _robustly(
    groups: Sequence[_Group], settings: PlacementSettings
) -> tuple[list[_Group], Variances]:
    """Variances under which what was seen is likeliest, people's own part Student-t: in turns with
    their trust.
    """
    variances = Variances()
    kept = list(groups)
    for _ in range(settings.rounds):
        variances = _likeliest(kept, variances, settings)
        kept = [_trusted(group, variances, settings.freedom) for group in kept]
    return kept, variances


def _likeliest(
    groups: Sequence[_Group], start: Variances, settings: PlacementSettings
) -> Variances:
    def surprise(logs: np.ndarray) -> float:
        variances = Variances(*np.exp(logs))
        total = 0.0
        for group in groups:
            factor = np.linalg.cholesky(group.shared(variances) + group.of_people(variances))
            total += 3.0 * np.log(np.diag(factor)).sum() + 0.5 * np.sum(
                np.linalg.solve(factor, group.offsets) ** 2
            )
        return total

    logs = np.log(np.maximum(astuple(start), settings.variances[0]))
    bounds = [np.log(settings.variances)] * len(logs)
    return Variances(*np.exp(minimize(surprise, logs, method="L-BFGS-B", bounds=bounds).x))


def _trusted(group: _Group, variances: Variances, freedom: float) -> _Group:
    """The group with each person's trust by how far they are from what all share (expectation step
    of the t).
    """
    shared = group.shared(variances)
    own = group.of_people(variances)
    left = group.offsets - shared @ np.linalg.solve(shared + own, group.offsets)
    plain = replace(group, trust=np.ones(len(group.people))).of_people(variances)
    trust = np.array(group.trust)
    for name in np.unique(group.people):
        mine = group.people == name
        surprise = float(
            np.sum(left[mine] * np.linalg.solve(plain[np.ix_(mine, mine)], left[mine]))
        )
        trust[mine] = (freedom + 3 * mine.sum()) / (freedom + surprise)
    return replace(group, trust=trust)


def _groups(everything: Iterable[Seen]) -> list[_Group]:
    def row(sample: Seen) -> tuple[str, str, str, str]:
        return sample.place, sample.label, sample.person, sample.marker.label

    rows = []
    for (at, label, person, _), same in groupby(sorted(everything, key=row), key=row):
        ones = list(same)
        rows.append(
            (at, label, person, ones[0].marker, np.mean([one.offset for one in ones], axis=0))
        )
    groups = []
    for at, same in groupby(rows, key=lambda each: each[0]):
        _, labels, people, markers, offsets = zip(*same, strict=True)
        trust = np.ones(len(people))
        groups.append(
            _Group(at, markers, np.array(offsets), np.array(labels), np.array(people), trust)
        )
    return groups


def _usual(group: _Group, label: str | None, variances: Variances, body: BodyModel) -> UsualPlace:
    """Posterior mean and predictive spread of another person's marker at a place, with a label or
    with any other.
    """
    first = 0 if label is None else int(np.argmax(group.labels == label))
    same = np.ones(len(group.people), bool) if label is None else group.labels == label
    shares = variances.place + (0.0 if label is None else variances.label) * same
    towards = group.scale * group.scale[first] * shares
    gain = np.linalg.solve(group.shared(variances) + group.of_people(variances), towards)
    spread = np.sqrt(group.scale[first] ** 2 * sum(astuple(variances)) - gain @ towards)
    shift, off = _along_skin(group.markers[first], gain @ group.offsets, body)
    return UsualPlace(shift, off, float(spread), len(np.unique(group.people[same])))


def _distance(place: UsualPlace, other: UsualPlace) -> float:
    """Between two places or their spreads, whichever is larger (m)."""
    lengths = [np.array([*usual.shift, usual.off, usual.spread]) for usual in (place, other)]
    return float(np.abs(lengths[0] - lengths[1]).max())


def _along_skin(
    marker: Marker, offset: Float[np.ndarray, " 3"], body: BodyModel
) -> tuple[tuple[float, float, float], float]:
    """An offset from a marker's place on the template as a way along the skin and a change of the
    distance from it.
    """
    betas = np.zeros(body.num_betas)
    distance = np.array([marker.distance])
    vertex = MarkerLayout("one", (marker,)).vertices(body)
    skin = body.rest_vertices(betas)
    start = default_markers(body, betas, vertex, distance)
    near = signed_distance(start + mirrored(marker, offset), skin, body.faces)
    on_skin = near.barycentric[0] @ skin[body.faces[near.triangle[0]]]
    x, y, z = mirrored(marker, on_skin - skin[vertex[0]])
    middle = not {name.split("_")[0] for name in marker.landmarks} & {"left", "right"}
    return (0.0 if middle else float(x), float(y), float(z)), float(
        near.distance[0]
    ) - marker.distance
