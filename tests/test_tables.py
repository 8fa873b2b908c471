"""tests/benchmarks/tables.py says whether a row follows the published protocol."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

import pytest
import tables
from published import learn_and_evaluate, protocol

from nerf_core.datasets import LoadOptions, load_scene
from nerf_core.geometry.scene import Scene
from nerf_core.training.settings import RunSettings
from nerf_core.training.trainer import Trainer


@pytest.fixture(scope="module")
def demo() -> Scene:
    return load_scene(None, LoadOptions())


def full(scene: Scene, count: int, size: int) -> Scene:
    """The scene with so many test views of so many pixels; its photos are not those."""
    view = replace(scene.views[0], camera=scene.views[0].camera.resized(size, size))
    return replace(scene, views=(view,) * count, splits={"test": tuple(range(count))}, synthetic=True)


def test_the_published_protocol_is_all_200_views_at_full_size_on_white(demo: Scene) -> None:
    white = replace(demo, background=(1.0, 1.0, 1.0))
    assert protocol(full(white, 200, 800)) == "the published protocol: all 200 test views, 800×800, on white"
    for other in (full(white, 25, 800), full(white, 200, 400), full(replace(demo, background=(0.0,) * 3), 200, 800)):
        assert protocol(other).startswith(f"subset of {len(other.views)} test views")


def test_all_test_views_are_compared_and_the_whole_time_is_told(demo: Scene) -> None:
    started = time.time() - 100
    found = learn_and_evaluate(Trainer(demo, RunSettings(method="voxels")), 0.2, started, None)
    assert found["views"] == len(demo.split("test")) > 0
    assert 100 < found["wall"] < 100 + 60
    assert 0.2 <= found["seconds"] < found["wall"]
    assert found["lpips"] is None
    assert 0 < found["ssim"] < 1


def test_seconds_and_protocol_reach_the_rows(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def parsed(*words: str) -> tables.argparse.Namespace:
        monkeypatch.setattr("sys.argv", ["tables.py", "--scenes", str(Path()), *words])
        return tables.parse(tables.ROWS, [*tables.CPU_MEASURES, *tables.ROWS])

    assert parsed().repeat == 5
    published = parsed("--protocol", "published", "--seconds", "30")
    assert (published.rows, published.repeat, published.seconds) == (["lego800-voxels"], 3, 30)
    with pytest.raises(SystemExit):
        parsed("--protocol", "published", "--rows", "rates")
    assert "choose from lego100-voxels" in capsys.readouterr().err
