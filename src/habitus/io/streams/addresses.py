"""Hosts and ports as a user writes them."""

from habitus.errors import HabitusError, shown


def host_and_port(address: object, port: int) -> tuple[str, int]:
    """``HOST``, ``HOST:PORT`` or nothing, which is this machine; raises HabitusError for a port
    that is none.
    """
    text = "" if address is None else str(address).strip()
    host, colon, number = text.partition(":")
    if colon and not (number.isdigit() and 0 < int(number) < 65536):
        raise HabitusError(
            f"the address {shown(text)!r} has no port after its colon; expected HOST or HOST:PORT"
        )
    return host or "127.0.0.1", int(number) if colon else port
