"""The picture in the viewport: at each pixel the best of the newest preview and a sharper one, warped to the camera.

New pixels of a moving camera are few. So the sharpest picture before stays on top, warped, where it still shows more
than the newest one: `Layer.blur` compares them, in pixels. The newest one fills the rest, and finer ones fade in.
"""

from __future__ import annotations

from collections.abc import Hashable
from typing import NamedTuple

import moderngl
import numpy as np

from nerf_core.geometry.camera import Camera
from nerf_core.live.messages import Preview

from .warp import FRAGMENT, NO_RIVAL, VERTEX, Canvas, Layer, same_view
from .warp_mesh import SOFT

FADE_SECONDS = 0.2  # short enough to be no wait, long enough to be no pop
REST_SECONDS = 6.0  # a picture of earlier weights is given up so long after the camera came to rest
SHARPEST = 0.1  # quantile: a picture is given up if not even this part of it shows more than the newest one


class Shown(NamedTuple):
    """A texture, row 0 at the top, the texture coordinates of the viewport's corners, and its opacity.

    content: changes whenever what the texture shows does.
    """

    texture: moderngl.Texture
    first: tuple[float, float]
    last: tuple[float, float]
    alpha: float = 1.0
    content: Hashable = None


class ViewportPicture:
    """The picture of the viewport, as layers to be drawn over each other.

    A warp is drawn again only if something changed.

    shown: the layers of the last `draw`, the lowest first. The lowest is opaque.
    fading: whether the next `draw` shows something else even if nothing new comes.
    """

    def __init__(self, context: moderngl.Context) -> None:
        self._context = context
        self._program = context.program(vertex_shader=VERTEX, fragment_shader=FRAGMENT)
        self.shown: tuple[Shown, ...] = ()
        self.fading = False
        self._canvases: dict[str, Canvas] = {}
        self._drawn: dict[str, tuple[object, ...]] = {}  # by canvas: what is on it
        self._newest: Layer | None = None
        self._sharp: Layer | None = None  # an older picture that shows more somewhere
        self._coarser: Layer | None = None  # the newest one's coarser level, over which it fades in
        self._given_up: float | None = None  # when the sharp picture began to fade out
        self._blur_before = 0.0  # that the newest picture's blur fades from
        self._camera: Camera | None = None
        self._rests_since = 0.0

    def draw(self, preview: Preview, camera: Camera, background: tuple[float, float, float], now: float) -> bool:
        """Bring `shown` up to date.

        Args:
            preview: the newest picture.
            camera: the viewport's camera, a pinhole.
            background: the scene's colour where nothing is, in [0, 1].
            now: the time in seconds.

        Returns:
            Whether something is warped.
        """
        if self._camera is None or not same_view(self._camera, camera):
            self._camera, self._rests_since = camera, now
            self._drop_coarser()
        newest = self._newest
        if newest is None or newest.preview is not preview:
            newest = self._newest = self._take(preview, camera, now)
        part = min((now - newest.arrived) / FADE_SECONDS, 1.0)
        if part >= 1:
            self._drop_coarser()
        blur = self._blur(newest, camera)
        blur = self._blur_before ** (1 - part) * blur**part if self._blur_before > blur else blur
        opacity = self._opacity(newest, camera, blur, part, now)
        direct = same_view(preview.camera, camera)
        layers = [_direct(newest)] if direct else [self._warped("newest", newest, camera, background, NO_RIVAL)]
        if self._coarser is not None:
            layers = [_direct(self._coarser), layers[0]._replace(alpha=part)]
        if self._sharp is not None:
            sharp = self._warped("sharp", self._sharp, camera, None, blur)
            layers.append(sharp._replace(alpha=opacity))
        self.shown = tuple(layers)
        self.fading = self._coarser is not None or self._given_up is not None or (self._sharp is not None and part < 1)
        return self._sharp is not None or not direct

    def _take(self, preview: Preview, camera: Camera, now: float) -> Layer:
        """Make the newest layer, and choose what becomes of the one before."""
        layer, before = Layer(self._context, preview, now), self._newest
        self._drop_coarser()
        self._blur_before = 0.0
        if before is None:
            return layer
        if (before.preview.model, before.preview.mode) != (preview.model, preview.mode):
            before.release()
            self._drop_sharp()
            return layer
        step, sharp = preview.step, self._sharp
        blur, blur_before = self._blur(layer, camera), self._blur(before, camera, step)
        if blur_before < blur and (sharp is None or blur_before < self._blur(sharp, camera, step)):
            self._drop_sharp()
            self._sharp = before
            return layer
        if blur < blur_before:
            self._blur_before = blur_before
        finer = preview.stride < before.preview.stride
        if finer and same_view(preview.camera, camera) and same_view(before.preview.camera, camera):
            self._coarser = before
        else:
            before.release()
        return layer

    def _opacity(self, newest: Layer, camera: Camera, blur: float, part: float, now: float) -> float:
        """Return the opacity of the sharp picture as a whole; forget that picture if the newest one shows more."""
        sharp = self._sharp
        if sharp is None:
            return 0.0
        blurs = sharp.blur(camera, newest.preview.step)
        rests = max(now - self._rests_since, 0.0)
        answered = same_view(newest.preview.camera, camera)
        outdated = answered and rests > REST_SECONDS and newest.preview.step > sharp.preview.step
        if not len(blurs) or (part >= 1 and np.quantile(blurs, SHARPEST) >= blur):
            self._drop_sharp()
            return 0.0
        if outdated and self._given_up is None:
            self._given_up = now
        gone = 0.0 if self._given_up is None else (now - self._given_up) / FADE_SECONDS
        if gone >= 1:
            self._drop_sharp()
        return max(1 - gone, 0.0)

    @staticmethod
    def _blur(layer: Layer, camera: Camera, step: int | None = None) -> float:
        """The median of `Layer.blur`; `NO_RIVAL` if the camera sees nothing of the picture."""
        blurs = layer.blur(camera, layer.preview.step if step is None else step)
        return float(np.median(blurs)) if len(blurs) else NO_RIVAL

    def _warped(
        self, name: str, layer: Layer, camera: Camera, background: tuple[float, float, float] | None, rival: float
    ) -> Shown:
        """Draw a warp, over a background or over nothing, if it is not on its canvas already."""
        # A coarse picture needs few pixels, and software GL takes its time by pixels. But enlarged transparent ones
        # would lend their black to their neighbours.
        scale = 1 if background is None else max(layer.preview.stride // SOFT, 1)
        canvas, size = self._canvases.get(name), (-(-camera.width // scale), -(-camera.height // scale))
        if canvas is None or canvas.texture.size != size:
            if canvas is not None:
                canvas.release()
            canvas = self._canvases[name] = Canvas(self._context, size)
            self._drawn.pop(name, None)
        step = self._newest.preview.step if self._newest is not None else layer.preview.step
        wanted = (layer, camera.intrinsics(), camera.c2w.tobytes(), background, rival, layer.aged(step))
        if self._drawn.get(name) != wanted:
            self._drawn[name] = wanted
            canvas.target.use()
            canvas.target.clear(*(background or (0.0, 0.0, 0.0)), 0.0 if background is None else 1.0, depth=1.0)
            layer.warp(self._program, canvas.target, camera, step, rival)
            kind = moderngl.NEAREST if scale == 1 else moderngl.LINEAR
            canvas.texture.filter = (kind, kind)
        return Shown(canvas.texture, (0.0, 0.0), (1.0, 1.0), content=wanted)

    def _drop_sharp(self) -> None:
        if self._sharp is not None:
            self._sharp.release()
        self._sharp = self._given_up = None
        self._drawn.pop("sharp", None)

    def _drop_coarser(self) -> None:
        if self._coarser is not None:
            self._coarser.release()
        self._coarser = None

    def forget(self) -> None:
        """Forget all pictures, because another scene is shown."""
        self._drop_sharp()
        self._drop_coarser()
        if self._newest is not None:
            self._newest.release()
        self._newest, self.shown, self.fading = None, (), False
        self._drawn.clear()

    def release(self) -> None:
        self.forget()
        for canvas in self._canvases.values():
            canvas.release()
        self._canvases.clear()
        self._program.release()


def _direct(layer: Layer) -> Shown:
    """The picture itself. Texel (i, j) was computed at the pixel centre (i · stride + ½, j · stride + ½)."""
    preview, image = layer.preview, layer.image
    kind = moderngl.NEAREST if preview.stride == 1 else moderngl.LINEAR
    image.filter = (kind, kind)
    ends = (0, 0), (preview.camera.width, preview.camera.height)
    first, last = (
        tuple(((end - 0.5) / preview.stride + 0.5) / size for end, size in zip(corner, image.size, strict=True))
        for corner in ends
    )
    return Shown(image, first, last, content=layer)
