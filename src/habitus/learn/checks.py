"""Checks of registrations before training: faults are reported by the registration's name."""

from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from habitus.errors import HabitusError
from habitus.learn.check_settings import CHECKS, CheckSettings
from habitus.learn.findings import (
    Finding,
    check_template,
    duplicates,
    mislabelled,
    subject_findings,
    unposed,
)
from habitus.mesh.registrations import Registrations
from habitus.mesh.size import Measures, Ruler
from habitus.mesh.template import Template

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
_MAX_NAMED = 5  # errors in a message


def check_registrations(
    registrations: Registrations,
    template: Template,
    *,
    over: Callable[[Callable, Iterable], Iterable] = map,
    settings: CheckSettings = CHECKS,
) -> list[Finding]:
    """All that is wrong with registrations and their template, errors first.

    Errors: another topology than the template's; parts scattered over the mesh; vertices that are
    infinite; more holes than vertices; another unit than metres; a mesh that is broken (collapsed,
    torn, its vertices in another order, a mirror image); a registration under the name of one
    subject with the build of another; a subject of two sexes. Warnings: oddities of the template
    (`check_template`); joints that hardly bend in the pose set; subjects with one pose; meshes that
    are there twice; another axis up, or faced, than the template's; holes. One registration is in
    memory at a time; ``over`` maps a function over registrations, in order (on threads, say).
    """
    findings = [*check_template(template, settings), *subject_findings(registrations)]
    other = other_topology(registrations, template)
    if other:
        return [Finding("error", "the registrations", other), *findings]
    ruler = Ruler(template)
    measures = list(over(partial(_measure, ruler, registrations), range(len(registrations))))
    posed = registrations.made.tolist()
    wrong = [
        _fault(measure, template.num_vertices, made, settings)
        for measure, made in zip(measures, posed, strict=True)
    ]
    findings += [
        Finding("error", name, fault)
        for name, fault in zip(registrations.name, wrong, strict=True)
        if fault
    ]
    sound = np.array([not fault for fault in wrong], dtype=bool)
    findings += mislabelled(registrations, measures, sound, settings)
    findings += unposed(registrations, template, ruler, measures, sound, settings)
    findings += duplicates(registrations, measures, sound, settings.same)
    findings += _frame(measures, sound, settings)
    findings += _holes(registrations, measures, sound)
    return sorted(findings, key=lambda finding: finding.kind != "error")


def refuse(findings: Sequence[Finding]) -> None:
    """Raise HabitusError, in one line, where there are errors among the findings."""
    errors = [str(finding) for finding in findings if finding.kind == "error"]
    if errors:
        more = f"; and {len(errors) - _MAX_NAMED} more" if len(errors) > _MAX_NAMED else ""
        count = "1 error" if len(errors) == 1 else f"{len(errors)} errors"
        raise HabitusError(f"{count} in the registrations: {'; '.join(errors[:_MAX_NAMED])}{more}")


def other_topology(registrations: Registrations, template: Template) -> str | None:
    """Difference between the registrations' topology and the template's as text; None where they
    agree.

    The order of the faces, and at which corner each begins, do not matter.
    """
    if registrations.num_vertices != template.num_vertices:
        return (
            f"{registrations.num_vertices} vertices, the template has {template.num_vertices}; "
            "expected registrations of this template"
        )
    if len(registrations.faces) != len(template.faces):
        return (
            f"{len(registrations.faces)} faces, the template has {len(template.faces)}; "
            "expected the same ones"
        )
    off = len(_from_least(template.faces) - _from_least(registrations.faces))
    return (
        f"{off} of {len(template.faces)} faces are not the template's; expected the same ones"
        if off
        else None
    )


def _from_least(faces: Int[np.ndarray, "F 3"]) -> set[tuple[int, ...]]:
    """Faces that begin at their least corner."""
    turned = np.take_along_axis(faces, (faces.argmin(axis=1)[:, None] + np.arange(3)) % 3, axis=1)
    return set(map(tuple, turned.tolist()))


def _measure(ruler: Ruler, registrations: Registrations, k: int) -> Measures | str:
    """The measures of a registration, or why it cannot be read."""
    try:
        vertices, weight = registrations.read_seen(k)
        if (
            weight is not None and registrations.made[k]
        ):  # what does not count lies where it should all the same
            vertices = registrations.read(k)
            weight = np.isfinite(vertices).all(1).astype(np.float64)
            vertices[weight == 0] = 0.0
        return ruler.measure(vertices, None if weight is None else np.asarray(weight > 0))
    except HabitusError as error:
        return str(error)


