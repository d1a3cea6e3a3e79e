"""What processes of an archive do: look at a file, find a subject's shape, fit a capture. Each on
one thread; what is wrong with an item is its result, so that it costs no other.
"""

import json
import time
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from hashlib import blake2b
from pathlib import Path
from typing import Any

from habitus.body.model import BodyModel
from habitus.body.prior import prior_of
from habitus.errors import HabitusError, shown
from habitus.fit.markers.attempts import attempted
from habitus.fit.markers.recipe import fit_known, known_subject, warm_up
from habitus.fit.markers.result import MarkerFit
from habitus.io.captures.read import Capture
from habitus.io.captures.trc import is_fit_export
from habitus.io.layouts.draft import discovered_layout_text
from habitus.io.limits import open_file
from habitus.io.names import file_name
from habitus.jobs.archive.items import (
    ArchiveJob,
    BodyChoice,
    CaptureRef,
    Done,
    FileContent,
    Fit,
    Fitted,
    Inspect,
    KnownSubject,
    Seen,
    Shape,
    Shaped,
    Task,
    read_known,
    write_known,
)
from habitus.jobs.bodies import body_of, loaded, of_sex, with_fingers
from habitus.jobs.finding import EXPORTED, SURE, MarkerSet
from habitus.jobs.options import silent
from habitus.jobs.results import save_fit
from habitus.jobs.subjects import Agreed, Person, check_each, gather
from habitus.kernels.threads import one_thread
from habitus.report.archive import motion_picture, shape_picture

MAX_FRAMES = 200_000
"""Frames of a subject's captures that its shape stage looks at: more are left out, capture by
capture.
"""


def work(job: ArchiveJob, task: Task) -> Done:
    """What one process does with one item."""
    with one_thread():
        if isinstance(task, Inspect):
            return _inspect(job, task.path)
        return _shape(job, task) if isinstance(task, Shape) else _fit(job, task)


def digest_of(path: Path) -> str:
    """Of a file's content."""
    digest = blake2b(digest_size=16)
    with open_file(path) as file:
        while block := file.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()


def reason_of(error: Exception, path: Path) -> str:
    """Why there is no result, in one line; the file is named beside it."""
    if isinstance(error, HabitusError):
        text = str(error)
        for begin in (f"{path}: ", f"{path.name}: ", f"{path.stem}: "):
            text = text.removeprefix(begin)
        return text
    if isinstance(error, MemoryError):
        return (
            "there was too little memory for it; give each process more, and the same command again"
        )
    if isinstance(error, OSError):
        return (
            f"{error.strerror or shown(error, 200)}; check the path, its permissions and the disk"
        )
    kind = f"{type(error).__name__}: {shown(error, 200)}"
    return (
        f"{kind}; this is a fault of habitus: report it, with what habitus mosh -v says of "
        "this file alone"
    )


def _inspect(job: ArchiveJob, path: Path) -> FileContent:
    if is_fit_export(path):
        return FileContent(reason=EXPORTED, no_capture=True)
    try:
        digest = digest_of(path)
        people = job.recipe.read(path)
        return FileContent(
            digest,
            tuple(
                Seen(capture.subject, len(capture), capture.rate_hz, MarkerSet.of(capture))
                for capture in people
            ),
        )
    except Exception as error:
        return FileContent(
            reason=reason_of(error, path), no_capture=path.suffix.lower() not in SURE
        )


def _read(job: ArchiveJob, taken: CaptureRef) -> Capture:
    """The capture, under its results' name. Raises HabitusError where the file has changed since it
    was looked at.
    """
    if digest_of(taken.path) != taken.digest:
        raise HabitusError(
            "the file changed while the archive was made; give the same command again"
        )
    people = job.recipe.read(taken.path)
    if taken.person is not None:
        people = tuple(capture for capture in people if (capture.subject or "") == taken.person)
    return replace(people[0], name=file_name(taken.folder.name))


# -- a subject's shape -----------------------------------------------------------------------------


def _shape(job: ArchiveJob, task: Shape) -> Shaped:
    began = time.thread_time()
    try:
        captures, bad = _some_captures(job, task.captures)
        person, body = _together(job, captures, task, bad)
    except Exception as error:
        return Shaped(reason=reason_of(error, Path(task.name)))
    if person is None:
        return Shaped(bad=bad, reason="none of its captures can be fitted")
    try:
        return _shaped(job, task, list(captures), person, body, bad, began)
    except Exception as error:
        return Shaped(bad=bad, reason=reason_of(error, Path(task.name)))


def _some_captures(
    job: ArchiveJob, taken: Sequence[CaptureRef]
) -> tuple[dict[int, Capture], dict[int, str]]:
    """Captures by number, evenly among all where they are more than is looked at, and why others
    cannot be read.
    """
    captures: dict[int, Capture] = {}
    bad: dict[int, str] = {}
    frames = 0
    for k in _spread_order(len(taken)):
        if frames >= MAX_FRAMES:
            break
        try:
            captures[k] = _read(job, taken[k])
            frames += len(captures[k])
        except Exception as error:
            bad[k] = reason_of(error, taken[k].path)
    return dict(sorted(captures.items())), bad


