"""Many captures in one run: a failed capture does not stop the others; each has an
outcome.
"""

import json
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from habitus.body.model import BodyModel
from habitus.errors import HabitusError, shown
from habitus.files import locked, tidy
from habitus.fit.markers.result import MarkerFit
from habitus.io.captures.read import Capture
from habitus.io.names import file_name
from habitus.jobs.bodies import with_fingers
from habitus.jobs.finding import EXPORTED, SURE, CaptureFile, MarkerSet, find_captures, grouped
from habitus.jobs.mosh import Mosh
from habitus.jobs.options import silent
from habitus.jobs.results import capture_folders, save_fit
from habitus.jobs.subjects import Person, check_each, gather
from habitus.report import write_index
from habitus.results.save import MARKER_FILES
from habitus.types import PathLike, Progress

_Files = Mapping[CaptureFile, tuple[Capture, ...]]


@dataclass(frozen=True)
class Outcome:
    """What became of a capture: the folder of its results and the numbers in its metrics.json, or
    why there are none.

    ``left_out``: the file was found in a folder and is no capture, which is no failure.
    """

    source: Path
    name: str
    folder: Path | None = None
    numbers: Mapping[str, Any] = field(default_factory=dict)
    error: Exception | None = None
    left_out: bool = False

    @property
    def failed(self) -> bool:
        """Whether it should have been fitted and was not."""
        return self.error is not None and not self.left_out

    @property
    def reason(self) -> str:
        """Why there is no result, in one line that names the file."""
        where = shown(self.source, 300)
        text = str(self.error)
        if isinstance(self.error, HabitusError):
            for begin in (f"{where}: ", f"{self.source.name}: ", f"{self.name}: "):
                text = text.removeprefix(begin)
            return f"{where}: {text}"
        if isinstance(self.error, OSError):
            text = self.error.strerror or shown(text, 200)
            return f"{where}: {text}; check the path, its permissions and the disk"
        kind = f"{type(self.error).__name__}: {shown(text, 200)}"
        return (
            f"{where}: {kind}; this is a fault of habitus: report it, with what -v says of "
            "this file alone"
        )


def fit_all(
    recipe: Mosh,
    paths: Sequence[PathLike],
    out: PathLike,
    body: PathLike | BodyModel = "default",
    *,
    progress: Progress = silent,
    on_done: Callable[[Outcome], None] = lambda outcome: None,
) -> list[Outcome]:
    """Fit every capture among files and below folders; ``out`` receives a folder for each, as deep
    as it lay.

    Files that are given are one subject. Of a folder, captures that name the same subject and have
    their markers at the same places are one. What fails is left behind with its reason. Raises
    HabitusError where nothing can begin: no capture at all, no such layout or body, a folder that
    cannot be written to or that another run is at work in.
    """
    if not paths:
        raise HabitusError(
            "no capture was given; expected a file or a folder or more (C3D, TRC, CSV, TSV or npz)"
        )
    model = recipe.body(body)
    target = Path(out)
    recipe.check(model)
    files = find_captures([Path(path) for path in paths], target)
    outcomes: list[Outcome] = []
    with locked(target, MARKER_FILES):
        for place in {file.place for file in files}:
            tidy(target / place, MARKER_FILES)
        batch = _Batch(recipe, model, body, target, _Counted(progress, len(files), outcomes))
        for outcome in batch.run(files):
            outcomes.append(outcome)
            on_done(outcome)
        try:
            write_index(target)
        except HabitusError as error:
            outcomes.append(Outcome(target / "index.html", "index.html", error=error))
            on_done(outcomes[-1])
    return outcomes


@dataclass(frozen=True)
class _Counted:
    """Progress that says how many captures are done."""

    progress: Progress
    count: int
    done: Sequence[Outcome]

    def __call__(self, stage: str, share: float) -> None:
        self.progress(
            stage if self.count == 1 else f"{len(self.done)} of {self.count} done, {stage}", share
        )


