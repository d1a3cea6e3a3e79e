"""Which suspects matter: a marker that is wrong for long, one that jumped for a moment, one that
was put right.
"""

from typing import TYPE_CHECKING

from habitus.errors import shown
from habitus.fit.markers.suspects import Suspect

if TYPE_CHECKING:
    from habitus.fit.markers.result import MarkerFit

LONG = 0.1  # of the frames in which the marker is seen


def split_suspects(fit: "MarkerFit") -> tuple[list[Suspect], list[Suspect]]:
    """Suspects still wrong for a tenth of their frames or more, and those for less; each with most
    frames first.
    """
    seen = dict(zip(fit.labels, fit.visible.sum(axis=0).tolist(), strict=True))
    ordered = sorted(
        (s for s in fit.suspects if not s.corrected), key=lambda suspect: -suspect.frames
    )
    long = [suspect for suspect in ordered if suspect.frames >= LONG * seen.get(suspect.label, 0)]
    return long, [suspect for suspect in ordered if suspect not in long]


def corrected_suspects(fit: "MarkerFit") -> list[Suspect]:
    """Suspects that the fit put right, with most frames first."""
    return sorted((s for s in fit.suspects if s.corrected), key=lambda suspect: -suspect.frames)


def suspicions(fit: "MarkerFit") -> list[dict | None]:
    """For each label, in order: None, or its reasons and the worst kind: "wrong" (for long),
    "doubted", "corrected".
    """
    long, brief = split_suspects(fit)
    found: dict[str, dict] = {}
    for suspects, kind in (
        (long, "wrong"),
        (brief, "doubted"),
        (corrected_suspects(fit), "corrected"),
    ):
        for suspect in suspects:
            found.setdefault(suspect.label, {"reasons": [], "kind": kind})["reasons"].append(
                shown(suspect.reason, 400)
            )
    return [found.get(label) for label in fit.labels]
