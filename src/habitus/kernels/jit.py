"""The decorator of every compiled kernel: float64, no interpreter lock, cached on disk, compiled
when first called.
"""

import gc
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Any

from numba import njit
from numba.core import event
from numba.core.caching import FunctionCache

HERE = Path(__file__).parents[1]
FILES = (
    "kernels/jit.py",
    "kernels/simd.py",
    "kernels/simd_linalg.py",
    "kernels/simd_cholesky.py",
    "mesh/closest_kernels.py",
    "mesh/normal_kernels.py",
    "mesh/intersection_kernels.py",
    "body/dual_kernels.py",
    "body/kernels.py",
    "body/kernels_vjp.py",
    "observe/marker_rig.py",
    "observe/marker_kernels.py",
    "observe/marker_jacobian_kernels.py",
    "residuals/marker_kernels.py",
    "residuals/point_kernels.py",
    "residuals/keypoint_kernels.py",
    "io/rgbd/pcd.py",
    "render/kernels/structs.py",
    "render/kernels/vectors.py",
    "render/kernels/raster.py",
    "render/kernels/tiles.py",
    "render/kernels/polygons.py",
    "render/kernels/areas.py",
    "render/kernels/edges.py",
    "render/kernels/shadows.py",
    "render/kernels/samples.py",
    "render/kernels/images.py",
    "render/kernels/surfaces.py",
    "render/kernels/surfaces_vjp.py",
    "render/kernels/projection.py",
    "fit/markers/sequence_kernels.py",
    "fit/cameras/sequence_kernels.py",
    "fit/labels/kernels.py",
    "fit/retarget/robot_kernels.py",
    "fit/offset_kernels.py",
    "fit/points/correspondence_kernels.py",
    "render/kernels/textures.py",
    "learn/posing/kernels.py",
    "learn/steps/weights.py",
)
"""Files with compiled kernels."""


class _Undisturbed(event.Listener):
    """Lets no garbage be collected while numba compiles: it would take a sixth of the time, again
    and again.
    """

    def __init__(self) -> None:
        self._depth = 0
        self._collects = False

    def on_start(self, event: event.Event) -> None:
        """A function begins, maybe within one that calls it."""
        if self._depth == 0:
            self._collects = gc.isenabled()
            gc.disable()
        self._depth += 1

    def on_end(self, event: event.Event) -> None:
        """It is done."""
        self._depth -= 1
        if self._depth == 0 and self._collects:
            gc.enable()


event.register("numba:compile", _Undisturbed())


class _Cache(FunctionCache):
    """numba's own, of which no fault ends the run: the function is compiled then, and a file that
    is damaged begun anew.
    """

    @contextmanager
    def _guard_against_spurious_io_errors(self) -> Iterator[None]:
        try:
            yield
        except Exception:  # a damaged pickle may raise anything
            with suppress(OSError):
                self.flush()


def jit(function: Callable[..., Any], **options: Any) -> Callable[..., Any]:
    """Compile `function` at its first call and keep the result on disk until one of `FILES`
    changes; of another package, until one of the ``*_kernels.py`` beside the function does.

    numba itself watches only the file of the function, not those of the functions that were
    compiled into it. Where no folder for caches can be written to, every process compiles. A
    wrapper for C, which nothing here calls, would take a tenth of the time.
    """
    decorator: Any = njit
    dispatcher = decorator(nogil=True, error_model="numpy", no_cfunc_wrapper=True, **options)(
        function
    )
    if hasattr(dispatcher, "_cache"):  # not where NUMBA_DISABLE_JIT is set
        with suppress(RuntimeError):
            dispatcher._cache = cache = _Cache(function)
            file = cache._cache_file
            # compared before anything of an index is unpickled
            file._version = (file._version, _stamp(Path(function.__code__.co_filename)))
    return dispatcher


def jit_noalloc(function: Callable[..., Any]) -> Callable[..., Any]:
    """`jit` for functions that allocate no arrays: numba's reference counting is left out.

    In the short SIMD functions the counting would cost more than the work.
    """
    return jit(function, _nrt=False)


def jit_inline(function: Callable[..., Any]) -> Callable[..., Any]:
    """`jit_noalloc` for device functions that only kernels call: not callable from Python, and not
    cached.

    A Python wrapper and a cache file for each such function would take longer to make than its
    kernels.
    """
    decorator: Any = njit  # its signature leaves out the options that begin with _ and no_
    return decorator(
        nogil=True, error_model="numpy", _nrt=False, no_cpython_wrapper=True, no_cfunc_wrapper=True
    )(function)


def _stamp(own: Path) -> tuple:
    files = () if HERE in own.parents else sorted(own.parent.glob("*_kernels.py"))
    return _own_stamp() + _stamp_of(files)


@cache
def _own_stamp() -> tuple:
    """Of `FILES`, looked at once a process: some forty kernels ask."""
    return _stamp_of([HERE / name for name in FILES])


def _stamp_of(files: Iterable[Path]) -> tuple:
    stats = (path.stat() for path in files if path.exists())
    return tuple((entry.st_mtime_ns, entry.st_size) for entry in stats)
