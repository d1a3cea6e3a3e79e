"""Which modules have their annotations checked while tests run, and by what.

Of each function that states shapes the first calls in each test are checked: checks of all calls,
and of functions without shapes, took a third of the time of the tests of marker fits.
"""

from collections.abc import Callable
from dataclasses import is_dataclass
from functools import wraps
from inspect import isclass
from pathlib import Path
from typing import Any, get_args

from beartype import beartype
from jaxtyping import AbstractArray, jaxtyped

ROOT = Path(__file__).resolve().parents[2]
CALLS = 10
"""Of a function, that are checked in one test."""
COMPILED = ("from habitus.kernels.jit import", "import numba", "from numba")


def checked_modules(package: str) -> list[str]:
    """The modules of a package that state shapes, but those with compiled kernels, which a check
    would wrap.
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


_tests = 0


def begin_test() -> None:
    """The first calls of all functions are checked again."""
    global _tests
    _tests += 1


def first_calls(*, typechecker: Callable) -> Callable:
    """What the import hook decorates functions and classes with, in place of `jaxtyped`."""

    def decorated(thing: Any) -> Any:
        if isclass(thing):
            if is_dataclass(thing):
                thing.__init__ = decorated(thing.__init__)
            return thing
        hints = thing.__annotations__.values()
        if not any(isinstance(hint, str) or _has_shape(hint) for hint in hints):
            return thing
        return _in_first_calls(thing, jaxtyped(thing, typechecker=typechecker))

    return decorated


def _in_first_calls(plain: Callable, checked: Callable) -> Callable:
    test, calls = -1, 0

    @wraps(plain)
    def either(*args: Any, **kwargs: Any) -> Any:
        nonlocal test, calls
        if test != _tests:
            test, calls = _tests, 0
        calls += 1
        return (checked if calls <= CALLS else plain)(*args, **kwargs)

    return either


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
