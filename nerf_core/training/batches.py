"""Draw the pixels of a training step."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from nerf_core.common.errors import UserError
from nerf_core.geometry.camera import Camera
from nerf_core.geometry.cameras import Cameras
from nerf_core.geometry.fast_rays import photo_colors
from nerf_core.geometry.photos import DAMAGED, WAITING, WIDEN, Photos, PhotosLost, first_photos
from nerf_core.geometry.rays import Rays
from nerf_core.geometry.scene import Scene
from nerf_core.methods import Draw

TAPS = 4  # pixels a side, at most, that stand for a block of a large capture's photo: all of a block of 4 × 4
FACTORS = np.array([0x9E3779B97F4A7C15, 0xBF58476D1CE4E5B9, 0x94D049BB133111EB], np.uint64)  # see `shuffled`
MOST_DRAWN = 2**62  # places of an order, more than any run uses: a state from elsewhere must leave room to count on
TRIES = 16  # rounds of drawing pixels until enough of them are not masked


class Batch(NamedTuple):
    """The pixels of a training step.

    rays: R rays.
    colors: (R, 3) float32 in [0, 1], the photos' colours, sRGB-encoded.
    photo: (R,) int64 on the CPU, which photos: positions in `PixelSampler.views`.
    """

    rays: Rays
    colors: Tensor
    photo: Tensor


class _Level:
    """The training photos at one size.

    cameras: N cameras.
    sizes: (N, 2) int64, width and height.
    reach: (N,) how far from the principal point a fisheye lens shows something, in units of the focal
        length; infinite for other lenses. None: all pixels show something.
    offsets: (N + 1,) int64; photo i has the pixels offsets[i] … offsets[i + 1] − 1, counted over all photos.
    pixels, starts, kept: see `Photos`.
    usable: (n,) int64, the photos with pixels that count; None: all.
    filled: the photos of a large capture at full size, of which blocks are averaged when they are drawn; else None.
    """

    def __init__(self, photos: Photos, cameras: list[Camera], scene: Scene, filled: Photos | None = None) -> None:
        self.filled = filled
        self.cameras = Cameras(cameras, scene.near, scene.far)
        self.sizes = torch.from_numpy(photos.sizes)
        reach = torch.tensor([camera.lens.reach() for camera in cameras], dtype=torch.float64)
        self.reach = reach if reach.isfinite().any() else None
        counts = self.sizes.prod(-1)
        self.offsets = torch.cat([torch.zeros(1, dtype=torch.long), counts.cumsum(0)])
        self.pixels, self.starts = photos.flat, torch.from_numpy(photos.starts)
        self.kept = None if not photos.masked_photos else torch.from_numpy(photos.kept)
        self.usable = None
        if self.kept is not None:
            masks = (photos.mask(k) for k in range(len(photos.sizes)))
            usable = [k for k, mask in enumerate(masks) if mask is None or mask.any()]
            if usable:
                self.usable = torch.tensor(usable)
            else:  # the pixels that count lie at the border, which shrinking cuts off
                self.kept = None

    def shown(self, index: Tensor, pixel: Tensor) -> Tensor:
        """Return integer pixels (R, 2) of the photos `index` (R,) without those where a fisheye lens shows nothing.

        A corner outside the lens's circle is replaced by its inverse in that circle, so that no random number is drawn.
        """
        if self.reach is None:
            return pixel
        offset = (pixel + 0.5 - self.cameras.principal[index]) / self.cameras.focal[index]
        share = self.reach[index] / offset.norm(dim=-1)
        moved = self.cameras.principal[index] + (share.square()[:, None] * offset) * self.cameras.focal[index]
        inside = moved.nan_to_num(0.0).clamp(min=0).long()
        return torch.where(share[:, None] < 1, torch.minimum(inside, self.sizes[index] - 1), pixel)


class PixelSampler:
    """Draws random pixels of the training photos, as rays with their colours. It has a generator of its own.

    As in NeRF's official code, the pixels of all photos are shuffled and taken in turn, so that none is drawn again
    before each was drawn. The order is computed (`shuffled`): a list of it would take eight bytes a pixel. Masked ones
    are taken and left out. Where all pixels of a step come from one photo, they are drawn with replacement.
    """

    def __init__(self, scene: Scene, train_images: int, device: torch.device, seed: int) -> None:
        """Choose the photos.

        Args:
            scene: the scene; its split "train" is used.
            train_images: how many of these photos, evenly spread; 0: all.
            device: where the rays and colours go.
            seed: of the generator.

        Raises:
            UserError: the scene has no training photos.
        """
        views = list(scene.trained(train_images))
        if not views:
            raise UserError(f"{scene.name}: no training photos: every photo is held out")
        if scene.photos.filling is not None and scene.photos.ids is not None:
            place = np.argsort(scene.photos.filling.order)[scene.photos.ids]  # argsort inverts a permutation
            views.sort(key=lambda view: place[view])
        self.scene, self.views, self.device = scene, views, device
        self.generator = torch.Generator().manual_seed(seed)
        self._key = self._any_key()
        self._drawn = 0  # places in the order that are used up
        self._photos: dict[int, _Level] = {}

    def repose(self, scene: Scene) -> None:
        """Take the cameras' poses from another scene of the same photos."""
        self.scene = scene
        poses = torch.from_numpy(scene.poses[self.views])
        for level in self._photos.values():
            level.cameras.c2w = poses

    def draw(self, wanted: Draw, part: range | None = None) -> tuple[Rays, Tensor]:
        """Return the rays and colours of `batch`."""
        return self.batch(wanted, part)[:2]

    def arrived(self, step: int) -> bool:
        """Return whether the photos of a step are read. If not, those that lack are read next. Raises UserError."""
        photos = self.scene.photos
        if photos.filling is None or photos.ids is None:
            return True
        photos.filling.check()
        ids = photos.ids[self.views[: first_photos(step)]]
        lacking = ids[photos.filling.state[ids] == WAITING]
        for k in lacking[::-1].tolist():  # the one that is asked for last is read first
            photos.filling.prefer(k)
        return not len(lacking)

    def batch(self, wanted: Draw, part: range | None = None, step: int = 0) -> Batch:
        """Draw the pixels of one training step.

        Args:
            wanted: how many, and from which part of the photos.
            part: return only these of them; the generator moves on as for all. None: all.
            step: the number of steps done, which decides the photos of a large capture. They must have `arrived`.
        """
        photos = self._at(wanted.shrink)
        if photos.filled is not None:
            return self._filled_batch(photos, photos.filled, wanted, part, step)
        index, pixel = self._pixels(photos, wanted) if photos.kept is None else self._counting(photos, wanted)
        if part is not None:
            index, pixel = index[part.start : part.stop], pixel[part.start : part.stop]
        colors = photo_colors(index, pixel, photos.sizes[:, 0], photos.starts, photos.pixels)
        return Batch(photos.cameras.rays(index, pixel + 0.5).to(self.device), colors.to(self.device), index)

    def _filled_batch(self, photos: _Level, whole: Photos, wanted: Draw, part: range | None, step: int) -> Batch:
        """Draw from the first photos of a large capture. For a damaged one, the one before it is taken.

        whole: the photos at full size.
        """
        first = min(first_photos(step), len(self.views))
        good = self._good(whole, first)
        index, pixel = self._pixels(photos, wanted, among=good)
        if part is not None:
            index, pixel = index[part.start : part.stop], pixel[part.start : part.stop]
        colors = block_colors(whole, index, pixel, wanted.shrink)
        return Batch(photos.cameras.rays(index, pixel + 0.5).to(self.device), colors.to(self.device), index)

    def _good(self, whole: Photos, first: int) -> Tensor:
        """For each of the `first` photos itself, or the next sound one before it, or the first sound one: (first,)."""
        assert whole.filling is not None
        assert whole.ids is not None
        sound = whole.filling.state[whole.ids[:first]] != DAMAGED
        if not sound.any():
            raise PhotosLost(f"{self.scene.name}: {whole.filling.damaged()[0]}: no photo can be read: check the files")
        before = np.maximum.accumulate(np.where(sound, np.arange(first), -1))
        return torch.from_numpy(np.where(before < 0, sound.argmax(), before))

    def _pixels(
        self, photos: _Level, wanted: Draw, photo: int = -1, among: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Draw pixels, whether they count or not: photos (R,), columns and rows (R, 2).

        photo: take all from it. among: (n,) what to take for each of the first n photos; None: all photos as they are.
        """
        count, total = wanted.rays, len(photos.sizes) if among is None else len(among)
        if photo >= 0 or wanted.one_image:
            index = (torch.tensor([photo]) if photo >= 0 else self._integers(total, 1)).expand(count)
            where = torch.rand(count, 2, generator=self.generator, dtype=torch.float64)
        else:
            at = self._next(int(photos.offsets[total]), count)
            index = torch.searchsorted(photos.offsets, at, right=True) - 1
            at, width = at - photos.offsets[index], photos.sizes[index, 0]
            # as shares of the photo: its middle, or another photo instead of it, may have another size
            where = (torch.stack([at % width, at // width], -1).double() + 0.5) / photos.sizes[index]
        if among is not None:
            index = among[index]
        size = photos.sizes[index]
        window = size
        if wanted.crop < 1:
            window = (size * wanted.crop).long().clamp(min=1)
        pixel = (size - window) // 2 + (where * window).long()
        return index, photos.shown(index, pixel)

    def _counting(self, photos: _Level, wanted: Draw) -> tuple[Tensor, Tensor]:
        """Draw pixels that count, as `_pixels` does. Masked ones are drawn again, so that no list of pixels is kept.

        The middle of the photos may be masked: after TRIES, pixels are taken from whole photos. If hardly a pixel
        counts, those that were found are repeated.
        """
        assert photos.kept is not None
        assert photos.usable is not None
        photo = int(photos.usable[self._integers(len(photos.usable), 1)]) if wanted.one_image else -1
        found: list[tuple[Tensor, Tensor]] = []
        lacking, asked, tries = wanted.rays, 0, 0
        while lacking and tries < 2 * TRIES:
            tries += 1
            share = (wanted.rays - lacking + 1) / (asked + 1)
            rays = min(math.ceil(lacking / share), 4 * wanted.rays)
            crop = 1.0 if tries > TRIES and not found else wanted.crop
            index, pixel = self._pixels(photos, wanted._replace(rays=rays, crop=crop), photo)
            at = photos.starts[index] + pixel[:, 1] * photos.sizes[index, 0] + pixel[:, 0]
            good = photos.kept[at].nonzero()[:lacking, 0]
            lacking, asked = lacking - len(good), asked + rays
            if len(good):
                found.append((index[good], pixel[good]))
        if not found:
            found.append(self._first(photos, max(photo, 0)))
        index, pixel = (torch.cat(v) for v in zip(*found, strict=True))
        again = torch.arange(wanted.rays) % len(index)
        return index[again], pixel[again]

    @staticmethod
    def _first(photos: _Level, photo: int) -> tuple[Tensor, Tensor]:
        """A pixel that counts, of a photo or else of the first that has one."""
        assert photos.kept is not None
        assert photos.usable is not None
        k = photo if photo in photos.usable else int(photos.usable[0])
        start, (width, height) = int(photos.starts[k]), photos.sizes[k].tolist()
        at = int(photos.kept[start : start + width * height].nonzero()[0, 0])
        return torch.tensor([k]), torch.tensor([[at % width, at // width]])

    def _at(self, shrink: int) -> _Level:
        """Return the photos at 1/shrink of their size. Only the last size is kept: schedules do not go back to one."""
        if shrink not in self._photos:
            self._photos = {}  # frees the memory first
            photos = self.scene.photos.at(self.views)
            cameras = [self.scene.views[i].camera for i in self.views]
            if shrink > 1:
                cameras = [camera.shrunk(shrink) for camera in cameras]
            if photos.filling is not None:
                small = replace(photos, sizes=np.array([(c.width, c.height) for c in cameras], np.int64))
                self._photos = {shrink: _Level(small, cameras, self.scene, photos)}
                return self._photos[shrink]
            if shrink > 1:
                photos = shrunk(photos, [(camera.width, camera.height) for camera in cameras], shrink)
            self._photos = {shrink: _Level(photos, cameras, self.scene)}
        return self._photos[shrink]

    def _next(self, below: int, count: int) -> Tensor:
        """Return the next `count` numbers, (R,) int64, of 0 … below − 1 in random order, again and again."""
        found, lacking, bits = [], count, max(below - 1, 1).bit_length()
        while lacking:
            # of 2^bits numbers those from `below` on are skipped, which are less than half
            places = self._drawn + np.arange((lacking << bits) // below + 1, dtype=np.uint64)
            numbers = shuffled(places, self._key, bits)
            good = np.flatnonzero(numbers < below)[:lacking]
            lacking -= len(good)
            self._drawn += len(places) if lacking else int(good[-1]) + 1
            found.append(numbers[good].astype(np.int64))
        return torch.from_numpy(np.concatenate(found))

    def _any_key(self) -> int:
        return int(torch.randint(2**63 - 1, (1,), generator=self.generator))

    def _integers(self, below: int, count: int) -> Tensor:
        return torch.randint(below, (count,), generator=self.generator)

    def state(self) -> dict[str, Tensor]:
        """Return by name, for a checkpoint, what decides which pixels are drawn next."""
        return {"generator": self.generator.get_state(), "order": torch.tensor([self._key, self._drawn])}

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Continue from `state`. Raises KeyError, RuntimeError, TypeError or ValueError if it is no sampler's state."""
        order = state.get("order")
        if order is not None:
            fits = order.shape == (2,) and order.dtype == torch.int64 and (order >= 0).all()
            if not fits or order[1] > MOST_DRAWN:
                raise ValueError("the order of pixels is not two numbers of 0 or more, the second up to 2⁶²")
        self.generator.set_state(state["generator"])
        # an earlier version drew with replacement
        self._key, self._drawn = (self._any_key(), 0) if order is None else order.tolist()


def shuffled(places: np.ndarray, key: int, bits: int) -> np.ndarray:
    """Return the numbers at some places of 0 … 2^bits − 1 in random order, which is another one every 2^bits places.

    Each round multiplies by an odd number and moves high bits to low ones, modulo 2^bits. Both can be undone, so that
    every number comes once. The factors are those of SplitMix64 (Steele, Lea and Flood 2014), which mix well.

    Args:
        places: (R,) uint64.
        key: of the order, 0 … 2⁶³ − 1.
        bits: 1 … 63.

    Returns:
        (R,) uint64.
    """
    mask, half = np.uint64((1 << bits) - 1), np.uint64(max(bits // 2, 1))
    keys = mixed(np.uint64(key) + (places >> np.uint64(bits)) * FACTORS[0])
    numbers = places & mask
    for n, factor in enumerate(FACTORS):
        numbers = ((numbers ^ (keys >> np.uint64(21 * n))) * factor) & mask
        numbers ^= numbers >> half
    return numbers


def mixed(keys: np.ndarray) -> np.ndarray:
    """Return keys (R,) uint64 whose bits all depend on all bits of the given ones (SplitMix64)."""
    keys = (keys ^ (keys >> np.uint64(30))) * FACTORS[1]
    keys = (keys ^ (keys >> np.uint64(27))) * FACTORS[2]
    return keys ^ (keys >> np.uint64(31))


def block_colors(photos: Photos, index: Tensor, pixel: Tensor, factor: int) -> Tensor:
    """Return the mean colours of blocks of factor × factor pixels, of which at most TAPS × TAPS are read.

    Up to a factor of TAPS it gives what `shrunk` stores, for photos that are too many to be stored a second time; of
    larger blocks it is an even sample.

    Args:
        photos: N photos at full size.
        index: (R,) the photo of each block.
        pixel: (R, 2) integer column and row of the block.
        factor: the side of a block, in pixels.

    Returns:
        sRGB colours (R, 3), float32 in [0, 1].
    """
    k, corner = index.numpy(), pixel.numpy()
    size = photos.sizes[k]
    side = np.minimum(factor, size.min(1))
    taps = min(factor, TAPS)
    total = np.zeros((len(k), 3))
    for row in range(taps):
        y = corner[:, 1] * side + (2 * row + 1) * side // (2 * taps)
        for column in range(taps):
            x = corner[:, 0] * side + (2 * column + 1) * side // (2 * taps)
            total += photos.flat[photos.starts[k] + y * size[:, 0] + x]
    scale = WIDEN if photos.flat.dtype == np.uint8 else 1
    return torch.from_numpy((np.floor(total * scale / taps**2 + 0.5) / 65535).astype(np.float32))


def shrunk(photos: Photos, sizes: Sequence[tuple[int, int]], factor: int) -> Photos:
    """Average photos over blocks of factor × factor pixels.

    Args:
        photos: N photos.
        sizes: their new sizes (width, height), those of `Camera.shrunk`.
        factor: the side of a block, in pixels.
    """
    small, masks = Photos.empty(sizes), {}
    for k, image in enumerate(photos.images):
        width, height = sizes[k]
        side = min(factor, *image.shape[:2])
        blocks = image[: height * side, : width * side].reshape(height, side, width, side, 3)
        if (mask := photos.mask(k)) is None:
            mean = blocks.mean((1, 3), dtype=np.float32)
        else:
            inside = mask[: height * side, : width * side].reshape(height, side, width, side, 1)
            mean, masks[k] = _kept_mean(blocks, inside)
        small.put(k, (mean + np.float32(0.5)).astype(np.uint16))
    return small.masked(masks) if masks else small


def _kept_mean(blocks: np.ndarray, inside: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Average the pixels of blocks that count.

    A block counts if half of its pixels do. If no block of the photo does, every one with a pixel that counts does.

    Args:
        blocks: (h, side, w, side, 3).
        inside: (h, side, w, side, 1) bool.

    Returns:
        The means (h, w, 3) float32, and which blocks count, (h, w).
    """
    number = inside.sum((1, 3), dtype=np.float32)
    mean = (blocks * inside).sum((1, 3), dtype=np.float32) / np.maximum(number, 1)
    half = number[..., 0] >= blocks.shape[1] ** 2 / 2
    return mean, half if half.any() else number[..., 0] > 0
