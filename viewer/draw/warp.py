"""Move every pixel of a picture to its place in another camera, by its depth, and tell how far to trust it there."""

from __future__ import annotations

import moderngl
import numpy as np

from nerf_core.geometry.camera import Camera
from nerf_core.live.messages import Preview

from .warp_mesh import SOFT, sheet, warp_mesh

VERTEX = """
#version 330
uniform mat4 motion;    // from the old camera's axes to the new one's
uniform vec3 eye;       // the new camera, in the old one's axes
uniform vec4 lens_old;  // fx, fy, cx, cy
uniform vec4 lens_new;
uniform vec2 size_new;
uniform float near;
uniform bool behind;    // everything else
in vec3 point;    // pixel of the old image, z-depth there
in vec2 colored;  // pixel that lends its colour
in float spread;  // pixels of the old image that have one colour
out vec3 source;
out vec2 place;
out float turn;
out float width;
void main() {
    vec2 ray = (point.xy - lens_old.zw) / lens_old.xy;
    vec3 seen = vec3(ray.x * point.z, -ray.y * point.z, -point.z);
    vec4 local = motion * vec4(seen, 1.0);
    float w = -local.z;
    vec2 pixel = vec2(local.x, -local.y) * lens_new.xy + lens_new.zw * w;
    gl_Position = vec4(2.0 * pixel / size_new - w, behind ? 0.99999 * w : w - 2.0 * near, w);
    source = vec3(colored * point.z, point.z);  // homogeneous: linear over a plane in space, as varyings are
    place = point.xy * point.z;
    turn = atan(length(cross(seen, seen - eye)), dot(seen, seen - eye));
    width = spread;
}
"""

FRAGMENT = """
#version 330
uniform sampler2D image;  // alpha: whether something was hit
uniform float stride;
uniform bool cut;       // draw only what was hit, or only what was not
uniform bool hits;
uniform float slip;     // pixels by which a point is out of place for each radian that its ray turned
uniform float aged;     // factor on the blur, because the model has learnt since
uniform float rival;    // blur of the picture below
in vec3 source;
in vec2 place;
in float turn;
in float width;
out vec4 fragment;

void main() {
    vec2 at = place / source.z;
    float magnified = 1.0 / max(min(length(dFdx(at)), length(dFdy(at))), 1e-6);
    vec2 size = vec2(textureSize(image, 0));
    vec2 texel = clamp((source.xy / source.z - 0.5) / stride + 0.5, vec2(0.5), size - 0.5);
    vec4 color = texture(image, texel / size);
    if (cut && (color.a > 0.5) != hits) discard;
    float blur = aged * (max(width * magnified, 1.0) + slip * turn);
    float trust = clamp(log2(rival / blur), 0.0, 1.0);
    fragment = vec4(color.rgb, trust);
}
"""

SLIP = 0.05  # of the focal length, for each radian: see `blur`
FORGETTING = 2.4  # power of the steps: see `blur`
SAMPLED = 16  # rows and columns of the pixels at which a picture's blur is estimated
NO_RIVAL = 1e9  # blur of nothing


class Canvas:
    """A texture with depth that a warp is drawn into."""

    def __init__(self, context: moderngl.Context, size: tuple[int, int]) -> None:
        self.texture = context.texture(size, 4)
        self.texture.repeat_x = self.texture.repeat_y = False
        self._depth = context.depth_renderbuffer(size)
        self.target = context.framebuffer([self.texture], self._depth)

    def release(self) -> None:
        for item in (self.target, self._depth, self.texture):
            item.release()


