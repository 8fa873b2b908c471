"""How a field is sampled, supervised, rendered and opened up: one file a method."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from copy import deepcopy
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, Protocol, Self, runtime_checkable

from nerf_core.common.errors import UserError
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


class Config(Protocol):
    """A method's constants: a frozen dataclass whose fields `nerf_core.common.configs` describes.

    total_steps: length of the training schedule. train_images: how many training photos are used, evenly spread;
    0: all of them.
    """

    @property
    def total_steps(self) -> int: ...

    @property
    def train_images(self) -> int: ...

    def to_json(self) -> dict[str, Any]:
        """JSON values by name: what a checkpoint stores and `Method.restore` reads."""
        ...


class Renderable(Protocol):
    """A model that draws pictures.

    coarse: what draws the cheaper picture, for menus; empty if there is none.
    alone: whether a ray's colour is the same, within 1e-6, whichever rays are computed with it. A network of low
        precision rounds differently for other shapes; an opened ray is then computed with its neighbours.
    device: where the model runs, whatever was asked for.
    """

    coarse: ClassVar[str]
    alone: ClassVar[bool]
    device: torch.device

    @property
    def tile(self) -> int:
        """How many rays one call of `render` works on at a time. A preview asks for no more, so that it can stop."""
        ...

    @property
    def born(self) -> int:
        """The step at which what draws the picture began to learn."""
        ...

    def render(self, rays: Rays, quality: str = "fine") -> Rendering:
        """Colours, opacities and depths of any number of rays; "coarse" is the cheaper picture if there is one."""
        ...

    def frozen(self) -> Self:
        """A copy for pictures: training this model further does not change it."""
        ...


@runtime_checkable
class Traceable(Renderable, Protocol):
    """A model whose pixels are composited from samples: `nerf_core.probe` can open them."""

    def trace(self, rays: Rays) -> Trace:
        """`render` with everything it composited kept."""
        ...


@runtime_checkable
class Radiant(Protocol):
    """A model that has a colour at a point: the radiance panel and the view-dependence mode show it."""

    def radiance(self, points: Tensor, directions: Tensor) -> Tensor:
        """Colours (P, K, 3) that world points (P, 3) emit against the ray directions (K, 3), camera to point."""
        ...


@runtime_checkable
class Dense(Protocol):
    """A model that has a density at a point: normals come from its gradient."""

    def density(self, points: Tensor) -> Tensor:
        """σ (P,) at world points (P, 3): that of `Samples.sigma` where space is not bent, else per unit of the box."""
        ...


@runtime_checkable
class Explainable(Protocol):
    """A model that shows its own stages of a pixel."""

    def explain(self, rays: Rays) -> tuple[Stage, ...]:
        """What happens to one ray between its beginning and its colour, with its own values."""
        ...


class Trainable(Protocol):
    """A model that learns from photos, one optimiser step at a time."""

    config: Any  # a Config of the method's own

    @property
    def stage(self) -> str:
        """What the user should know about the progress of training; empty: nothing."""
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
        """The pixels that training step `step` asks for; `train` is given pixels that were drawn like that."""
        ...

    def train(
        self, rays: Rays, truth: Tensor, step: int, steps: int | None, yield_callback: Callable[[], None]
    ) -> float:
        """One optimiser step on R rays and their colours (R, 3); returns the mean squared error of the final colour.

        `yield_callback` is called between pieces of at most some 10 ms on a CPU, so that a preview can be served.
        What it raises abandons the step; the trainer then restores `generators` and calls what `undo` returned.
        """
        ...

    def halve(self) -> bool:
        """Use half the memory in `train` from now on, at the price of speed; False if that is not possible."""
        ...

    def state(self) -> dict[str, Tensor]:
        """Weights, optimiser and random state, by name: what a checkpoint stores."""
        ...

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Continue from `state`. Raises KeyError, RuntimeError or ValueError if it does not fit."""
        ...

    def parameters(self) -> list[Tensor]:
        """The tensors that training changes."""
        ...


class Method(Renderable, Trainable, Protocol):
    """A model of one scene with its optimiser; owned by one thread.

    summary: the sentence that menus show. constants: the dataclass of its `Config`, whose fields are declared with
    `nerf_core.common.configs.constant`. presets: names of sets of constants besides "auto".

    `Traceable`, `Radiant`, `Dense` and `Explainable` are what a method may be besides. Where it is not, panels and
    probes say so (`lacking`).
    """

    summary: ClassVar[str]
    constants: ClassVar[type[Any]]
    presets: ClassVar[tuple[str, ...]]

    @staticmethod
    def configure(scene: Scene, preset: str, changes: Mapping[str, str], device: torch.device) -> Config:
        """The configuration of `preset` with `changes` by name. Raises UserError."""
        ...

    @staticmethod
    def restore(config: Mapping[str, Any]) -> Config:
        """The configuration that a checkpoint stores as a JSON object. Raises UserError."""
        ...

    def __init__(self, scene: Scene, config: Any, device: torch.device, seed: int) -> None: ...


class Defaults:
    """What most methods answer: no coarse picture, nothing to tell, nothing to undo. A method may inherit from it."""

    coarse: ClassVar[str] = ""
    alone: ClassVar[bool] = True
    stage, born = "", 0
    presets: ClassVar[tuple[str, ...]] = ()
    generators: tuple[torch.Generator, ...] = ()

    def undo(self, step: int) -> Callable[[], None]:
        return lambda: None

    def halve(self) -> bool:
        return False

    def frozen(self) -> Self:
        return deepcopy(self)


METHODS: Registry[type[Method]] = Registry(
    "method", "nerf_core.methods", leaf="method", entry_points="nerf_viewer.methods"
)

ABSENT = {
    "trace": "keeps no samples along a ray",
    "radiance": "has no radiance at a point",
    "explain": "does not explain its steps",
}


def lacking(method: str, ability: str) -> str:
    """A sentence if the method of this name lacks `ability` (a key of ABSENT); empty if it has it or is unknown."""
    if not method or method not in METHODS.names() or hasattr(METHODS.get(method), ability):
        return ""
    return f"method {method} {ABSENT[ability]}"


def traced(method: Method, rays: Rays) -> Trace:
    """`method.trace(rays)`. Raises UserError if the method keeps no samples."""
    if not isinstance(method, Traceable):
        raise UserError(f"{lacking(METHODS.name_of(type(method)), 'trace')}: its pixels cannot be opened")
    return method.trace(rays)
