"""The error for everything that the user can mend."""

from nerf_core.common.names import printable


class UserError(Exception):
    """One line that says what was found, where (file, field) and what to do. Programs print it and exit with `status`.

    text: may hold names of files as they are; see `printable`.
    """

    status = 2

    def __init__(self, text: str) -> None:
        super().__init__(printable(text))


def shorten(value: object, limit: int = 60) -> str:
    """Return `repr(value)` cut to `limit` characters, because a value of a broken file can be megabytes long."""
    text = repr(value)
    return text if len(text) <= limit else text[: limit - 1] + "…"
