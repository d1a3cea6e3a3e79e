"""A registered scan: the free surface in the body's topology, the model under it, and the verdict
on both, by evidence that needs no ground truth.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from habitus.body.model import BodyModel
from habitus.body.state import BodyState
from habitus.fit.points.correspondences import hidden_vertices
from habitus.fit.points.scan import Cloud
from habitus.fit.points.settings import SCANS
from habitus.fit.points.skin_grid import SkinGrid
from habitus.fit.verdict import (
    BODY,
    COMMON_SENTENCES,
    DOUBTFUL,
    FAILED,
    GOOD,
    HEAD,
    PARTS,
    SIDES,
    Bound,
    PeopleLimits,
    Reason,
    Verdict,
    above,
    below,
    enumerated,
    measurement_reasons,
    proportion_reasons,
    solver_reasons,
    vertex_parts,
    weigh,
    worst,
)
from habitus.mesh.intersections import intersecting_pairs
from habitus.mesh.normals import vertex_normals

SCANNED_PEOPLE = PeopleLimits(
    above=Bound(0.15, np.inf), below=Bound(0.15, np.inf), proportions=Bound(5.5, np.inf), head=HEAD
)
"""Measurements outside those of people are a doubt: clothes are measured, too. Their range is wider
than a fit's that infers them: a surface on the scan measures it. Less than 1 cm of hair is measured
with the head. Proportions: a scan stretched by 1.3 across lies at 6.7, one squeezed by 0.7 in depth
at 6.3, six surfaces of people whom no body of ours made at 1.9 to 4.0."""

TWIST = Bound(SCANS.limbs.most_twisted, np.inf)


@dataclass(frozen=True)
class ScanLimits:
    """Limits of the evidence on a registered scan.

    "Simulated": set on the simulated people of benchmarks/register_scans.py; "by hand": chosen
    without a measurement. All were then tried on the spoilt scans of benchmarks/surface_faults.py
    and on the surfaces of four people whom no body of ours made: a real scan of 10,000 points in
    T-pose, a mean woman of a survey's scans, SMPL's mean man, and a jumper with bent wrists. Their
    values are given where a limit decided.
    """

    median: Bound = Bound(0.0015, 0.004)
    """Metres from scan to surface, median,"""
    p95: Bound = Bound(0.006, 0.020)
    """and 95th percentile. Simulated; the four have medians of 0.2 to 0.4 mm, and 1.5, 1.8 and 4.1
    mm, or 11 mm where both hands are wrong."""
    model: Bound = Bound(0.008, 0.020)
    """Metres from scan to model, median. Simulated; the four have 3.4 to 5.6 mm."""
    matched: Bound = Bound(0.93, 0.80)
    """Share of the scan that the model explains (within 5 cm, with similar normals). Simulated; the
    four have 98 % and more."""
    betas: Bound = Bound(3.0, np.inf)
    """Root mean square of the first `judged_betas`. 1 is usual of those the shape space was learned
    from; of real people scanned and registered rightly, single betas lie at 3 to 5. A rare shape is
    a doubt and never a failure: what nobody can be, the misfit shows. By hand; the four have 1.1,
    1.4, 2.1 and 3.4 (the jumper), the mean of a survey's women 2.6 in ten poses, a scan that is
    scaled by 1.4 has 3.2.
    """
    judged_betas: int = 24
    """Further betas are not judged: of people whom no body of ours made, registered rightly, they
    reach 4 to 8."""
    largest_beta: Bound = Bound(8.0, np.inf)
    """Largest of these betas. By hand; on bodies 3.0 four surfaces of people whom no body of ours
    made have 2.9 to 6.7 in ten poses. Scans stretched by 1.3 across or squeezed by 0.7 in depth
    have 3.8 and 3.5: `PeopleLimits.proportions` finds those."""
    pose: Bound = Bound(2.2, 3.5)
    """Root mean square of the pose in the prior's standard deviations. Simulated; the jumper, whose
    limbs are right but for the hands, has 2.8, the others 0.7 to 1.0."""
    joint: Bound = Bound(6.0, np.inf)
    """Standard deviations of one joint by itself. No joint of 643 frames of ten captures is beyond
    4.5; collars that hold a wrong arm to the scan are at 6 to 14."""
    twist: Bound = TWIST
    """Standard deviations of a forearm's twist, its hand's included (`limbs.forearm_twists`). 1.9
    is the most of 1159 frames of six captures; two forearms half a turn off had 6.3 and 6.7."""
    seen: Bound = Bound(0.6, 0.15)
    """Share of the body that the scan shows. Simulated, from the front; the four have 0.8 and more.
    """
    lost: Bound = Bound(0.005, 0.015)
    """Share of the scan, by area, that lies off the surface in one place: half a hand is 0.5 %, an
    arm in a wrong pose 1.3 %. By hand; in deep folds it lies further off
    (`LimbSettings.lost_in_folds`)."""
    lost_hands: Bound = Bound(0.0025, 0.006)
    """The same where that place is at the hands or the feet: fingers that are a little off are a
    doubt on the hands alone. By hand; 0.6 % at the jumper's wrong hands, 0.3 to 0.5 % in 8 of 40
    scans of foreign people whose fingers lie 5 to 10 mm off."""
    lost_head: Bound = Bound(0.0025, 0.02)
    """The same at the head. By hand; 0.7 to 1.1 % of a woman whose mesh has the inside of a mouth
    and whose face is right within 3 mm."""
    cuts: Bound = Bound(100, 800)
    """Pairs of triangles that cut each other in the surface and not in the model. By hand; 38 to 63
    of six right surfaces, most of them in an armpit or the groin; 107 of an arm that is wrong, 206
    where half of a person is missing."""
    cuts_end: Bound = Bound(40, 400)
    """The same of hands and feet, where a fist closes on itself. By hand; 61 and 69 at feet that
    are right: a doubt by part."""
    legs: Bound = Bound(60, np.inf)
    """Pairs of triangles in which one lower leg or foot cuts the other. By hand; 215 of a woman
    whose legs were exchanged, 23 in the simulated surface that she was scanned from; 0 of 17 other
    fits (eight people of benchmarks/wide_people.py)."""
    cuts_head: Bound = Bound(40, np.inf)
    """The same of the head: ears and hair cut themselves in surfaces that are right within 1 mm. By
    hand; 0 to 55 at right heads."""
    clothed: Bound = Bound(0.1, np.inf)
    """Share of the body under loose clothes or hair: there the skin is 8 mm off on average
    (benchmarks/clothed_people.py)."""
    head_seen: Bound = Bound(0.3, 0.0)
    """Share of the head that the scan shows: the height rests on it. By hand, for a scan whose head
    is missing; 0.8 and more of the four."""
    limb_seen: Bound = Bound(0.4, 0.0)
    """Share of a limb (`LIMBS`) that the scan shows. By hand; 0.81 and more of 144 limbs of 18
    people of benchmarks/wide_people.py, 0.07 of a forearm that the fit put elsewhere."""
    points: Bound = Bound(4000, 0)
    """Points of a scan, as many as there would be if it showed all of the body. Of people unlike
    the body's own 13 of 15 with 4,000 to 8,000 points were right (3 mm mean, 7 mm at 95 %), of nine
    with fewer 6, of 42 with more 39 (benchmarks/wide_people.py, seed 91, of 34 those with few)."""
    islands: Bound = Bound(0.1, np.inf)
    """Share of the scan in components separate from the person, which are left out: more than dust
    and stands may be another person. By hand, for two people side by side (0.5); at most 0.001 of
    the four."""
    people: PeopleLimits = SCANNED_PEOPLE
    limb_agreement: float = 0.4
    limb_deviation: float = 0.006
    """A limb is unlike itself in the person's other scans where its offsets from the model
    correlate with theirs by less than the first and are this far (m, RMS) from them. By hand; of
    80 limbs of a person in ten poses one, an arm turned about itself by a quarter, has .05 and
    9.3 mm; the others .64 to .98, up to 5.2 mm."""
    rival: Bound = Bound(1.05, 0.0)
    """Misfit of the best other pose relative to the best. Simulated; no other pose came close to
    those of the four."""


LIMITS = ScanLimits()

SENTENCES: Mapping[str, str] = MappingProxyType(
    {
        **COMMON_SENTENCES,
        "person": "Nothing in the scan has the form of a person; only a rough start was fitted.",
        "model": "The model is {mm:.1f} mm from the scan (median).",
        "matched": "Only {percent:.0f} % of the scan is a surface of the body.",
        "median": "The surface is {mm:.1f} mm from the scan (median).",
        "p95": "5 % of the scan is {mm:.0f} mm or more from the surface.",
        "lost": "A piece with {percent:.1f} % of the scan is off the surface: {place}.",
        "cuts": "The surface intersects itself in {count:.0f} pairs of triangles: {place}.",
        "legs": "The lower legs pass through each other in {count:.0f} pairs of triangles; they "
        "may be exchanged.",
        "pose": "The pose is rare: {ratio:.1f} standard deviations from the mean (RMS).",
        "joint": "The {joint} is bent in a rare way ({ratio:.1f} standard deviations); the limb "
        "may be wrong.",
        "twist": "The {limb} is twisted in a rare way ({ratio:.1f} standard deviations); it may be "
        "half a turn off.",
        "seen": "The scan shows {percent:.0f} % of the body; the rest continues the model.",
        "head": "The scan shows {percent:.0f} % of the head; it continues the model, as does the "
        "height.",
        "limb": "The scan shows {percent:.0f} % of the {limb}; its pose comes from the pose prior.",
        "islands": "{percent:.0f} % of the scan lies apart and was left out; it may be another "
        "person or a part of this one.",
        "points": "The scan has {points:,.0f} points on all of the body; with fewer than "
        "{limit:,.0f} the skin may be a centimetre off along the surface.",
        "clothed": "Loose clothes may hang off {percent:.0f} % of the body; the skin under them "
        "is estimated.",
        "rival": "Another pose fits nearly as well.",
        "unlike": "The shape is {mm:.0f} mm (RMS) from that of the person's other scans: another "
        "person, or a wrong pose; the scan was registered by itself.",
        "limbs": "The surface of the {limbs} is unlike that in the person's other scans; it may be "
        "turned about its own axis.",
    }
)


def judge_scan(fit: "ScanFit", limits: ScanLimits = LIMITS) -> Verdict:
    """The verdict on a registered scan."""
    return weigh((_reasons,), fit, limits, SENTENCES)


def _reasons(fit: "ScanFit", limits: ScanLimits) -> Iterator[Reason]:
    if not fit.person:
        yield Reason(FAILED, "person")
        return
    yield from solver_reasons(fit.status)
    judged = fit.betas[: limits.judged_betas]
    betas = float(np.sqrt(np.mean(np.square(judged)))) if len(judged) else 0.0
    largest = float(np.abs(judged).max(initial=0.0))
    rare = worst([above(betas, limits.betas), above(largest, limits.largest_beta)])
    median, p95 = (float(np.percentile(fit.to_surface, share)) for share in (50, 95))
    model = float(np.median(fit.to_model))
    points = {"points": fit.points, "limit": limits.points.doubtful}
    levels = [
        Reason(above(fit.clothed, limits.clothed), "clothed", {"percent": 100.0 * fit.clothed}),
        Reason(above(model, limits.model), "model", {"mm": 1e3 * model}),
        Reason(below(fit.matched, limits.matched), "matched", {"percent": 100.0 * fit.matched}),
        Reason(above(median, limits.median), "median", {"mm": 1e3 * median}),
        Reason(above(p95, limits.p95), "p95", {"mm": 1e3 * p95}),
        _lost(fit, limits),
        *_cuts(fit, limits),
        Reason(above(fit.crossed_legs, limits.legs), "legs", {"count": fit.crossed_legs}),
        Reason(rare, "shape", {"rms": betas, "largest": largest}),
        Reason(above(fit.pose_distance, limits.pose), "pose", {"ratio": fit.pose_distance}),
        Reason(
            above(fit.joint_deviation, limits.joint),
            "joint",
            {"joint": fit.rarest_joint.replace("_", " "), "ratio": fit.joint_deviation},
        ),
        Reason(below(fit.seen, limits.seen), "seen", {"percent": 100.0 * fit.seen}),
        Reason(below(fit.head_seen, limits.head_seen), "head", {"percent": 100.0 * fit.head_seen}),
        Reason(below(fit.points, limits.points), "points", points),
        Reason(above(fit.islands, limits.islands), "islands", {"percent": 100.0 * fit.islands}),
    ]
    for joint, share in fit.limbs_seen.items():
        values = {"percent": 100.0 * share, "limb": LIMBS[joint]}
        levels.append(Reason(below(share, limits.limb_seen), "limb", values))
    for joint, ratio in fit.twists.items():
        values = {"limb": LIMBS[joint], "ratio": ratio}
        levels.append(Reason(above(ratio, limits.twist), "twist", values))
    if fit.rival is not None:
        levels.append(Reason(below(fit.rival, limits.rival), "rival"))
    if fit.unlike:
        levels.append(Reason(DOUBTFUL, "unlike", {"mm": 1e3 * fit.unlike}))
    turned = [
        LIMBS[joint]
        for joint, limb in fit.limbs.items()
        if limb.correlation < limits.limb_agreement and limb.deviation > limits.limb_deviation
    ]
    if turned:
        levels.append(Reason(DOUBTFUL, "limbs", {"limbs": enumerated(turned)}))
    yield from (reason for reason in levels if reason.level != GOOD)
    if fit.measurements:
        stature = float(np.ptp(fit.body.v_template[:, 1]))
        yield from measurement_reasons(fit.measurements, fit.body.age, stature, limits.people)
        yield from proportion_reasons(fit.measurements, fit.body.age, limits.people)


def _lost(fit: "ScanFit", limits: ScanLimits) -> Reason:
    part = fit.lost_part
    bound = {BODY: limits.lost, HEAD: limits.lost_head}.get(part, limits.lost_hands)
    values = {"percent": 100.0 * fit.lost, "place": _place(part)}
    return Reason(above(fit.lost, bound), "lost", values, part)


def _cuts(fit: "ScanFit", limits: ScanLimits) -> Iterator[Reason]:
    for part, count in fit.cuts.items():
        bound = {BODY: limits.cuts, HEAD: limits.cuts_head}.get(part, limits.cuts_end)
        yield Reason(above(count, bound), "cuts", {"count": count, "place": _place(part)}, part)


def _place(part: str) -> str:
    """Where on a person, in words."""
    return "on the trunk, an arm or a leg" if part == BODY else f"at the {part}"


LIMBS: Mapping[str, str] = MappingProxyType(
    {
        f"{side}_{joint}": f"{side} {word}"
        for side in SIDES
        for joint, word in (
            ("shoulder", "upper arm"),
            ("elbow", "forearm"),
            ("hip", "thigh"),
            ("knee", "lower leg"),
        )
    }
)
"""The joints at which limbs begin that can be turned about their own axis, and the limbs' names."""