def _fault(
    measures: Measures | str, vertices: int, made: bool, settings: CheckSettings
) -> str | None:
    """The fault of one registration by itself, or None. One that was ``made`` may be folded up as
    nobody is scanned.
    """
    if isinstance(measures, str):
        return measures
    m = measures
    if m.bad:
        return (
            f"{m.bad} {'vertex is' if m.bad == 1 else 'vertices are'} not finite; repair or leave "
            "it out"
        )
    if m.holes > settings.max_holes * vertices:
        return (
            f"{m.holes} of its {vertices} vertices are holes; expected "
            f"{settings.max_holes:.0%} of them or less: leave it out"
        )
    if min(m.extent, m.edge) < settings.min_size:
        return "its vertices are collapsed to a point or a line; repair or leave it out"
    least, most = settings.edge
    if not least < m.edge < most and m.strain < settings.max_strain:
        factor = min(_UNITS, key=lambda factor: abs(np.log(m.edge / factor)))
        problems = (
            f"it seems to be {_UNITS[factor]}"
            if abs(np.log(m.edge / factor)) < np.log(settings.unit_ratio)
            else "no known unit"
        )
        return (
            f"its edges are {m.edge:.4g} times the template's: {problems}; expected metres: say "
            "its unit"
        )
    if m.short > settings.max_short:
        return f"{m.short:.0%} of its edges are collapsed to a point; repair or leave it out"
    if m.edge > settings.edge_over_extent * m.extent and not (
        made and m.strain < settings.max_strain
    ):
        return (
            f"its edges are {m.edge:.3g} times as long as the template's, its whole "
            f"{m.extent:.3g} times as large; "
            "expected the template's vertices, each in its place in the order and on the surface"
        )
    if m.flying:
        return f"{m.flying} of its edges cross the body: vertices fly off; repair or leave it out"
    if m.long > settings.max_long or m.strain > settings.max_strain:
        return (
            f"its edges are {m.strain:.0%} off the template's in the mean, {m.long:.1%} over 5 "
            "times as long; "
            "repair or leave it out"
        )
    if m.mirrored > settings.max_mirrored:
        return "it is a mirror image of the template (left for right); flip one axis"
    return None


def _frame(
    measures: Sequence[Any], sound: Bool[np.ndarray, " N"], settings: CheckSettings
) -> list[Finding]:
    """Registrations that stand in another frame than the template's: z up, say, or all facing
    backwards.
    """
    turns = [measures[k].upright for k in np.flatnonzero(sound).tolist()]
    if not turns:
        return []
    up, front = (_axis(np.mean(turns, axis=0)[:, column], settings) for column in (1, 2))
    if up in ("", "+y") and (up == "" or front in ("", "+z")):
        return []
    faced = f" and face {front}" if front else ""
    message = (
        f"they stand with {up} up{faced}; expected +y up, facing +z, as the template: turn them, "
        "or their roots' poses "
        "will all hold that turn"
    )
    return [Finding("warning", "the registrations", message)]


def _axis(mean: Float[np.ndarray, " 3"], settings: CheckSettings) -> str:
    """The axis that a mean direction lies along; "" where directions differ, or lie along none."""
    length = float(np.linalg.norm(mean))
    k = int(np.abs(mean).argmax())
    along = np.cos(np.deg2rad(settings.axis_deg)) * length
    clear = length > settings.aligned and abs(mean[k]) > along
    return f"{'-' if mean[k] < 0 else '+'}{'xyz'[k]}" if clear else ""


def _holes(
    registrations: Registrations, measures: Sequence[Any], sound: Bool[np.ndarray, " N"]
) -> list[Finding]:
    holes = {
        registrations.name[k]: measures[k].holes
        for k in np.flatnonzero(sound).tolist()
        if measures[k].holes
    }
    if not holes:
        return []
    most = max(holes, key=lambda name: holes[name])
    share = np.array([*holes.values()]) / registrations.num_vertices
    many = f"{len(holes)} registrations have" if len(holes) > 1 else "1 registration has"
    message = (
        f"{many} holes: {share.mean():.1%} of the vertices on average, most {most} "
        f"({share.max():.1%})"
    )
    return [Finding("warning", "the registrations", message)]
