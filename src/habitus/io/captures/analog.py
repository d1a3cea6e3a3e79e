"""Analog channels of C3D files: force plates, EMG and the like, in the file's units."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from habitus.errors import HabitusError
from habitus.io.captures.c3d import DataPlace, find_data
from habitus.io.captures.c3d_parameters import Header, Parameters, reals
from habitus.io.limits import check_count

MAX_SAMPLES = 500_000_000
"""Of all channels together."""
MAX_CHANNELS = 4096


@dataclass(frozen=True, eq=False)
class Analog:
    """Samples (S, A) of A channels, scaled, at ``rate_hz``, from the first frame of the points on.
    ``units`` and ``labels`` as the file has them, empty where it has none.
    """

    labels: tuple[str, ...]
    units: tuple[str, ...]
    samples: Float[np.ndarray, "S A"]
    rate_hz: float
    points_hz: float


def read_analog(content: bytes, name: str) -> tuple[Analog, Header, Parameters]:
    """The analog channels of a C3D file's bytes, its header and its parameters; no channels where
    it has none.

    Raises HabitusError where the bytes are no C3D file, or where the channels' number contradicts
    the size of a frame.
    """
    place, header, parameters = find_data(content, name)
    points_hz = float(parameters.number("POINT", "RATE") or header.rate_hz)
    channels = int(parameters.number("ANALOG", "USED") or 0)
    empty = channels <= 0 or place.analog_words == 0 or place.frames <= 0
    if empty or not 0.1 < points_hz < 1e5:
        return Analog((), (), np.zeros((0, 0)), points_hz, points_hz), header, parameters
    check_count(channels, MAX_CHANNELS, f"{name}: analog channels")
    if place.analog_words % channels:
        raise HabitusError(
            f"{name}: {place.analog_words} analog values a frame of {channels} channels; expected "
            "a whole number of samples: export the file again"
        )
    each = place.analog_words // channels
    check_count(place.frames * place.analog_words, MAX_SAMPLES, f"{name}: analog samples")
    raw = _words(content, place, parameters).reshape(place.frames * each, channels)
    general = parameters.number("ANALOG", "GEN_SCALE")
    scale = _of_channels(parameters.numbers("ANALOG", "SCALE"), channels, 1.0)
    offset = _of_channels(_signed(parameters), channels, 0.0)
    with np.errstate(all="ignore"):
        samples = (raw - offset) * scale * (1.0 if general is None else general)
    return (
        Analog(
            _texts(parameters, "LABELS", channels),
            _texts(parameters, "UNITS", channels),
            samples,
            points_hz * each,
            points_hz,
        ),
        header,
        parameters,
    )


def _words(content: bytes, place: DataPlace, parameters: Parameters) -> np.ndarray:
    """The analog values of all frames, as stored."""
    block = np.frombuffer(content, np.uint8, place.frames * place.stride, place.start)
    block = block.reshape(place.frames, place.stride)
    own = np.ascontiguousarray(block[:, 4 * place.points * place.word :]).reshape(-1)
    if place.word == 4:
        with np.errstate(invalid="ignore"):  # signalling NaNs in damaged files
            return reals(own, parameters.processor).astype(np.float64)
    unsigned = any("UNSIGNED" in text.upper() for text in parameters.texts("ANALOG", "FORMAT"))
    kind = (">" if parameters.processor == "mips" else "<") + ("u2" if unsigned else "i2")
    return np.frombuffer(own, kind).astype(np.float64)


def _signed(parameters: Parameters) -> np.ndarray:
    """Offsets of the channels, which are signed where samples are."""
    offsets = parameters.numbers("ANALOG", "OFFSET").astype(np.float64)
    unsigned = any("UNSIGNED" in text.upper() for text in parameters.texts("ANALOG", "FORMAT"))
    return offsets if unsigned else np.where(offsets > 32767.0, offsets - 65536.0, offsets)


def _of_channels(values: np.ndarray, channels: int, usual: float) -> Float[np.ndarray, " A"]:
    out = np.full(channels, usual)
    out[: min(channels, len(values))] = values[:channels]
    return out


def _texts(parameters: Parameters, name: str, channels: int) -> tuple[str, ...]:
    texts = [*parameters.texts("ANALOG", name), *parameters.texts("ANALOG", f"{name}2")]
    return tuple((texts + [""] * channels)[:channels])
