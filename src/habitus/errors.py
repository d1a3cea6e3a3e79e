"""The one family of errors that a user is meant to read."""


class HabitusError(Exception):
    """Bad input, said in one line: what arrived, what was expected, what to do. The command exits with 2."""
