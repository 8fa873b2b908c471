"""Write files completely or not at all."""

from __future__ import annotations

import errno
import os
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from nerf_core.common.errors import UserError


def write_atomically(path: Path, data: bytes | str) -> None:
    """Write `data` to `path` so that the path holds either all of it or the old file (temporary file, fsync, rename).

    Raises UserError when the folder cannot be written or the disk is full.
    """
    temporary = path.parent / f".{path.name}.{os.getpid()}.part"
    try:
        if path.is_dir():  # also "." and "/", which have no name
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
        path.parent.mkdir(parents=True, exist_ok=True)
        with temporary.open("wb") as file:
            file.write(data.encode() if isinstance(data, str) else data)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    except OSError as error:
        with suppress(OSError):  # if the path itself is impossible, removing fails like creating
            temporary.unlink()
        advice = "choose a folder that has space and takes files"
        raise UserError(f"{path}: cannot be written: {error.strerror or error}; {advice}") from None
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a new file beside `path`. It replaces `path` when the block succeeds and is deleted when it raises."""
    part = claim_part(path)
    try:
        yield part
        os.replace(part, path)
    except OSError as error:
        raise unwritable(path, error) from error
    finally:
        part.unlink(missing_ok=True)


def claim_part(path: Path) -> Path:
    """Create an empty file beside `path`, with its folder if needed, and with the permissions of an ordinary file."""
    part = path.parent / f".{uuid.uuid4().hex}.part"
    try:
        part.parent.mkdir(parents=True, exist_ok=True)
        part.open("xb").close()
    except OSError as error:
        raise unwritable(path, error) from error
    return part


def unwritable(path: Path, error: OSError) -> UserError:
    return UserError(f"cannot write {path}: {error.strerror or error}; choose a folder that has space and takes files")
