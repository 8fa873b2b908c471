"""Methods: each one defines a field, how rays sample it, how it learns and how it explains itself. One file each."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from copy import deepcopy
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, Protocol, Self, runtime_checkable

from nerf_core.common.errors import UserError
from nerf_core.common.language import marked, phrase
from nerf_core.common.registry import Registry
from nerf_core.geometry.scene import Scene
from nerf_core.methods.group import ALONE, Group
from nerf_core.methods.stages import Stage

if TYPE_CHECKING:
    import torch
    from torch import Tensor

    from nerf_core.geometry.camera import Camera
    from nerf_core.geometry.rays import Rays, Rendering, Trace


class Draw(NamedTuple):
    """The pixels that a training step asks for.

    rays: their number.
    one_image: take all of them from one photo.
    crop: take them from the middle of photos; the share of each side.
    shrink: take them from photos averaged over shrink × shrink pixels.
    """

    rays: int
    one_image: bool = False
    crop: float = 1.0
    shrink: int = 1


class Config(Protocol):
    """A method's constants: a frozen dataclass whose fields `nerf_core.common.configs` describes.

    total_steps: the length of the training schedule; 0: the method has nothing to train.
    train_images: how many training photos are used, evenly spread; 0: all.
    """

    @property
    def total_steps(self) -> int: ...

    @property
    def train_images(self) -> int: ...

    def to_json(self) -> dict[str, Any]:
        """Return JSON values by name. A checkpoint stores them and `Method.restore` reads them."""
        ...


class Renderable(Protocol):
    """A model that draws pictures.

    coarse: the name of the cheaper picture, for menus; empty if there is none.
    alone: whether a ray's colour stays the same, within 1e-6, whichever rays are computed with it. A network in low
        precision rounds differently for other shapes; an opened ray is then computed together with its neighbours.
    device: where the model really runs, whichever device was asked for.
    """

    coarse: ClassVar[str]
    alone: ClassVar[bool]
    device: torch.device

    @property
    def tile(self) -> int:
        """The number of rays that `render` computes at a time. A preview asks for no more, so that it can stop."""
        ...

    @property
    def born(self) -> int:
        """The training step at which the model that draws the picture began to learn."""
        ...

    def render(self, rays: Rays, quality: str = "fine") -> Rendering:
        """Render any number of rays.

        Args:
            rays: R rays.
            quality: "fine", or "coarse" for the cheaper picture if there is one.

        Returns:
            Colours, opacities and depths of the rays.
        """
        ...

    def frozen(self) -> Self:
        """Return a copy for pictures; training this model further does not change the copy."""
        ...


@runtime_checkable
class Traceable(Renderable, Protocol):
    """A model whose pixels are composited from samples: `nerf_core.probe` can open them."""

    def trace(self, rays: Rays) -> Trace:
        """Render rays and keep all the samples that were composited."""
        ...


@runtime_checkable
class Radiant(Protocol):
    """A model that has a colour at a point: the radiance panel and the view-dependence mode show it."""

    def radiance(self, points: Tensor, directions: Tensor) -> Tensor:
        """Return the colours (P, K, 3) of world points (P, 3), seen along K ray directions (K, 3), camera to point."""
        ...


@runtime_checkable
class Dense(Protocol):
    """A model that has a density at a point: normals come from its gradient."""

    def density(self, points: Tensor) -> Tensor:
        """Return the density σ (P,) at world points (P, 3).

        It has the unit of `Samples.sigma`, except in NDC and contracted space, where it is per unit of the box.
        """
        ...


@runtime_checkable
class Explainable(Protocol):
    """A model that shows its own stages of a pixel."""

    def explain(self, rays: Rays) -> tuple[Stage, ...]:
        """Return the stages that turn one ray into its colour, with the ray's own values."""
        ...


@runtime_checkable
class Posed(Protocol):
    """A model whose picture depends on the whole camera, not on each ray alone; see `aimed`."""

    def facing(self, camera: Camera) -> Self:
        """Return the model that draws this camera's rays. It shares its tensors with this one."""
        ...

    def caption(self, camera: Camera) -> str:
        """Return what the picture of this camera shows, in words for the window; empty: nothing worth saying."""
        ...


@runtime_checkable
class Visiting(Protocol):
    """A model without samples that looks at places along a ray. The microscope marks them."""

    def visited(self, rays: Rays) -> Tensor:
        """Return the places (R, V) that R rays look at, as world distances in the order of the visits."""
        ...


