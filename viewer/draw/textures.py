"""Textures by name, for the panels."""

from __future__ import annotations

import itertools

import moderngl
import numpy as np
from imgui_bundle import imgui

from .imgui_renderer import ImguiRenderer

IDLE_FRAMES = 600  # a texture that is not drawn for so long gives its memory back
_numbers = itertools.count()


class TextureCache:
    """Keeps one GL texture per name. It uploads an array only if it is another object than before."""

    def __init__(self, renderer: ImguiRenderer) -> None:
        self._renderer = renderer
        self._held: dict[str, tuple[np.ndarray, moderngl.Texture]] = {}
        self._uploads: dict[int, int] = {}  # by texture: the number of its last upload
        self._retired: list[moderngl.Texture] = []
        self._frame = 0
        self._drawn: dict[str, int] = {}  # by name: the last frame

    def begin_frame(self) -> None:
        """Free the textures that were replaced in the last frame, whose draw commands still referred to them.

        Those that were not drawn for IDLE_FRAMES go, too.
        """
        self._frame += 1
        for key in [key for key, frame in self._drawn.items() if self._frame - frame > IDLE_FRAMES]:
            del self._drawn[key]
            self._retired.append(self._held.pop(key)[1])
        for texture in self._retired:
            self._renderer.remove(texture)
            texture.release()
        self._retired.clear()

    def get(self, key: str, rgba: np.ndarray, smooth: bool = True) -> imgui.ImTextureRef:
        """Return the texture of `key`.

        rgba: uint8 (h, w, 4), row 0 at uv y = 0 (the top of an imgui image). Raises ValueError for other shapes.
        """
        if rgba.ndim != 3 or rgba.shape[2] != 4 or rgba.dtype != np.uint8 or 0 in rgba.shape:
            raise ValueError(f"texture {key!r}: got {rgba.dtype} {rgba.shape}, wants uint8 (h, w, 4)")
        self._drawn[key] = self._frame
        held, texture = self._held.get(key, (None, None))
        if texture is not None and texture.size != (rgba.shape[1], rgba.shape[0]):
            self._retired.append(self._held.pop(key)[1])
            texture = held = None
        if texture is None:
            texture = self._renderer.context.texture((rgba.shape[1], rgba.shape[0]), 4)
            texture.repeat_x = texture.repeat_y = False
        if held is not rgba:
            texture.write(np.ascontiguousarray(rgba))
            self._held[key] = (rgba, texture)
            self._uploads[texture.glo] = next(_numbers)
        kind = moderngl.LINEAR if smooth else moderngl.NEAREST
        texture.filter = (kind, kind)
        return self._renderer.add(texture, content=(self._uploads[texture.glo], smooth))

    def release(self) -> None:
        self._retired += [texture for _, texture in self._held.values()]
        self._held.clear()
        self._drawn.clear()
        self.begin_frame()
