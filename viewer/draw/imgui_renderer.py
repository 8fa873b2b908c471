"""Draw imgui's draw data with moderngl, and keep the textures that it refers to (imgui 1.92's texture protocol)."""

from __future__ import annotations

import ctypes
from collections.abc import Hashable, Sequence

import moderngl
import numpy as np
from imgui_bundle import imgui

from .damage import Box, Drawn, Part, damage

VERTEX_SHADER = """
#version 330
uniform vec4 place;  // scale and shift from pixels, y down, to clip space
in vec2 position;
in vec2 uv;
in vec4 color;
out vec2 vertex_uv;
out vec4 vertex_color;
void main() {
    vertex_uv = uv;
    vertex_color = color;
    gl_Position = vec4(position * place.xy + place.zw, 0.0, 1.0);
}
"""

FRAGMENT_SHADER = """
#version 330
uniform sampler2D image;
in vec2 vertex_uv;
in vec4 vertex_color;
out vec4 fragment;
void main() {
    fragment = vertex_color * texture(image, vertex_uv);
}
"""

# Colours have straight alpha; the framebuffer's alpha must still add up to 1.
BLEND = (moderngl.SRC_ALPHA, moderngl.ONE_MINUS_SRC_ALPHA, moderngl.ONE, moderngl.ONE_MINUS_SRC_ALPHA)


Ground = tuple[float, float, float, float]