class LimbAgreement(NamedTuple):
    """How the offsets of a limb's skin from the model, along its normals at rest, agree with the
    median of the person's other scans: RMS difference (m) and correlation.
    """

    deviation: float
    correlation: float


@dataclass(frozen=True, eq=False)
class ScanColours:
    """What colours of several scans of a person came to.

    ``albedo`` (G, 3), linear up to a factor, is the texture all share, at the nodes of ``grid``;
    ``apart`` (G,) how far this scan's tones (log of linear colours) are from the others' there,
    ``before`` and ``after`` that over the skin (1.48 times the median) where geometry had it and
    where it is now; ``slid`` (m) how far the surface went.
    """

    grid: SkinGrid
    albedo: Float[np.ndarray, "G 3"]
    apart: Float[np.ndarray, " G"]
    before: float
    after: float
    slid: float = 0.0


@dataclass(frozen=True, eq=False)
class ScanFit:
    """One scan, registered. Metres and radians, y up; ``to_body`` (4, 4) takes the file's numbers
    there.

    ``vertices`` (V, 3) are the free surface; ``weights`` (V,), 0 to 1, say where the scan tells of
    it: 0 in holes, where it continues the model. ``betas``, shared by all scans of a person,
    ``pose`` (J, 3) and ``trans`` (3,) are the model's, ``rest_vertices`` (V, 3) the free surface
    carried back to rest. ``to_surface`` and ``to_model`` (M,) are the distances (m) of the points
    of ``cloud`` that are the body's, ``far_from_surface`` (N,) those of all. ``matched`` is their
    share, ``lost`` the share of all that lie together off the surface and ``lost_part`` the part of
    the body there, ``rival`` how much worse the best other pose is (1: as good; None: none came
    close), ``pose_distance`` the pose's root mean square distance from the prior's mean, in
    standard deviations. ``cuts``: pairs of triangles that cut each other in the surface
    beyond those of the model, by part of the body (`habitus.fit.verdict.PARTS`). ``person``: False
    where the start was so far from the scan that the rest was not tried; the surface is then the
    model's. ``islands``: share of the scan that was left out as separate components. ``up_axis`` is
    the scan's own axis that points up. ``status``: how the last solve of pose and shape ended
    (`habitus.minimize`: "converged", "iterations", "stalled", …; "no person" where none was tried);
    ``costs``: its cost by term. ``unlike``: how far (m, RMS) the shape is from the median of the
    person's scans, where it was registered alone and is too far. ``rarest_joint``: the joint of
    trunk, limbs and head that is furthest from the prior's mean by itself, and
    ``joint_deviation`` how far, in its standard deviations. ``covered`` (V,): 1 where loose clothes
    or hair may hang off the skin, which is estimated there (None: nowhere); ``cloth``: by region,
    how far (m, median) the scan is off it. ``hair`` (V,): thickness (m) of the hair that is part of
    the surface (None: there is none, or less than 1 cm).
    """

    scan_name: str
    body_name: str
    body: BodyModel
    betas: Float[np.ndarray, " B"]
    pose: Float[np.ndarray, "J 3"]
    trans: Float[np.ndarray, " 3"]
    vertices: Float[np.ndarray, "V 3"]
    model_vertices: Float[np.ndarray, "V 3"]
    rest_vertices: Float[np.ndarray, "V 3"]
    weights: Float[np.ndarray, " V"]
    cloud: Cloud
    to_surface: Float[np.ndarray, " M"]
    to_model: Float[np.ndarray, " M"]
    far_from_surface: Float[np.ndarray, " N"]
    matched: float
    lost: float
    rival: float | None
    pose_distance: float
    to_body: Float[np.ndarray, "4 4"]
    up_axis: str
    person: bool = True
    islands: float = 0.0
    notes: tuple[str, ...] = ()
    stage_seconds: Mapping[str, float] = field(default_factory=dict)
    settings: Mapping[str, Any] = field(default_factory=dict)
    colours: ScanColours | None = None
    cuts: Mapping[str, int] = field(default_factory=dict)
    lost_part: str = BODY
    status: str = "no person"
    costs: Mapping[str, float] = field(default_factory=dict)
    unlike: float = 0.0
    joint_deviation: float = 0.0
    rarest_joint: str = ""
    twists: Mapping[str, float] = field(default_factory=dict)
    """How far forearms are twisted, by their joints (`LIMBS`; `limbs.forearm_twists`)."""
    covered: Float[np.ndarray, " V"] | None = None
    hair: Float[np.ndarray, " V"] | None = None
    cloth: Mapping[str, float] = field(default_factory=dict)
    limbs: Mapping[str, LimbAgreement] = field(default_factory=dict)
    """By joint (`LIMBS`), where a person has three scans or more (`limbs_compared`)."""

    @property
    def state(self) -> BodyState:
        """The model's shape, pose and place."""
        return BodyState(self.betas, self.pose, self.trans)

    @property
    def seen(self) -> float:
        """The share of vertices that the scan shows, or the clothes on them."""
        return float(self._shown.mean())

    @property
    def points(self) -> float:
        """How many points the scan would have if it showed all of the body as densely."""
        return len(self.cloud.points) / max(self.seen, 1e-6)

    @property
    def clothed(self) -> float:
        """The share of vertices that loose clothes or hair may cover."""
        return 0.0 if self.covered is None else float(self.covered.mean())

    @property
    def _shown(self) -> Float[np.ndarray, " V"]:
        return self.weights if self.covered is None else np.maximum(self.weights, self.covered)

    @cached_property
    def head_seen(self) -> float:
        """The same of the head, without pockets that nobody sees; 1 for a body without a head."""
        hidden = hidden_vertices(self.body)
        rows = vertex_parts(self.body) == PARTS.index(HEAD)
        rows = rows if hidden is None else rows & ~hidden
        return float(self._shown[rows].mean()) if rows.any() else 1.0

    @cached_property
    def limbs_seen(self) -> Mapping[str, float]:
        """The share of the vertices of each limb that the scan shows, by its joint (`LIMBS`)."""
        own = np.array(self.body.joint_names)[self.body.strongest_joint]
        shown = {joint: self._shown[own == joint] for joint in LIMBS}
        return {joint: float(each.mean()) for joint, each in shown.items() if len(each)}

    @cached_property
    def crossed_legs(self) -> int:
        """In how many pairs of triangles one lower leg or foot cuts the other."""
        sides = np.zeros(self.body.num_joints, int)
        for k, name in enumerate(self.body.joint_names):
            side, _, joint = name.partition("_")
            if side in SIDES and joint in ("knee", "ankle", "foot"):
                sides[k] = 1 + SIDES.index(side)
        own = sides[self.body.strongest_joint]
        faces = self.body.faces[(own[self.body.faces] > 0).all(1)]
        first, second = own[faces[intersecting_pairs(self.vertices, faces)][:, :, 0]].T
        return int((first != second).sum())

    @cached_property
    def skin_at_rest(self) -> Float[np.ndarray, "V 3"]:
        """The free surface carried back to rest (m), but the model where hair hides the skin, from
        half of its thickness on.
        """
        if self.hair is None:
            return self.rest_vertices
        covered = np.minimum(2.0 * self.hair / self.hair.max(), 1.0)[:, None]
        model = np.asarray(self.body.rest_vertices(self.betas))
        return (1.0 - covered) * self.rest_vertices + covered * model

    @cached_property
    def measurements(self) -> Mapping[str, float]:
        """What the person measures, on the skin at rest; {} for a body that is no person's."""
        return self.body.measure_rest(self.skin_at_rest)

    @cached_property
    def skin_offset(self) -> Float[np.ndarray, " V"]:
        """How far (m) the skin at rest lies outwards of the model, along the model's normals."""
        model = np.asarray(self.body.rest_vertices(self.betas))
        return ((self.skin_at_rest - model) * vertex_normals(model, self.body.faces)).sum(1)

    @cached_property
    def verdict(self) -> Verdict:
        """What the registration is worth: ``level`` (good, doubtful or failed) and ``reasons``, a
        sentence each.
        """
        return judge_scan(self)
