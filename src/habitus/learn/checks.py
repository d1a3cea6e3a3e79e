"""Checks of registrations before training: faults are reported by the registration's name."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float, Int

from habitus.errors import HabitusError
from habitus.mesh.registrations import Registrations
from habitus.mesh.size import Measures, Ruler
from habitus.mesh.template import Template

LEAST_POSES, BENT = 5, np.deg2rad(15.0)
_UNITS = {
    1000.0: "in millimetres",
    100.0: "in centimetres",
    39.37: "in inches",
    10.0: "in decimetres",
    3.281: "in feet",
    0.1: "ten times too small",
    0.01: "a hundred times too small (metres taken for centimetres)",
    0.001: "a thousand times too small (metres taken for millimetres)",
}
_MOST_NAMED, _STRAINED = 5, 0.4


@dataclass(frozen=True)
class Finding:
    """One thing that is wrong: an "error" keeps from learning, a "warning" does not. ``name``: a registration, a
    subject, a joint, or "the registrations".
    """

    kind: Literal["error", "warning"]
    name: str
    message: str

    def __str__(self) -> str:
        return f"{self.name}: {self.message}"


def check_registrations(
    registrations: Registrations, template: Template, *, over: Callable[[Callable, Iterable], Iterable] = map
) -> list[Finding]:
    """All that is wrong with registrations, errors first.

    Errors: another topology than the template's; vertices that are not finite; another unit than metres; a mesh that is
    broken (collapsed, torn, its vertices in another order, a mirror image); a registration under the name of one
    subject with the build of another; a subject of two sexes. Warnings: joints without vertices; joints that hardly
    bend in the pose set; subjects with one pose. One registration is in memory at a time; ``over`` maps a function over
    registrations, in order (on threads, say).
    """
    findings = [
        Finding("warning", joint, "no vertex belongs to this joint; expected a part of the mesh, or a tree without it")
        for joint in template.empty_joints
    ]
    findings += _subject_findings(registrations)
    other = other_topology(registrations, template)
    if other:
        return [Finding("error", "the registrations", other), *findings]
    ruler = Ruler(template)
    measures = list(over(partial(_measure, ruler, registrations), range(len(registrations))))
    wrong = [_fault(measure) for measure in measures]
    findings += [Finding("error", name, fault) for name, fault in zip(registrations.name, wrong, strict=True) if fault]
    sound = np.array([not fault for fault in wrong], dtype=bool)
    findings += _mislabelled(registrations, measures, sound)
    findings += _unposed(registrations, template, ruler, measures, sound)
    return sorted(findings, key=lambda finding: finding.kind != "error")


def refuse(findings: Sequence[Finding]) -> None:
    """Raise HabitusError, in one line, where there are errors among the findings."""
    errors = [str(finding) for finding in findings if finding.kind == "error"]
    if errors:
        more = f"; and {len(errors) - _MOST_NAMED} more" if len(errors) > _MOST_NAMED else ""
        count = "1 error" if len(errors) == 1 else f"{len(errors)} errors"
        raise HabitusError(f"{count} in the registrations: {'; '.join(errors[:_MOST_NAMED])}{more}")


def other_topology(registrations: Registrations, template: Template) -> str | None:
    """Difference between the registrations' topology and the template's as text; None where they agree.

    The order of the faces, and at which corner each begins, do not matter.
    """
    if registrations.num_vertices != template.num_vertices:
        return (
            f"{registrations.num_vertices} vertices, the template has {template.num_vertices}; "
            "expected registrations of this template"
        )
    if len(registrations.faces) != len(template.faces):
        return f"{len(registrations.faces)} faces, the template has {len(template.faces)}; expected the same ones"
    off = len(_from_least(template.faces) - _from_least(registrations.faces))
    return f"{off} of {len(template.faces)} faces are not the template's; expected the same ones" if off else None


def _from_least(faces: Int[np.ndarray, "F 3"]) -> set[tuple[int, ...]]:
    """Faces that begin at their least corner."""
    turned = np.take_along_axis(faces, (faces.argmin(axis=1)[:, None] + np.arange(3)) % 3, axis=1)
    return set(map(tuple, turned.tolist()))


def _measure(ruler: Ruler, registrations: Registrations, k: int) -> Measures | str:
    """The measures of a registration, or why it cannot be read."""
    try:
        return ruler.measure(registrations.read(k))
    except HabitusError as error:
        return str(error)


def _fault(measures: Measures | str) -> str | None:
    """The fault of one registration by itself, or None."""
    if isinstance(measures, str):
        return measures
    m = measures
    if m.bad:
        return f"{m.bad} vertices are not finite; repair or leave it out"
    if m.extent < 1e-6 or m.edge < 1e-6:
        return "its vertices are collapsed to a point or a line; repair or leave it out"
    if not 0.22 < m.edge < 2.2 and m.strain < _STRAINED:
        factor = min(_UNITS, key=lambda factor: abs(np.log(m.edge / factor)))
        told = f"it seems to be {_UNITS[factor]}" if abs(np.log(m.edge / factor)) < np.log(1.6) else "no known unit"
        return f"its edges are {m.edge:.4g} times the template's: {told}; expected metres: say its unit"
    if m.short > 0.05:
        return f"{m.short:.0%} of its edges are collapsed to a point; repair or leave it out"
    if m.edge > 2 * m.extent:
        return (
            f"its edges are {m.edge:.3g} times as long as the template's, its whole {m.extent:.3g} times as large; "
            "expected the template's vertices, each in its place in the order and on the surface"
        )
    if m.flying:
        return f"{m.flying} of its edges cross the body: vertices fly off; repair or leave it out"
    if m.long > 0.01 or m.strain > _STRAINED:
        return (
            f"its edges are {m.strain:.0%} off the template's in the mean, {m.long:.1%} over 5 times as long; "
            "repair or leave it out"
        )
    if m.mirrored > 0.6:
        return "it is a mirror image of the template (left for right); flip one axis"
    return None


def _subject_findings(registrations: Registrations) -> list[Finding]:
    findings = []
    sexes: dict[str, dict[str, list[str]]] = {}
    poses: dict[str, int] = {}
    r = registrations
    for subject, sex, which, name in zip(r.subject, r.sex, r.set, r.name, strict=True):
        sexes.setdefault(subject, {}).setdefault(sex, []).append(name)
        if which == "pose":
            poses[subject] = poses.get(subject, 0) + 1
    for subject, told in sexes.items():
        if len(told) > 1:
            counts = sorted(((len(names), sex or "not told", names[0]) for sex, names in told.items()), reverse=True)
            words = " and ".join(f"{sex} in {count} (first {name})" for count, sex, name in counts)
            findings.append(Finding("error", subject, f"the sex of this subject is {words}; expected one"))
    findings += [
        Finding("warning", subject, "one pose only; expected several of a subject of the pose set, or the set 'shape'")
        for subject, count in poses.items()
        if count == 1
    ]
    return findings


def _mislabelled(registrations: Registrations, measures: Sequence[Any], sound: Bool[np.ndarray, " N"]) -> list[Finding]:
    """Registrations far from their own subject's build and near another's.

    A build is compared with the median of its subject's others, and with other subjects' medians, in spreads within
    subjects. Far and near are meant so that two alike people who are mixed up go unnoticed rather than one person in
    an odd pose is blamed.
    """
    rows = np.flatnonzero(sound)
    if not len(rows):
        return []
    builds = np.stack([measures[k].build for k in rows.tolist()]).astype(np.float64)
    builds = builds[:, np.isfinite(builds).all(axis=0)]
    subject = registrations.subject_index[rows]
    middle, own = _medians(builds, subject, len(registrations.subjects))
    several = np.flatnonzero(np.isfinite(own).all(axis=1))
    if not len(several) or not builds.shape[1]:
        return []
    gaps = np.abs(builds[several] - own[several])
    spread = np.maximum(1.5 * np.quantile(gaps, 0.75, axis=0), 0.002)
    mine = _distance(gaps, spread)
    findings = []
    for i in np.flatnonzero(mine > 1.8 * np.median(mine)).tolist():
        k = int(several[i])
        others = _distance(np.abs(middle - builds[k]), spread)
        others[subject[k]] = np.inf
        nearest = int(np.nanargmin(others))
        if others[nearest] < 0.6 * mine[i]:
            name, alike = registrations.subjects[subject[k]], registrations.subjects[nearest]
            message = (
                f"it is said to be {name} but is built like {alike} ({others[nearest]:.2f} spreads away, "
                f"{mine[i]:.2f} from {name}); check its subject"
            )
            findings.append(Finding("error", registrations.name[rows[k]], message))
    return findings


def _distance(gaps: Float[np.ndarray, "n L"], spread: Float[np.ndarray, " L"]) -> Float[np.ndarray, " n"]:
    """The mean gap in spreads, none of them counting for more than ten."""
    return np.minimum(gaps / spread, 10.0).mean(axis=1)


def _medians(
    builds: Float[np.ndarray, "n L"], subject: Int[np.ndarray, " n"], subjects: int
) -> tuple[Float[np.ndarray, "S L"], Float[np.ndarray, "n L"]]:
    """Each subject's median, and for each row that of its subject's other rows; NaN where there are none."""
    middle, own = np.full((subjects, builds.shape[1]), np.nan), np.full(builds.shape, np.nan)
    order = np.argsort(subject, kind="stable")
    for rows in np.split(order, np.flatnonzero(np.diff(subject[order])) + 1):
        middle[subject[rows[0]]] = np.median(builds[rows], axis=0)
        if len(rows) > 20:
            own[rows] = middle[subject[rows[0]]]
        elif len(rows) > 1:
            own[rows] = [_usual(builds[row], builds[np.delete(rows, i)]) for i, row in enumerate(rows)]
    return middle, own


def _usual(build: Float[np.ndarray, " L"], others: Float[np.ndarray, "n L"]) -> Float[np.ndarray, " L"]:
    """The median of a subject's other builds; of two, whose middle is nobody's, the nearer one."""
    return np.median(others, axis=0) if len(others) > 2 else others[np.abs(others - build).sum(axis=1).argmin()]


def _unposed(
    registrations: Registrations, template: Template, ruler: Ruler, measures: Sequence[Any], sound: np.ndarray
) -> list[Finding]:
    """Joints that fewer than `LEAST_POSES` registrations of the pose set bend by 15 degrees from their mean."""
    posed = np.flatnonzero(sound & np.array([which == "pose" for which in registrations.set], dtype=bool))
    if len(posed) < LEAST_POSES:
        message = f"{len(posed)} in the set 'pose'; expected {LEAST_POSES} and more, for every joint to bend"
        return [Finding("warning", "the registrations", message)]
    turns = np.stack([measures[k].turns for k in posed.tolist()])
    u, _, vt = np.linalg.svd(turns.mean(axis=0, dtype=np.float64))
    u[..., 2] *= np.linalg.det(u @ vt)[:, None]
    cosine = (np.einsum("njab,jab->nj", turns, u @ vt) - 1) / 2
    bent = (cosine < np.cos(BENT)).sum(axis=0)
    return [
        Finding(
            "warning",
            template.joint_names[joint],
            f"fewer than {LEAST_POSES} poses bend this joint more than 15 degrees ({bent[joint]} of {len(posed)} do); "
            "add poses that do, or expect little of it",
        )
        for joint in range(1, template.num_joints)
        if ruler.rigid[joint] and bent[joint] < LEAST_POSES
    ]
