"""Run folders: config.json, log.jsonl and checkpoints/. `nerf-core eval` adds metrics.json and eval/."""

from __future__ import annotations

import itertools
import json
import os
import platform
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import asdict, fields, replace
from importlib import metadata
from pathlib import Path
from typing import Any

from torch import Tensor

from nerf_core.captures.opening import open_capture
from nerf_core.common import device
from nerf_core.common.errors import UserError, shorten
from nerf_core.common.files import clear_leftovers, locked_file, write_atomically
from nerf_core.common.json_files import Fields, read_json
from nerf_core.datasets import LoadOptions
from nerf_core.methods.group import ALONE, Group
from nerf_core.training import checkpoint
from nerf_core.training.settings import RunSettings, filled
from nerf_core.training.trainer import Trainer

CONFIG = "the object that `nerf-core train` wrote"
CONFIG_FIELDS = {"data", "settings", "method", "device", "versions"}
OPTION_NAMES = {"changes": "set"}  # options that have another name than their setting


class RunFolder:
    """One training on disk. Hold it with `claimed()` to write to it; reading is possible at any time.

    path: the folder.
    config_file: its config.json.
    log_file: its log.jsonl.
    """

    def __init__(self, path: Path) -> None:
        """Name the folder. Nothing is read or written yet, and the folder need not exist."""
        self.path = path
        self.config_file = path / "config.json"
        self.log_file = path / "log.jsonl"

    @contextmanager
    def claimed(self) -> Iterator[None]:
        """Lock the folder during the block, so that no other process trains in it. Create it if necessary.

        A new folder is removed again if the block does not write config.json.

        Raises:
            UserError: another process holds the folder, or it cannot be written.
        """
        existed = self.path.exists()
        try:
            (self.path / "checkpoints").mkdir(parents=True, exist_ok=True)
            file = locked_file(self.path / ".lock")
        except OSError as error:
            raise self._unwritable(error) from None
        if file is None:
            raise UserError(f"{self.path}: another process trains in this folder: wait for it or choose another --out")
        with file:
            clear_leftovers(self.path / "checkpoints")  # of a process that was killed while saving
            try:
                yield
            finally:
                if not existed and not self.config_file.exists():
                    file.close()
                    self._remove_new()

    def _remove_new(self) -> None:
        """Remove what `claimed` made, unless somebody put files into it meanwhile."""
        with suppress(OSError):
            (self.path / ".lock").unlink()
            (self.path / "checkpoints").rmdir()
            self.path.rmdir()

    # ---- writing --------------------------------------------------------------------------------------------------

    def must_be_new(self) -> None:
        """Raise UserError if the folder has a run already, or files of other programs that a run would replace."""
        if self.checkpoints():
            raise UserError(f"{self.path}: holds a run already: continue it with --resume or choose another --out")
        own = self.config_file.exists() and set(read_json(self.config_file, CONFIG).values) >= CONFIG_FIELDS
        names = () if own else (self.config_file, self.log_file, self.path / "metrics.json", self.path / "eval")
        for path in names:
            if path.exists():
                raise UserError(f"{path}: not written by a training: choose another --out")

    def begin(self, data: Path | None, settings: RunSettings, trainer: Trainer) -> None:
        """Write config.json for a new run, and an empty log.

        A log that exists is emptied: it belongs to a run that ended before its first checkpoint.

        Args:
            data: the dataset; None is the demo scene.
            settings: the settings that the trainer was made from.
            trainer: the trainer of the run.

        Raises:
            UserError: the folder cannot be written.
        """
        settings = replace(settings, method=trainer.method_name)
        config = {
            "data": None if data is None else str(data.resolve()),
            "settings": asdict(settings),
            "method": trainer.config.to_json(),
            "device": device.describe(trainer.device),
            "versions": _versions(),
        }
        write_atomically(self.config_file, json.dumps(config, indent=2) + "\n")
        write_atomically(self.log_file, "")

    def log(self, line: Mapping[str, float]) -> None:
        """Append one JSON object to log.jsonl. Raises UserError if it cannot be written."""
        try:
            with self.log_file.open("a", encoding="utf-8") as file:
                file.write(json.dumps(line) + "\n")
        except OSError as error:
            raise self._unwritable(error) from None

    def save(self, description: Mapping[str, Any], state: Mapping[str, Tensor]) -> Path:
        """Write a checkpoint unless its step has one, and delete all but the newest two.

        Args:
            description: that of `Trainer.describe()`.
            state: that of `Trainer.state()`.

        Returns:
            The file of the checkpoint.

        Raises:
            UserError: the file cannot be written, or a foreign file has its name.
        """
        path = checkpoint.step_path(self.path, description["step"])
        if not path.exists():
            checkpoint.save(path, description, state)
            checkpoint.keep_newest(self.path)
        elif not checkpoint.is_own(path):
            raise UserError(f"{path}: not a checkpoint of its step, and not replaced: move it away")
        return path

    # ---- reading --------------------------------------------------------------------------------------------------

    def checkpoints(self) -> list[Path]:
        """Return the files of the checkpoints, oldest first."""
        return checkpoint.checkpoints(self.path)

    def config(self) -> tuple[Path | None, RunSettings]:
        """Read config.json.

        Returns:
            The dataset (None is the demo scene), and the settings.

        Raises:
            UserError: the folder is not a run, or config.json is not valid.
        """
        if not self.config_file.is_file():
            raise UserError(
                f"{self.path}: not a run: it has no config.json; give the folder that `nerf-core train` wrote"
            )
        document = read_json(self.config_file, CONFIG)
        settings = document.values.get("settings")
        if not isinstance(settings, dict):
            raise document.error("settings", "an object is needed: was this file written by `nerf-core train`?")
        load = settings.get("load")
        if not isinstance(load, dict):
            raise document.error("settings.load", "an object is needed: was this file written by `nerf-core train`?")
        options = filled(LoadOptions, Fields(load, self.config_file, "settings.load."))
        given = {**settings, "load": options}
        data = Path(document.text("data")) if "data" in document else None
        return data, filled(RunSettings, Fields(given, self.config_file, "settings."))

    def restore(
        self, data: Path | None = None, on: str = "auto", progress: Callable[[str, int, int], None] | None = None,
        group: Group = ALONE,
    ) -> tuple[Trainer, tuple[str, ...]]:  # fmt: skip
        """Load the newest intact checkpoint with its scene.

        Args:
            data: where the dataset is now, if it has moved; None: where config.json says.
            on: the device, such as "cpu"; "auto" picks one.
            progress: called as (what is done, photos done, photos in all) while photos load; it may raise to cancel.
            group: the processes that will train it together.

        Returns:
            The trainer, which has the scene, and warnings for the user, a line each.

        Raises:
            UserError: there is no checkpoint that can be read, the scene is another than the checkpoint's, or another
                version wrote it.
        """
        stored, settings = self.config()
        path, description, state, rejected = checkpoint.newest(self.path)
        scene = open_capture(data or stored, settings.load, progress)
        if not scene.is_of(description):
            raise UserError(f"{path}: {scene.difference(description)}")
        device.pick_device(on)  # a wrong one is no fault of the checkpoint
        with checkpoint.named(path):
            trainer = Trainer.resume(scene, description, state, on, group)
        return trainer, (*rejected, *scene.notes, *trainer.notes(description))

    def rewind(self, step: int) -> tuple[str, ...]:
        """Prepare the folder for a run that continues from `step`.

        Later checkpoints are damaged, or they would have been loaded: they are renamed. A file whose header does not
        show that it was written here stays. Later lines of the log are removed. The log serves plots alone, so a
        damaged one stops nothing.

        Args:
            step: the step that was loaded.

        Returns:
            Warnings for the user, a line each.

        Raises:
            UserError: a checkpoint cannot be renamed.
        """
        for path in self.checkpoints():
            if checkpoint.step_of(path) > step and checkpoint.has_own_header(path):
                try:
                    path.rename(_aside(path))
                except OSError as error:
                    raise self._unwritable(error) from None
        try:
            return self._rewind_log(step)
        except (OSError, UserError) as error:
            return (f"{self.log_file}: cannot be continued ({error}); training goes on without it",)

    def _rewind_log(self, step: int) -> tuple[str, ...]:
        """Keep the lines up to a step. A log with lines that cannot be read is kept aside, but for a cut last line."""
        if not self.log_file.exists():
            return ()
        lines = self.log_file.read_bytes().splitlines(keepends=True)
        steps = [_step_of(line) for line in lines]
        kept = b"".join(line for line, k in zip(lines, steps, strict=True) if k is not None and k <= step)
        notes: tuple[str, ...] = ()
        unread = steps[: -1 if lines and not lines[-1].endswith(b"\n") else None].count(None)
        if unread:
            aside = _aside(self.log_file)
            self.log_file.rename(aside)
            notes = (f"{self.log_file}: {unread} of {len(lines)} lines cannot be read; it is kept as {aside.name}",)
        write_atomically(self.log_file, kept)
        return notes

    def _unwritable(self, error: OSError) -> UserError:
        where = error.filename or self.path
        return UserError(f"{where}: cannot be written ({error.strerror or error}): choose another --out")


