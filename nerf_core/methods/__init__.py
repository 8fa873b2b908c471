"""How a field is sampled, supervised, rendered and opened up: one file a method."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, Protocol, Self

from nerf_core.common.registry import Registry
from nerf_core.geometry.scene import Scene
from nerf_core.methods.stages import Stage

if TYPE_CHECKING:
    import torch
    from torch import Tensor

    from nerf_core.geometry.rays import Rays, Rendering, Trace


class Draw(NamedTuple):
    """What a step asks for: so many rays, all of one photo or of any, from the middle `crop` of it, of photos that are
    averaged over `shrink` × `shrink` pixels."""

    rays: int
    one_image: bool = False
    crop: float = 1.0
    shrink: int = 1


class Method(Protocol):
    """A model of one scene with its optimiser; owned by one thread.

    `summary` is the sentence that menus show, `coarse` what draws the cheaper picture (empty: there is none).
    `config`: as `configure` or `restore` made it. `device`: where it runs, whatever was asked for. `tile` is how many
    rays one call of `render` works on at a time: a preview asks for no more, so that it can be dropped between two.
    `alone`: whether a ray comes out the same, within 1e-6, whichever rays are computed with it; a network of lesser
    precision rounds otherwise for other shapes, and there an opened ray is computed with its neighbours.
    """

    summary: ClassVar[str]
    coarse: ClassVar[str]
    alone: ClassVar[bool]
    config: Any
    device: torch.device

    @property
    def tile(self) -> int: ...

    @property
    def stage(self) -> str:
        """What the user should know of where training stands; mostly nothing."""
        ...

    @property
    def born(self) -> int:
        """The step at which what draws the picture began to learn: mostly 0."""
        ...

    @staticmethod
    def configure(scene: Scene, preset: str, changes: Mapping[str, str], device: torch.device) -> Any:
        """The configuration (a frozen dataclass) of `preset` with `changes` by name. Raises UserError."""
        ...

    @staticmethod
    def restore(config: Mapping[str, Any]) -> Any:
        """The configuration that a checkpoint stores as a JSON object. Raises UserError."""
        ...

    def __init__(self, scene: Scene, config: Any, device: torch.device, seed: int) -> None: ...

    def train(self, rays: Rays, truth: Tensor, step: int, steps: int | None, pump: Callable[[], None]) -> float:
        """One optimiser step on R rays and their colours (R, 3); returns the mean squared error of the final colour.

        `pump` is called between pieces of at most some 10 ms on a CPU, so that a preview can be served. What it
        raises abandons the step; the trainer then restores `generators` and calls what `undo` returned.
        """
        ...

    @property
    def generators(self) -> tuple[torch.Generator, ...]:
        """The generators that `train` draws from."""
        ...

    def undo(self, step: int) -> Callable[[], None]:
        """A function that takes back what training step `step` has changed when it is abandoned, but random numbers.

        Called before the step begins.
        """
        ...

    def draw(self, step: int) -> Draw:
        """Which pixels training step `step` wants; those it is given to `train` are drawn like that."""
        ...

    def halve(self) -> bool:
        """Use half the memory in `train` from now on, at the price of speed; False where that cannot be."""
        ...

    def render(self, rays: Rays, quality: str = "fine") -> Rendering:
        """Any number of rays, in padded tiles; "coarse" is the cheaper picture where there is one."""
        ...

    def trace(self, rays: Rays) -> Trace:
        """`render` with everything it composited kept."""
        ...

    def radiance(self, points: Tensor, directions: Tensor) -> Tensor:
        """Colours (P, K, 3) that world points (P, 3) emit against the ray directions (K, 3), camera to point."""
        ...

    def density(self, points: Tensor) -> Tensor:
        """σ (P,) at world points (P, 3): that of `Samples.sigma` where space is not bent, else per unit of the box."""
        ...

    def explain(self, rays: Rays) -> tuple[Stage, ...]:
        """What happens to one ray between its beginning and its colour, with its own values."""
        ...

    def frozen(self) -> Self:
        """The model as it is now, for pictures alone: training this one on does not change it."""
        ...

    def state(self) -> dict[str, Tensor]:
        """Weights, optimiser and random state, by name: what a checkpoint stores."""
        ...

    def load_state(self, state: Mapping[str, Tensor]) -> None: ...

    def parameters(self) -> list[Tensor]: ...


METHODS: Registry[type[Method]] = Registry(
    "method", "nerf_core.methods", leaf="method", entry_points="nerf_viewer.methods"
)
