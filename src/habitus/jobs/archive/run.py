"""An archive: every capture below a folder, fitted subject by subject, in parallel processes."""

import json
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from functools import cache
from hashlib import blake2b
from pathlib import Path
from typing import Any

from habitus import __version__
from habitus.errors import HabitusError, check_extra
from habitus.files import locked, tidy
from habitus.io.names import escaped, file_name
from habitus.jobs.archive.grouping import SubjectsTable, grouped_by_subject, read_subjects
from habitus.jobs.archive.items import (
    ArchiveJob,
    CaptureRef,
    FileContent,
    Fit,
    Fitted,
    Inspect,
    Shape,
    Shaped,
)
from habitus.jobs.archive.manifest import DONE, Manifest, Row, folder_names, open_manifest
from habitus.jobs.archive.tasks import digest_of, work
from habitus.jobs.finding import CaptureFile, find_captures
from habitus.jobs.options import ArchiveOptions, takes
from habitus.parallel.queue import Lost, Queue, open_queue
from habitus.report.archive import write_archive_page, write_table
from habitus.results.save import MARKER_FILES
from habitus.types import PathLike

SUBJECTS = "subjects"
"""Folder of the subjects' shapes, below that of the results."""
_CAPTURE_COST = 600
_SHAPE_COST = 4000  # frames whose fit takes as long: reading, exports, report; a shape stage


@dataclass(frozen=True)
class Tally:
    """How far an archive is: captures, how many of them are done, failed, or were done before;
    seconds that are left, None while nobody knows; what is going on.
    """

    stage: str = ""
    captures: int = 0
    done: int = 0
    failed: int = 0
    kept: int = 0
    share: float = 0.0
    seconds_left: float | None = None


class Plan:
    """What is to be done next: captures of subjects whose shape is known, then the next subject's
    shape, the largest subjects and the longest captures first.

    files: where each capture's file lies; recipe: a digest of all that is asked for.
    """

    def __init__(
        self,
        manifest: Manifest,
        job: ArchiveJob,
        files: Mapping[str, Path],
        recipe: str,
        on_failure: Callable[[str, str], None],
    ):
        self._manifest = manifest
        self._out = job.out
        self._files = files
        self._recipe = recipe
        self._on_failure = on_failure
        self._ready: deque[tuple[Row, str | None, str]] = deque()
        self._shapes: deque[Shape] = deque()
        self._of_shape: dict[str, list[Row]] = {}
        self._under_way: dict[Path, tuple[Row, str]] = {}
        self.kept = 0
        self.failed = 0
        self.count = 0
        self.fitted_now = 0
        self._work = 0
        self._left = 0
        self._began = time.monotonic()
        subjects: dict[str, list[Row]] = {}
        folders: set[str] = set()
        for row in self._manifest.captures():
            if row.folder in folders:
                self._failed(
                    row,
                    f"its results would overwrite another capture's, {row.folder}; rename one of "
                    "them",
                )
            else:
                folders.add(row.folder)
                subjects.setdefault(row.subject, []).append(row)
        for name, rows in sorted(
            subjects.items(), key=lambda pair: -sum(row.frames for row in pair[1])
        ):
            self._begin(name, rows)
        self._left = self._work

    def _begin(self, name: str, rows: list[Row]) -> None:
        self.count += len(rows)
        known = self._manifest.subject(name)
        if known is not None and self._stands(known, rows):
            self._fit_with(rows, known[0] or None, known[3])
            return
        self._of_shape[name] = rows
        self._work += _SHAPE_COST + sum(map(_cost, rows))
        digest = blake2b(name.encode(), digest_size=4).hexdigest()
        file = f"{SUBJECTS}/{file_name(name)}~{digest}.npz"
        self._shapes.append(Shape(name, tuple(self._taken(row) for row in rows), file))

    def _stands(self, known: tuple[str, str, dict[str, str], str], rows: list[Row]) -> bool:
        """Whether a shape was found by this recipe, from captures that are as they were."""
        file, recipe, sources, _ = known
        digests = {_key(row): row.digest for row in rows}
        there = not file or (self._out / file).is_file()
        return (
            there
            and recipe == self._recipe
            and all(digests.get(k) == v for k, v in sources.items())
        )

    def _fit_with(self, rows: list[Row], file: str | None, digest: str) -> None:
        for row in sorted(rows, key=lambda row: -row.frames):
            key = _digest([row.digest, row.person, digest, self._recipe])
            if row.state == DONE and row.key == key and self._there(row):
                self.kept += 1
                self._left -= _cost(row) if row.subject in self._of_shape else 0
                continue
            self._work += 0 if row.subject in self._of_shape else _cost(row)
            self._ready.append((row, file, key))

    def _there(self, row: Row) -> bool:
        return (self._out / row.folder / "metrics.json").is_file()

    def _taken(self, row: Row) -> CaptureRef:
        return CaptureRef(
            self._files[row.path], row.person or None, row.digest, self._out / row.folder
        )

    # -- in turn -----------------------------------------------------------------------------------

    def take(self) -> Shape | Fit | None:
        """The next item; None where there is none before another ends."""
        if self._ready:
            row, file, key = self._ready.popleft()
            task = Fit(self._taken(row), file)
            self._under_way[task.capture.folder] = row, key
            return task
        return self._shapes.popleft() if self._shapes else None

    def shaped(self, task: Shape, shape: Shaped) -> None:
        """A subject's shape is known, or cannot be found: then each capture is fitted by itself."""
        rows = self._of_shape[task.name]
        self._left -= _SHAPE_COST
        for k, reason in shape.bad.items():
            self._failed(rows[k], reason)
        rest = [row for k, row in enumerate(rows) if k not in shape.bad]
        sources = {_key(rows[k]): rows[k].digest for k in shape.sources}
        if not shape.reason:
            self._manifest.shaped(task.name, task.file, self._recipe, sources, shape)
        self._fit_with(rest, task.file if not shape.reason else None, shape.digest)

    def fitted(self, task: Fit, result: Fitted) -> None:
        """A capture is done."""
        row, key = self._under_way.pop(task.capture.folder)
        self._manifest.fitted(row, key, result)
        self._left -= _cost(row)
        self.fitted_now += not result.reason
        if result.reason:
            self.failed += 1
            self._on_failure(row.path, result.reason)

    def _failed(self, row: Row, reason: str) -> None:
        self._manifest.failed(row, reason)
        self.failed += 1
        self._left -= _cost(row) if row.subject in self._of_shape else 0
        self._on_failure(row.path, reason)

    def tally(self) -> Tally:
        """How far it is."""
        share = 1.0 - self._left / self._work if self._work else 1.0
        passed = time.monotonic() - self._began
        left = passed * (1.0 - share) / share if share > 0.002 else None
        done = self.fitted_now + self.kept
        return Tally("fitting", self.count, done, self.failed, self.kept, share, left)


