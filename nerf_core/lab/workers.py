"""Do a study's rows as tasks of a Ray cluster. A task whose worker is lost is done again by another one."""

from __future__ import annotations

import logging
import socket
import tempfile
from pathlib import Path
from typing import Any

from nerf_core import __version__
from nerf_core.common.errors import UserError, shorten
from nerf_core.common.files import write_atomically
from nerf_core.lab.job import Rows, RunRows, StudyJob, row_pieces
from nerf_core.lab.records import Advance, Result, Row
from nerf_core.lab.study import Bench, Study, Subject

SCHEME = "ray://"
RETRIES = 3  # of a row whose worker is lost
CONNECTIONS = 4  # attempts, if the cluster breaks them off
CONNECT_SECONDS = 5.0
WAIT_SECONDS = 0.3  # between looks at the cluster, in which Ctrl-C can come
CORES = 1  # of a task; a row trains on so many threads


def rows_on(address: str) -> RunRows:
    """Return what does a study's rows on a cluster.

    The machines of the cluster need the same version of this package; the capture is sent to them. Pictures and run
    folders come back.

    Args:
        address: of Ray's client server, ray://HOST:PORT.

    Raises:
        UserError: the address is none, or Ray is not installed.
    """
    host, _, port = address.removeprefix(SCHEME).rpartition(":")
    if not (address.startswith(SCHEME) and host and port.isdigit() and int(port) < 2**16):
        raise UserError(f"--workers {shorten(address)}: give the address of a Ray cluster, ray://HOST:PORT")
    try:
        import ray  # noqa: F401  only to know that it is there
    except ImportError:
        raise UserError("--workers: Ray is not installed: pip install 'nerf-viewer[ray]'") from None

    def run_rows(job: StudyJob, rows: tuple[Row, ...]) -> Rows:
        return _on_cluster(address, job, rows)

    return run_rows


def _on_cluster(address: str, job: StudyJob, rows: tuple[Row, ...]) -> Rows:
    import ray
    from ray.exceptions import RayError

    if not rows:
        return
    if job.subject.scene is None and job.subject.data is not None:
        raise UserError("--workers: a photo is not sent to them: leave --workers out")
    if getattr(job.study, "lpips_weights", ""):
        raise UserError("--workers: the file of --lpips-weights is not sent to them: leave one of the two out")
    client = _connected(address)
    try:
        task: Any = ray.remote(num_cpus=CORES, max_retries=RETRIES)(done_elsewhere)
        subject = ray.put(job.subject._replace(threads=CORES))
        waiting = {task.remote(job.study, subject, row, __version__): row for row in rows}
        for row in rows:
            yield row.key, Advance(0.0, "waits for a worker")
        while waiting:
            ready, _ = ray.wait(list(waiting), num_returns=1, timeout=WAIT_SECONDS)
            for reference in ready:
                row = waiting.pop(reference)
                yield row.key, _fetched(reference, job.bench(row))
            if not ready:
                row = next(iter(waiting.values()))
                yield row.key, Advance(0.0, f"on the cluster, {len(waiting)} of {len(rows)} left")
    except (ConnectionError, RayError) as error:
        reason = shorten(" ".join(str(error).split()), 120)
        raise UserError(f"--workers {address}: the cluster is lost ({reason}): rows that are done are kept") from None
    finally:
        client.disconnect()  # which ends the tasks that are not done


def _connected(address: str) -> Any:
    """Return a connection to a cluster.

    Raises:
        UserError: there is no cluster, or it does not let this program in.
    """
    import ray

    host, _, port = address.removeprefix(SCHEME).rpartition(":")
    attempts = 0
    while True:
        try:
            socket.create_connection((host, int(port)), CONNECT_SECONDS).close()  # Ray itself waits half a minute
            return ray.init(address, logging_level=logging.ERROR, log_to_driver=False)
        except ConnectionAbortedError as error:  # the process that it forks for a program may crash or be late
            attempts += 1
            if attempts == CONNECTIONS:
                reason = shorten(str(error).strip().rpartition("\n")[2], 120)  # the last line of its traceback
                text = f"the cluster does not let us in ({reason}): look at its logs, or start it again"
                raise UserError(f"--workers {address}: {text}") from None
        except (ConnectionError, RuntimeError, ValueError, OSError) as error:
            reason = shorten(" ".join(str(error).split()), 120)
            raise UserError(f"--workers {address}: no cluster answers ({reason}): start one with `ray start`") from None


def _fetched(reference: Any, bench: Bench) -> Result:
    """Return the result of a row that is done, and write its files."""
    import ray
    from ray.exceptions import RayError

    try:
        result, pictures, run = ray.get(reference)
    except RayError as error:  # the worker was lost again and again, or the row has a fault
        reason = shorten(" ".join(str(error).split()[-40:]), 200)
        return {"failed": f"the worker failed: {reason}"}
    for folder, files in ((bench.pictures, pictures), (bench.run, run)):
        for name, data in files.items():
            write_atomically(folder / name, data)
    return result


def done_elsewhere(
    study: Study, subject: Subject, row: Row, version: str
) -> tuple[Result, dict[str, bytes], dict[str, bytes]]:
    """Do a row on a worker.

    Returns:
        What was measured, and the files of the folder of pictures and of the run folder by relative name.
    """
    if version != __version__:
        text = f"the cluster has version {__version__} of nerf-viewer, and this machine {version}: install the same"
        return {"failed": text}, {}, {}
    with tempfile.TemporaryDirectory(prefix="nerf-viewer-") as folder:
        bench = Bench(Path(folder) / "pictures", Path(folder) / "run")
        result: Result = {}
        for _, piece in row_pieces(study, subject, row, bench):
            if not isinstance(piece, Advance):
                result = piece
        return result, _files(bench.pictures), _files(bench.run)


def _files(folder: Path) -> dict[str, bytes]:
    """Read all files of a folder by relative name, but hidden ones."""
    found = sorted(path for path in folder.rglob("*") if path.is_file() and not path.name.startswith("."))
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in found}