class ImguiRenderer:
    """Serves the current imgui context; its texture ids are GL texture names."""

    def __init__(self, context: moderngl.Context) -> None:
        self.context = context
        self._program = context.program(vertex_shader=VERTEX_SHADER, fragment_shader=FRAGMENT_SHADER)
        self._vertices = context.buffer(reserve=1 << 20, dynamic=True)
        self._indices = context.buffer(reserve=1 << 20, dynamic=True)
        self._arrays = self._make_arrays()
        self._textures: dict[int, moderngl.Texture] = {}
        self._contents: dict[int, Hashable] = {}  # by texture: see `add`
        self._opaque: set[int] = set()
        self.drawn: list[Box] = []  # where the last `render` drew
        self._before: tuple[tuple[int, int], Ground, list[Drawn]] | None = None  # what `render` drew last
        # Indices have 32 bits in this build, so vertex offsets are not needed.
        imgui.get_io().backend_flags |= imgui.BackendFlags_.renderer_has_textures
        largest = context.info["GL_MAX_TEXTURE_SIZE"]
        platform = imgui.get_platform_io()
        platform.renderer_texture_max_width = platform.renderer_texture_max_height = largest

    def _make_arrays(self) -> moderngl.VertexArray:
        return self.context.vertex_array(
            self._program,
            [(self._vertices, "2f 2f 4f1", "position", "uv", "color")],
            index_buffer=self._indices,
            index_element_size=imgui.INDEX_SIZE,
        )

    def add(
        self, texture: moderngl.Texture, opaque: bool = False, content: Hashable | None = None
    ) -> imgui.ImTextureRef:
        """Let draw commands refer to `texture`. The caller keeps it and calls `remove` before releasing it.

        Args:
            texture: the texture.
            opaque: it has no transparent texel, so that the pixels under it need not be read.
            content: changes whenever what the texture shows does. None: that may be any time.
        """
        self._textures[texture.glo] = texture
        self._contents[texture.glo] = object() if content is None else content
        self._opaque.discard(texture.glo)  # GL reuses the name of a released texture
        if opaque:
            self._opaque.add(texture.glo)
        return imgui.ImTextureRef(texture.glo)

    def remove(self, texture: moderngl.Texture) -> None:
        self._textures.pop(texture.glo, None)
        self._contents.pop(texture.glo, None)
        self._opaque.discard(texture.glo)

    def render(
        self, data: imgui.ImDrawData, target: moderngl.Framebuffer, ground: Ground | None = None, kept: bool = False
    ) -> None:
        """Draw what imgui shows into the viewport of `target`.

        Args:
            data: what imgui shows.
            target: where to draw.
            ground: the colour under it; None: over what is there.
            kept: `target` has still what the last call drew, so that only what has changed is drawn.
        """
        for texture in data.textures:
            self._update(texture)
        width, height = int(data.display_size.x), int(data.display_size.y)
        if width <= 0 or height <= 0:
            return
        lists = [self._read(commands, data) for commands in data.cmd_lists]
        before, self._before = self._before, None  # whatever is raised, the next frame is drawn anew
        dirty = [Box(0, 0, width, height)]
        if kept and before is not None and before[:2] == ((width, height), ground):
            dirty = damage(before[2], lists)
        self.drawn = dirty
        target.use()
        if ground is not None:
            for box in dirty:
                target.clear(*ground, viewport=box.for_gl(height))
        self.context.blend_func = BLEND  # pyright: ignore[reportAttributeAccessIssue]  write-only in moderngl's stubs
        x, y = data.display_pos
        self._program["place"] = (2 / width, -2 / height, -1 - 2 * x / width, 1 + 2 * y / height)
        for one in lists:
            self._draw(one, dirty, height)
        self.context.scissor = None
        if ground is not None:
            self._before = (width, height), ground, lists

    def _read(self, commands: imgui.ImDrawList, data: imgui.ImDrawData) -> Drawn:
        vertices, indices, (x, y) = commands.vtx_buffer, commands.idx_buffer, data.display_pos
        parts: list[Part] = []
        for command in commands.cmd_buffer:
            left, top, right, bottom = command.clip_rect
            whole = Box(0, 0, int(data.display_size.x), int(data.display_size.y))
            box = Box(int(left - x), int(top - y), int(right - x), int(bottom - y)).common(whole)
            name = command.tex_ref.get_tex_id()
            if box and command.elem_count:
                content = name, self._contents[name], name in self._opaque
                parts.append(Part(box, content, command.idx_offset, command.elem_count))
        return Drawn(
            ctypes.string_at(vertices.data_address(), vertices.size() * imgui.VERTEX_SIZE) if parts else b"",
            ctypes.string_at(indices.data_address(), indices.size() * imgui.INDEX_SIZE) if parts else b"",
            tuple(parts),
            (x, y),
        )

    def _draw(self, one: Drawn, dirty: Sequence[Box], height: int) -> None:
        """Draw a list of commands where something has changed."""
        todo = [(part, box) for part in one.parts for place in dirty if (box := part.box.common(place))]
        if todo:
            self._upload(one)
        for part, box in todo:
            self.context.scissor = box.for_gl(height)
            name, _, opaque = part.texture
            self._textures[name].use()
            self.context.enable_only(moderngl.NOTHING if opaque else moderngl.BLEND)
            self._arrays.render(moderngl.TRIANGLES, vertices=part.length, first=part.first)

    def _upload(self, one: Drawn) -> None:
        grown = False
        for buffer, data in ((self._vertices, one.vertices), (self._indices, one.indices)):
            if buffer.size < len(data):
                buffer.orphan(2 * len(data))
                grown = True
        if grown:
            self._arrays.release()
            self._arrays = self._make_arrays()
        for buffer, data in ((self._vertices, one.vertices), (self._indices, one.indices)):
            buffer.orphan()  # the driver may still read the old content
            buffer.write(data)

    def _update(self, texture: imgui.ImTextureData) -> None:
        status = imgui.ImTextureStatus
        if texture.status == status.want_create:
            mine = self.context.texture((texture.width, texture.height), 4, _pixels(texture).tobytes())
            mine.repeat_x = mine.repeat_y = False
            texture.set_tex_id(self.add(mine, content=object()).get_tex_id())
            texture.status = status.ok
        elif texture.status == status.want_updates:
            mine, pixels = self._textures[texture.tex_id], _pixels(texture)
            for r in texture.updates:
                part = pixels[r.y : r.y + r.h, r.x : r.x + r.w]
                mine.write(part.tobytes(), viewport=(r.x, r.y, r.w, r.h))
            # What was in it stays where it was: glyphs are added, and what refers to them is new.
            texture.status = status.ok
        elif texture.status == status.want_destroy:
            self._destroy(texture)

    def _destroy(self, texture: imgui.ImTextureData) -> None:
        self._textures.pop(texture.tex_id).release()
        texture.set_tex_id(0)
        texture.status = imgui.ImTextureStatus.destroyed

    def release(self) -> None:
        """Free imgui's textures and the renderer's objects. Textures that were added belong to their owners."""
        for texture in imgui.get_platform_io().textures:
            if texture.tex_id:
                self._destroy(texture)
        imgui.get_io().backend_flags &= ~imgui.BackendFlags_.renderer_has_textures
        for mine in (self._arrays, self._vertices, self._indices, self._program):
            mine.release()
        self._textures.clear()
        self._before = None


def _pixels(texture: imgui.ImTextureData) -> np.ndarray:
    return texture.get_pixels_array().reshape(texture.height, texture.width, texture.bytes_per_pixel)