def _spread_order(count: int) -> list[int]:
    """All numbers below, so that the first ones are spread over all: by their bits from behind."""
    bits = max(1, (count - 1).bit_length())
    return sorted(range(count), key=lambda k: int(f"{k:0{bits}b}"[::-1], 2))


def _together(
    job: ArchiveJob, captures: dict[int, Capture], task: Shape, bad: dict[int, str]
) -> tuple[Person | None, BodyModel]:
    """The person of all captures that can be fitted; ``captures`` loses the others, ``bad`` gains
    them.
    """
    body = fitted_body(job.body, job.recipe.joints, job.recipe.age, "neutral")
    if not captures:
        return None, body
    try:
        return _person(job, list(captures.values()), body), body
    except Exception:
        for k in list(captures):
            try:
                _person(job, [captures[k]], body)
            except Exception as error:
                bad[k] = reason_of(error, task.captures[k].path)
                del captures[k]
        return (_person(job, list(captures.values()), body) if captures else None), body


def _person(job: ArchiveJob, captures: Sequence[Capture], body: BodyModel) -> Person:
    (person,) = gather([[capture] for capture in captures], job.recipe.layout, None, body)
    check_each(person)
    return person


def _shaped(
    job: ArchiveJob,
    task: Shape,
    numbers: Sequence[int],
    person: Person,
    body: BodyModel,
    bad: dict[int, str],
    began: float,
) -> Shaped:
    recipe = job.recipe
    (person,), fingered = with_fingers([person], body, job.body, recipe.joints)
    joints = recipe.joints if fingered is body else "smplh"
    model = body_of(fingered, recipe, person, recipe.recipe_settings, silent)
    estimate = known_subject(
        model.body, prior_of(model.body), person.layout, person.recordings, recipe.recipe_settings
    )
    _, subject = estimate
    layout = subject.layout
    layout_text = (
        ""
        if person.discovery is None
        else discovered_layout_text(person.discovery, shown(task.name))
    )
    choice = BodyChoice(joints, model.body.age, model.sex, model.female_probability, model.notes)
    agreed = replace(Agreed.of(person), layout=layout)
    known = KnownSubject(
        choice,
        agreed,
        subject.shape,
        subject.exchanged,
        subject.misplaced,
        subject.seconds,
        layout_text,
    )
    digest = write_known(known, job.out / task.file)
    betas = subject.shape.betas
    return Shaped(
        digest,
        tuple(numbers[k] for k in subject.sources),
        bad,
        model.body.measure(betas),
        tuple(float(b) for b in betas),
        shape_picture(model.body, betas),
        time.thread_time() - began,
    )


# -- a capture -------------------------------------------------------------------------------------


def _fit(job: ArchiveJob, task: Fit) -> Fitted:
    began = time.thread_time()
    clock = time.perf_counter()
    try:
        capture = _read(job, task.capture)
        seconds = time.perf_counter() - clock
        fit = (
            _alone(job, capture, seconds)
            if task.file is None
            else _known(job, capture, task.file, seconds)
        )
        options = job.options
        fit = save_fit(
            fit, task.capture.folder, npz_style=options.npz_style, minimal=options.minimal
        )
        numbers = json.loads((task.capture.folder / "metrics.json").read_text("utf-8"))
        return Fitted(numbers, motion_picture(fit), time.thread_time() - began)
    except Exception as error:
        return Fitted(
            reason=reason_of(error, task.capture.path), seconds=time.thread_time() - began
        )


def _alone(job: ArchiveJob, capture: Capture, seconds: float) -> MarkerFit:
    return job.recipe.fit(capture, job.body)


def _known(job: ArchiveJob, capture: Capture, file: str, seconds: float) -> MarkerFit:
    known = _kept(job.out / file, (job.out / file).stat().st_mtime_ns)
    choice = known.choice
    settings = job.recipe.recipe_settings
    layout = known.agreed.layout
    body = fitted_body(job.body, choice.joints, choice.age, choice.sex)
    prior = prior_of(body)
    recording = known.agreed.recording(capture)
    fit = fit_known(recording, known.subject(body), settings)
    fit = attempted(fit, body, prior, layout, recording, settings, True)
    fit = replace(
        fit,
        stage_seconds={"read": seconds, **fit.stage_seconds},
        discovered_layout=known.discovered_layout,
    )
    return known.chosen(body).noted(fit)


_kept = lru_cache(maxsize=4)(lambda path, changed: read_known(path))


@lru_cache(maxsize=4)
def fitted_body(body: str, joints: str, age: Any, sex: str) -> BodyModel:
    """A body by its words (`BodyChoice`), with its kernels loaded."""
    model = of_sex(loaded(body, joints, None if age == "auto" else age), sex)
    warm_up(model)
    return model
