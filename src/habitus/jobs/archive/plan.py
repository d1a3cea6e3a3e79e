"""What is to be done for an archive, in which order, and what need not be done again."""

import json
import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from hashlib import blake2b
from pathlib import Path
from typing import Any

from habitus import __version__
from habitus.io.names import file_name
from habitus.jobs.archive.items import Fit, Fitted, Order, Shape, Shaped, Taken
from habitus.jobs.archive.manifest import DONE, Manifest, Row
from habitus.jobs.archive.tasks import digest_of

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
        order: Order,
        files: Mapping[str, Path],
        recipe: str,
        on_failure: Callable[[str, str], None],
    ):
        self._manifest = manifest
        self._out = order.out
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

    def _taken(self, row: Row) -> Taken:
        return Taken(self._files[row.path], row.person or None, row.digest, self._out / row.folder)

    # -- in turn -----------------------------------------------------------------------------------

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
        self._left -= _SHAPE_COST
        for k, reason in found.bad.items():
            self._failed(rows[k], reason)
        rest = [row for k, row in enumerate(rows) if k not in found.bad]
        sources = {_key(rows[k]): rows[k].digest for k in found.sources}
        if not found.reason:
            self._manifest.shaped(task.name, task.file, self._recipe, sources, found)
        self._fit_with(rest, task.file if not found.reason else None, found.digest)

    def fitted(self, task: Fit, found: Fitted) -> None:
        """A capture is done."""
        row, key = self._under_way.pop(task.capture.folder)
        self._manifest.fitted(row, key, found)
        self._left -= _cost(row)
        self.fitted_now += not found.reason
        if found.reason:
            self.failed += 1
            self._on_failure(row.path, found.reason)

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


def recipe_digest(order: Order) -> str:
    """Of all that a result depends on besides its capture: options, the files that these name, and
    the version.
    """
    told: dict[str, Any] = asdict(order.recipe) | {
        "minimal": order.minimal,
        "npz_style": order.npz_style,
    }
    files = [Path(str(name)) for name in (order.body, order.recipe.layout)]
    contents = [digest_of(path) if path.is_file() else str(path) for path in files]
    return _digest([__version__, json.dumps(told, sort_keys=True, default=str), *contents])
