"""Opens and writes sets of registrations; their vertices stay on disk until they are asked for."""

import os
import shutil
import tempfile
import zipfile
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import IO

import numpy as np
from jaxtyping import Float

from habitus.errors import HabitusError
from habitus.files import atomic_write
from habitus.io.registrations.known import joined_known, known_form
from habitus.io.registrations.sources import KNOWN, WORDS, Source, open_source
from habitus.io.registrations.table import table_text
from habitus.io.registrations.vertex_files import ScaledVertices, joined
from habitus.io.units import METRES, unit_of
from habitus.mesh.registrations import Registrations


def open_registrations(
    path: str | Path | Sequence[str | Path], *, unit: str = "m", every: int = 1
) -> Registrations:
    """The registrations of a path, or of several with one topology, one after the other; their
    vertices stay on disk.

    A path is: an ``.npz`` or a zarr group with ``vertices`` (N, V, 3), ``faces`` (F, 3),
    ``subject`` and, where they are known, ``sex``, ``set``, ``name``, ``verdict`` and ``unit``
    (N,), ``weights`` of vertices, 0 to 1, (V,) or (N, V), and what is known of registrations that
    were made (`habitus.mesh.known.Known`): ``pose`` (N, J, 3), ``trans`` (N, 3), ``betas`` (N, B),
    ``rest`` (S, V, 3) of the subjects as they appear; a folder with ``registrations.csv`` (columns
    subject and, if known, sex, set, name, unit, frame) that names PLY or OBJ files in its column
    file, or lies beside ``vertices.npy``, ``faces.npy`` and, if known, ``weights.npy``,
    ``pose.npy`` and so on; a folder of numbered meshes, ten a subject (FAUST); a folder of such
    ``.npz``, one a person, say; an ``.h5`` of ``faces`` and sequences ``<subject>_<sequence>`` of
    shape (V, 3, T) (Dyna), of which ``every`` so many frames are taken. ``unit`` (m, cm, mm, ...)
    is that of the numbers where the data do not state it. Without a set, a registration is of the
    set "pose" if its subject has several, else "shape". Raises HabitusError, naming the file, for
    all else.
    """
    if unit_of(unit) is None:
        raise HabitusError(f"unit is {unit!r}; expected one of {', '.join(METRES)}")
    if every < 1:
        raise HabitusError(f"every {every} frames asked for; expected 1 or more")
    paths = [
        each
        for one in ([path] if isinstance(path, str | Path) else path)
        for each in _archives(Path(one))
    ]
    if not paths:
        raise HabitusError(f"no registrations given; expected {KNOWN}")
    sources = [open_source(one, every) for one in paths]
    first = sources[0]
    for other in sources[1:]:
        if other.vertices.shape[1] != first.vertices.shape[1] or not np.array_equal(
            other.faces, first.faces
        ):
            raise HabitusError(
                f"{other.path}: {other.vertices.shape[1]} vertices and {len(other.faces)} faces, "
                "another topology than "
                f"{first.path} with {first.vertices.shape[1]} and {len(first.faces)}; expected "
                "one template's"
            )
    words = {key: tuple(word for source in sources for word in source.words[key]) for key in WORDS}
    factor = np.array([METRES[unit_of(word or unit) or "m"] for word in words["unit"]])
    vertices = joined([source.vertices for source in sources])
    return Registrations(
        vertices=vertices if (factor == 1).all() else ScaledVertices(vertices, factor),
        faces=first.faces,
        subject=words["subject"],
        sex=words["sex"],
        set=_sets(words["subject"], words["set"]),
        name=words["name"],
        verdict=words["verdict"] if any(words["verdict"]) else (),
        weights=_weights(sources),
        known=joined_known(
            [source.known for source in sources],
            [source.words["subject"] for source in sources],
            factor,
        ),
    )


def _archives(path: Path) -> list[Path]:
    """The archives in a folder of such, and any other path as it is."""
    inside = sorted(path.glob("*.npz")) if path.is_dir() and path.suffix != ".zarr" else []
    return inside if inside and not (path / "registrations.csv").exists() else [path]


