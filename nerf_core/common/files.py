"""Write files completely or not at all, and clear what a killed process left half written."""

from __future__ import annotations

import errno
import itertools
import os
import shutil
import sys
import time
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

from nerf_core.common.errors import UserError

PREFIX, SUFFIX = ".nerf-viewer-", ".part"  # of what is being written: no other program uses such names
FRESH_SECONDS = 60.0  # a younger part may belong to a process that has not locked it yet
UNLOCKABLE_SECONDS = 86_400.0  # without locks, a part as old as this is left over: nothing is written for a day


class Part:
    """A new hidden file or folder, to be written and then moved into its place.

    It is locked while this process lives, so that `clear_leftovers` can tell it from one of a killed process. Its name
    is short, because that of the target may have the 255 bytes that systems allow.

    path: the file or folder.
    """

    def __init__(self, folder: Path, *, directory: bool = False) -> None:
        """Make it, and `folder` if needed. Leftovers in `folder` are cleared. Raises OSError."""
        folder.mkdir(parents=True, exist_ok=True)
        clear_leftovers(folder)
        self.path = folder / f"{PREFIX}{uuid.uuid4().hex}{SUFFIX}"
        if directory:
            self.path.mkdir()
        else:
            self.path.open("xb").close()  # with the permissions of an ordinary file
        self._lock = _locked(self.path)

    def release(self) -> None:
        """Remove what was not moved into its place. A second call does nothing."""
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None
        _remove(self.path)


def clear_leftovers(folder: Path) -> None:
    """Delete the parts in a folder that no living process writes. Files of other programs are not touched."""
    with suppress(OSError):
        for path in folder.glob(f"{PREFIX}*{SUFFIX}"):
            with suppress(OSError):
                age = time.time() - path.stat().st_mtime
                lock = _locked(path)
                if lock is not None:
                    os.close(lock)
                if (lock is not None and (age > FRESH_SECONDS or not _empty(path))) or age > UNLOCKABLE_SECONDS:
                    _remove(path)


def write_atomically(path: Path, data: bytes | str, *, numbered: bool = False) -> Path:
    """Write `data` to `path` so that the path holds either all of it or the old file (temporary file, fsync, rename).

    Args:
        path: the file.
        data: its contents; text is written as UTF-8.
        numbered: replace nothing: if `path` is taken, the first that is not of name-2, name-3 … is written.

    Returns:
        The file that was written.

    Raises:
        UserError: the folder cannot be written or the disk is full.
    """
    try:
        if path.is_dir() and not numbered:  # also "." and "/", which have no name
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
        part = Part(path.parent)
        try:
            with part.path.open("wb") as file:
                file.write(data.encode() if isinstance(data, str) else data)
                file.flush()
                os.fsync(file.fileno())
            if numbered:
                path = _claimed(path)
            part.path.replace(path)
        finally:
            part.release()
        return path
    except OSError as error:
        advice = "choose a folder that has space and takes files"
        raise UserError(f"{path}: cannot be written: {error.strerror or error}; {advice}") from None


def _claimed(path: Path) -> Path:
    """Make an empty file, with a number if the name is taken, and return it. Raises OSError."""
    for number in itertools.count(1):
        file = path if number == 1 else path.with_name(f"{path.stem}-{number}{path.suffix}")
        try:
            file.open("xb").close()  # of two programs that try it, one gets the name
        except FileExistsError:
            continue
        return file
    raise AssertionError


@contextmanager
def utf8_path(path: Path) -> Iterator[Path]:
    """Yield a path of an existing file for libraries that take only names in UTF-8. Raises OSError."""
    try:
        str(path).encode()
    except UnicodeEncodeError:
        with path.open("rb") as file:
            yield Path(f"/dev/fd/{file.fileno()}")  # other names than in UTF-8 exist only where this does
    else:
        yield path


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a new file beside `path`. It replaces `path` when the block succeeds and is deleted when it raises."""
    part = claim_part(path)
    try:
        yield part.path
        os.replace(part.path, path)
    except OSError as error:
        raise unwritable(path, error) from error
    finally:
        part.release()


def claim_part(path: Path) -> Part:
    """Make an empty part beside `path`, with its folder if needed. Raises UserError."""
    try:
        return Part(path.parent)
    except OSError as error:
        raise unwritable(path, error) from error


def unwritable(path: Path, error: OSError) -> UserError:
    return UserError(f"cannot write {path}: {error.strerror or error}; choose a folder that has space and takes files")


def _locked(path: Path) -> int | None:
    """Open and lock a file or folder.

    Returns:
        The descriptor, whose lock ends with the process. None if another process holds the lock, or if the system
        cannot lock a file that is to be renamed, as Windows.
    """
    if sys.platform == "win32":
        return None
    import fcntl

    descriptor = os.open(path, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(descriptor)
        return None
    return descriptor


def _empty(path: Path) -> bool:
    return not any(path.iterdir()) if path.is_dir() else path.stat().st_size == 0


def _remove(path: Path) -> None:
    with suppress(OSError):
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink(missing_ok=True)


def locked_file(path: Path) -> BinaryIO | None:
    """Open a file and lock it until it is closed or the process ends. None: another process has it. Raises OSError."""
    file = path.open("ab+")
    try:
        if sys.platform == "win32":
            import msvcrt

            msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
        else:
            import fcntl

            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        file.close()
        return None
    return file
