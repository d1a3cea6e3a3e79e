"""Options of jobs: one frozen dataclass a job, each option with its type, default and help in one
place.

tyro makes the command from it, and `takes` makes a function take its fields as keywords. Modules of
options load neither NumPy nor the numerics, so that help comes at once.
"""

import inspect
from collections.abc import Callable
from dataclasses import MISSING, dataclass, fields, replace
from functools import wraps
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import tyro

if TYPE_CHECKING:
    from habitus.body.model import BodyModel
    from habitus.types import PathLike

    Body = PathLike | BodyModel
    File = PathLike
else:  # what a command line can say
    Body = File = str

Flag = Annotated[bool, tyro.conf.FlagCreatePairsOff, tyro.conf.arg(help_behavior_hint="")]
"""An option that is given or not."""
PythonOnly = tyro.conf.Suppress
"""Marks an option that the command line does not show."""
R = TypeVar("R")


def silent(stage: str, share: float) -> None:
    """Does nothing (default progress callback)."""


def unset(metavar: str) -> Any:
    """For options without a default worth showing: the help names none."""
    return tyro.conf.arg(metavar=metavar, help_behavior_hint="")


def metavar(text: str) -> Any:
    """What stands for the value in the help."""
    return tyro.conf.arg(metavar=text)


@dataclass(frozen=True, kw_only=True)
class BodyOption:
    """The body that a job uses."""

    body: Annotated[Body, metavar("default|FILE")] = "default"
    """The body model: the bundled one, or an SMPL-family file (npz, pkl)."""


def takes(kind: type) -> Callable[[Callable[..., R]], Callable[..., R]]:
    """A decorator: the function's ``options``, a ``kind``, may also be given field by field.

    ``job(x, fps=60)`` is ``job(x, options=Options(fps=60))``; keywords replace fields of
    ``options``. The signature shows every field.
    """
    names = {field.name for field in fields(kind) if field.init}

    def decorated(function: Callable[..., R]) -> Callable[..., R]:
        own = inspect.signature(function)
        clash = names & set(own.parameters)
        assert not clash, f"{function.__name__} and {kind.__name__} both have {clash}"

        @wraps(function)
        def with_keywords(*given: Any, options: Any = None, **keywords: Any) -> R:
            changes = {name: keywords.pop(name) for name in names & keywords.keys()}
            if options is None:
                options = kind(**changes)
            elif not isinstance(options, kind):  # options of the base class: the rest by default
                options = kind(**{f.name: getattr(options, f.name) for f in fields(options)})
                options = replace(options, **changes)
            elif changes:
                options = replace(options, **changes)
            return function(*given, options=options, **keywords)

        with_keywords.__signature__ = _signature(own, kind)  # type: ignore[attr-defined]
        return with_keywords

    return decorated


def _signature(own: inspect.Signature, kind: type) -> inspect.Signature:
    """The function's parameters, with a keyword for each field in the place of ``options``."""
    added = [
        inspect.Parameter(
            field.name,
            inspect.Parameter.KEYWORD_ONLY,
            default=field.default if field.default_factory is MISSING else field.default_factory(),
            annotation=getattr(field.type, "__origin__", field.type)
            if hasattr(field.type, "__metadata__")
            else field.type,
        )
        for field in fields(kind)
        if field.init
    ]
    kept = [one for name, one in own.parameters.items() if name != "options"]
    first = [one for one in kept if one.kind is not inspect.Parameter.KEYWORD_ONLY]
    last = [one for one in kept if one.kind is inspect.Parameter.KEYWORD_ONLY]
    return own.replace(parameters=[*first, *added, *last])
