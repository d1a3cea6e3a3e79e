"""The one family of errors that a user is meant to read."""

from types import ModuleType


class HabitusError(Exception):
    """Bad input, said in one line: what arrived, what was expected, what to do. The command exits with 2."""


def require_extra(module: str, what: str, extra: str = "train") -> ModuleType:
    """A module that comes with an extra. Raises HabitusError, saying how to get it, where it is not installed."""
    import importlib

    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise HabitusError(
            f"{what} need {module}, which is not installed; install it with: pip install 'habitus[{extra}]'"
        ) from error


class TorchIsAnExtra:
    """Around a block that may need PyTorch: a HabitusError says how to get it where it is not installed."""

    def __init__(self, what: str):
        self.what = what

    def __enter__(self) -> None:
        pass

    def __exit__(self, kind: object, error: object, traceback: object) -> None:
        if isinstance(error, ModuleNotFoundError) and error.name == "torch":
            raise HabitusError(
                f"{self.what} needs PyTorch, which is not installed; install it with: pip install 'habitus[torch]' "
                "(or habitus[train], habitus[images])"
            ) from error
