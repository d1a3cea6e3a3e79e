"""The decorator of every compiled kernel: float64, no interpreter lock, cached on disk, compiled when first called."""

from pathlib import Path

from numba import njit

HERE = Path(__file__).parent
FILES = (
    "compiled.py",
    "lanes.py",
    "lane_algebra.py",
    "solve/lane_cholesky.py",
    "observe/plain_kernels.py",
    "observe/lane_rig.py",
    "observe/lane_kernels.py",
    "observe/lane_slopes.py",
    "residuals/marker_lanes.py",
    "render/raster_kernels.py",
    "render/edge_kernels.py",
    "render/shadow_kernels.py",
    "render/sample_kernels.py",
    "render/image_kernels.py",
    "render/surface_kernels.py",
    "fit/sequence_kernels.py",
    "fit/turns.py",
    "render/texture_kernels.py",
    "learn/quaternion_parts.py",
    "learn/posing_kernels.py",
    "learn/weights_kernels.py",
)
"""Files with compiled kernels."""


def compiled(function, **options):
    """Compile `function` at its first call and keep the result on disk until one of `FILES` changes.

    numba itself watches only the file of the function, not those of the functions that were compiled into it.
    """
    dispatcher = njit(cache=True, nogil=True, error_model="numpy", **options)(function)
    cache_file = getattr(getattr(dispatcher, "_cache", None), "_cache_file", None)
    if cache_file is not None and hasattr(cache_file, "_source_stamp"):
        cache_file._source_stamp = (cache_file._source_stamp, _stamp())
    return dispatcher


def lean(function):
    """Compile a function that makes no arrays, without counting references to those it is given.

    In functions of lanes, which are short and many, the counting would cost more than the work.
    """
    return compiled(function, _nrt=False)


def part(function):
    """Compile a function that makes no arrays into the kernels that call it: Python cannot, and no file keeps it.

    An entry from Python and a file of machine code for each such function would take longer to make than its kernels.
    """
    return njit(nogil=True, error_model="numpy", _nrt=False, no_cpython_wrapper=True, no_cfunc_wrapper=True)(function)


def _stamp() -> tuple:
    found = ((HERE / name).stat() for name in FILES if (HERE / name).exists())
    return tuple((entry.st_mtime_ns, entry.st_size) for entry in found)
