"""Registers scans: from files to surfaces in the body's topology, for training and measuring."""

import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any, Self

from habitus.body.model import BodyModel
from habitus.body.prior import prior_of
from habitus.body.state import BodyState
from habitus.errors import HabitusError
from habitus.fit.points.scan import Scan
from habitus.fit.points.scan_colours import check_colours, with_colours
from habitus.fit.points.scan_result import ScanFit
from habitus.fit.points.scan_states import simpler
from habitus.fit.points.scans import Registrar
from habitus.fit.points.settings import CLOTHES, SCANS, ScanSettings
from habitus.io.models.bodies import SHIPPED, SHIPPED_BETAS, save_body
from habitus.io.names import file_name, one_file
from habitus.io.registrations.open import write_registrations
from habitus.io.scans import read_scan, scans_in
from habitus.jobs.bodies import loaded
from habitus.jobs.coregister import coregistered, registrations
from habitus.jobs.options import RegisterOptions, takes
from habitus.jobs.results import with_methods
from habitus.kernels.threads import one_blas_thread
from habitus.parallel.workers import map_on_threads
from habitus.report.registration import scan_page
from habitus.results.save import SCAN_FILES, result_lock, save_scan
from habitus.types import PathLike, Progress

DATASET = "registrations.npz"
"""What `habitus train` reads, beside the folders of the scans."""
TRAINED = "coregistered.npz"
"""The body that coregistration trains."""
SEXES = ("female", "male")
EXCLUSIVE = {
    ("separate", "sequence"): "a sequence is of one person",
    ("separate", "texture"): "colours are compared within one person",
    ("coregister", "separate"): "coregister takes a folder for each person",
    ("coregister", "sequence"): "coregister takes scans in no order",
    ("coregister", "texture"): "coregister takes no colours",
}
"""Options that exclude each other, and why."""


class ScanResult(ScanFit):
    """A registered scan that can write itself."""

    @classmethod
    def of(cls, fit: ScanFit) -> Self:
        """The same scan, with the method."""
        return with_methods(cls, fit)

    def save(self, folder: PathLike) -> None:
        """Write body.npz, surface.ply, model.ply, rest.ply, surface.glb, metrics.json, report.html.

        Raises HabitusError where the folder cannot be written.
        """
        save_scan(self, folder, scan_page)


@takes(RegisterOptions)
def register_scans(
    scans: Sequence[Scan | PathLike] | Scan | PathLike,
    body: BodyModel | PathLike = "default",
    *,
    options: RegisterOptions,
    out: PathLike | None = None,
    progress: Progress = lambda stage, share: None,
) -> list[ScanResult]:
    """Scans of a person registered to a body: surfaces in its topology, one shape, a pose each (T
    5.4).

    scans: files (ply, obj, stl, glb, gltf, off, xyz), folders of such, or `Scan`\\ s: points (N, 3)
    in any unit and axes. body: a model, a file, "neutral", "female", "male", or "default": the best
    of these three. out: a folder that receives ``SCAN/`` with body.npz, surface.ply, surface.glb,
    model.ply, rest.ply, metrics.json and report.html, and registrations.npz, which ``habitus
    train`` reads. Raises HabitusError for data that are no scan of a person, where that can be
    known before a fit; after it, see the verdict and ``status``.
    """
    sex = options.sex or ""
    if sex not in ("", *SEXES):
        raise HabitusError(f"sex is {sex!r}; expected {' or '.join(SEXES)}, or nothing")
    for one, other in EXCLUSIVE:
        if getattr(options, one) and getattr(options, other):
            raise HabitusError(
                f"{one} and {other} were given; expected one of them: {EXCLUSIVE[one, other]}"
            )
    given = [scans] if isinstance(scans, Scan | str | os.PathLike) else list(scans)
    if not given:
        raise HabitusError("no scans were given; expected files, folders or points")
    with result_lock(out, SCAN_FILES):
        people = _people(given, options)
        read = [scan for each in people.values() for scan in each]
        if options.texture:
            check_colours(read)
        names = _folders(people, options, Path(out)) if out is not None else []
        settings = options.settings or SCANS
        if options.clothes != "none":
            settings = replace(settings, clothes=CLOTHES[options.clothes])
        registrar = made_ready(body, options.age, settings, staged=not options.coregister)
        with one_blas_thread():
            fits, trained = _registered(registrar, people, options, progress)
            if options.texture:
                progress("colours", 0.9)
                fits = with_colours(
                    registrar.settled(next((fit for fit in fits if fit.person), fits[0])),
                    fits,
                    read,
                )
        results = [ScanResult.of(fit) for fit in fits]
        if out is not None:
            for fit, name in zip(results, names, strict=True):
                fit.save(Path(out) / name)
            subjects = names
            if not options.separate:
                whole = file_name(Path(out).resolve().name)
                subjects = [person or whole for person, each in people.items() for _ in each]
            write_registrations(registrations(fits, names, subjects, sex), Path(out) / DATASET)
            if trained is not None:
                save_body(trained, Path(out) / TRAINED)
        progress("done", 1.0)
        return results


