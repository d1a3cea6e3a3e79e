"""Checks before training and what they report: of the template (parts, joints, sides), and of the
registrations' subjects and poses.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from habitus.learn.check_settings import CHECKS, CheckSettings
from habitus.learn.posing.rig import kinship
from habitus.mesh.registrations import Registrations
from habitus.mesh.size import Measures, Ruler
from habitus.mesh.template import Template

MAX_NAMED = 3  # names in a message


@dataclass(frozen=True)
class Finding:
    """One thing that is wrong: an "error" keeps from learning, a "warning" does not. ``name``: a
    registration, a subject, a joint, several of them, or "the registrations".
    """

    kind: Literal["error", "warning"]
    name: str
    message: str

    def __str__(self) -> str:
        return f"{self.name}: {self.message}"


def named(names: Sequence[str], limit: int = MAX_NAMED) -> str:
    """Names one after the other; beyond the first few how many more."""
    more = f" and {len(names) - limit} more" if len(names) > limit else ""
    return ", ".join(names[:limit]) + more


def check_template(template: Template, settings: CheckSettings = CHECKS) -> list[Finding]:
    """What is odd about a template. Errors: parts that are scattered over the mesh. Warnings:
    joints without vertices; pieces of parts that lie among parts far from theirs; joints called
    left on the right side.
    """
    findings = []
    if template.empty_joints:
        message = (
            "no vertex belongs to this joint; expected a part of the mesh, or a tree without it"
        )
        findings.append(Finding("warning", named(template.empty_joints, 5), message))
    return [*findings, *_scattered(template, settings), *_sides(template)]


def _scattered(template: Template, settings: CheckSettings) -> list[Finding]:
    pieces, stray = scattered(template, settings.kin)
    if pieces - len(np.unique(template.part)) > settings.max_pieces * template.num_vertices:
        message = (
            f"its {template.num_joints} parts lie in {pieces} pieces; expected parts of connected "
            "vertices, one around "
            "each bone: check the order of the array 'part'"
        )
        return [Finding("error", "the template", message)]
    lost = [k for k in range(template.num_joints) if stray[k] >= settings.min_stray]
    if not lost:
        return []
    message = (
        f"{stray[lost].sum()} vertices lie among parts of joints that are far from theirs in the "
        "tree; expected "
        "parts of connected vertices, one around each bone"
    )
    return [
        Finding("warning", f"parts of {named([template.joint_names[k] for k in lost])}", message)
    ]


def scattered(template: Template, kin: int = CHECKS.kin) -> tuple[int, Int[np.ndarray, " J"]]:
    """How many connected pieces all parts are of, and how many vertices of each part lie in pieces
    that touch only parts more than ``kin`` bones away.

    Pieces that touch nothing do not count: eyes and teeth are pieces of the mesh of their own.
    """
    pairs = template.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    parts = template.part[pairs]
    within = parts[:, 0] == parts[:, 1]
    ends = pairs[within]
    joined = coo_array(
        (np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=2 * (template.num_vertices,)
    )
    count, piece = connected_components(joined, directed=False)
    across = np.concatenate([pairs[~within], pairs[~within][:, ::-1]])
    is_related = (
        kinship(template.parents)[template.part[across[:, 0]], template.part[across[:, 1]]] <= kin
    )
    touches = np.zeros(count, bool)
    related = np.zeros(count, bool)
    touches[piece[across[:, 0]]] = True
    related[piece[across[is_related, 0]]] = True
    lost = (touches & ~related)[piece]
    return int(touches.sum()), np.bincount(template.part[lost], minlength=template.num_joints)


def _sides(template: Template) -> list[Finding]:
    words = [name.lower() for name in template.joint_names]
    across = {"left": [], "right": []}
    for joint, word in enumerate(words):
        for side, places in across.items():
            if side in word and len(rows := template.part_vertices(joint)):
                places.append(template.vertices[rows, 0].mean())
    if not (across["left"] and across["right"]) or np.mean(across["left"]) >= np.mean(
        across["right"]
    ):
        return []
    message = (
        "parts of joints called left have smaller x than those called right; expected x to the "
        "body's left: turn the "
        "template so that it faces +z, or exchange the names"
    )
    return [Finding("warning", "the template", message)]


def subject_findings(registrations: Registrations) -> list[Finding]:
    """Subjects of two sexes (errors), and those of the pose set with one pose."""
    findings = []
    sexes: dict[str, dict[str, list[str]]] = {}
    poses: dict[str, int] = {}
    r = registrations
    for subject, sex, which, name in zip(r.subject, r.sex, r.set, r.name, strict=True):
        sexes.setdefault(subject, {}).setdefault(sex, []).append(name)
        if which == "pose":
            poses[subject] = poses.get(subject, 0) + 1
    for subject, by_sex in sexes.items():
        if len(by_sex) > 1:
            counts = sorted(
                ((len(names), sex or "unknown", names[0]) for sex, names in by_sex.items()),
                reverse=True,
            )
            words = " and ".join(f"{sex} in {count} (first {name})" for count, sex, name in counts)
            findings.append(
                Finding("error", subject, f"the sex of this subject is {words}; expected one")
            )
    single = [subject for subject, count in poses.items() if count == 1]
    if single:
        message = "one pose only; expected several of a subject of the pose set, or the set 'shape'"
        findings.append(Finding("warning", _many(single, "subjects"), message))
    return findings


def mislabelled(
    registrations: Registrations,
    measures: Sequence[Any],
    sound: Bool[np.ndarray, " N"],
    settings: CheckSettings = CHECKS,
) -> list[Finding]:
    """Registrations far from their own subject's build and near another's.

    A build is compared with the median of its subject's others, and with other subjects' medians,
    in spreads within subjects. Far and near are meant so that two alike people who are mixed up go
    unnoticed rather than one person in an odd pose is blamed.
    """
    rows = np.flatnonzero(sound)
    if not len(rows):
        return []
    builds = np.stack([measures[k].build for k in rows.tolist()]).astype(np.float64)
    builds = builds[:, np.isfinite(builds).all(axis=0)]
    subject = registrations.subject_index[rows]
    middle, of_others = _medians(builds, subject, len(registrations.subjects), settings.many_rows)
    several = np.flatnonzero(np.isfinite(of_others).all(axis=1))
    if not len(several) or not builds.shape[1]:
        return []
    gaps = np.abs(builds[several] - of_others[several])
    spread = settings.spread_factor * np.quantile(gaps, settings.spread_quantile, axis=0)
    spread = np.maximum(spread, settings.min_spread)
    mine = _distance(gaps, spread, settings.max_spreads)
    findings = []
    for i in np.flatnonzero(mine > settings.far * np.median(mine)).tolist():
        k = int(several[i])
        others = _distance(np.abs(middle - builds[k]), spread, settings.max_spreads)
        others[subject[k]] = np.inf
        nearest = int(np.nanargmin(others))
        if others[nearest] < settings.near * mine[i]:
            name = registrations.subjects[subject[k]]
            alike = registrations.subjects[nearest]
            message = (
                f"its subject is {name} but its build is that of {alike} ({others[nearest]:.2f} "
                "spreads from it, "
                f"{mine[i]:.2f} from {name}); check its subject"
            )
            findings.append(Finding("error", registrations.name[rows[k]], message))
    return findings


def _distance(
    gaps: Float[np.ndarray, "n L"], spread: Float[np.ndarray, " L"], limit: float
) -> Float[np.ndarray, " n"]:
    """The mean gap in spreads, none of them counting for more than ``limit``."""
    return np.minimum(gaps / spread, limit).mean(axis=1)


def _medians(
    builds: Float[np.ndarray, "n L"], subject: Int[np.ndarray, " n"], subjects: int, many: int
) -> tuple[Float[np.ndarray, "S L"], Float[np.ndarray, "n L"]]:
    """Each subject's median, and for each row that of its subject's other rows; NaN where there are
    none. Of more than ``many`` rows a single one does not change the median.
    """
    middle = np.full((subjects, builds.shape[1]), np.nan)
    of_others = np.full(builds.shape, np.nan)
    order = np.argsort(subject, kind="stable")
    for rows in np.split(order, np.flatnonzero(np.diff(subject[order])) + 1):
        middle[subject[rows[0]]] = np.median(builds[rows], axis=0)
        if len(rows) > many:
            of_others[rows] = middle[subject[rows[0]]]
        elif len(rows) > 1:
            of_others[rows] = [
                _usual(builds[row], builds[np.delete(rows, i)]) for i, row in enumerate(rows)
            ]
    return middle, of_others


def _usual(
    build: Float[np.ndarray, " L"], others: Float[np.ndarray, "n L"]
) -> Float[np.ndarray, " L"]:
    """The median of a subject's other builds; of two, whose middle is nobody's, the nearer one."""
    return (
        np.median(others, axis=0)
        if len(others) > 2
        else others[np.abs(others - build).sum(axis=1).argmin()]
    )


def unposed(
    registrations: Registrations,
    template: Template,
    ruler: Ruler,
    measures: Sequence[Any],
    sound: np.ndarray,
    settings: CheckSettings = CHECKS,
) -> list[Finding]:
    """Joints that fewer than ``min_poses`` registrations of the pose set bend by ``bent_deg`` from
    their mean.
    """
    least_poses = settings.min_poses
    posed = np.flatnonzero(
        sound & np.array([which == "pose" for which in registrations.set], dtype=bool)
    )
    if len(posed) < least_poses:
        message = (
            f"{len(posed)} in the set 'pose'; expected {least_poses} and more, for every "
            "joint to bend"
        )
        return [Finding("warning", "the registrations", message)]
    turns = np.stack([measures[k].turns for k in posed.tolist()])
    u, _, vt = np.linalg.svd(np.nan_to_num(np.nanmean(turns, axis=0, dtype=np.float64)))
    u[..., 2] *= np.linalg.det(u @ vt)[:, None]
    cosine = (np.einsum("njab,jab->nj", turns, u @ vt) - 1) / 2
    bent = (cosine < np.cos(np.deg2rad(settings.bent_deg))).sum(axis=0)
    stiff = [
        joint
        for joint in range(1, template.num_joints)
        if ruler.rigid[joint] and bent[joint] < least_poses
    ]
    stiff.sort(key=lambda joint: bent[joint])
    if not stiff:
        return []
    these, least = (
        ("this joint", bent[stiff[0]])
        if len(stiff) == 1
        else ("each of these joints", bent[stiff].min())
    )
    message = (
        f"fewer than {least_poses} poses bend {these} more than {settings.bent_deg:g} degrees "
        f"({least} of {len(posed)} do"
        f"{' at the least' if len(stiff) > 1 else ''}); add poses that do, or expect little of "
        f"{'it' if len(stiff) == 1 else 'them'}"
    )
    return [
        Finding(
            "warning",
            _many([template.joint_names[joint] for joint in stiff], "joints"),
            message,
        )
    ]


def duplicates(
    registrations: Registrations,
    measures: Sequence[Any],
    sound: Bool[np.ndarray, " N"],
    same_length: float = CHECKS.same,
) -> list[Finding]:
    """Meshes that are there twice, wherever they stand: all their parts are built and turned
    alike.
    """
    rows = np.flatnonzero(sound)
    order = rows[np.argsort([measures[k].strain for k in rows.tolist()], kind="stable")].tolist()
    same: dict[int, int] = {}
    for place, k in enumerate(order):
        for other in order[place + 1 :]:
            if measures[other].strain - measures[k].strain > same_length:
                break
            if other not in same and _alike(measures[k], measures[other], same_length):
                same[other] = k
    if not same:
        return []
    pairs = [
        f"{registrations.name[max(pair)]} is {registrations.name[min(pair)]}"
        for pair in sorted(same.items())
    ]
    count = "1 mesh is" if len(same) == 1 else f"{len(same)} meshes are"
    message = (
        f"{count} there twice ({named(pairs)}); leave copies out: they add no information and "
        "count twice"
    )
    return [Finding("warning", "the registrations", message)]


def _alike(measures: Measures, other: Measures, same_length: float) -> bool:
    return all(
        np.allclose(getattr(measures, key), getattr(other, key), rtol=0, atol=atol, equal_nan=True)
        for key, atol in (("build", same_length), ("turns", 10 * same_length))
    )


def _many(names: Sequence[str], what: str) -> str:
    """A few names as they are; of many the number and the first."""
    return ", ".join(names) if len(names) <= 3 else f"{len(names)} {what} ({named(names)})"
