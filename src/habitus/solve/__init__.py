"""Solvers that know nothing of bodies. `habitus.solve.minimize` is the function, though a file has
the same name.
"""

import sys
from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from habitus.solve.minimize import minimize as minimize


class _Solve(ModuleType):
    """This package, with one name that is loaded when asked for."""

    @property
    def minimize(self) -> Any:
        """The function of `habitus.solve.minimize`."""
        return import_module("habitus.solve.minimize").minimize

    @minimize.setter
    def minimize(self, module: ModuleType) -> None:
        """Python sets a package's attribute to each file it has loaded: here the function keeps its
        name.
        """


sys.modules[__name__].__class__ = _Solve
