"""What pages about one study share: their temporary folders."""

from __future__ import annotations

import shutil
import tempfile
import weakref
from pathlib import Path


class StudyFolders:
    """Folders for studies, in a temporary folder that goes when the page does: a page is for playing.

    The Lab panel and `nerf-core lab` write results to keep.
    """

    def __init__(self, name: str) -> None:
        """name: of the page, in the name of the temporary folder."""
        self._name = name
        self._home: Path | None = None
        self._studies: list[Path] = []

    def fresh(self, current: Path | None) -> Path:
        """Make a folder for a study, and delete those that no study can need any more. Raises OSError.

        current: the folder of the newest study that is known to have begun. Studies begin one after the other, so those
            before it have ended. It and those after it may still be at work. None, or another folder: all stay.
        """
        if current in self._studies:
            ended = self._studies.index(current)
            for folder in self._studies[:ended]:
                shutil.rmtree(folder, ignore_errors=True)
            del self._studies[:ended]
        folder = self.kept("study")
        self._studies.append(folder)
        return folder

    def kept(self, name: str) -> Path:
        """Make a folder that stays as long as the page. Raises OSError. name: what its name begins with."""
        if self._home is None:
            self._home = Path(tempfile.mkdtemp(prefix=f"nerf-viewer-{self._name}-"))
            weakref.finalize(self, shutil.rmtree, self._home, ignore_errors=True)  # at the latest when Python ends
        return Path(tempfile.mkdtemp(prefix=f"{name}-", dir=self._home))
