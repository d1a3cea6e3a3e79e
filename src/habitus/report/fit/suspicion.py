"""Which suspects matter: a marker that is wrong for long, or one that jumped for a moment."""

from typing import TYPE_CHECKING

from habitus.fit.mosh.suspects import Suspect

if TYPE_CHECKING:
    from habitus.fit.mosh.result import MarkerFit

LONG = 0.1  # of the frames in which the marker is seen


def split_suspects(fit: "MarkerFit") -> tuple[list[Suspect], list[Suspect]]:
    """Suspects for a tenth of their frames or more, and those for less; each with most frames first."""
    seen = dict(zip(fit.labels, fit.visible.sum(axis=0).tolist(), strict=True))
    ordered = sorted(fit.suspects, key=lambda suspect: -suspect.frames)
    long = [suspect for suspect in ordered if suspect.frames >= LONG * seen.get(suspect.label, 0)]
    return long, [suspect for suspect in ordered if suspect not in long]


def suspicions(fit: "MarkerFit") -> list[dict | None]:
    """For each label, in order: None, or its reasons and whether they last."""
    long, brief = split_suspects(fit)
    found: dict[str, dict] = {}
    for suspects, lasting in ((long, True), (brief, False)):
        for suspect in suspects:
            found.setdefault(suspect.label, {"reasons": [], "lasting": lasting})["reasons"].append(suspect.reason)
    return [found.get(label) for label in fit.labels]
