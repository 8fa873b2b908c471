"""Rows of a study on a Ray cluster of this machine: two worker processes, one of which is lost."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

import pytest

from nerf_core.common.errors import UserError
from nerf_core.lab.workers import CONNECTIONS, _connected, rows_on

pytestmark = pytest.mark.skipif(find_spec("ray") is None, reason="needs the extra nerf-viewer[ray]")
ROOT = Path(__file__).parents[3]
PATIENCE = 200  # seconds
TASK = b"ray::done_elsewhere"  # the name that Ray gives to a process while it does a row


def free_port() -> int:
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return listener.getsockname()[1]


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[str, int]]:
    """A cluster with two workers: its address, and the process that has started it."""
    port = free_port()
    command = [sys.executable, "-m", "ray.scripts.scripts", "start", "--head", "--block", "--num-cpus=2",
               f"--port={free_port()}", f"--ray-client-server-port={port}", "--include-dashboard=false",
               "--disable-usage-stats"]  # fmt: skip
    env = os.environ | {"PYTHONPATH": str(ROOT), "RAY_USAGE_STATS_ENABLED": "0", "RAY_worker_niceness": "0"}
    log = tmp_path_factory.mktemp("ray") / "log"
    with log.open("wb") as file, subprocess.Popen(
        command, env=env, stdout=file, stderr=file, start_new_session=True
    ) as head:  # fmt: skip
        try:
            end = time.monotonic() + PATIENCE
            while time.monotonic() < end and head.poll() is None:
                with socket.socket() as probe:
                    if probe.connect_ex(("127.0.0.1", port)) == 0:
                        break
                time.sleep(0.1)
            else:
                raise AssertionError(log.read_text(encoding="utf-8"))
            yield f"ray://127.0.0.1:{port}", head.pid
        finally:
            head.send_signal(signal.SIGTERM)  # it stops what it has started
            try:
                head.wait(30)
            except subprocess.TimeoutExpired:
                os.killpg(head.pid, signal.SIGKILL)


def started(capture: Path, out: Path, workers: str, *options: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "nerf_core.cli", "lab", "memory", str(capture), "--out", str(out),
               "--workers", workers, "--views", "1", *options]  # fmt: skip
    return subprocess.Popen(
        command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, encoding="utf-8"
    )


def parent(process: int) -> int:
    """The parent of a process; 0 if it has ended."""
    try:
        return int(Path(f"/proc/{process}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()[1])
    except OSError:
        return 0


def descends(process: int, head: int) -> bool:
    while process > 1 and process != head:
        process = parent(process)
    return process == head


def tasks(head: int) -> set[int]:
    """The processes that do rows now, of the cluster that a process has started."""
    found = set()
    for file in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            if file.read_bytes().startswith(TASK) and descends(int(file.parent.name), head):
                found.add(int(file.parent.name))
        except OSError:  # it has ended meanwhile
            continue
    return found


@pytest.mark.thorough(25)
@pytest.mark.skipif(not Path("/proc/self/cmdline").exists(), reason="finds the workers in /proc")
def test_rows_are_done_by_two_workers_and_a_lost_one_is_replaced(
    capture: Path, tmp_path: Path, cluster: tuple[str, int]
) -> None:
    address, head = cluster
    seen: set[int] = set()
    with started(capture, tmp_path, address, "--sides", "4,5,6", "--budget", "3s") as study:
        end, killed = time.monotonic() + PATIENCE, 0
        while study.poll() is None and time.monotonic() < end:
            now = tasks(head)
            seen |= now
            if not killed and len(now) == 2:
                time.sleep(0.5)
                killed = min(now)
                os.kill(killed, signal.SIGKILL)
            time.sleep(0.05)
        study.kill()
        assert study.stdout is not None
        said = study.stdout.read()
    assert study.returncode == 0, said
    assert killed
    assert len(seen) >= 3, "two workers, and another for the lost one"
    results = json.loads((tmp_path / "results.json").read_text(encoding="utf-8"))
    assert [one["row"]["side"] for one in results.values()] == [4, 5, 6]
    for key, one in results.items():
        assert one["result"]["threads"] == 1
        assert one["result"]["psnr"] > 5
        assert list((tmp_path / "pictures" / key).rglob("*.png"))
        assert list((tmp_path / "runs" / key / "checkpoints").glob("*.safetensors"))
    assert (tmp_path / "memory.png").is_file()
    assert "wrote" in said


def test_no_cluster_is_said_in_one_line(capture: Path, tmp_path: Path) -> None:
    address = f"ray://127.0.0.1:{free_port()}"
    with started(capture, tmp_path, address, "--sides", "4", "--budget", "1steps") as study:
        assert study.stdout is not None
        said = study.stdout.read().strip()
        assert study.wait(PATIENCE) == 2, said
    assert said.splitlines()[-1].startswith(f"nerf-core: --workers {address}: no cluster answers")


def test_a_cluster_that_breaks_off_is_asked_again(monkeypatch: pytest.MonkeyPatch) -> None:
    import ray

    answers: list[object] = []

    def init(address: str, **options: object) -> object:
        if not answers or answers.pop(0) is None:
            raise ConnectionAbortedError(
                "Initialization failure from server:\nTraceback:\n  …\nRuntimeError: no channel\n"
            )
        return address

    monkeypatch.setattr(ray, "init", init)
    with socket.create_server(("127.0.0.1", 0)) as server:
        address = f"ray://127.0.0.1:{server.getsockname()[1]}"
        answers[:] = [None] * (CONNECTIONS - 1) + [True]
        assert _connected(address) == address
        with pytest.raises(UserError, match=r"the cluster does not let us in \('RuntimeError: no channel'\): look"):
            _connected(address)
        monkeypatch.setattr(ray, "init", lambda *_, **__: (_ for _ in ()).throw(ConnectionAbortedError))
        with pytest.raises(UserError, match="does not let us in"):  # without a word
            _connected(address)


@pytest.mark.parametrize("address", ["ray://", "localhost:10001", "dask://x:1"])
def test_another_address_is_refused(address: str) -> None:
    with pytest.raises(UserError, match=r"give the address of a Ray cluster, ray://HOST:PORT"):
        rows_on(address)