def _cost(row: Row) -> int:
    return row.frames + _CAPTURE_COST


def _key(row: Row) -> str:
    return f"{row.path}\n{row.person}"


def _digest(parts: list[str]) -> str:
    return blake2b("\0".join(parts).encode(), digest_size=16).hexdigest()


def recipe_digest(job: ArchiveJob) -> str:
    """Digest of all that a result depends on besides its capture: options, the files that these
    name, and the version.
    """
    options = asdict(replace(job.options, body="", subjects=None))  # by their content, below
    files = [Path(str(name)) for name in (job.body, job.recipe.layout)]
    contents = [digest_of(path) if path.is_file() else str(path) for path in files]
    return _digest([__version__, json.dumps(options, sort_keys=True, default=str), *contents])


PAGE = "index.html"
TABLE = "archive.parquet"


@dataclass(frozen=True)
class Archive:
    """What became of an archive: the folder of results, its captures' numbers, and why there are
    none of some.

    ``failed``: paths below the folder of captures and reasons. ``fitted`` were fitted now, ``kept``
    before; ``levels`` counts verdicts; ``left_out`` files are no captures.
    """

    folder: Path
    fitted: int
    kept: int
    failed: tuple[tuple[str, str], ...]
    levels: dict[str, int]
    subjects: int
    left_out: int
    seconds: float

    @property
    def page(self) -> Path:
        """The page that shows all."""
        return self.folder / PAGE

    @property
    def table(self) -> Path:
        """All metrics, a row a capture (Parquet)."""
        return self.folder / TABLE


@takes(ArchiveOptions)
def archive(
    folder: PathLike,
    out: PathLike,
    *,
    options: ArchiveOptions,
    workers: int | str | None = None,
    progress: Callable[[Tally], None] = lambda tally: None,
    on_failure: Callable[[str, str], None] = lambda path, reason: None,
) -> Archive:
    """Fit every capture below a folder, subject by subject, and resume where an earlier run of the
    same stopped.

    ``out`` receives a folder for each capture, as deep as it lay, with what `habitus.mosh` writes;
    index.html, archive.parquet; and archive.sqlite, which records what is done and by which input:
    what did not change is not fitted again. body: a name or a file. workers: processes of one
    thread each (as many as there are cores), or the address of a Dask scheduler, whose machines
    must see both folders under the same paths. progress is called with a `Tally`, on_failure with a
    path and why it has no result. Raises HabitusError where nothing can begin.
    """
    began = time.monotonic()
    check_extra("duckdb", "tables of an archive", "archive")
    job = ArchiveJob(options, Path(out).absolute())
    job.recipe.check(job.recipe.body(job.body))
    subjects = options.subjects
    top = Path(folder).absolute()
    if not top.is_dir():
        raise HabitusError(f"{folder}: is no folder; an archive is made of all captures below one")
    captures = find_captures([top], job.out)
    table = (
        None
        if subjects is None
        else read_subjects(Path(subjects), [capture.path.relative_to(top) for capture in captures])
    )
    with locked(job.out, MARKER_FILES), ExitStack() as stack:
        for place in {capture.place for capture in captures}:
            tidy(job.out / place, MARKER_FILES)
        manifest = stack.enter_context(open_manifest(job.out))
        processes = cache(lambda: stack.enter_context(open_queue(workers)))
        files = {_called(capture.path.relative_to(top)): capture for capture in captures}
        run = _Run(job, top, files, manifest, processes, progress, on_failure)
        run.look()
        run.group(table)
        run.fit()
        return run.finish(time.monotonic() - began)