def must_agree(given: RunSettings, run: RunFolder) -> None:
    """Check that the options to continue a run agree with those that it was begun with.

    An option that is left at its default is taken from the run. The number of steps and the device may change; the
    learning schedule does not change with them.

    Args:
        given: the options now.
        run: the run.

    Raises:
        UserError: an option differs.
    """
    stored, plain = run.config()[1], RunSettings()
    pairs = [(f.name, given, stored, plain) for f in fields(RunSettings) if f.name not in ("load", "steps", "device")]
    pairs += [(f.name, given.load, stored.load, plain.load) for f in fields(LoadOptions)]
    for name, *owners in pairs:
        new, old, default = (getattr(owner, name) for owner in owners)
        if new not in (default, old):
            option = OPTION_NAMES.get(name, name).replace("_", "-")
            raise UserError(
                f"--{option}: {run.path} was begun with {shorten(old)} and cannot continue with {shorten(new)}: "
                "leave the option out, or begin anew in another --out"
            )


def _aside(path: Path) -> Path:
    """Return a name for a damaged file that no file has yet."""
    names = (f"{path.name}.damaged{f'-{n}' if n > 1 else ''}" for n in itertools.count(1))
    return next(file for file in map(path.with_name, names) if not os.path.lexists(file))


def _step_of(line: bytes) -> float | None:
    """Return the step of a log line; None for a line that is none."""
    try:
        step = json.loads(line)["step"]
    except (ValueError, KeyError, TypeError, RecursionError):
        return None
    return step if type(step) in (int, float) else None


def _versions() -> dict[str, str]:
    names = ("nerf-viewer", "torch", "numpy", "safetensors")
    found = {d.metadata["Name"]: d.version for name in names for d in metadata.distributions(name=name)}
    return {"python": platform.python_version(), "system": platform.platform(), **found}
