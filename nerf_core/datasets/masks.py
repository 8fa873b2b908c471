"""Find the masks of photos, and read which pixels count.

A pixel is masked where its mask is 0, as in COLMAP and nerfstudio. The alpha of a photo of a real capture is a mask,
too: what is not opaque is masked. A pixel of an averaged photo counts only if its whole area does.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image

from nerf_core.common.errors import UserError
from nerf_core.common.language import phrases
from nerf_core.datasets.capture import Capture, LoadOptions, Photo
from nerf_core.datasets.images import BROKEN, Header, UnreadableError, measure, opaque_pixels, oriented
from nerf_core.datasets.photo_folders import FOLDER, MASK_END, MASK_FOLDERS
from nerf_core.datasets.resample import average_rows

OPAQUE = 1 - 1 / 255  # alpha from here on is opaque: averages of 1 are not exactly 1


def masked_by_alpha(capture: Capture, options: LoadOptions) -> bool:
    """Return whether alpha says which pixels count; else photos are composited over the background.

    A named background is what the user wants to see behind the photos' transparent parts.
    """
    return not capture.synthetic and options.background == "auto"


def with_masks(capture: Capture) -> Capture:
    """Return the capture with the mask files that lie beside its photos. An object on a plain background has none."""
    if capture.synthetic:
        return capture
    found = masks_beside([photo.path for photo in capture.photos])
    photos = tuple(
        p if p.mask is not None else replace(p, mask=mask) for p, mask in zip(capture.photos, found, strict=True)
    )
    return replace(capture, photos=photos)


def masks_beside(photos: Sequence[Path]) -> list[Path | None]:
    """Return the mask of each photo: NAME.mask.png beside it, or masks/NAME.jpg.png or masks/NAME.png.

    The folder of masks lies beside that of the photos or in it. Of a link, also that of the photo that it leads to.
    None: there is none.
    """
    known: dict[Path, bool] = {}
    real = {folder: folder.resolve() for folder in {photo.parent for photo in photos}}

    def found(path: Path) -> Path | None:
        mask, home = _beside(path, known), real[path.parent]
        if mask is not None or (home == path.parent and not path.is_symlink()):
            return mask
        return _beside(path.resolve(), known)

    return [found(photo) for photo in photos]


def _beside(photo: Path, known: dict[Path, bool]) -> Path | None:
    """The mask beside a photo, or None. known: which folders exist, as far as it has been looked up."""
    candidates = [photo.with_name(photo.stem + MASK_END), photo.with_name(photo.name + MASK_END)]
    above = [photo.parent, *photo.parent.parents][:4]
    home = next((folder for folder in above if FOLDER.fullmatch(folder.name)), photo.parent)
    inside = photo.relative_to(home)
    number = home.name.removeprefix("images") if home.name.startswith("images") else ""
    for name in dict.fromkeys(folder + end for end in (number, "") for folder in MASK_FOLDERS):
        for folder in (home.parent / name, home / name):
            if known.setdefault(folder, os.path.isdir(folder)):
                candidates += [folder / f"{inside}.png", (folder / inside).with_suffix(".png")]
    return next((file for file in candidates if file != photo and os.path.isfile(file)), None)  # also of long names


def kept_pixels(photo: Photo, header: Header, upright: bool, by_alpha: bool) -> np.ndarray | None:
    """Return which pixels of a photo count by its mask and its alpha, (height, width) bool; None: all do.

    Args:
        photo, header, upright: as `read_mask` takes them; the photo need not have a mask.
        by_alpha: whether the photo has an alpha that is a mask.

    Raises:
        UserError: as `read_mask` does.
        UnreadableError: the alpha cannot be read.
    """
    parts = [alpha_mask(photo, upright)] if by_alpha else []
    if photo.mask is not None:
        parts.append(read_mask(photo, header, upright))
    return found if parts and not (found := np.logical_and.reduce(parts)).all() else None


def read_mask(photo: Photo, header: Header, upright: bool) -> np.ndarray:
    """Read the mask of a photo at the size of the photo's camera.

    Args:
        photo: a photo with a mask.
        header: the photo's own.
        upright: whether the photo is turned by its EXIF orientation. A mask that was stored as the photo is turns too.

    Returns:
        (height, width) bool, True where pixels count.

    Raises:
        UserError: the mask cannot be read, or has another shape than the photo.
    """
    assert photo.mask is not None
    kept = _stored(photo.mask)
    width, height = (
        (header.height, header.width) if upright and header.orientation >= 5 else (header.width, header.height)
    )
    if upright and header.orientation > 1 and _alike(kept, header.width, header.height):
        kept = oriented(kept, header.orientation)
    if not _alike(kept, width, height):
        raise UserError(
            f"{photo.mask} has {kept.shape[1]}×{kept.shape[0]} pixels, its photo {photo.path} {width}×{height}: save "
            "the mask in the size of its photo"
        )
    return resized(kept, (photo.camera.width, photo.camera.height))


def _stored(file: Path) -> np.ndarray:
    """Whether each pixel of a mask is not 0 in some channel, (H, W) bool. Alpha of a mask does not count."""
    try:
        measure(file)
        with Image.open(file) as stored:
            plain = stored.convert("RGB") if stored.mode in ("P", "PA", "RGBA", "CMYK") else stored
            values = np.asarray(plain.getchannel(0) if plain.mode == "LA" else plain)
    except (UnreadableError, *BROKEN) as error:
        raise UserError(f"{file}: a mask that cannot be read: save it again as a grey PNG, or delete it") from error
    return np.asarray(values.any(-1) if values.ndim == 3 else values != 0)


def _alike(kept: np.ndarray, width: int, height: int) -> bool:
    """Whether a mask has a photo's shape, whatever its scale: masks of full size fit photos of images_4."""
    high, wide = kept.shape
    return abs(wide * height - high * width) <= max(width, height, wide, high)


def resized(kept: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Return a mask (H, W) bool at another size (width, height): a pixel counts if its whole area does."""
    width, height = size
    if kept.shape[0] < height or kept.shape[1] < width:
        rows, columns = np.arange(height) * kept.shape[0] // height, np.arange(width) * kept.shape[1] // width
        return kept[rows[:, None], columns]
    if kept.shape == (height, width):
        return kept

    def decode(rows: np.ndarray) -> np.ndarray:
        return rows.astype(np.float32)[..., None]

    mean = average_rows(average_rows(kept, height, decode)[..., 0].T, width, decode)[..., 0].T
    return mean > OPAQUE


def alpha_mask(photo: Photo, upright: bool) -> np.ndarray:
    """Return where a photo is opaque, (height, width) bool at the size of its camera."""
    return resized(opaque_pixels(photo.path, upright), (photo.camera.width, photo.camera.height))


def notes_on_masks(masked: Sequence[bool], empty: Sequence[str]) -> list[str]:
    """Return notes on masks.

    Args:
        masked: of each photo that is used, whether it has a mask.
        empty: the names of photos that are masked as a whole.
    """
    notes = []
    if empty:
        notes.append(
            phrases(
                "{n:,} photo is masked as a whole and left out, first {first}",
                "{n:,} photos are masked as a whole and left out, first {first}",
                len(empty),
                first=empty[0],
            )
        )
    without = len(masked) - sum(masked)
    if any(masked) and without:
        notes.append(
            phrases(
                "{n:,} photo has no mask and is used whole; the others have one",
                "{n:,} photos have no mask and are used whole; the others have one",
                without,
            )
        )
    return notes
