"""From capture files to moving bodies on disk: read, fit, write. The command and ``habitus.mosh`` both call this."""

import os
import re
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from habitus.body.model import BodyModel
from habitus.errors import HabitusError
from habitus.export import write_glb, write_npz, write_obj_sequence
from habitus.fit.mosh.hold_out import held_out_errors, merged
from habitus.fit.mosh.recipe import fit_markers, iterate_fits
from habitus.fit.mosh.result import HeldOut, MarkerFit
from habitus.fit.mosh.settings import MoshSettings
from habitus.fit.mosh.warm_up import warm_up
from habitus.io.captures.read import Capture, read_captures
from habitus.io.files import writable_folder
from habitus.io.models.bodies import load_body
from habitus.io.models.priors import load_pose_prior
from habitus.jobs.subjects import Person, gather, leave_out
from habitus.report import write_metrics, write_report
from habitus.types import PathLike, Progress

GENDERS = ("neutral", "female", "male", "auto")


def mosh(
    captures: PathLike | Sequence[PathLike],
    out: PathLike | None = None,
    *,
    layout: PathLike = "auto",
    body: PathLike | BodyModel = "default",
    gender: str = "neutral",
    soft_tissue: bool = True,
    causal: bool = False,
    hold_out: Sequence[str] = (),
    hold_out_every: int | None = None,
    subject: str | None = None,
    rate_hz: float | None = None,
    obj: bool = False,
    seed: int = 0,
    progress: Progress = lambda stage, share: None,
) -> list[MarkerFit]:
    """Fit a body to the captures of one subject and, where ``out`` is given, write what comes out.

    captures: C3D, TRC, CSV, TSV or npz files; several are one subject with one shape. Where a file holds several
    people, each is fitted by itself, or only the one named ``subject``. layout: "auto", a shipped name or a file.
    hold_out leaves markers out of everything and reports their error; hold_out_every does so for all, one in so many
    at a time. Each fit lies in ``out/<capture's name>/``. Raises HabitusError with one clear line on bad input.
    """
    paths = [captures] if isinstance(captures, str | os.PathLike) else list(captures)
    if not paths:
        raise HabitusError("no capture was given; expected one file or more (C3D, TRC, CSV, TSV or npz)")
    model = body if isinstance(body, BodyModel) else load_body(body)
    _check_gender(gender)
    folder = None if out is None else writable_folder(Path(out))
    progress("read", 0.0)
    began = time.perf_counter()
    people = gather([read_captures(path, rate_hz=rate_hz) for path in paths], layout, subject)
    read_seconds = time.perf_counter() - began
    settings = MoshSettings(soft_tissue=soft_tissue and not causal, causal=causal, seed=seed)
    found = [capture for person in people for capture in person.captures]
    folders = {} if folder is None else _folders(found, len(people) > 1)
    progress("start", 0.0)
    startup = warm_up(model)
    fits = []
    for person in people:
        for fit, capture in zip(
            _fits(model, person, settings, hold_out, hold_out_every, progress), person.captures, strict=True
        ):
            seconds = {"read": read_seconds / len(found), **fit.stage_seconds}
            fit = replace(fit, stage_seconds=seconds, startup_seconds=startup, recorded=dict(capture.recorded))
            fits.append(fit if folder is None else write(fit, folder / folders[id(capture)], obj=obj))
    return fits


def _fits(
    body: BodyModel,
    person: Person,
    settings: MoshSettings,
    labels: Sequence[str],
    every: int | None,
    progress: Progress,
) -> Iterator[MarkerFit]:
    """A person's fits, one after another, with the errors of held-out markers where they were asked for."""
    prior = body.pose_prior or load_pose_prior()
    if labels:
        kept, held = leave_out(person, labels)
        fits = iterate_fits(body, prior, kept.layout, kept.recordings, settings, progress)
        for fit, observed in zip(fits, held.observed, strict=True):
            yield replace(fit, held_out=held_out_errors(fit, held.layout, observed))
        return
    rotated = None if every is None else rotate_hold_out(body, person, every, settings, progress)
    for index, fit in enumerate(iterate_fits(body, prior, person.layout, person.recordings, settings, progress)):
        yield fit if rotated is None else replace(fit, held_out=rotated[index])


def rotate_hold_out(
    body: BodyModel,
    person: Person,
    every: int,
    settings: MoshSettings,
    progress: Progress = lambda stage, share: None,
) -> list[HeldOut]:
    """Each marker's held-out error, one in ``every`` left out at a time: ``every`` fits of each capture."""
    if not 2 <= every <= len(person.layout):
        raise HabitusError(
            f"hold-out-every is {every}; expected 2 to {len(person.layout)}, the number of matched markers"
        )
    folds = []
    for k in range(every):
        progress(f"hold out {k + 1} of {every}", k / every)
        kept, held = leave_out(person, person.layout.labels[k::every])
        fits = fit_markers(body, body.pose_prior or load_pose_prior(), kept.layout, kept.recordings, settings)
        folds.append([held_out_errors(fit, held.layout, o) for fit, o in zip(fits, held.observed, strict=True)])
    return [merged([fold[r] for fold in folds]) for r in range(len(person.captures))]


def write(fit: MarkerFit, folder: Path, obj: bool = False) -> MarkerFit:
    """body.npz, body.glb, metrics.json and report.html, each written whole; the fit comes back with its export time."""
    began = time.perf_counter()
    write_npz(fit, folder / "body.npz")
    write_glb(fit, folder / "body.glb")
    if obj:
        write_obj_sequence(fit, folder / "obj")
    write_report(fit, folder / "report.html")
    exported = time.perf_counter() - began
    seconds = {**fit.stage_seconds, "export": exported}
    fit = replace(fit, stage_seconds={**seconds, "total": sum(v for v in seconds.values() if v)})
    write_metrics(fit, folder / "metrics.json")
    return fit


def _folders(captures: Sequence[Capture], several: bool) -> dict[int, str]:
    """The folder of each capture, by its id: its name, and with several people that of its person."""
    names = {}
    for capture in captures:
        name = f"{capture.name}_{capture.subject or 'unnamed'}" if several else capture.name
        names[id(capture)] = re.sub(r"[/\\:\0]", "_", name)
    twice = sorted({name for name in names.values() if list(names.values()).count(name) > 1})
    if twice:
        raise HabitusError(
            f"several captures are called {', '.join(twice)}, so their results would overwrite each other; "
            "expected names that differ; rename one, or fit them in separate runs"
        )
    return names


def _check_gender(gender: str) -> None:
    if gender not in GENDERS:
        raise HabitusError(f"gender is {gender!r}; expected one of {', '.join(GENDERS)}")
    if gender in ("female", "male"):
        raise HabitusError(f"this body has no {gender} model, only a neutral one; leave --gender at neutral or auto")