class Layer:
    """A picture in GL, with the mesh that warps need. The mesh is built when the first warp needs it.

    preview: the picture.
    arrived: when it came, in seconds.
    image: its colours.
    """

    def __init__(self, context: moderngl.Context, preview: Preview, arrived: float) -> None:
        self.preview, self.arrived = preview, arrived
        height, width = preview.depth.shape
        self.image = context.texture((width, height), 4, np.ascontiguousarray(preview.rgba))
        self.image.repeat_x = self.image.repeat_y = False
        self._context = context
        self._source: moderngl.Texture | None = None  # the image, with alpha 0 where nothing was hit
        self._meshes: list[tuple[moderngl.VertexArray, moderngl.Buffer, moderngl.Buffer]] = []
        hit = preview.depth[np.isfinite(preview.depth)]
        self._middle = float(np.median(hit)) if len(hit) else None
        self._sampled: tuple[np.ndarray, np.ndarray] | None = None  # some of the picture's points, and their depths

    def blur(self, camera: Camera, step: int) -> np.ndarray:
        """Estimate how blurred a warp of the picture is at pixels of it that `camera` sees.

        The blur of a picture that was computed for the camera is its stride: the size of the smallest thing that it
        shows. A warp adds to it. It magnifies: the texels of the old picture cover more pixels. It slips: depth is not
        exact, and colours change with the direction. Both errors grow with the angle between the ray of the old camera
        and that of the new one, so each radian counts as SLIP focal lengths. For a model of the demo scene, a warp by
        1, 5, 14 and 29 degrees has the mean error of a new picture of stride 2, 4, 8 and 16. And it ages: if the model
        has done 4/3 of the steps since, its blur counts twice.

        Args:
            camera: the camera that is wanted.
            step: the newest known training step.

        Returns:
            (N,) pixels of `camera`; empty if it sees nothing of the picture.
        """
        old, stride = self.preview.camera, float(self.preview.stride)
        if same_view(old, camera):
            return np.array([stride * self.aged(step)])
        if self._sampled is None:
            self._sampled = _some_points(self.preview)
        points, z = self._sampled
        rays = points - camera.c2w[:, 3]
        x, y, ahead = (rays @ (camera.c2w[:, :3] * [1, -1, -1])).T
        framed = (np.abs(x * camera.fx) < camera.cx * ahead) & (np.abs(y * camera.fy) < camera.cy * ahead)
        rays, before = rays[framed], points[framed] - old.c2w[:, 3]
        cosine = (rays * before).sum(-1) / np.sqrt((rays * rays).sum(-1) * (before * before).sum(-1))
        magnified = camera.fy / ahead[framed] * z[framed] / old.fy
        turn = np.arccos(np.clip(cosine, -1, 1))
        return self.aged(step) * (np.maximum(stride * magnified, 1) + SLIP * camera.fy * turn)

    def aged(self, step: int) -> float:
        """Return the factor on the blur of a picture whose model has learnt until `step` since."""
        learnt = self.preview.step - self.preview.born
        if step <= self.preview.step:
            return 1.0
        return ((step - self.preview.born) / learnt) ** FORGETTING if learnt > 0 else NO_RIVAL

    def warp(
        self, program: moderngl.Program, target: moderngl.Framebuffer, camera: Camera, step: int, rival: float
    ) -> None:
        """Draw the picture as `camera` would see it, over what is in `target`.

        Alpha says how far to trust a pixel: 0 where its blur is at least `rival`, 1 where it is at most half of it.

        Args:
            program: VERTEX and FRAGMENT.
            target: of the camera's size. What was not hit is drawn as well if there is a rival.
            camera: a pinhole camera.
            step: the newest known training step.
            rival: the blur of the picture that is drawn below this one, in pixels; NO_RIVAL: there is none.
        """
        if self._middle is None:
            return  # nothing was hit anywhere
        if not self._meshes:
            self._build(program)
        assert self._source is not None
        old = self.preview.camera
        motion = _inverse(_square(camera.c2w)) @ _square(old.c2w)
        program["motion"] = tuple(motion.T.ravel())  # GL stores matrices by columns
        program["eye"] = tuple(old.c2w[:, :3].T @ (camera.c2w[:, 3] - old.c2w[:, 3]))
        program["lens_old"] = (old.fx, old.fy, old.cx, old.cy)
        program["lens_new"] = (camera.fx, camera.fy, camera.cx, camera.cy)
        program["size_new"] = (camera.width, camera.height)
        program["near"] = 1e-3 * self._middle  # points nearer than that count as behind the eye
        program["stride"] = float(self.preview.stride)
        program["cut"] = self.preview.stride < SOFT
        program["slip"] = SLIP * camera.fy
        program["aged"] = self.aged(step)
        program["rival"] = rival
        self._source.use()
        self._context.enable_only(moderngl.DEPTH_TEST)
        surface, *rest = self._meshes
        program["hits"], program["behind"] = True, False
        surface[0].render(moderngl.TRIANGLES)
        if rest and rival < NO_RIVAL:
            program["hits"], program["behind"] = False, True
            rest[0][0].render(moderngl.TRIANGLES)

    def _build(self, program: moderngl.Program) -> None:
        assert self._middle is not None
        height, width = self.preview.depth.shape
        hit = self.preview.depth > 0
        rgba = self.preview.rgba.copy()
        rgba[..., 3] = 255 * hit
        self._source = self._context.texture((width, height), 4, rgba)
        self._source.repeat_x = self._source.repeat_y = False
        meshes = [warp_mesh(self.preview)]
        if not hit.all() and self.preview.stride < SOFT:
            meshes.append(sheet(self.preview, self._middle))
        for points, triangles in meshes:
            vertices = self._context.buffer(np.ascontiguousarray(points, np.float32))
            indices = self._context.buffer(np.ascontiguousarray(triangles, np.int32))
            layout = [(vertices, "3f 2f 1f", "point", "colored", "spread")]
            arrays = self._context.vertex_array(program, layout, index_buffer=indices)
            self._meshes.append((arrays, vertices, indices))

    def release(self) -> None:
        for item in (self.image, *filter(None, [self._source]), *(part for mesh in self._meshes for part in mesh)):
            item.release()
        self._meshes.clear()
        self._source = None


def same_view(a: Camera, b: Camera) -> bool:
    """Return whether two cameras have exactly the same rays."""
    return a.intrinsics() == b.intrinsics() and np.array_equal(a.c2w, b.c2w)


def _some_points(preview: Preview) -> tuple[np.ndarray, np.ndarray]:
    """Return points (N, 3) of a picture in the world, from all over it, and their z-depths (N,)."""
    camera = preview.camera
    rows, columns = (np.unique(np.linspace(0, n - 1, SAMPLED).astype(int)) for n in preview.depth.shape)
    z = preview.depth[np.ix_(rows, columns)].astype(np.float64).ravel()
    columns, rows = (grid.ravel() for grid in np.meshgrid(columns, rows))
    x = (columns * preview.stride + 0.5 - camera.cx) / camera.fx
    y = (rows * preview.stride + 0.5 - camera.cy) / camera.fy
    hit = np.isfinite(z)
    local = (np.stack([x, -y, -np.ones_like(x)], -1) * z[:, None])[hit]
    return camera.c2w[:, 3] + local @ camera.c2w[:, :3].T, z[hit]


def _square(c2w: np.ndarray) -> np.ndarray:
    return np.vstack([c2w, [0.0, 0.0, 0.0, 1.0]])


def _inverse(pose: np.ndarray) -> np.ndarray:
    """The inverse of a rotation and a shift."""
    inverse = np.eye(4)
    inverse[:3, :3] = pose[:3, :3].T
    inverse[:3, 3] = -pose[:3, :3].T @ pose[:3, 3]
    return inverse
