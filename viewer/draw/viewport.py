"""The picture in the viewport: the newest preview, or a warp of it while the camera is ahead of the preview."""

from __future__ import annotations

from typing import NamedTuple

import moderngl
import numpy as np

from nerf_core.geometry.camera import Camera
from nerf_core.live.messages import Preview

WARP_VERTEX = """
#version 330
uniform mat4 motion;    // from the old camera's axes to the new one's
uniform vec4 lens_old;  // fx, fy, cx, cy
uniform vec4 lens_new;
uniform vec2 size_new;
uniform float near;
in vec3 point;   // pixel of the old image, z-depth there
in vec2 colored;  // pixel that lends its colour
out vec3 source;
void main() {
    vec2 ray = (point.xy - lens_old.zw) / lens_old.xy;
    vec4 local = motion * vec4(ray.x * point.z, -ray.y * point.z, -point.z, 1.0);
    float w = -local.z;
    vec2 pixel = vec2(local.x, -local.y) * lens_new.xy + lens_new.zw * w;
    gl_Position = vec4(2.0 * pixel / size_new - w, w - 2.0 * near, w);
    source = vec3(colored * point.z, point.z);  // homogeneous: linear over a plane in space, as varyings are
}
"""

WARP_FRAGMENT = """
#version 330
uniform sampler2D image;
uniform sampler2D depth;
uniform float stride;
in vec3 source;
out vec4 fragment;

void main() {
    vec2 size = vec2(textureSize(image, 0));
    vec2 texel = clamp((source.xy / source.z - 0.5) / stride + 0.5, vec2(0.5), size - 0.5);
    if (texelFetch(depth, ivec2(texel), 0).r <= 0.0) discard;  // nothing was hit: the background is there already
    vec3 color = texture(image, texel / size).rgb;
    float grey = dot(color, vec3(0.2126, 0.7152, 0.0722));
    fragment = vec4(mix(color, vec3(grey), PALER), 1.0);
}
"""

PALER = 0.35  # a warped picture loses this share of its colour, because it is not the model's current picture
WARP_FRAGMENT = WARP_FRAGMENT.replace("PALER", str(PALER))

JUMP = (
    1.1  # ratio of far to near depth in a cell: a larger one is an edge with something behind it, not a slanted surface
)
MESH_CELLS = (
    160  # along the longer side: fine enough for silhouettes, and 30,000 triangles are fast even in software GL
)


class Shown(NamedTuple):
    """A texture, row 0 at the top, and the texture coordinates of the viewport's corners."""

    texture: moderngl.Texture
    first: tuple[float, float]
    last: tuple[float, float]


