"""An archive: every capture below a folder, fitted subject by subject, in as many processes as there are."""

import json
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field
from functools import cache
from hashlib import blake2b
from pathlib import Path
from typing import Any

from habitus import __version__
from habitus.errors import HabitusError, check_extra
from habitus.export.amass import check_npz_style
from habitus.io.files import locked, tidy
from habitus.io.names import file_name
from habitus.jobs.archive.grouping import grouped_by_subject
from habitus.jobs.archive.manifest import DONE, Manifest, Row, folder_names, open_manifest
from habitus.jobs.archive.table import SubjectsTable, read_subjects
from habitus.jobs.archive.tasks import Done, Fit, Fitted, Look, Looked, Order, Shape, Shaped, Taken, digest_of, work
from habitus.jobs.discovering import check_layout
from habitus.jobs.finding import Found, find_captures
from habitus.jobs.mosh import Mosh
from habitus.jobs.mosh_files import OURS
from habitus.parallel.queue import Lost, Queue, open_queue
from habitus.report.archive.page import write_archive_page
from habitus.report.archive.table import write_table
from habitus.types import PathLike

PAGE, TABLE, SUBJECTS = "index.html", "archive.parquet", "subjects"
_CAPTURE_COST = 600  # frames that a capture costs besides its own: reading, exports, the report


@dataclass(frozen=True)
class Tally:
    """How far an archive is: captures, how many of them are done, failed, or were done before; seconds that are left,
    None while nobody knows; what is going on.
    """

    stage: str = ""
    captures: int = 0
    done: int = 0
    failed: int = 0
    kept: int = 0
    share: float = 0.0
    seconds_left: float | None = None


