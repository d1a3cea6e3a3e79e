"""Which modules have their annotations checked while tests run, and by what."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, get_args

from beartype import beartype
from jaxtyping import AbstractArray

ROOT = Path(__file__).resolve().parents[2]
COMPILED = ("from habitus.kernels.jit import", "import numba", "from numba")


def checked_modules(package: str) -> list[str]:
    """The modules of a package that state shapes, but those with compiled kernels, which a check
    would wrap. The hook wraps every function of a module, which slows readers of single bytes.
    """
    source = ROOT / ("lab/src" if package.startswith("habitus_lab.") else "src")
    place = source / package.replace(".", "/")
    names = []
    for path in sorted([place.with_suffix(".py"), *place.rglob("*.py")]):
        # The hook takes the name of a package for all that is in it.
        if path.exists() and path.stem != "__init__":
            text = path.read_text()
            compiled = any(words in text for words in COMPILED)
            name = ".".join(path.relative_to(source).with_suffix("").parts)
            if "jaxtyping" in text and not compiled:
                names.append(name)
    return names


def shapes_only(function: Callable[..., Any]) -> Callable[..., Any]:
    """Checks the annotations that carry shapes: tests give stand-ins for classes."""
    function.__annotations__ = {
        name: hint for name, hint in function.__annotations__.items() if _has_shape(hint)
    }
    return beartype(function)


def _has_shape(hint: Any) -> bool:
    if isinstance(hint, type) and issubclass(hint, AbstractArray):
        return True
    return any(_has_shape(part) for part in get_args(hint))