class ViewportPicture:
    """The picture of the viewport: the preview itself, or a warp of it in a texture of the camera's size.

    A warp is drawn again only if something changed.
    """

    def __init__(self, context: moderngl.Context) -> None:
        self._context = context
        self._warp = context.program(vertex_shader=WARP_VERTEX, fragment_shader=WARP_FRAGMENT)
        self._warp["image"], self._warp["depth"] = 0, 1
        self._target: moderngl.Framebuffer | None = None
        self._warped: moderngl.Texture | None = None
        self._shown: Shown | None = None
        self._image: moderngl.Texture | None = None
        self._depth: moderngl.Texture | None = None
        self._mesh: tuple[moderngl.VertexArray, moderngl.Buffer, moderngl.Buffer] | None = None
        self._near = 1.0
        self._preview: Preview | None = None
        self._drawn: Camera | None = None
        self._background: tuple[float, float, float] | None = None

    @property
    def shown(self) -> Shown:
        """The result of the last `draw`."""
        assert self._shown is not None, "draw first"
        return self._shown

    def draw(self, preview: Preview, camera: Camera, background: tuple[float, float, float]) -> bool:
        """Bring `shown` up to date for a pinhole `camera`; whether it is a warp of an older view."""
        stale = not same_view(preview.camera, camera)
        unchanged = self._drawn is not None and preview is self._preview and same_view(self._drawn, camera)
        if unchanged and background == self._background:
            return stale
        if stale:
            self.draw_warped(preview, camera, background)
        else:
            self._show(preview)
        self._drawn, self._background = camera, background
        return stale

    def _upload(self, preview: Preview) -> None:
        height, width = preview.depth.shape
        image = self._image
        if image is None or image.size != (width, height):
            self._release(image)
            image = self._context.texture((width, height), 4)
            image.repeat_x = image.repeat_y = False
        image.write(np.ascontiguousarray(preview.rgba))
        self._image = image
        self._release(self._depth, *(self._mesh or ()))
        self._depth = self._mesh = None  # built when a warp needs them
        self._preview = preview

    def _resize(self, width: int, height: int) -> moderngl.Texture:
        """The texture that warps are drawn into."""
        if self._warped is None or self._warped.size != (width, height):
            self._release_target()
            self._warped = self._context.texture((width, height), 4)
            self._warped.filter = (moderngl.NEAREST, moderngl.NEAREST)  # it is shown pixel for pixel
            depth = self._context.depth_renderbuffer((width, height))
            self._target = self._context.framebuffer([self._warped], depth)
        return self._warped

    def _show(self, preview: Preview) -> None:
        """Show the preview itself. Texel (i, j) was computed at the pixel centre (i · stride + ½, j · stride + ½)."""
        if preview is not self._preview:
            self._upload(preview)
        assert self._image is not None
        sharp = preview.stride == 1
        self._image.filter = (moderngl.NEAREST, moderngl.NEAREST) if sharp else (moderngl.LINEAR, moderngl.LINEAR)
        camera, stride = preview.camera, preview.stride
        first, last = (
            tuple(((end - 0.5) / stride + 0.5) / size for end, size in zip(ends, self._image.size, strict=True))
            for ends in ((0, 0), (camera.width, camera.height))
        )
        self._shown = Shown(self._image, first, last)

    def draw_warped(self, preview: Preview, camera: Camera, background: tuple[float, float, float]) -> None:
        """Move every pixel of `preview` to its place in `camera`, by its depth."""
        if preview is not self._preview:
            self._upload(preview)
        texture = self._resize(camera.width, camera.height)
        assert self._target is not None
        assert self._image is not None
        self._shown = Shown(texture, (0.0, 0.0), (1.0, 1.0))
        self._target.use()
        self._target.clear(*_paler(background), 1.0, depth=1.0)
        if self._mesh is None or self._depth is None:
            self._build_mesh(preview)
        if self._mesh is None or self._depth is None:
            return  # nothing was hit anywhere
        old = preview.camera
        motion = _inverse(_square(camera.c2w)) @ _square(old.c2w)
        self._warp["motion"] = tuple(motion.T.ravel())  # GL stores matrices by columns
        self._warp["lens_old"] = (old.fx, old.fy, old.cx, old.cy)
        self._warp["lens_new"] = (camera.fx, camera.fy, camera.cx, camera.cy)
        self._warp["size_new"] = (camera.width, camera.height)
        self._warp["near"] = self._near
        self._warp["stride"] = float(preview.stride)
        self._context.enable_only(moderngl.DEPTH_TEST)
        self._image.filter = (moderngl.LINEAR, moderngl.LINEAR)
        self._image.use(0)
        self._depth.use(1)
        self._mesh[0].render(moderngl.TRIANGLES)

    def _build_mesh(self, preview: Preview) -> None:
        points, triangles = warp_mesh(preview)
        if not len(triangles):
            return
        height, width = preview.depth.shape
        present = np.nan_to_num(preview.depth, nan=0.0)
        self._depth = self._context.texture((width, height), 1, present.astype("f4").tobytes(), dtype="f4")
        vertices = self._context.buffer(points.astype("f4").tobytes())
        indices = self._context.buffer(triangles.astype("i4").tobytes())
        layout = [(vertices, "3f 2f", "point", "colored")]
        arrays = self._context.vertex_array(self._warp, layout, index_buffer=indices)
        self._mesh = (arrays, vertices, indices)
        self._near = 1e-3 * float(
            np.nanmedian(preview.depth)
        )  # points nearer than a thousandth of the scene count as behind the eye

    @staticmethod
    def _release(*objects: moderngl.Texture | moderngl.Buffer | moderngl.VertexArray | None) -> None:
        for item in objects:
            if item is not None:
                item.release()

    def _release_target(self) -> None:
        if self._target is not None:
            self._release(self._warped)
            if self._target.depth_attachment is not None:
                self._target.depth_attachment.release()
            self._target.release()
            self._target = self._warped = None

    def release(self) -> None:
        self._release_target()
        self._release(self._image, self._depth, *(self._mesh or ()))
        self._warp.release()


