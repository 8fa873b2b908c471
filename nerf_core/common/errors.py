"""The one kind of error that a user is meant to read."""


class UserError(Exception):
    """What was got, where (file, field), and what would be right: one line, no traceback, exit status 2."""


def shorten(value: object, limit: int = 60) -> str:
    """`repr(value)` on one line, cut to `limit` characters: values of a broken file can be megabytes."""
    text = repr(value)
    return text if len(text) <= limit else text[: limit - 1] + "…"