class Trainable(Protocol):
    """A model that learns from photos, one optimiser step at a time."""

    config: Any  # a Config of the method's own

    @property
    def stage(self) -> str:
        """A remark about the progress of training for the user; empty if there is none."""
        ...

    @property
    def generators(self) -> tuple[torch.Generator, ...]:
        """The generators that `train` draws from."""
        ...

    def undo(self, step: int) -> Callable[[], None]:
        """Return a function that restores the model if training step `step` is abandoned. Call it before the step.

        A step is abandoned before its weights change; see `train`. The function does not restore random generators; the
        trainer does that.
        """
        ...

    def draw(self, step: int) -> Draw:
        """Return which pixels training step `step` needs. The trainer draws them and passes them to `train`."""
        ...

    def train(
        self, rays: Rays, truth: Tensor, step: int, steps: int | None, yield_callback: Callable[[], None]
    ) -> float:
        """Make one optimiser step.

        Args:
            rays: R rays.
            truth: (R, 3) the photos' colours.
            step: the number of this step.
            steps: the length of the run; None: as the configuration says.
            yield_callback: called between pieces of about 10 ms on a CPU, so that previews can be drawn. If it
                raises, the step is abandoned: the trainer restores `generators` and calls the function of `undo`.

        If device memory runs out, the trainer abandons the step too, calls `halve`, and makes the step again. So
        torch.OutOfMemoryError must not be raised once the weights have changed.

        Returns:
            The mean squared error of the final colour.
        """
        ...

    def halve(self) -> bool:
        """Use half the memory in `train` from now on, which is slower. Returns False if that is not possible."""
        ...

    def rest(self) -> None:
        """Free the memory that only training steps need and the next one can make anew. Called when training pauses."""
        ...

    def state(self) -> dict[str, Tensor]:
        """Return weights, optimiser and random state by name, for a checkpoint."""
        ...

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Continue from `state`. Raises KeyError, RuntimeError or ValueError if it does not fit this model."""
        ...

    def parameters(self) -> list[Tensor]:
        """The tensors that training changes."""
        ...


class Method(Renderable, Trainable, Protocol):
    """A model of one scene with its optimiser. One thread owns it.

    summary: the sentence that menus show.
    constants: the dataclass of its `Config`; its fields are declared with `nerf_core.common.configs.constant`.
    presets: the names of sets of constants besides "auto".

    `Traceable`, `Radiant`, `Dense`, `Explainable`, `Visiting` and `Posed` are optional. Panels and probes say what a
    method lacks; see `lacking`.
    """

    summary: ClassVar[str]
    constants: ClassVar[type[Any]]
    presets: ClassVar[tuple[str, ...]]

    @staticmethod
    def configure(scene: Scene, preset: str, changes: Mapping[str, str], device: torch.device) -> Config:
        """Return the configuration of `preset` for this scene and device, with `changes` by name. Raises UserError."""
        ...

    @staticmethod
    def restore(config: Mapping[str, Any]) -> Config:
        """Rebuild the configuration that a checkpoint stores as a JSON object. Raises UserError."""
        ...

    def __init__(self, scene: Scene, config: Any, device: torch.device, seed: int) -> None:
        """Make a new model of a scene, at training step 0.

        Args:
            scene: the scene.
            config: what `configure` or `restore` returned.
            device: the device that was asked for; `Renderable.device` says which one is used.
            seed: of everything random. The same seed gives the same weights on one CPU.
        """
        ...


@runtime_checkable
class Distributed(Protocol):
    """A method whose training steps several processes can share.

    `draw` then asks for the rays of the whole group. `train` gets those of `group.part` and draws random numbers for
    all. It calls `group.add` on the gradients before the optimiser's step, and on every number that decides a later
    step. It returns the error of the whole batch.

    distributed: True. A model that others inherit from leaves it to each registered method.
    group: the processes; the trainer sets it before the first step.
    """

    distributed: ClassVar[bool]
    group: Group


class Defaults:
    """Defaults that a method may inherit: no coarse picture, no remark on progress, nothing to undo or to free, and one
    process."""

    coarse: ClassVar[str] = ""
    alone: ClassVar[bool] = True
    stage, born = "", 0
    presets: ClassVar[tuple[str, ...]] = ()
    generators: tuple[torch.Generator, ...] = ()
    distributed: ClassVar[bool] = False
    group: Group = ALONE

    def undo(self, step: int) -> Callable[[], None]:
        return lambda: None

    def halve(self) -> bool:
        return False

    def rest(self) -> None:
        pass

    def frozen(self) -> Self:
        return deepcopy(self)


METHODS: Registry[type[Method]] = Registry(
    "method", "nerf_core.methods", leaf="method", entry_points="nerf_viewer.methods"
)

ABSENT = {
    "trace": marked("method {method} keeps no samples along a ray"),
    "radiance": marked("method {method} has no radiance at a point"),
    "explain": marked("method {method} does not explain its steps"),
}


def lacking(method: str, ability: str) -> str:
    """Return a sentence if the method lacks an ability; empty if it has it or is unknown.

    Args:
        method: the method's name.
        ability: a key of ABSENT.
    """
    if not method or method not in METHODS.names() or hasattr(METHODS.get(method), ability):
        return ""
    return phrase(ABSENT[ability], method=method)


def nothing_to_train(method: str) -> str:
    """Return a sentence about a method, given by its name, whose `Config.total_steps` is 0."""
    return phrase("nothing to train: method {method} has no parameters", method=method)


def traced(method: Method, rays: Rays) -> Trace:
    """Call `method.trace(rays)`. Raises UserError if the method keeps no samples."""
    if not isinstance(method, Traceable):
        raise UserError(f"{lacking(METHODS.name_of(type(method)), 'trace')}: it can draw colours alone")
    return method.trace(rays)


def aimed(method: Method, camera: Camera) -> Method:
    """Return the model that draws the rays of a camera: `facing(camera)` of a `Posed` one, else the method itself."""
    return method.facing(camera) if isinstance(method, Posed) else method


def caption(method: Method, camera: Camera) -> str:
    """Return what a picture of this camera shows, in words; empty if the method has nothing to say."""
    return method.caption(camera) if isinstance(method, Posed) else ""
