"""Find the poses of photos with pycolmap: `python -P sfm_program.py FOLDER`, a process of its own.

FOLDER holds task.json (see `main`) and photos/, small upright copies of the photos. The program writes there:

- lines of JSON on standard output: what is being done, how much of it, and how many photos have a pose;
- growing.npz, the cameras and points so far, replaced again and again;
- sparse/0, the largest model as COLMAP writes it, in pixels of the original photos;
- result.json: what became of each photo.

It is a process of its own because the mapper can crash, hang, or need more memory than there is. Structure from motion
is COLMAP's (Schönberger and Frahm, CVPR 2016), with its incremental mapper.
"""

from __future__ import annotations

import itertools
import json
import os
import sqlite3
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np

COUNT_SECONDS = 0.5  # between counts of the photos and pairs that COLMAP has done
GROWING_SECONDS = 0.7  # between pictures of the growing model
GROWING_POINTS = 6000  # enough to recognise a scene
WORDS = 64  # of the vocabulary for `resemblance`: a VLAD of 64 words tells scenes apart (Jégou et al., CVPR 2010)
SAMPLED = 40_000  # descriptors that the vocabulary is made of
ROUNDS = 8  # of k-means: the words hardly move any more
PANORAMIC = (5, 6)  # COLMAP's two-view configurations "panoramic" and "planar or panoramic": turned, not moved
PAIR_BASE = 2147483647  # COLMAP's pair_id is id1 · (2³¹ − 1) + id2
STRONG = 100  # verified matches that chance does not make
CANNOT_MATCH = 75.0  # degrees between two views of one surface: SIFT matches up to some 50
IN_ORDER = 10  # photos that follow one another, when only those are matched
MOSTLY = 0.9  # of the photos: fewer are not worth a way without jumps
# photos up to which one thread places them: sums of several threads are rounded differently each time, and a model that
# was trained on other poses cannot go on. For so few, threads save no time.
REPEATED = 200
LEAST_MODEL = 3  # photos; COLMAP's 10 would give up small captures


SAID = os.dup(1)  # to the parent alone: what libraries print on standard output goes to standard error


def say(**values: object) -> None:
    """Tell the parent, on a line of its own."""
    os.write(SAID, json.dumps(values).encode() + b"\n")


def main(folder: Path) -> None:
    """Do the task in task.json.

    names, sizes: of the original photos; (width, height) upright.
    copies: their files in photos/. Those in one folder were taken by one camera.
    masked: whether masks/ has the mask of a copy, COPY.png, 0 where nothing is to be looked for.
    lens: COLMAP's camera model, and the focal length to begin with, in longer sides.
    side, features, octave: the longer side of a copy, the most features of a photo, and the first octave of SIFT.
    pairs, near: "all", "video" or "alike", and how many others a photo is matched with then.
    threads, seed: for pycolmap.
    """
    os.dup2(2, 1)
    threading.Thread(target=_die_with_parent, daemon=True).start()
    os.chdir(folder)  # pycolmap takes no path that is not UTF-8
    task = json.loads(Path("task.json").read_text("utf-8"))
    import pycolmap

    pycolmap.logging.minloglevel = 2  # errors alone: standard error is for what went wrong
    pycolmap.set_random_seed(task["seed"])
    _features(pycolmap, task)
    found = _matches(pycolmap, task)
    models = _map(pycolmap, task)
    folded = bool(models) and _folded(models[0], task)
    if folded:
        _unfold(pycolmap, task)
        again = _map(pycolmap, task)
        models = again if again and again[0].num_reg_images() >= MOSTLY * models[0].num_reg_images() else models
        folded = models is again
    found["folded"] = np.array([folded])
    _write(pycolmap, task, models, found)


def _die_with_parent() -> None:
    """Standard input ends when the parent does, however it ends."""
    while os.read(0, 4096):  # not sys.stdin: its lock, held here, would abort the interpreter's own end
        pass
    os._exit(1)