@dataclass
class _Run:
    job: ArchiveJob
    top: Path
    files: Mapping[str, CaptureFile]
    manifest: Manifest
    processes: Callable[[], Queue]
    progress: Callable[[Tally], None]
    on_failure: Callable[[str, str], None]
    fitted: int = 0
    kept: int = 0
    recipe: str = ""

    def __post_init__(self) -> None:
        self.recipe = recipe_digest(self.job)

    # -- what there is -----------------------------------------------------------------------------

    def look(self) -> None:
        """Inspect at every file that is new or changed since it was looked at."""
        known = self.manifest.stamps()
        here = self.files
        self.manifest.forget([path for path in known if path not in here])
        stamps = {path: _stamp(file.path) for path, file in here.items()}
        new = deque(path for path in here if known.get(path) != (*stamps[path], DONE))
        count = len(new)
        names = {here[path].path: path for path in new}
        items = self._done(lambda: Inspect(here[new.popleft()].path) if new else None)
        for looked, (task, result) in enumerate(items, 1):
            path = names[task.path]
            result = FileContent(reason=str(result)) if isinstance(result, Lost) else result
            self.manifest.record_file(path, stamps[path], *self._named(here[path], result))
            if result.reason and not result.no_capture:
                self.on_failure(path, result.reason)
            self.progress(Tally("reading", captures=count, done=looked, share=looked / count))

    def _named(self, file: CaptureFile, result: FileContent) -> tuple[FileContent, list[str]]:
        try:
            names = folder_names(file, result.people)
            if len(set(names)) < len(names):
                raise HabitusError("several people in the file have one name; rename them")
            return result, names
        except HabitusError as error:
            return FileContent(result.digest, reason=str(error)), []

    def group(self, table: SubjectsTable | None) -> None:
        """Tell whose each capture is."""
        self.manifest.group(
            grouped_by_subject(self.manifest.marker_sets(), table, file_name(self.top.name))
        )

    def _done(self, take: Callable[[], Any]) -> Iterator[tuple[Any, Any]]:
        """Items as they end; no process is started for none."""
        first = [item for item in [take()] if item is not None]
        return (
            self.processes().done(work, self.job, lambda: first.pop() if first else take())
            if first
            else iter(())
        )

    # -- the work ----------------------------------------------------------------------------------

    def fit(self) -> None:
        """Find the shapes that are missing and fit the captures that are not done."""
        paths = {name: file.path for name, file in self.files.items()}
        plan = Plan(self.manifest, self.job, paths, self.recipe, self.on_failure)
        self.progress(plan.tally())
        for task, result in self._done(plan.take):
            if isinstance(task, Shape):
                plan.shaped(
                    task, Shaped(reason=str(result)) if isinstance(result, Lost) else result
                )
            else:
                result = Fitted(reason=str(result)) if isinstance(result, Lost) else result
                plan.fitted(task, result)
            self.progress(plan.tally())
        self.fitted = plan.fitted_now
        self.kept = plan.kept

    def finish(self, seconds: float) -> Archive:
        """Write the page and the table, and tell what became of all."""
        people = self.manifest.people()
        write_archive_page(
            self.job.out / PAGE,
            self.top.name,
            self.manifest.results(),
            people,
            self.manifest.count(),
        )
        write_table(self.job.out / TABLE, self.manifest.results())
        failed = []
        levels = {}
        for row in self.manifest.results():
            if row["state"] != DONE:
                failed.append((row["path"], row["reason"]))
            else:
                level = (row["numbers"].get("verdict") or {}).get("level", "")
                levels[level] = levels.get(level, 0) + 1
        left_out = self.manifest.left_out()
        return Archive(
            self.job.out,
            self.fitted,
            self.kept,
            tuple(failed),
            levels,
            len(people),
            left_out,
            seconds,
        )


def _called(relative: Path) -> str:
    """A file in the manifest: its path below the folder of captures, as a text whatever it
    holds.
    """
    return escaped(relative.as_posix())


def _stamp(path: Path) -> tuple[int, int]:
    try:
        status = path.stat()
    except OSError:
        return 0, 0
    return status.st_size, status.st_mtime_ns
