"""An archive: every capture below a folder, fitted subject by subject, in as many processes as
there are.
"""

import os
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from habitus.errors import HabitusError, check_extra
from habitus.export.amass import check_npz_style
from habitus.files import locked, tidy
from habitus.io.names import file_name
from habitus.jobs.archive.grouping import grouped_by_subject
from habitus.jobs.archive.items import Fitted, Look, Looked, Order, Shape, Shaped
from habitus.jobs.archive.manifest import DONE, Manifest, folder_names, open_manifest
from habitus.jobs.archive.plan import Plan, Tally, recipe_digest
from habitus.jobs.archive.table import SubjectsTable, read_subjects
from habitus.jobs.archive.tasks import work
from habitus.jobs.discovering import check_layout
from habitus.jobs.finding import Found, find_captures
from habitus.jobs.mosh import Mosh
from habitus.parallel.queue import Lost, Queue, open_queue
from habitus.report.archive import write_archive_page, write_table
from habitus.results.save import MARKER_FILES
from habitus.types import PathLike

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


def archive(
    folder: PathLike,
    out: PathLike,
    *,
    subjects: PathLike | None = None,
    mosh: Mosh | None = None,
    body: PathLike = "default",
    workers: int | str | None = None,
    minimal: bool = False,
    npz_style: str = "habitus",
    progress: Callable[[Tally], None] = lambda tally: None,
    on_failure: Callable[[str, str], None] = lambda path, reason: None,
) -> Archive:
    """Fit every capture below a folder, subject by subject, and go on where an earlier run of the
    same stopped.

    ``out`` receives a folder a capture, as deep as it lay, with what `habitus.mosh` writes,
    index.html, archive.parquet, and archive.sqlite, which knows what is done and by which input:
    what did not change is not fitted again. subjects: a table (CSV: capture, subject) of whose
    captures are whose; else the files' subjects and folders tell. mosh: the recipe. body: a name or
    a file. workers: processes of one thread each (as many as there are cores), or the address of a
    Dask scheduler, whose machines must see both folders under the same paths. minimal: of each
    capture only body.npz and metrics.json. progress is told a `Tally`, on_failure a path and why it
    has no result. Raises HabitusError where nothing can begin.
    """
    began = time.monotonic()
    recipe = mosh or Mosh()
    check_extra("duckdb", "tables of an archive", "archive")
    order = Order(recipe, str(body), Path(out).absolute(), minimal, npz_style)
    check_npz_style(npz_style, recipe.body(order.body))
    check_layout(recipe.layout)
    top = Path(folder).absolute()
    if not top.is_dir():
        raise HabitusError(f"{folder}: is no folder; an archive is made of all captures below one")
    found = find_captures([top], order.out)
    table = (
        None
        if subjects is None
        else read_subjects(Path(subjects), [one.path.relative_to(top) for one in found])
    )
    with locked(order.out, MARKER_FILES), ExitStack() as stack:
        for place in {one.place for one in found}:
            tidy(order.out / place, MARKER_FILES)
        manifest = stack.enter_context(open_manifest(order.out))
        processes = cache(lambda: stack.enter_context(open_queue(workers)))
        files = {_called(one.path.relative_to(top)): one for one in found}
        run = _Run(order, top, files, manifest, processes, progress, on_failure)
        run.look()
        run.group(table)
        run.fit()
        return run.finish(time.monotonic() - began)


@dataclass
class _Run:
    order: Order
    top: Path
    files: Mapping[str, Found]
    manifest: Manifest
    processes: Callable[[], Queue]
    progress: Callable[[Tally], None]
    on_failure: Callable[[str, str], None]
    fitted: int = 0
    kept: int = 0
    recipe: str = ""

    def __post_init__(self) -> None:
        self.recipe = recipe_digest(self.order)

    # -- what there is -----------------------------------------------------------------------------

    def look(self) -> None:
        """Look at every file that is new or changed since it was looked at."""
        known = self.manifest.stamps()
        here = self.files
        self.manifest.forget([path for path in known if path not in here])
        stamps = {path: _stamp(one.path) for path, one in here.items()}
        new = deque(path for path in here if known.get(path) != (*stamps[path], DONE))
        count = len(new)
        names = {here[path].path: path for path in new}
        items = self._done(lambda: Look(here[new.popleft()].path) if new else None)
        for looked, (task, result) in enumerate(items, 1):
            path = names[task.path]
            result = Looked(reason=str(result)) if isinstance(result, Lost) else result
            self.manifest.looked(path, stamps[path], *self._named(here[path], result))
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
        self.manifest.group(
            grouped_by_subject(self.manifest.worn(), table, file_name(self.top.name))
        )

    def _done(self, take: Callable[[], Any]) -> Iterator[tuple[Any, Any]]:
        """Items as they end; no process is started for none."""
        first = [one for one in [take()] if one is not None]
        return (
            self.processes().done(work, self.order, lambda: first.pop() if first else take())
            if first
            else iter(())
        )

    # -- the work ----------------------------------------------------------------------------------

    def fit(self) -> None:
        """Find the shapes that are missing and fit the captures that are not done."""
        paths = {name: one.path for name, one in self.files.items()}
        plan = Plan(self.manifest, self.order, paths, self.recipe, self.on_failure)
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
            self.order.out / PAGE,
            self.top.name,
            self.manifest.results(),
            people,
            self.manifest.count(),
        )
        write_table(self.order.out / TABLE, self.manifest.results())
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
            self.order.out,
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
    return os.fsencode(relative.as_posix()).decode("utf-8", "backslashreplace")


def _stamp(path: Path) -> tuple[int, int]:
    try:
        told = path.stat()
    except OSError:
        return 0, 0
    return told.st_size, told.st_mtime_ns
