"""The tree of joints that a mesh hangs on, as a tuple of parents."""

from habitus.errors import HabitusError


def check_parents(parents: tuple[int, ...]) -> None:
    """Raise HabitusError unless ``parents`` is one tree whose root is joint 0 and whose parents
    come first.
    """
    if not parents or parents[0] != -1:
        raise HabitusError(
            f"parents begin with {list(parents[:1])}; expected -1: joint 0 is the root"
        )
    for joint, parent in enumerate(parents[1:], 1):
        if not 0 <= parent < joint:
            raise HabitusError(
                f"the parent of joint {joint} is {parent}; expected a joint before it (0 to "
                f"{joint - 1})"
            )