@dataclass(frozen=True)
class _Batch:
    recipe: Mosh
    body: BodyModel
    given: PathLike | BodyModel
    out: Path
    progress: Progress

    def run(self, files: Sequence[CaptureFile]) -> Iterator[Outcome]:
        """What becomes of each, group after group."""
        given = [file for file in files if file.given]
        if given:
            yield from self._group(given)
        marker_sets: list[tuple[CaptureFile, MarkerSet | None]] = []
        for file in files:
            if file.exported:
                yield Outcome(file.path, file.name, error=HabitusError(EXPORTED), left_out=True)
            elif not file.given:
                self.progress("read", 0.0)
                try:
                    marker_sets.append((file, self._marker_set(file)))
                except Exception as error:
                    yield Outcome(
                        file.path,
                        file.name,
                        error=error,
                        left_out=file.path.suffix.lower() not in SURE,
                    )
        for group in grouped(marker_sets):
            yield from self._group(group)

    def _marker_set(self, file: CaptureFile) -> MarkerSet | None:
        """None for a file of several people, which is fitted by itself."""
        captures = self.recipe.read(file.path)
        return MarkerSet.of(captures[0]) if len(captures) == 1 else None

    def _group(self, group: Sequence[CaptureFile]) -> Iterator[Outcome]:
        files: dict[CaptureFile, tuple[Capture, ...]] = {}
        began = time.perf_counter()
        for file in group:
            self.progress("read", 0.0)
            try:
                file_name(file.name, shown(file.path))
                files[file] = tuple(replace(c, name=file.name) for c in self.recipe.read(file.path))
            except Exception as error:
                yield Outcome(file.path, file.name, error=error)
        yield from self._fitted(files, time.perf_counter() - began)

    def _fitted(self, files: _Files, seconds: float) -> Iterator[Outcome]:
        """The fits of one subject's files, which took so many seconds to read.

        Files that cannot be fitted together are fitted without those that cannot be alone. Where a
        fit breaks off, each file that is not done yet is fitted by itself.
        """
        if not files:
            return
        try:
            people, folders = self._people(files)
            people, body = with_fingers(people, self.body, self.given, self.recipe.joints)
        except Exception as error:
            yield from self._apart(files, seconds, error)
            return
        owners = {id(capture): file for file, captures in files.items() for capture in captures}
        left = {id(capture) for person in people for capture in person.captures}
        try:
            fits = self.recipe.fit_people(body, people, seconds, progress=self.progress)
            for capture, fit in fits:
                left.discard(id(capture))
                yield self._saved(owners[id(capture)], fit, folders[id(capture)])
        except Exception as error:
            for file in dict.fromkeys(owners[key] for key in owners if key in left):
                if len(files) == 1 or any(id(capture) not in left for capture in files[file]):
                    yield Outcome(file.path, file.name, error=error)
                else:
                    yield from self._fitted({file: files[file]}, seconds / len(files))

    def _people(self, files: _Files) -> tuple[list[Person], dict[int, Path]]:
        recipe = self.recipe
        people = gather(
            list(files.values()), recipe.layout, recipe.subject, self.body, self.progress
        )
        for person in people:
            check_each(person)
        place = self.out / next(iter(files)).place
        captures = [capture for person in people for capture in person.captures]
        return people, capture_folders(place, captures, len(people) > 1)

    def _apart(self, files: _Files, seconds: float, error: Exception) -> Iterator[Outcome]:
        bad: dict[CaptureFile, Exception] = {}
        for file, captures in files.items():
            try:
                self._people({file: captures})
            except Exception as its_own:
                bad[file] = its_own
                yield Outcome(file.path, file.name, error=error if len(files) == 1 else its_own)
        rest = {file: captures for file, captures in files.items() if file not in bad}
        for some in [rest] if bad else [{file: captures} for file, captures in rest.items()]:
            yield from self._fitted(some, seconds * len(some) / len(files))

    def _saved(self, file: CaptureFile, fit: MarkerFit, folder: Path) -> Outcome:
        try:
            save_fit(fit, folder, self.recipe.obj, self.recipe.npz_style)
            numbers = json.loads((folder / "metrics.json").read_text("utf-8"))
        except Exception as error:
            return Outcome(file.path, folder.name, error=error)
        return Outcome(file.path, folder.name, folder, numbers)
