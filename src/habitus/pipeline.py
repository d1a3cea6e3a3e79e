"""From capture files to moving bodies on disk: read, fit, write. The command and ``habitus.mosh`` both call this."""

import os
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from habitus.body.model import BodyModel
from habitus.errors import HabitusError
from habitus.export import write_glb, write_npz, write_obj_sequence
from habitus.fit.holdout import hold_out, hold_out_by_rotation
from habitus.fit.mosh import fit_markers
from habitus.fit.result import MarkerFit
from habitus.fit.settings import MoshSettings
from habitus.io.captures import Capture, read_captures
from habitus.io.models import load_body
from habitus.io.priors import load_pose_prior
from habitus.people import Person, gather
from habitus.report import write_metrics, write_report

PathLike = str | os.PathLike[str]
Progress = Callable[[str, float], None]
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
    hold_out_labels: Sequence[str] = (),
    hold_out_every: int | None = None,
    subject: str | None = None,
    rate_hz: float | None = None,
    obj: bool = False,
    seed: int = 0,
    progress: Progress = lambda stage, share: None,
) -> list[MarkerFit]:
    """Fit a body to the captures of one subject and, where ``out`` is given, write what comes out.

    captures: C3D, TRC, CSV, TSV or npz files; several are one subject with one shape. Where a file holds several people,
    each is fitted by itself, or only the one named ``subject``. layout: "auto", a shipped name or a file. hold_out_labels
    leaves markers out of everything and reports their error; hold_out_every does so for all, one in so many at a time.
    Each fit lies in ``out/<capture's name>/``. Raises HabitusError with one clear line on bad input.
    """
    began = time.perf_counter()
    paths = [captures] if isinstance(captures, str | os.PathLike) else list(captures)
    model = body if isinstance(body, BodyModel) else load_body(body)
    _check_gender(gender)
    folder = None if out is None else _writable(Path(out))
    progress("read", 0.0)
    people = gather([read_captures(path, rate_hz=rate_hz) for path in paths], layout, subject)
    read_seconds = time.perf_counter() - began
    settings = MoshSettings(soft_tissue=soft_tissue and not causal, causal=causal, seed=seed)
    fits = []
    for person in people:
        for fit, capture in zip(
            _fit(model, person, settings, hold_out_labels, hold_out_every, progress), person.captures, strict=True
        ):
            seconds = {"read": read_seconds / sum(len(p.captures) for p in people), **fit.stage_seconds}
            fit = replace(fit, stage_seconds=seconds, recorded=dict(capture.recorded))
            fits.append(fit if folder is None else write(fit, folder / _folder_name(capture, people), obj=obj))
    return fits


def _fit(
    body: BodyModel,
    person: Person,
    settings: MoshSettings,
    labels: Sequence[str],
    every: int | None,
    progress: Progress,
) -> list[MarkerFit]:
    prior = load_pose_prior()
    if labels:
        return list(hold_out(body, prior, person.layout, person.recordings, labels, settings))
    fits = fit_markers(body, prior, person.layout, person.recordings, settings, progress)
    if every is None:
        return list(fits)
    held = hold_out_by_rotation(body, prior, person.layout, person.recordings, every, settings)
    return [replace(fit, held_out=out) for fit, out in zip(fits, held, strict=True)]


def write(fit: MarkerFit, folder: Path, obj: bool = False) -> MarkerFit:
    """body.npz, body.glb, metrics.json and report.html of one fit, each written whole; gives the fit back with its export time."""
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


def _folder_name(capture: Capture, people: Sequence[Person]) -> str:
    return capture.name if len(people) == 1 else f"{capture.name}_{capture.subject}"


def _writable(folder: Path) -> Path:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise HabitusError(f"cannot write to {folder}: {error.strerror}; choose another folder with --out") from error
    if not os.access(folder, os.W_OK | os.X_OK):
        raise HabitusError(f"cannot write to {folder}: permission denied; choose another folder with --out")
    return folder


def _check_gender(gender: str) -> None:
    if gender not in GENDERS:
        raise HabitusError(f"gender is {gender!r}; expected one of {', '.join(GENDERS)}")
    if gender in ("female", "male"):
        raise HabitusError(f"this body has no {gender} model, only a neutral one; leave --gender at neutral or auto")
