"""Measure how long the tour takes: what it makes the reader wait for, and the time to read it.

    python tests/benchmarks/tour.py [--words-a-minute 200] [--language ru]

A reader who reads each step's words, does its tasks with mouse and keys, opens its answers, and goes on. The model
trains meanwhile. Prints for each step the seconds of reading and of waiting: until the step stands, and from a task's
last key until the tour has noticed it. Fails if it does not notice one within two minutes.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "helpers"))

import tour_reader

from nerf_core.live.worker import Worker
from nerf_core.training.settings import RunSettings
from viewer.app.app import App
from viewer.model.state import TourWish
from viewer.tour.steps import Question, Step
from viewer.window import load_libraries, open_offscreen

SIZE = (1280, 800)
PATIENCE, AGAIN = 120.0, 3.0  # seconds: until the measurement fails, and until a task is tried again


def words(step: Step) -> int:
    """The words of a step, with its answers."""
    texts = [step.title]
    for block in step.blocks:
        texts += [block.text, block.answer if isinstance(block, Question) else ""]
    return sum(len(text.split()) for text in texts)


class Reader:
    def __init__(self, app: App, words_a_minute: float) -> None:
        self.app, self.rate = app, words_a_minute

    def spend(self, seconds: float, until: Callable[[], bool] = lambda: False) -> float:
        """Draw frames as the window does, for some seconds or until something holds. Returns the seconds."""
        begun = time.monotonic()
        while (spent := time.monotonic() - begun) < seconds and not until():
            self.app.window.poll(0.02)
            self.app.frame()
        return spent

    def wait(self, until: Callable[[], bool], what: str) -> float:
        spent = self.spend(PATIENCE, until)
        if not until():
            raise SystemExit(f"the tour did not get on in {PATIENCE:.0f} s: {what}")
        return spent

    def read(self, step: Step) -> tuple[float, float]:
        """Go through a step. Returns the seconds of reading and of waiting."""
        guide = self.app.tour
        waited = self.wait(lambda: guide.stands, step.name)
        reading = self.spend(60 * words(step) / self.rate)
        for number, task in enumerate(step.tasks):
            if task.until is None:
                continue
            for patience in (AGAIN,) * 3 + (PATIENCE,):  # the mouse may miss, and a key may have to be pressed twice
                if (step.name, number) not in guide.ticks:
                    tour_reader.do(self.app, task, self.app.settle)
                    waited += self.spend(patience, lambda number=number: (step.name, number) in guide.ticks)
            if (step.name, number) not in guide.ticks:
                raise SystemExit(f"the tour did not notice a task: {step.name}, {task.until.words}")
        return reading, waited


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--words-a-minute", type=float, default=200.0)
    parser.add_argument("--language", default="en")
    parser.add_argument("--size", type=int, nargs=2, default=SIZE)
    parser.add_argument("--pictures", type=Path, help="folder for a screenshot of each step at its end")
    args = parser.parse_args()
    load_libraries()
    window = open_offscreen(tuple(args.size), 1.0)
    worker = Worker(RunSettings(), wake=window.wake)
    worker.start()
    app = App(window, worker, language=args.language)
    app.state.tour = TourWish("begin")
    reader, begun = Reader(app, args.words_a_minute), time.monotonic()
    reader.wait(lambda: bool(app.tour.steps), "it did not begin")
    total = [0.0, 0.0]
    for step in app.tour.steps:
        reading, waited = reader.read(step)
        total = [total[0] + reading, total[1] + waited]
        method, at = app.state.snapshot.method, app.state.snapshot.step
        print(f"{step.name}: read {reading:.0f} s, waited {waited:.1f} s; {method} at step {at:,}", flush=True)
        if args.pictures is not None:
            args.pictures.mkdir(parents=True, exist_ok=True)
            app.screenshot(args.pictures / f"{step.name}.png")
        if step is not app.tour.steps[-1]:
            tour_reader.press(app, "tour.next")
            reader.spend(0.5)
    errors = [shown.notice.text for shown in app.state.notices if shown.notice.level == "error"]
    spent = time.monotonic() - begun
    print(f"in all {spent:.0f} s: read {total[0]:.0f} s, waited {total[1]:.0f} s; errors: {errors or 'none'}")
    app.close()
    worker.stop(10)


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)  # the film is written there
        main()
