"""What processes of an archive are sent, and what they send back."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from habitus.jobs.finding import Worn
from habitus.jobs.mosh import Mosh


@dataclass(frozen=True)
class Order:
    """What all items share: the recipe, the body's name or file, the folder of results, and what
    they look like.
    """

    recipe: Mosh
    body: str
    out: Path
    minimal: bool = False
    npz_style: str = "habitus"


@dataclass(frozen=True)
class Look:
    """A file to be looked at."""

    path: Path


@dataclass(frozen=True)
class Seen:
    """Somebody in a file: the file's name for them, how much there is of them, and what they
    wore.
    """

    subject: str | None
    frames: int
    rate_hz: float
    worn: Worn


@dataclass(frozen=True)
class Looked:
    """Everybody in a file and a digest of its content, or why there is nobody; `no_capture`: which
    is no failure.
    """

    digest: str = ""
    people: tuple[Seen, ...] = ()
    reason: str = ""
    no_capture: bool = False


@dataclass(frozen=True)
class Taken:
    """A capture as it was when it was looked at; ``person`` is somebody's name where the file holds
    several people.
    """

    path: Path
    person: str | None
    digest: str
    folder: Path


@dataclass(frozen=True)
class Shape:
    """A subject whose shape is to be found by its captures and written to a file, relative to the
    folder of results.
    """

    name: str
    captures: tuple[Taken, ...]
    file: str


@dataclass(frozen=True)
class Shaped:
    """A subject's shape: a digest of it, the captures (by number) that gave frames, what it
    measures, a picture; those that cannot be fitted, by number; or why there is none, and each
    capture is to be fitted by itself.
    """

    digest: str = ""
    sources: tuple[int, ...] = ()
    bad: dict[int, str] = field(default_factory=dict)
    measured: dict[str, float] = field(default_factory=dict)
    betas: tuple[float, ...] = ()
    picture: bytes = b""
    seconds: float = 0.0
    reason: str = ""


@dataclass(frozen=True)
class Fit:
    """A capture to be fitted: with the shape in a file, or by itself."""

    capture: Taken
    file: str | None


@dataclass(frozen=True)
class Fitted:
    """The numbers of a capture's metrics.json and a picture of it, or why there are none; seconds
    of CPU.
    """

    numbers: dict[str, Any] = field(default_factory=dict)
    picture: bytes = b""
    seconds: float = 0.0
    reason: str = ""


Task = Look | Shape | Fit
Done = Looked | Shaped | Fitted