@dataclass(frozen=True)
class Archive:
    """What became of an archive: the folder of results, its captures' numbers, and why there are none of some.

    ``failed``: paths below the folder of captures and reasons. ``fitted`` were fitted now, ``kept`` before;
    ``levels`` counts verdicts; ``left_out`` files are no captures.
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


def archive(
    folder: PathLike,
    out: PathLike,
    *,
    subjects: PathLike | None = None,
    mosh: Mosh | None = None,
    body: PathLike = "default",
    workers: int | str | None = None,
    lean: bool = False,
    npz_style: str = "habitus",
    progress: Callable[[Tally], None] = lambda tally: None,
    on_failure: Callable[[str, str], None] = lambda path, reason: None,
) -> Archive:
    """Fit every capture below a folder, subject by subject, and go on where an earlier run of the same stopped.

    ``out`` receives a folder a capture, as deep as it lay, with what `habitus.mosh` writes, index.html,
    archive.parquet, and archive.sqlite, which knows what is done and by which input: what did not change is not fitted
    again. subjects: a table (CSV: capture, subject) of whose captures are whose; else the files' subjects and folders
    tell. mosh: the recipe. body: a name or a file. workers: processes of one thread each (as many as there are cores),
    or the address of a Dask scheduler, whose machines must see both folders under the same paths. lean: of each capture
    only body.npz and metrics.json. progress is told a
    `Tally`, on_failure a path and why it has no result. Raises HabitusError where nothing can begin.
    """
    began, recipe = time.monotonic(), mosh or Mosh()
    check_extra("duckdb", "tables of an archive", "archive")
    order = Order(recipe, str(body), Path(out).absolute(), lean, npz_style)
    check_npz_style(npz_style, recipe.body(order.body))
    check_layout(recipe.layout)
    top = Path(folder).absolute()
    if not top.is_dir():
        raise HabitusError(f"{folder}: is no folder; an archive is made of all captures below one")
    found = find_captures([top], order.out)
    table = None if subjects is None else read_subjects(Path(subjects), [one.path.relative_to(top) for one in found])
    with locked(order.out, OURS), ExitStack() as stack:
        for place in {one.place for one in found}:
            tidy(order.out / place, OURS)
        manifest = stack.enter_context(open_manifest(order.out))
        processes = cache(lambda: stack.enter_context(open_queue(workers)))
        run = _Run(order, top, manifest, processes, progress, on_failure)
        run.look(found)
        run.group(table)
        run.fit()
        return run.finish(time.monotonic() - began)


@dataclass
class _Run:
    order: Order
    top: Path
    manifest: Manifest
    processes: Callable[[], Queue]
    progress: Callable[[Tally], None]
    on_failure: Callable[[str, str], None]
    fitted: int = 0
    kept: int = 0
    recipe: str = field(default="")

    def __post_init__(self) -> None:
        self.recipe = _recipe_digest(self.order)

    # -- what there is ------------------------------------------------------------------------------------------------

    def look(self, found: list[Found]) -> None:
        """Look at every file that is new or changed since it was looked at."""
        known = self.manifest.stamps()
        here = {one.path.relative_to(self.top).as_posix(): one for one in found}
        self.manifest.forget([path for path in known if path not in here])
        stamps = {path: _stamp(one.path) for path, one in here.items()}
        new = deque(path for path in here if known.get(path) != (*stamps[path], DONE))
        count, looked = len(new), 0
        names = {here[path].path: path for path in new}
        for task, result in self._done(lambda: Look(here[new.popleft()].path) if new else None):
            path = names[task.path]
            result = Looked(reason=str(result)) if isinstance(result, Lost) else result
            self.manifest.looked(path, stamps[path], *self._named(here[path], result))
            looked += 1
            if result.reason and not result.no_capture:
                self.on_failure(path, result.reason)
            self.progress(Tally("reading", captures=count, done=looked, share=looked / count))

    def _named(self, one: Found, result: Looked) -> tuple[Looked, list[str]]:
        try:
            names = folder_names(one, result.people)
            if len(set(names)) < len(names):
                raise HabitusError("several people in the file have one name; rename them")
            return result, names
        except HabitusError as error:
            return Looked(result.digest, reason=str(error)), []

    def group(self, table: SubjectsTable | None) -> None:
        """Tell whose each capture is."""
        self.manifest.group(grouped_by_subject(self.manifest.worn(), table, file_name(self.top.name)))

    def _done(self, take: Callable[[], Any]) -> Iterator[tuple[Any, Any]]:
        """Items as they end; no process is started for none."""
        first = [one for one in [take()] if one is not None]
        return self.processes().done(work, self.order, lambda: first.pop() if first else take()) if first else iter(())

    # -- the work -----------------------------------------------------------------------------------------------------

    def fit(self) -> None:
        """Find the shapes that are missing and fit the captures that are not done, those of the largest subjects first."""
        plan = _Plan(self)
        self.kept = plan.kept
        self.progress(plan.tally())
        for task, result in self._done(plan.take):
            if isinstance(task, Shape):
                plan.shaped(task, Shaped(reason=str(result)) if isinstance(result, Lost) else result)
            else:
                result = Fitted(reason=str(result)) if isinstance(result, Lost) else result
                self.fitted += not result.reason
                plan.fitted(task, result)
            self.progress(plan.tally())

    def finish(self, seconds: float) -> Archive:
        """Write the page and the table, and tell what became of all."""
        people = self.manifest.people()
        write_archive_page(self.order.out / PAGE, self.top.name, self.manifest.results(), people, self.manifest.count())
        write_table(self.order.out / TABLE, self.manifest.results())
        failed, levels = [], {}
        for row in self.manifest.results():
            if row["state"] != DONE:
                failed.append((row["path"], row["reason"]))
            else:
                level = (row["numbers"].get("verdict") or {}).get("level", "")
                levels[level] = levels.get(level, 0) + 1
        left_out = self.manifest.left_out()
        return Archive(
            self.order.out, self.fitted, self.kept, tuple(failed), levels, len(people), left_out, seconds
        )


class _Plan:
    """What is to be done next: captures of subjects whose shape is known, then the next subject's shape."""

    def __init__(self, run: _Run):
        self._run, self._manifest = run, run.manifest
        self._ready: deque[tuple[Row, str | None, str]] = deque()
        self._shapes: deque[Shape] = deque()
        self._of_shape: dict[str, list[Row]] = {}
        self._under_way: dict[Path, tuple[Row, str]] = {}
        self.kept, self.failed, self.count = 0, 0, 0
        self._work, self._left, self._began = 0, 0, time.monotonic()
        subjects: dict[str, list[Row]] = {}
        for row in self._manifest.captures():
            subjects.setdefault(row.subject, []).append(row)
        for name, rows in sorted(subjects.items(), key=lambda pair: -sum(row.frames for row in pair[1])):
            self._begin(name, rows)
        self._left = self._work

    def _begin(self, name: str, rows: list[Row]) -> None:
        self.count += len(rows)
        known = self._manifest.subject(name)
        if known is not None and self._stands(known, rows):
            self._fit_with(rows, known[0] or None, known[3])
            return
        self._of_shape[name] = rows
        self._work += sum(map(_cost, rows))
        digest = blake2b(name.encode(), digest_size=4).hexdigest()
        file = f"{SUBJECTS}/{file_name(name)}~{digest}.npz"
        self._shapes.append(Shape(name, tuple(self._taken(row) for row in rows), file))

    def _stands(self, known: tuple[str, str, dict[str, str], str], rows: list[Row]) -> bool:
        """Whether a shape was found by this recipe, from captures that are as they were."""
        file, recipe, sources, _ = known
        digests = {_key(row): row.digest for row in rows}
        there = not file or (self._run.order.out / file).is_file()
        return there and recipe == self._run.recipe and all(digests.get(k) == v for k, v in sources.items())

    def _fit_with(self, rows: list[Row], file: str | None, digest: str) -> None:
        for row in sorted(rows, key=lambda row: -row.frames):
            key = _digest([row.digest, row.person, digest, self._run.recipe])
            if row.state == DONE and row.key == key and self._there(row):
                self.kept += 1
                self._left -= _cost(row) if row.subject in self._of_shape else 0
                continue
            self._work += 0 if row.subject in self._of_shape else _cost(row)
            self._ready.append((row, file, key))

    def _there(self, row: Row) -> bool:
        return (self._run.order.out / row.folder / "metrics.json").is_file()

    def _taken(self, row: Row) -> Taken:
        return Taken(self._run.top / row.path, row.person or None, row.digest, self._run.order.out / row.folder)

    # -- in turn ------------------------------------------------------------------------------------------------------

    def take(self) -> Shape | Fit | None:
        """The next item; None where there is none before another ends."""
        if self._ready:
            row, file, key = self._ready.popleft()
            task = Fit(self._taken(row), file)
            self._under_way[task.capture.folder] = row, key
            return task
        return self._shapes.popleft() if self._shapes else None

    def shaped(self, task: Shape, found: Shaped) -> None:
        """A subject's shape is known, or cannot be found: then each capture is fitted by itself."""
        rows = self._of_shape[task.name]
        for k, reason in found.bad.items():
            self._failed(rows[k], reason)
        rest = [row for k, row in enumerate(rows) if k not in found.bad]
        sources = {_key(rows[k]): rows[k].digest for k in found.sources}
        if not found.reason:
            self._manifest.shaped(task.name, task.file, self._run.recipe, sources, found)
        self._fit_with(rest, task.file if not found.reason else None, found.digest)

    def fitted(self, task: Fit, found: Fitted) -> None:
        """A capture is done."""
        row, key = self._under_way.pop(task.capture.folder)
        self._manifest.fitted(row, key, found)
        self._left -= _cost(row)
        if found.reason:
            self.failed += 1
            self._run.on_failure(row.path, found.reason)

    def _failed(self, row: Row, reason: str) -> None:
        self._manifest.failed(row, reason)
        self.failed += 1
        self._left -= _cost(row)
        self._run.on_failure(row.path, reason)

    def tally(self) -> Tally:
        """How far it is."""
        share = 1.0 - self._left / self._work if self._work else 1.0
        passed = time.monotonic() - self._began
        left = passed * (1.0 - share) / share if share > 0.002 else None
        done = self._run.fitted + self.kept
        return Tally("fitting", self.count, done, self.failed, self.kept, share, left)


def _cost(row: Row) -> int:
    return row.frames + _CAPTURE_COST


def _key(row: Row) -> str:
    return f"{row.path}\n{row.person}"


def _stamp(path: Path) -> tuple[int, int]:
    try:
        told = path.stat()
    except OSError:
        return 0, 0
    return told.st_size, told.st_mtime_ns


def _digest(parts: list[str]) -> str:
    return blake2b("\0".join(parts).encode(), digest_size=16).hexdigest()


def _recipe_digest(order: Order) -> str:
    """Of all that a result depends on besides its capture: options, the files that these name, and the version."""
    told: dict[str, Any] = asdict(order.recipe) | {"lean": order.lean, "npz_style": order.npz_style}
    files = [Path(str(name)) for name in (order.body, order.recipe.layout)]
    contents = [digest_of(path) if path.is_file() else str(path) for path in files]
    return _digest([__version__, json.dumps(told, sort_keys=True, default=str), *contents])