def _registered(
    registrar: Registrar,
    people: Mapping[str, Sequence[Scan]],
    options: RegisterOptions,
    progress: Progress,
) -> tuple[list[ScanFit], BodyModel | None]:
    """The fits of all scans, and the body that was trained on them (None: none was)."""
    asked = {"unit": options.unit, "up": options.up, "seed": options.seed}
    if options.coregister:
        done = coregistered(replace(registrar, others=()), people, asked, progress)
        return [fit for each in done.fits.values() for fit in each], done.body
    run = _in_time if options.sequence else _together
    return [fit for each in people.values() for fit in run(registrar, each, asked, progress)], None


def _people(given: Sequence[Scan | PathLike], options: RegisterOptions) -> dict[str, list[Scan]]:
    """The scans of each person."""
    if options.coregister:
        names = [each.name if isinstance(each, Scan) else Path(each).stem for each in given]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise HabitusError(
                f"several people are called {', '.join(twice)}; expected folders whose names differ"
            )
        return {name: _read(each) for name, each in zip(names, given, strict=True)}
    scans = [one for each in given for one in _read(each)]
    return {str(k): [scan] for k, scan in enumerate(scans)} if options.separate else {"": scans}


def made_ready(
    body: BodyModel | PathLike = "default",
    age: float | None = None,
    settings: ScanSettings = SCANS,
    *,
    staged: bool = True,
) -> Registrar:
    """A body prepared for registration; of "default" women's and men's, too, whichever explains
    scans best.

    With ``staged``, bodies by name end with finger joints and all their betas, and a body that is
    given with them is only then fitted in them: poses are sought, and the first stages run, without
    (`simpler`).
    """

    def ready(one: BodyModel | PathLike) -> Registrar:
        model = loaded(one, age=age)
        by_name = isinstance(one, str) and one in SHIPPED
        if not staged or (not by_name and simpler(model) is model):
            return Registrar.of(model, prior_of(model), settings)

        @cache
        def detailed() -> Registrar:
            whole = loaded(one, "smplh", age, SHIPPED_BETAS) if by_name else model
            return Registrar.of(whole, prior_of(whole), settings)

        first = simpler(model)
        return replace(Registrar.of(first, prior_of(first), settings), detailed=detailed)

    others = SEXES if isinstance(body, str) and body == "default" else ()
    first, *rest = map_on_threads(ready, (body, *others))
    return replace(first, others=tuple(rest))


def _read(one: Scan | PathLike) -> list[Scan]:
    return [one] if isinstance(one, Scan) else [read_scan(path) for path in scans_in([one])]


def _folders(
    people: Mapping[str, Sequence[Scan]], options: RegisterOptions, out: Path
) -> list[str]:
    """A folder's name for each scan. Raises HabitusError where two would share one."""
    titles = [
        f"{person}_{scan.name}" if options.coregister else scan.name
        for person, each in people.items()
        for scan in each
    ]
    names = [file_name(title, f"the scan {title!r}") for title in titles]
    twice = one_file(names, out)
    if twice:
        raise HabitusError(
            f"several scans are called {', '.join(twice)}; expected names that differ; rename one"
        )
    return names


def _together(
    registrar: Registrar, scans: Sequence[Scan], asked: Mapping[str, Any], progress: Progress
) -> list[ScanFit]:
    """All scans of a person at once."""
    return registrar.register(scans, **asked, progress=progress)


def _in_time(
    registrar: Registrar, scans: Sequence[Scan], asked: Mapping[str, Any], progress: Progress
) -> list[ScanFit]:
    """One scan after the other, each from the state of the one before and coupled to it, upright as
    the first was.
    """
    fits: list[ScanFit] = []
    for k, scan in enumerate(scans):
        previous = None
        here = dict(asked)
        if fits:
            last = fits[-1]
            previous = BodyState(last.betas, last.pose[None], last.trans[None])
            here["up"], registrar = last.up_axis, registrar.settled(last).after(last)
        fits += registrar.register([scan], **here, previous=previous)
        progress("sequence", k / len(scans))
    return fits
