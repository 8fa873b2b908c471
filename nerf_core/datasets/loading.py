"""Load a `Scene` from a path: recognise the format, check and read the photos, choose their size, normalise poses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from nerf_core.common.errors import UserError, shorten
from nerf_core.common.language import phrase, phrases
from nerf_core.common.names import printable
from nerf_core.datasets.calibration import fitted, oddities
from nerf_core.datasets.capture import DATASETS, Capture, LoadOptions
from nerf_core.datasets.claims import HEAVY_BYTES
from nerf_core.datasets.geometry import normalise
from nerf_core.datasets.images import Header, UnreadableError, damage_notes, measure, read_photo
from nerf_core.datasets.in_threads import Progress, in_threads
from nerf_core.datasets.large import Reading, arriving, is_large
from nerf_core.datasets.masks import kept_pixels, masked_by_alpha, notes_on_masks, with_masks
from nerf_core.datasets.recognise import recognise
from nerf_core.geometry.photos import Photos
from nerf_core.geometry.scene import Scene, View

WHITE, BLACK = (1.0, 1.0, 1.0), (0.0, 0.0, 0.0)
MOST_POINTS = 20_000  # of a sparse model that a scene keeps, to show: more are a cloud just the same
LARGEST_SIDE = 1_000_000  # in pixels: no photo has more
LEAST_SIDE = 16  # pixels of the longer side that --downscale must leave: fewer show nothing


def load_scene(path: Path | None, options: LoadOptions, progress: Progress | None = None) -> Scene:
    """Load a capture: photos at the wanted size, poses in the trainer's frame.

    Args:
        path: a folder or a .json, .xml or .csv file; None opens the demo scene.
        options: the user's choices.
        progress: called as (what is done, photos done, photos in all) from this thread, first "looking for masks", then
            "checking photos", then "loading photos" or "reading the first photos"; it may raise to cancel.

    Returns:
        The scene. `Scene.notes` has warnings about what is odd but harmless.

    Raises:
        UserError: names file, field and remedy.
    """
    check_options(options)
    try:
        source, name, notes = recognise(path, options.format)
        folder = source if source.is_dir() else source.parent
        capture = DATASETS.get(name).read(source, options)
        if progress is not None:
            progress(phrase("looking for masks"), 0, len(capture.photos))
        capture, headers, damaged = _readable(with_masks(capture), progress)
        capture, upright, eight_bits, size_notes = _sized(capture, headers, options)
        _refuse_heavy(capture, headers, upright, options)
        normalised = normalise(capture, options)
        background = _background(capture, headers, options)
        by_alpha, more_damaged = masked_by_alpha(capture, options), []
        if is_large(capture, headers, by_alpha):
            how = Reading(folder.resolve().name, capture, headers, upright, eight_bits, background)
            photos, mask_notes = arriving(how, progress)
            kept = range(len(capture.photos))
        else:
            photos, kept, more_damaged = _photos(capture, upright, eight_bits, background, progress)
            photos, kept, mask_notes = _masked(capture, headers, upright, photos, kept, by_alpha)
    except OSError as error:
        raise UserError(
            f"{error.filename or path}: {error.strerror or error}: check the path and its rights"
        ) from error
    cameras = [normalised.cameras[i] for i in kept]
    capture = _with_splits(capture.keeping(kept))
    notes += (*capture.notes, *size_notes, *mask_notes, *damage_notes(damaged + more_damaged), *normalised.notes)
    return Scene(
        name="demo" if path is None else printable(folder.resolve().name),
        format=capture.format,
        views=tuple(map(View, _names(capture), cameras, _sighted(capture, normalised.to_input))),
        photos=photos.at(kept),
        splits=capture.splits or {},
        near=normalised.near,
        far=normalised.far,
        background=background,
        center=normalised.center,
        radius=normalised.radius,
        up=normalised.up,
        to_input=normalised.to_input,
        disparity=normalised.disparity,
        synthetic=capture.synthetic,
        ndc=normalised.ndc,
        notes=tuple(map(printable, notes)),
        landmarks=capture.landmarks,
        points=_some_points(capture.points, normalised.to_input),
    )


def _some_points(points: np.ndarray | None, to_input: np.ndarray) -> np.ndarray | None:
    """At most MOST_POINTS sparse points, evenly chosen, in scene units."""
    if points is None or not len(points):
        return None
    return _to_scene(points[:: -(-len(points) // MOST_POINTS)], to_input)


def _sighted(capture: Capture, to_input: np.ndarray) -> list[np.ndarray | None]:
    """For each photo the points that it sees, in scene units."""
    return [None if photo.sighted is None else _to_scene(photo.sighted, to_input) for photo in capture.photos]


def _to_scene(points: np.ndarray, to_input: np.ndarray) -> np.ndarray:
    inverse = np.linalg.inv(to_input)
    return (points @ inverse[:3, :3].T + inverse[:3, 3]).astype(np.float32)


def check_options(options: LoadOptions) -> None:
    """Raise UserError for numbers out of range."""
    if not 1 <= options.downscale <= LARGEST_SIDE:
        raise UserError(f"--downscale is {shorten(options.downscale)}: give a whole number from 1 to {LARGEST_SIDE:,}")
    if not 0 <= options.max_size <= LARGEST_SIDE:
        raise UserError(f"--max-size is {shorten(options.max_size)}: give the longer side in pixels, or 0 for no limit")
    if not options.memory_gb > 0:
        raise UserError(f"--memory-gb is {options.memory_gb}: give how many GB the photos may take, more than 0")


def _readable(capture: Capture, progress: Progress | None) -> tuple[Capture, list[Header], list[str]]:
    """Drop the photos that are not images. Returns the rest, their headers, and the fault of each dropped photo."""
    found = in_threads(
        lambda i: measure(capture.photos[i].path), range(len(capture.photos)), phrase("checking photos"), progress
    )
    damaged = [str(v) for v in found if isinstance(v, UnreadableError)]
    kept = [i for i, v in enumerate(found) if isinstance(v, Header)]
    if not kept:
        raise UserError(f"no photo can be read ({damaged[0]}): save them as PNG or JPEG")
    return capture.keeping(kept), [v for v in found if isinstance(v, Header)], damaged


def _sized(
    capture: Capture, headers: Sequence[Header], options: LoadOptions
) -> tuple[Capture, list[bool], bool, list[str]]:
    """Scale the cameras to the sizes at which photos will be loaded.

    Returns the capture, which photos must be rotated by EXIF, whether 8 bits hold all photos, and notes.
    """
    notes = oddities([photo.camera for photo in capture.photos])
    upright = [fitted(p, h) for p, h in zip(capture.photos, headers, strict=True)]
    rotated = sum(h.orientation != 1 for h in headers)
    if rotated:
        notes.append(
            phrases(
                "{n:,} photo with an EXIF rotation: {turned} turned by it, {stored} taken as stored, as the "
                "calibration says",
                "{n:,} photos with an EXIF rotation: {turned} turned by it, {stored} taken as stored, as the "
                "calibration says",
                rotated,
                turned=sum(upright),
                stored=rotated - sum(upright),
            )
        )
    shapes = [
        (h.height, h.width) if turn and h.orientation >= 5 else (h.width, h.height)
        for h, turn in zip(headers, upright, strict=True)
    ]  # 2, 3 and 4 keep the shape
    downscale = max(
        1.0, options.downscale / capture.reduced
    )  # the folder may hold smaller photos than the user asked for
    _refuse_tiny(max(shapes, key=max), options.downscale, capture.reduced)
    masked = any(p.mask is not None for p in capture.photos)  # one more byte a pixel
    further, sizes = 1, [_target(shape, options, downscale) for shape in shapes]
    while True:
        eight_bits = sizes == shapes and all(h.eight_bits for h in headers)  # averaging makes more than 8
        if ((3 if eight_bits else 6) + masked) * sum(w * h for w, h in sizes) <= options.memory_gb * 1e9:
            break
        further += 1
        sizes = [_target(shape, options, downscale, further) for shape in shapes]
    if further > 1:
        notes.append(
            phrase(
                "photos are downscaled by a further {further}, to {width}×{height}, to fit into {memory:g} GB: raise "
                "--memory-gb to keep their size",
                further=further,
                width=sizes[0][0],
                height=sizes[0][1],
                memory=options.memory_gb,
            )
        )
    photos = tuple(
        replace(p, camera=p.camera.resized(*size), orientation=1 if turn else h.orientation)
        for p, size, h, turn in zip(capture.photos, sizes, headers, upright, strict=True)
    )
    return replace(capture, photos=photos), upright, eight_bits, notes


def _refuse_tiny(size: tuple[int, int], downscale: int, reduced: int) -> None:
    """Raise UserError if --downscale leaves hardly a pixel of the largest photo.

    Args:
        size: its pixels in the file.
        downscale: how many times smaller than full size the user asked for.
        reduced: how many times smaller than full size the file is.
    """
    longest = max(size) * reduced
    if downscale <= reduced or round(longest / downscale) >= LEAST_SIDE:
        return
    most = max(int(longest / (LEAST_SIDE - 0.5)), 1)  # sides are rounded
    left = "×".join(str(round(side * reduced / downscale)) for side in size)
    raise UserError(
        f"--downscale is {downscale}: it leaves {left} of the {size[0] * reduced}×{size[1] * reduced} pixels of a "
        f"photo: give at most {most}"
    )


def _refuse_heavy(capture: Capture, headers: Sequence[Header], upright: Sequence[bool], options: LoadOptions) -> None:
    """Raise UserError if reading a photo would take more than the photos may. Heavy ones are read one at a time."""
    for photo, header, turn in zip(capture.photos, headers, upright, strict=True):
        shape = (header.width, header.height) if turn and header.orientation >= 5 else (header.height, header.width)
        memory = header.memory.peak(shape, (photo.camera.width, photo.camera.height))
        if memory > max(options.memory_gb * 1e9, HEAVY_BYTES):
            raise UserError(
                f"{photo.path}: decoding its {header.width}×{header.height} pixels takes {memory / 1e9:.1f} GB, "
                f"--memory-gb allows {options.memory_gb:g}: raise it, or save the photo smaller"
            )


def _target(size: tuple[int, int], options: LoadOptions, downscale: float, further: int = 1) -> tuple[int, int]:
    """(width, height) after the options, divided by `further`. Raises UserError if no pixel is left."""
    longest = max(size) / downscale
    limit = options.max_size or longest
    scale = min(1.0, limit / longest) / downscale / further
    width, height = round(size[0] * scale), round(size[1] * scale)
    if min(width, height) < 1:
        raise UserError(
            f"a photo of {size[0]}×{size[1]} pixels has none left at --downscale {options.downscale}, "
            f"--max-size {options.max_size}, --memory-gb {options.memory_gb:g}: ask for larger photos"
        )
    return width, height


def _background(capture: Capture, headers: Sequence[Header], options: LoadOptions) -> tuple[float, float, float]:
    if options.background == "auto":
        return WHITE if capture.synthetic or any(h.alpha for h in headers) else BLACK
    return WHITE if options.background == "white" else BLACK


def _photos(
    capture: Capture,
    upright: Sequence[bool],
    eight_bits: bool,
    background: tuple[float, float, float],
    progress: Progress | None,
) -> tuple[Photos, list[int], list[str]]:
    """Read all photos. Returns them, the indices of those that could be read, and the fault of each of the others."""
    sizes = [(photo.camera.width, photo.camera.height) for photo in capture.photos]
    photos = Photos.empty(sizes, eight_bits)

    def read(i: int) -> None:
        photos.put(i, read_photo(capture.photos[i].path, sizes[i], background, upright[i]))

    found = in_threads(read, range(len(capture.photos)), phrase("loading photos"), progress)
    damaged = [str(v) for v in found if isinstance(v, UnreadableError)]
    if len(damaged) == len(found):
        raise UserError(f"no photo can be read ({damaged[0]}): save them as PNG or JPEG")
    return photos, [i for i, v in enumerate(found) if v is None], damaged


def _masked(
    capture: Capture,
    headers: Sequence[Header],
    upright: Sequence[bool],
    photos: Photos,
    kept: Sequence[int],
    by_alpha: bool,
) -> tuple[Photos, list[int], list[str]]:
    """Read the masks of photos.

    Args:
        capture, headers, upright, photos: N photos.
        kept: the indices of those that could be read.
        by_alpha: whether alpha is a mask.

    Returns:
        The photos with their masks, the indices of those that have a pixel that counts, and notes.
    """
    masks: dict[int, np.ndarray] = {}

    def read(i: int) -> None:
        found = kept_pixels(capture.photos[i], headers[i], upright[i], by_alpha and headers[i].alpha)
        if found is not None:
            masks[i] = found

    given = [i for i in kept if capture.photos[i].mask is not None or (by_alpha and headers[i].alpha)]
    damaged = [str(v) for v in in_threads(lambda k: read(given[k]), range(len(given)), "", None) if v is not None]
    if damaged:
        raise UserError(f"{damaged[0]}: its alpha cannot be read: save it again as PNG")
    if not masks:
        return photos, list(kept), notes_on_masks([i in given for i in kept], [])
    photos = photos.masked(masks)
    left = [i for i in kept if i not in masks or masks[i].any()]
    empty = [capture.photos[i].name for i in kept if i not in left]
    if not left:
        raise UserError(
            f"every photo is masked as a whole, first {shorten(empty[0])}: masks are 0 where pixels are ignored"
        )
    return photos, left, notes_on_masks([i in given for i in left], empty)


def _names(capture: Capture) -> list[str]:
    """The photos' names as they are shown. Where two look alike, backslashes are doubled, which keeps them apart."""
    names = [photo.name for photo in capture.photos]
    shown = [printable(name) for name in names]
    return shown if len(set(shown)) == len(shown) else [printable(name.replace("\\", "\\\\")) for name in names]


def _with_splits(capture: Capture) -> Capture:
    splits = capture.named_splits()
    if not splits.get("train"):
        counts = ", ".join(f"{name} has {len(index)}" for name, index in splits.items())
        raise UserError(f"no photo of the training split can be used ({counts}): check the photos that it lists")
    return replace(capture, splits=splits)
