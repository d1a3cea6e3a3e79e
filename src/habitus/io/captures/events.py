"""Foot strikes and foot offs that a C3D file holds (the EVENT group)."""

from collections.abc import Mapping

import numpy as np

from habitus.gait.events import FootEvents
from habitus.io.captures.c3d_parameters import Header, Parameters, read_parameters

STRIKES, OFFS = ("foot strike", "heel strike", "foot down"), ("foot off", "toe off", "foot up")


def read_events(content: bytes, name: str) -> Mapping[str, FootEvents]:
    """The events of each foot (s from the first frame of the points) that a C3D file's bytes hold;
    empty where it has none. Raises HabitusError where the bytes are no C3D file.
    """
    header, parameters = read_parameters(content, name)
    labels = [text.strip().lower() for text in parameters.texts("EVENT", "LABELS")]
    sides = [text.strip().lower() for text in parameters.texts("EVENT", "CONTEXTS")]
    times = _times(header, parameters)
    found: dict[str, dict[str, list[float]]] = {}
    for side, label, time in zip(sides, labels, times, strict=False):
        if side in ("left", "right") and np.isfinite(time):
            own = found.setdefault(side, {"strikes": [], "offs": []})
            if label in STRIKES:
                own["strikes"].append(time)
            elif label in OFFS:
                own["offs"].append(time)
    return {
        side: FootEvents(np.array(sorted(own["strikes"])), np.array(sorted(own["offs"])), "file")
        for side, own in found.items()
    }


def _times(header: Header, parameters: Parameters) -> list[float]:
    """Minutes and seconds of each event since the recording began, of which the file's first frame
    may be a later one.
    """
    flat = parameters.numbers("EVENT", "TIMES").astype(np.float64)
    pairs = flat[: 2 * (len(flat) // 2)].reshape(-1, 2)
    rate = parameters.number("POINT", "RATE") or header.rate_hz
    first = parameters.numbers("TRIAL", "ACTUAL_START_FIELD")
    start = float(first[0] + 65536 * first[1]) if len(first) > 1 else float(header.first_frame)
    shift = (start - 1.0) / rate if rate and rate > 0 else 0.0
    return (60.0 * pairs[:, 0] + pairs[:, 1] - shift).tolist()