@contextmanager
def _counted(pycolmap: Any, stage: str, total: int, count: Callable[[Any], int]) -> Iterator[None]:
    """Say how much of a stage COLMAP has done while it does it: what `count` finds in the database.

    It is read here, by COLMAP's own copy of SQLite: a reader in another process would sometimes lock it while COLMAP
    opens it, which COLMAP does not bear, and Python's copy in this process would break the locks of COLMAP's.
    """
    say(stage=stage, done=0, total=total)
    over = threading.Event()

    def watch(base: Any) -> None:
        said = 0
        while not over.wait(COUNT_SECONDS):
            with suppress(RuntimeError):  # pycolmap's for SQLite: the next count may be found
                if (done := min(count(base), total)) > said:
                    said = done
                    say(stage=stage, done=done, total=total)

    with pycolmap.Database.open("database.db") as base:
        watcher = threading.Thread(target=watch, args=(base,))
        watcher.start()
        try:
            yield
        finally:
            over.set()
            watcher.join()


# ---- features ----------------------------------------------------------------------------------------------------


def _features(pycolmap: Any, task: dict[str, Any]) -> None:
    options = pycolmap.FeatureExtractionOptions()
    options.num_threads, options.max_image_size = task["threads"], task["side"]
    options.sift.max_num_features, options.sift.first_octave = task["features"], task["octave"]
    reading = pycolmap.ImageReaderOptions()
    reading.camera_model, reading.default_focal_length_factor = task["lens"]
    if task["masked"]:
        reading.mask_path = "masks"
    numbers = range(1, len(task["copies"]) + 1)  # as `import_images` gives them

    def extracted(base: Any) -> int:
        return sum(base.exists_descriptors(number) for number in numbers)

    with _counted(pycolmap, "features", len(task["copies"]), extracted):
        # In their order: extraction numbers them as its threads end, and the numbers decide what is tried first, so
        # that the same photos would get other poses each time.
        pycolmap.import_images(
            "database.db", "photos", camera_mode=pycolmap.CameraMode.PER_FOLDER, image_names=task["copies"],
            options=reading,
        )  # fmt: skip
        pycolmap.extract_features(
            "database.db", "photos", image_names=task["copies"], camera_mode=pycolmap.CameraMode.PER_FOLDER,
            reader_options=reading, extraction_options=options, device=pycolmap.Device.cpu,
        )  # fmt: skip
    if task["lens"][0].endswith("FISHEYE"):
        _trust_focal_lengths(pycolmap)


def _trust_focal_lengths(pycolmap: Any) -> None:
    """Let pairs be verified along rays: only then does COLMAP take the lens into account, which bends pixels too far
    for a fundamental matrix."""
    with pycolmap.Database.open("database.db") as base:
        for camera in base.read_all_cameras():
            camera.has_prior_focal_length = True
            base.update_camera(camera)


# ---- matches -----------------------------------------------------------------------------------------------------


