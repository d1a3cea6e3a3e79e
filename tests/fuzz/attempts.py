"""One spoilt file given to one reader, and whether it answered as it should: sane values, or one
clear error.
"""

import io
import random
import shutil
import warnings
from collections.abc import Sequence
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path

from mutators import mutate
from target import Target, Tree

from habitus.errors import HabitusError


def spoilt(targets: Sequence[Target], number: int) -> tuple[Target, Tree]:
    """The target and the spoilt tree of mutant ``number``; the same ones each time."""
    rng = random.Random(number)
    target = rng.choices(targets, [target.share for target in targets])[0]
    tree = dict(rng.choice(target.trees))
    name = rng.choice(list(tree))
    tree[name] = mutate(rng, tree[name], [other for one in target.trees for other in one.values()])
    if len(tree) > 1 and rng.random() < 0.05:
        del tree[rng.choice(list(tree))]
    return target, tree


def attempt(target: Target, tree: Tree, folder: Path) -> str | None:
    """What is wrong with the answer to a tree of files, written below ``folder``; None where
    nothing is.
    """
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    for name, content in tree.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)
    printed = io.StringIO()
    try:
        with warnings.catch_warnings(), redirect_stdout(printed), redirect_stderr(printed):
            warnings.simplefilter("ignore")
            target.read(folder / target.entry)
    except HabitusError as error:
        return _wrong_message(error) or _relied_on_memory(error)
    except Exception as error:
        return f"{type(error).__name__}: {error}"[:300] + _where(error)
    return f"it printed {printed.getvalue()[:100]!r}" if printed.getvalue() else None


def _wrong_message(error: HabitusError) -> str | None:
    message = str(error)
    if not message or not message.isprintable() or len(message) >= 500:
        return f"a message of {len(message)} characters: {message[:200]!r}"
    return None


def _relied_on_memory(error: BaseException) -> str | None:
    """An error that came only because memory was at its end: on a larger machine there would be
    none.
    """
    cause: BaseException | None = error
    seen: set[int] = set()
    while cause is not None and id(cause) not in seen:
        if isinstance(cause, MemoryError):
            return f"memory was asked for without looking: {error}" + _where(cause)
        seen.add(id(cause))
        cause = cause.__cause__ or (None if cause.__suppress_context__ else cause.__context__)
    return None


def _where(error: BaseException) -> str:
    """The last lines of the project that an error came through."""
    trace = error.__traceback__
    places = []
    while trace is not None:
        code = trace.tb_frame.f_code
        if "habitus" in code.co_filename or "fuzz" in code.co_filename:
            places.append(f"{Path(code.co_filename).name}:{trace.tb_lineno}")
        trace = trace.tb_next
    return f" at {' < '.join(reversed(places[-3:]))}"