def same_view(a: Camera, b: Camera) -> bool:
    """Return whether two cameras have exactly the same rays."""
    return a.intrinsics() == b.intrinsics() and np.array_equal(a.c2w, b.c2w)


def warp_mesh(preview: Preview) -> tuple[np.ndarray, np.ndarray]:
    """Return a mesh over the picture: points (P, 5) = pixel x, y, z-depth, x, y of their colour; triangles (T, 3).

    A point beside an edge takes the mean depth of the hits around it, so that triangles reach past the edge; the
    fragment shader then cuts them at the exact texel. A triangle over a jump in depth covers the area that the motion
    uncovers. It has the colour of its farthest corner, because the uncovered surface lies behind.
    """
    height, width = preview.depth.shape
    step = max(1, -(-max(width, height) // MESH_CELLS))
    rows, columns = _lattice(height, step), _lattice(width, step)
    depth = preview.depth[np.ix_(rows, columns)].astype(np.float64)
    missing = np.isnan(depth)
    if missing.any():
        near_hits = _window_mean(preview.depth, step)[np.ix_(rows, columns)]
        depth = np.where(missing, near_hits, depth)
    x, y = columns * preview.stride + 0.5, rows * preview.stride + 0.5
    x[0], y[0], x[-1], y[-1] = (
        0,
        0,
        preview.camera.width,
        preview.camera.height,
    )  # the borders, because texel centres end before them
    columns_x, rows_y = np.meshgrid(x, y)
    points = np.stack([columns_x, rows_y, depth, columns_x, rows_y], -1).reshape(-1, 5)
    index = np.arange(len(rows) * len(columns)).reshape(len(rows), len(columns))
    a, b, c, d = index[:-1, :-1].ravel(), index[:-1, 1:].ravel(), index[1:, :-1].ravel(), index[1:, 1:].ravel()
    triangles = np.concatenate([np.stack([a, b, c], -1), np.stack([b, d, c], -1)])
    triangles = triangles[np.isfinite(points[triangles, 2]).all(-1)]
    corners = points[triangles, 2]
    jumps = corners.max(-1) > JUMP * corners.min(-1)
    torn = points[triangles[jumps]]  # (J, 3, 5)
    farthest = corners[jumps].argmax(-1)
    torn[..., 3:] = torn[np.arange(len(torn)), farthest, None, 3:]
    own = len(points) + np.arange(3 * len(torn)).reshape(-1, 3)
    return np.concatenate([points, torn.reshape(-1, 5)]), np.concatenate([triangles[~jumps], own])


def _lattice(count: int, step: int) -> np.ndarray:
    """0, step, 2·step … and the last index. Even a single texel gives two of them, so that there is a cell."""
    return np.append(np.arange(0, max(count - 1, 1), step), count - 1)


def _window_mean(depth: np.ndarray, reach: int) -> np.ndarray:
    """The mean of the finite values within `reach` texels, NaN where there are none: (h, w) → (h, w)."""
    hit = np.isfinite(depth)
    sums = [np.where(hit, depth, 0).astype(np.float64), hit.astype(np.float64)]
    for axis in (0, 1):
        pad = [(reach + 1, reach) if a == axis else (0, 0) for a in (0, 1)]
        length = depth.shape[axis]
        for i, values in enumerate(sums):
            total = np.cumsum(np.pad(values, pad), axis=axis)
            high, low = np.arange(length) + 2 * reach + 1, np.arange(length)
            sums[i] = total.take(high, axis) - total.take(low, axis)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(sums[1] > 0.5, sums[0] / sums[1], np.nan)  # 0.5: these are counts, summed as floats


def _paler(color: tuple[float, float, float]) -> tuple[float, float, float]:
    """The background with the same loss of colour as in the warp's shader."""
    grey = 0.2126 * color[0] + 0.7152 * color[1] + 0.0722 * color[2]
    r, g, b = ((1 - PALER) * v + PALER * grey for v in color)
    return r, g, b


def _square(c2w: np.ndarray) -> np.ndarray:
    return np.vstack([c2w, [0.0, 0.0, 0.0, 1.0]])


def _inverse(pose: np.ndarray) -> np.ndarray:
    """The inverse of a rotation and a shift."""
    inverse = np.eye(4)
    inverse[:3, :3] = pose[:3, :3].T
    inverse[:3, 3] = -pose[:3, :3].T @ pose[:3, 3]
    return inverse
