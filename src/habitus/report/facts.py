"""What an index says of a capture, out of its metrics.json, whatever that holds."""

from collections.abc import Mapping
from typing import Any, NamedTuple

from habitus.errors import shown

LEVELS = ("good", "doubtful", "failed")
LONGEST_NAME = 120


class Facts(NamedTuple):
    """Verdict and its reasons, error of the last stage (mm), what was captured, and the person;
    None: not said.
    """

    level: str | None
    reasons: tuple[str, ...]
    mean_mm: float | None
    p95_mm: float | None
    frames: float | None
    rate_hz: float | None
    markers: float | None
    suspects: int
    height_m: float | None
    mass_kg: float | None
    layout: str


def facts_of(numbers: Mapping[str, Any]) -> Facts:
    """The facts of one capture; what is not as it should be is not said."""
    errors, body, verdict = (
        _table(numbers, key) for key in ("marker_error_mm", "body_measurements", "verdict")
    )
    final = _table(errors, "soft_tissue") or _table(errors, "pose")
    suspects = numbers.get("suspect_markers")
    reasons = verdict.get("reasons")
    listed = suspects if isinstance(suspects, list) else []
    return Facts(
        verdict["level"] if verdict.get("level") in LEVELS else None,
        tuple(shown(reason, 300) for reason in reasons) if isinstance(reasons, list) else (),
        number(final.get("mean")),
        number(final.get("p95")),
        number(numbers.get("frames")),
        number(numbers.get("rate_hz")),
        number(numbers.get("markers")),
        sum(isinstance(one, dict) and not one.get("corrected") for one in listed),
        number(body.get("height_m")),
        number(body.get("mass_kg")),
        shown(numbers.get("layout", ""), LONGEST_NAME),
    )


def number(value: Any) -> float | None:
    """A number that can be shown, or None."""
    good = isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) < 1e15
    return value if good else None


def _table(numbers: Mapping[str, Any], key: str) -> Mapping[str, Any]:
    found = numbers.get(key)
    return found if isinstance(found, dict) else {}
