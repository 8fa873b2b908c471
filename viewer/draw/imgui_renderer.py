"""Draw imgui's draw data with moderngl, and keep the textures that it refers to (imgui 1.92's texture protocol)."""

from __future__ import annotations

import ctypes

import moderngl
import numpy as np
from imgui_bundle import imgui

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


class ImguiRenderer:
    """Serves the current imgui context; its texture ids are GL texture names."""

    def __init__(self, context: moderngl.Context) -> None:
        self.context = context
        self._program = context.program(vertex_shader=VERTEX_SHADER, fragment_shader=FRAGMENT_SHADER)
        self._vertices = context.buffer(reserve=1 << 20, dynamic=True)
        self._indices = context.buffer(reserve=1 << 20, dynamic=True)
        self._arrays = self._make_arrays()
        self._textures: dict[int, moderngl.Texture] = {}
        self._opaque: set[int] = set()
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

    def add(self, texture: moderngl.Texture, opaque: bool = False) -> imgui.ImTextureRef:
        """Let draw commands refer to `texture`. The caller keeps it and calls `remove` before releasing it.

        opaque: the texture has no transparent texel, so that the pixels under it need not be read.
        """
        self._textures[texture.glo] = texture
        self._opaque.discard(texture.glo)  # GL reuses the name of a released texture
        if opaque:
            self._opaque.add(texture.glo)
        return imgui.ImTextureRef(texture.glo)

    def remove(self, texture: moderngl.Texture) -> None:
        self._textures.pop(texture.glo, None)
        self._opaque.discard(texture.glo)

    def render(self, data: imgui.ImDrawData, target: moderngl.Framebuffer) -> None:
        """Draw over the content of `target`, in its viewport."""
        for texture in data.textures:
            self._update(texture)
        width, height = data.display_size
        if width <= 0 or height <= 0:
            return
        target.use()
        self.context.blend_func = BLEND  # pyright: ignore[reportAttributeAccessIssue]  write-only in moderngl's stubs
        x, y = data.display_pos
        self._program["place"] = (2 / width, -2 / height, -1 - 2 * x / width, 1 + 2 * y / height)
        for commands in data.cmd_lists:
            self._upload(commands)
            for command in commands.cmd_buffer:
                self._draw(command, (x, y), int(height))
        self.context.scissor = None

    def _upload(self, commands: imgui.ImDrawList) -> None:
        vertices, indices = commands.vtx_buffer, commands.idx_buffer
        vertex_bytes, index_bytes = vertices.size() * imgui.VERTEX_SIZE, indices.size() * imgui.INDEX_SIZE
        grown = False
        for buffer, needed in ((self._vertices, vertex_bytes), (self._indices, index_bytes)):
            if buffer.size < needed:
                buffer.orphan(2 * needed)
                grown = True
        if grown:
            self._arrays.release()
            self._arrays = self._make_arrays()
        for buffer, data, size in (
            (self._vertices, vertices, vertex_bytes),
            (self._indices, indices, index_bytes),
        ):
            if size:
                buffer.orphan()  # the driver may still read the old content
                buffer.write((ctypes.c_ubyte * size).from_address(data.data_address()))

    def _draw(self, command: imgui.ImDrawCmd, origin: tuple[float, float], height: int) -> None:
        left, top, right, bottom = command.clip_rect
        x, y = int(left - origin[0]), int(top - origin[1])
        x2, y2 = int(right - origin[0]), int(bottom - origin[1])
        if x2 <= x or y2 <= y or not command.elem_count:
            return
        self.context.scissor = (x, height - y2, x2 - x, y2 - y)
        name = command.tex_ref.get_tex_id()
        self._textures[name].use()
        self.context.enable_only(moderngl.NOTHING if name in self._opaque else moderngl.BLEND)
        self._arrays.render(moderngl.TRIANGLES, vertices=command.elem_count, first=command.idx_offset)

    def _update(self, texture: imgui.ImTextureData) -> None:
        status = imgui.ImTextureStatus
        if texture.status == status.want_create:
            mine = self.context.texture((texture.width, texture.height), 4, _pixels(texture).tobytes())
            mine.repeat_x = mine.repeat_y = False
            texture.set_tex_id(self.add(mine).get_tex_id())
            texture.status = status.ok
        elif texture.status == status.want_updates:
            mine, pixels = self._textures[texture.tex_id], _pixels(texture)
            for r in texture.updates:
                part = pixels[r.y : r.y + r.h, r.x : r.x + r.w]
                mine.write(part.tobytes(), viewport=(r.x, r.y, r.w, r.h))
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


def _pixels(texture: imgui.ImTextureData) -> np.ndarray:
    return texture.get_pixels_array().reshape(texture.height, texture.width, texture.bytes_per_pixel)