def _matches(pycolmap: Any, task: dict[str, Any]) -> dict[str, np.ndarray]:
    """Match pairs of photos. Returns what is known of each photo then: features, its best match, pairs turned."""
    pairs = list(_pairs(task))
    Path("pairs.txt").write_text("".join(f"{task['copies'][i]} {task['copies'][j]}\n" for i, j in pairs), "ascii")
    options, pairing = pycolmap.FeatureMatchingOptions(), pycolmap.ImportedPairingOptions()
    options.num_threads = task["threads"]
    pairing.match_list_path, pairing.block_size = "pairs.txt", max(1, min(100, len(pairs) // 40))  # for the progress
    verifying = pycolmap.TwoViewGeometryOptions()
    verifying.ransac.random_seed = task["seed"]
    with _counted(pycolmap, "matches", len(pairs), lambda base: base.num_verified_image_pairs()):
        pycolmap.match_image_pairs(
            "database.db", matching_options=options, pairing_options=pairing, verification_options=verifying,
            device=pycolmap.Device.cpu,
        )  # fmt: skip
    return _known(task)


def _pairs(task: dict[str, Any]) -> Iterator[tuple[int, int]]:
    """The pairs to match, each once: all; or those near in time and alike; or those alike."""
    count, near = len(task["copies"]), task["near"]
    if task["pairs"] == "all":
        yield from itertools.combinations(range(count), 2)
        return
    wanted = {(i, j) for i, row in enumerate(_resemblance(task, near)) for j in row.tolist()}
    if task["pairs"] == "video":
        wanted |= {(i, i + k) for i in range(count) for k in range(1, near + 1) if i + k < count}
    yield from sorted({(min(p), max(p)) for p in wanted})


def _resemblance(task: dict[str, Any], near: int) -> Iterator[np.ndarray]:
    """For each photo, the `near` others that resemble it most, by VLAD of its SIFT descriptors."""
    with closing(sqlite3.connect("file:database.db?mode=ro", uri=True)) as base:
        rows = dict(base.execute("SELECT name, data FROM images JOIN descriptors USING (image_id)").fetchall())
    described = [np.frombuffer(rows.get(name, b""), np.uint8).reshape(-1, 128) for name in task["copies"]]
    rng = np.random.default_rng(task["seed"])
    every = np.concatenate([d[rng.permutation(len(d))[: 1 + SAMPLED // len(described)]] for d in described])
    words = every[rng.permutation(len(every))[:WORDS]].astype(np.float32)
    for _ in range(ROUNDS if len(every) else 0):
        nearest = _nearest(every, words)
        for k in range(len(words)):
            if len(members := every[nearest == k]):
                words[k] = members.mean(0)
    codes = np.stack([_vlad(d, words) for d in described])
    alike = codes @ codes.T
    np.fill_diagonal(alike, -np.inf)
    return iter(np.argsort(-alike, 1, kind="stable")[:, : min(near, len(codes) - 1)])


def _nearest(descriptors: np.ndarray, words: np.ndarray) -> np.ndarray:
    return np.argmin((words**2).sum(1) - 2 * descriptors.astype(np.float32) @ words.T, 1)


def _vlad(descriptors: np.ndarray, words: np.ndarray) -> np.ndarray:
    """Sums of what is left of descriptors after their nearest word, each of length 1, together of length 1."""
    code = np.zeros(words.shape, np.float32)
    if len(descriptors):
        nearest = _nearest(descriptors, words)
        np.add.at(code, nearest, descriptors - words[nearest])
    code /= np.maximum(np.linalg.norm(code, axis=1, keepdims=True), 1e-9)  # a word without descriptors stays 0
    return code.ravel() / max(float(np.linalg.norm(code)), 1e-9)


def _known(task: dict[str, Any]) -> dict[str, np.ndarray]:
    count = len(task["copies"])
    place = {name: k for k, name in enumerate(task["copies"])}
    features, best, turned, fits = (np.zeros(count, int) for _ in range(4))
    with closing(sqlite3.connect("file:database.db?mode=ro", uri=True)) as base:
        ids = {number: place[name] for number, name in base.execute("SELECT image_id, name FROM images")}
        for number, rows in base.execute("SELECT image_id, rows FROM keypoints"):
            features[ids[number]] = rows
        for pair, rows, config in base.execute("SELECT pair_id, rows, config FROM two_view_geometries"):
            i, j = ids[pair // PAIR_BASE], ids[pair % PAIR_BASE]
            best[[i, j]] = np.maximum(best[[i, j]], rows)
            if rows:
                fits[[i, j]] += 1
                turned[[i, j]] += config in PANORAMIC
    return {"features": features, "best": best, "pairs": fits, "turned": turned}


# ---- poses -------------------------------------------------------------------------------------------------------


def _map(pycolmap: Any, task: dict[str, Any]) -> list[Any]:
    """Run the incremental mapper. Returns its models, the one with most photos first."""
    total = len(task["copies"])
    say(stage="poses", done=0, total=total)
    options = pycolmap.IncrementalPipelineOptions()
    alone = total <= REPEATED
    options.num_threads, options.min_model_size = 1 if alone else task["threads"], min(10, max(LEAST_MODEL, total // 3))
    options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = task["seed"]
    options.image_path, options.max_num_models = "photos", 5
    shown = 0.0

    def grown(pause: float = GROWING_SECONDS) -> None:
        nonlocal shown
        if manager.size() and time.monotonic() - shown > pause:
            model = manager.get(manager.size() - 1)
            if model.num_reg_images():
                _picture(model)
                say(stage="poses", done=model.num_reg_images(), total=total)
                shown = time.monotonic()

    manager = pycolmap.ReconstructionManager()
    with pycolmap.Database.open("database.db") as base:
        pipeline = pycolmap.IncrementalPipeline(options, base, manager)
        kinds = pycolmap.IncrementalPipelineCallback
        for kind in (kinds.INITIAL_IMAGE_PAIR_REG_CALLBACK, kinds.NEXT_IMAGE_REG_CALLBACK):
            pipeline.add_callback(kind, grown)
        pipeline.run()
    grown(0.0)
    return sorted((manager.get(k) for k in range(manager.size())), key=lambda m: -m.num_reg_images())


def _picture(model: Any) -> None:
    """Write the cameras (N, 3, 4), camera to world in OpenGL's axes, the points (P, 3) and their colours (P, 3)."""
    poses = np.array([_c2w(i.cam_from_world().matrix()) for i in model.images.values() if i.has_pose]).reshape(-1, 3, 4)
    every = model.points3D
    chosen = list(every)[:: max(1, len(every) // GROWING_POINTS)]
    points = np.array([every[k].xyz for k in chosen], np.float32).reshape(-1, 3)
    colors = np.array([every[k].color for k in chosen], np.uint8).reshape(-1, 3)
    with open("growing.tmp", "wb") as file:
        np.savez(file, poses=poses.astype(np.float32), points=points, colors=colors)
    with suppress(OSError):  # where the parent has it open, some systems refuse
        Path("growing.tmp").replace("growing.npz")


def _c2w(pose: np.ndarray) -> np.ndarray:
    """World to camera (3, 4) in OpenCV's axes → camera to world in OpenGL's."""
    return np.column_stack([pose[:, :3].T * (1, -1, -1), -pose[:, :3].T @ pose[:, 3]])


def _folded(model: Any, task: dict[str, Any]) -> bool:
    """Whether photos that follow one another, and match well, look in directions that cannot match.

    Two sides of a thing that look alike match one another. The mapper then puts the photos of both on one side, and the
    way of the camera, which was smooth, jumps to the other side and back.
    """
    axes = {image.name: image.cam_from_world().matrix()[2, :3] for image in model.images.values() if image.has_pose}
    place = {name: k for k, name in enumerate(task["copies"])}
    with closing(sqlite3.connect("file:database.db?mode=ro", uri=True)) as base:
        names = dict(base.execute("SELECT image_id, name FROM images"))
        rows = base.execute("SELECT pair_id, rows FROM two_view_geometries WHERE rows >= ?", (STRONG,)).fetchall()
    for pair, _ in rows:
        a, b = names[pair // PAIR_BASE], names[pair % PAIR_BASE]
        near = abs(place[a] - place[b]) == 1
        if near and a in axes and b in axes and float(axes[a] @ axes[b]) < np.cos(np.radians(CANNOT_MATCH)):
            return True
    return False


def _unfold(pycolmap: Any, task: dict[str, Any]) -> None:
    """Forget the matches of photos that do not nearly follow one another: what looks alike elsewhere may be the other
    side."""
    with pycolmap.Database.open("database.db") as base:
        ids = {image.name: image.image_id for image in base.read_all_images()}
        order = [ids[name] for name in task["copies"]]
        for i, j in itertools.combinations(range(len(order)), 2):
            if j - i > IN_ORDER and base.exists_two_view_geometry(order[i], order[j]):
                base.delete_two_view_geometry(order[i], order[j])


# ---- the result --------------------------------------------------------------------------------------------------


def _write(pycolmap: Any, task: dict[str, Any], models: list[Any], found: dict[str, np.ndarray]) -> None:
    names, place = task["names"], {name: k for k, name in enumerate(task["copies"])}
    placed: list[int] = []
    result: dict[str, Any] = {name: values.tolist() for name, values in found.items()} | {"points": 0, "error": 0.0}
    if models:
        model = models[0]
        model.extract_colors_for_all_images("photos")
        _picture(model)
        result["error"], result["points"] = float(model.compute_mean_reprojection_error()), model.num_points3D()
        placed = [place[image.name] for image in model.images.values() if image.has_pose]
        _restore_sizes(model, task, place)
        for image in model.images.values():
            image.name = os.fsencode(names[place[image.name]])  # as the system names it, in UTF-8 or not
        Path("sparse/0").mkdir(parents=True, exist_ok=True)
        model.write("sparse/0")
    result["placed"] = sorted(placed)
    result["models"] = [m.num_reg_images() for m in models]
    Path("result.json").write_text(json.dumps(result), "utf-8")


def _restore_sizes(model: Any, task: dict[str, Any], place: dict[str, int]) -> None:
    """Scale cameras and observed points from the copies to the original photos. One camera has one size."""
    scales: dict[int, np.ndarray] = {}
    for image in model.images.values():
        camera = model.cameras[image.camera_id]
        if image.camera_id not in scales:
            width, height = task["sizes"][place[image.name]]
            scales[image.camera_id] = np.array([width / camera.width, height / camera.height])
            camera.rescale(width, height)
        for point in image.points2D:
            point.xy = point.xy * scales[image.camera_id]


if __name__ == "__main__":
    main(Path(sys.argv[1]))