def _weights(sources: Sequence[Source]) -> Float[np.ndarray, "..."] | None:
    """The weights of all sources, 1 where one has none; None where none has any."""
    if all(source.weights is None for source in sources):
        return None
    if len(sources) == 1:
        return sources[0].weights
    shapes = [tuple(source.vertices.shape[:2]) for source in sources]
    weights = [1.0 if source.weights is None else source.weights for source in sources]
    return np.concatenate(
        [np.broadcast_to(weight, shape) for weight, shape in zip(weights, shapes, strict=True)]
    )


def _sets(subject: Sequence[str], given: Sequence[str]) -> tuple[str, ...]:
    count = Counter(subject)
    return tuple(
        word or ("pose" if count[name] > 1 else "shape")
        for name, word in zip(subject, given, strict=True)
    )


def write_registrations(
    registrations: Registrations, path: str | Path, *, dtype: type = np.float32
) -> None:
    """Write registrations to an ``.npz`` (not compressed, so that it is mapped when read) or to a
    new folder.

    One registration is in memory at a time; the file or the folder is there whole or not at all. A
    folder holds ``vertices.npy``, ``faces.npy`` and ``registrations.csv``. ``dtype`` is that of the
    vertices (m). Raises HabitusError where nothing can be written, or the folder exists and holds
    something.
    """
    target = Path(path)
    if target.suffix == ".npz":
        with (
            atomic_write(target) as temporary,
            zipfile.ZipFile(temporary, "w", zipfile.ZIP_STORED) as archive,
        ):
            with archive.open("vertices.npy", "w", force_zip64=True) as stream:
                _write_vertices(registrations, stream, dtype)
            arrays = {
                key: np.array(words, dtype=np.str_)
                for key in WORDS[:-1]
                if (words := getattr(registrations, key))
            }
            arrays |= _numbers(registrations)
            for key, array in {"faces": np.asarray(registrations.faces), **arrays}.items():
                with archive.open(f"{key}.npy", "w") as stream:
                    np.lib.format.write_array(stream, array, allow_pickle=False)
        return
    if target.suffix or (target.is_dir() and any(target.iterdir())):
        what = "a folder that is not empty" if not target.suffix else f"ending {target.suffix!r}"
        raise HabitusError(f"{target}: {what}; expected an .npz or a new folder")
    try:
        _write_folder(registrations, target, dtype)
    except OSError as error:
        raise HabitusError(
            f"cannot write {target}: {error.strerror or error}; choose another folder"
        ) from error


def _write_folder(registrations: Registrations, target: Path, dtype: type) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    temporary = Path(tempfile.mkdtemp(dir=target.parent, prefix=f".{target.name[:40]}-"))
    try:
        with (temporary / "vertices.npy").open("wb") as stream:
            _write_vertices(registrations, stream, dtype)
        np.save(temporary / "faces.npy", np.asarray(registrations.faces), allow_pickle=False)
        for key, array in _numbers(registrations).items():
            np.save(temporary / f"{key}.npy", array, allow_pickle=False)
        columns = {key: getattr(registrations, key) for key in WORDS[:-1]}
        table = table_text({key: words for key, words in columns.items() if words})
        (temporary / "registrations.csv").write_text(table, encoding="utf-8", newline="\n")
        temporary.chmod(0o755)
        with suppress(OSError):
            target.rmdir()  # an empty one, which Windows does not replace
        os.replace(temporary, target)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _numbers(registrations: Registrations) -> dict[str, np.ndarray]:
    """Weights, and what is known besides, where there are such."""
    weights = registrations.weights
    arrays = {} if weights is None else {"weights": np.asarray(weights[:], dtype=np.float32)}
    return arrays | known_form(registrations.known, registrations.subjects)


def _write_vertices(registrations: Registrations, stream: IO[bytes], dtype: type) -> None:
    shape = (len(registrations), registrations.num_vertices, 3)
    header = {"descr": np.dtype(dtype).str, "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(stream, header)
    for k in range(len(registrations)):
        stream.write(np.ascontiguousarray(registrations.vertices[k], dtype=dtype).tobytes())
