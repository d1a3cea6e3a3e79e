"""HDF5 files and zarr folders: what they claim is held against what they hold before anything of it
is read.

Both may say that an array is larger than all disks, keep it in another file, inflate a piece of it
without end, or name a step that runs code (zarr's codec "pickle"). Such ones are refused.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from habitus.errors import HabitusError, require_extra, shown
from habitus.io.limits import Allowance, array_size, check_inflated, check_present

_H5_FILTERS = {1: "gzip", 2: "shuffle", 3: "fletcher32", 32000: "lzf"}
_ZARR_STEPS = {
    "bytes",
    "blosc",
    "zstd",
    "gzip",
    "zlib",
    "lz4",
    "crc32c",
    "crc32",
    "transpose",
    "shuffle",
    "delta",
    "vlen-utf8",
}
_INFLATING = {"gzip": 31, "zlib": 15}
_STEEPEST = 1032  # deflate cannot grow more


def h5_array(file: Any, name: str, allowance: Allowance, *, whole: bool) -> Any:
    """The dataset ``name`` of an open HDF5 file; ``whole``: it will be in memory at once, else
    frame by frame.

    Raises HabitusError where it is no plain array that lies in this file, or claims more than the
    file can hold.
    """
    h5py = require_extra("h5py", "HDF5 files")
    what = shown(name)
    if not isinstance(file.get(name, getlink=True), h5py.HardLink):
        raise HabitusError(f"{what} is a link to elsewhere; expected an array in this file")
    data = file[name]
    if (
        not isinstance(data, h5py.Dataset)
        or data.is_virtual
        or data.external
        or data.dtype.kind not in "fiu"
    ):
        raise HabitusError(f"{what} is no plain array of numbers in this file; write it as one")
    made = data.id.get_create_plist()
    steps = [made.get_filter(k)[0] for k in range(made.get_nfilters())]
    odd = [str(step) for step in steps if step not in _H5_FILTERS]
    if odd:
        raise HabitusError(
            f"{what} is packed with filter {', '.join(odd)}; expected "
            f"{', '.join(_H5_FILTERS.values())}"
        )
    size = array_size(tuple(map(int, data.shape)))
    width = data.dtype.itemsize
    if data.chunks is None:
        check_present(size * width, data.id.get_storage_size(), what)
    if whole or data.chunks is not None:
        pieces = () if data.chunks is None else tuple(data.chunks)
        allowance.take(size if whole else array_size(pieces), width, what)
        _check_total(size * width, data.id.get_storage_size(), what)
    if data.chunks is not None:
        _check_h5_pieces(data, steps, allowance.limit, what)
    return data


def _check_total(claimed: int, stored: int, what: str) -> None:
    """A whole set of sequences may be larger than memory, but not larger than its packed pieces can
    be.
    """
    if claimed > max(Allowance(0).limit, _STEEPEST * stored):
        check_present(claimed, stored, what)


def _check_h5_pieces(data: Any, steps: list[int], most: int, what: str) -> None:
    """Pieces that are small enough cannot inflate far; the others are inflated once, on
    probation, if the file holds them.
    """
    if 1 not in steps:
        return
    present = data.file.id.get_filesize()
    for k in range(data.id.get_num_chunks()):
        piece = data.id.get_chunk_info(k)
        if piece.byte_offset + piece.size > present:
            raise HabitusError(
                f"{what} claims a piece beyond the file's end; expected a whole HDF5 file"
            )
        if piece.size * _STEEPEST > most:
            check_inflated(data.id.read_direct_chunk(piece.chunk_offset)[1], most, what)


def zarr_array(group: Any, folder: Path, name: str, allowance: Allowance, *, whole: bool) -> Any:
    """The array ``name`` of a zarr group in ``folder``; ``whole``: it will be in memory at once,
    else row by row.

    Raises HabitusError where it is none, is packed in a way that runs code, or claims more than the
    folder can hold.
    """
    data = group[name]
    if not hasattr(data, "metadata") or not hasattr(data, "chunks"):
        raise HabitusError(f"{name} is no array; expected one")
    steps = set(_steps(data.metadata))
    odd = sorted(steps - _ZARR_STEPS)
    if odd:
        raise HabitusError(
            f"{name} is packed with {shown(', '.join(odd))}; expected "
            f"{', '.join(sorted(_ZARR_STEPS))} (no sharding)"
        )
    width = max(1, getattr(data.dtype, "itemsize", 8))
    size = array_size(tuple(map(int, data.shape)))
    allowance.take(size if whole else array_size(tuple(data.shape[1:])), width, name)
    allowance.take(array_size(tuple(map(int, data.chunks))), width, f"a chunk of {name}")
    stored = 0
    for piece in _pieces(folder / name):
        stored += piece.stat().st_size
        _check_zarr_piece(piece, steps, allowance.limit, name)
    _check_total(size * width, 32 * stored, name)
    return data


def _steps(metadata: Any) -> Iterator[str]:
    """The names of the codecs of an array, whichever version of the format it is in."""
    description = metadata.to_dict()
    for step in [
        *(description.get("codecs") or ()),
        *(description.get("filters") or ()),
        description.get("compressor"),
    ]:
        if isinstance(step, dict):
            yield str(step.get("name") or step.get("id"))
        elif step is not None:
            yield str(getattr(step, "codec_id", type(step).__name__))


def _pieces(folder: Path) -> Iterator[Path]:
    for path in sorted(folder.rglob("*")):
        if path.is_symlink():
            raise HabitusError(
                f"{shown(path.name)} is a link to elsewhere; expected the files of this folder"
            )
        if path.is_file() and path.name not in ("zarr.json", ".zarray", ".zattrs"):
            yield path


def _check_zarr_piece(piece: Path, steps: set[str], most: int, what: str) -> None:
    """What a packed piece says that it unpacks to; where it does not say, it is inflated once, on
    probation.
    """
    with piece.open("rb") as file:
        head = file.read(18)
        claimed = [_CLAIMS[step](head) for step in steps & set(_CLAIMS)]
        check_present(max(claimed, default=0), most, f"a chunk of {what}")
        if steps & set(_INFLATING) and piece.stat().st_size * _STEEPEST > most:
            wbits = _INFLATING[next(iter(steps & set(_INFLATING)))]
            check_inflated(head + file.read(), most, what, wbits)


def _blosc_claim(head: bytes) -> int:
    return int.from_bytes(head[4:8], "little")


def _lz4_claim(head: bytes) -> int:
    return int.from_bytes(head[:4], "little")


def _zstd_claim(head: bytes) -> int:
    """The size of its content that a zstd frame names (RFC 8878, 3.1.1.1)."""
    if len(head) < 6 or head[:4] != b"\x28\xb5\x2f\xfd":
        return 0
    kind = head[4] >> 6
    single = head[4] >> 5 & 1
    if kind == 0 and not single:
        raise HabitusError("a zstd frame that does not name its size; write it again")
    begins = 5 + (0 if single else 1) + (0, 1, 2, 4)[head[4] & 3]
    return int.from_bytes(head[begins : begins + 2**kind], "little") + (256 if kind == 1 else 0)


_CLAIMS = {"blosc": _blosc_claim, "lz4": _lz4_claim, "zstd": _zstd_claim}
