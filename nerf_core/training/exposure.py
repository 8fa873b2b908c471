"""Learn the exposure and white balance of each training photo: a gain and an offset for each channel.

A photo shows t = a p + b, where p is the model's colour. Training compares the model with (t − b) / a, so that no
method needs to know about it. Every few steps the model draws some of the batch's pixels, and a and b follow in closed
form from the sums of p, t, p², p t and t² over the last batches (ridge regression). The model and the exposures are
thus learnt in turns.

A brighter model with smaller gains would match the photos as well. So the gains of a channel have the mean 1 over the
photos, and the offsets have the mean 0. Nor can photos tell a gain that grows in one direction of view from a model
whose colours do. So no part of gains and offsets is linear in the direction in which a photo looks: that is left to the
model. Without this rule, gains took up the bright side of a scene, which photos see from one side.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from torch import Tensor

from nerf_core.methods.group import ALONE, Group

EVERY = 4  # steps between two regressions
SHARE = 4  # one of so many rays of such a step's batch is drawn: some 2 % of the time of training
MEMORY = 0.8  # decay of the sums, per regression: the model of 20 steps ago counts little
LEARNT = 0.5  # share of the photos' variance that the model must explain: before, it knows nothing of their exposure
PIXELS = 200.0  # so many pixels of a photo count as independent at most, because neighbours are wrong together
GAIN_SPREAD, OFFSET_SPREAD = 0.3, 0.05  # standard deviations of the prior, around 1 and 0
NOISE = 1e-4  # least variance of a pixel: less than the square of 1/100
LEAST, MOST = 0.1, 10.0  # limits of a gain
MANY = 12  # with fewer photos, a direction explains too much of what is random
WHITE = 0.99  # a photo's value from here on may be clipped, and then says nothing about its gain


class Exposure:
    """The gains and offsets of N training photos.

    views: the photos as indices into `Scene.views`.
    gains, offsets: (N, 3) float32.
    """

    def __init__(self, views: Sequence[int], looks: np.ndarray) -> None:
        """Begin with the identity.

        Args:
            views: the photos as indices into `Scene.views`.
            looks: (N, 3) unit directions in which they look.
        """
        count = len(views)
        self.views = tuple(views)
        known = np.column_stack([np.ones(count), looks]) if count >= MANY else np.ones((count, 1))
        self._left = torch.from_numpy(np.eye(count) - known @ np.linalg.pinv(known, rcond=1e-3))
        self.gains, self.offsets = torch.ones(count, 3), torch.zeros(count, 3)
        self._sums = torch.zeros(count, 3, 6, dtype=torch.float64)  # of 1, p, t, p², p t, t²

    def due(self, step: int) -> bool:
        """Return whether `learn` is to be called with a training step."""
        return step % EVERY == 0

    def corrected(self, photo: Tensor, colors: Tensor) -> Tensor:
        """Return what photos would show with the mean exposure: (t − b) / a, in [0, 1].

        Args:
            photo: (R,) positions in `views`.
            colors: (R, 3) the photos' colours t.
        """
        gains, offsets = (v[photo].to(colors.device) for v in (self.gains, self.offsets))
        return ((colors - offsets) / gains).clamp(0, 1)

    def learn(self, photo: Tensor, predicted: Tensor, colors: Tensor, group: Group = ALONE) -> None:
        """Take in some pixels, and solve for all gains and offsets.

        Args:
            photo: (R,) positions in `views`.
            predicted: (R, 3) the model's colours p of the pixels.
            colors: (R, 3) the photos' colours t.
            group: the processes that train together; each gives its own pixels.
        """
        p, t = predicted.detach().cpu().double(), colors.detach().cpu().double()
        terms = torch.stack([torch.ones_like(p), p, t, p * p, p * t, t * t], -1) * (t < WHITE)[..., None]
        found = torch.zeros_like(self._sums).index_add_(0, photo.cpu(), terms)
        group.add([found])
        self._sums = MEMORY * self._sums + found
        self._solve()

    def _solve(self) -> None:
        """Minimise Σ (a p + b − t)² / σ² + (a − 1)² / GAIN_SPREAD² + b² / OFFSET_SPREAD² for each photo and channel.

        The sum counts as one of at most PIXELS pixels. σ² is the variance that straight lines leave, of all photos.
        """
        count, p, t, pp, pt, tt = (self._sums / self._sums[..., :1].clamp(min=1e-12)).unbind(-1)
        number, seen = self._sums[..., 0], count > 0
        by_p, by_both, by_t = pp - p * p, pt - p * t, tt - t * t
        explained = torch.where(seen, by_both.square() / by_p.clamp(min=1e-12), 0)
        whole, told = (float((number * v).sum()) for v in (by_t, explained))
        if not told > LEARNT * whole:
            return
        noise = max(NOISE, (whole - told) / float(number.sum()))
        trust = number.clamp(max=PIXELS) / noise
        aa, ab, bb = trust * pp + GAIN_SPREAD**-2, trust * p, trust * count + OFFSET_SPREAD**-2
        ra, rb = trust * pt + GAIN_SPREAD**-2, trust * t
        det = aa * bb - ab * ab  # positive, because the prior is
        gains, offsets = ((bb * ra - ab * rb) / det).clamp(LEAST, MOST), (aa * rb - ab * ra) / det
        self.gains = (1 + self._left @ (gains / gains.mean(0))).clamp(LEAST, MOST).float()
        self.offsets = (self._left @ offsets).float()

    def state(self) -> dict[str, Tensor]:
        """Return gains, offsets, sums and whose they are by name, for a checkpoint."""
        views = torch.tensor(self.views, dtype=torch.int64)
        return {"gains": self.gains, "offsets": self.offsets, "sums": self._sums, "views": views}

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Continue from `state`. Raises KeyError or ValueError if it is of other photos."""
        for name in ("gains", "offsets", "sums"):
            if state[name].shape != (value := self.state()[name]).shape:
                raise ValueError(f"{name} of {len(state[name])} photos, not {len(value)}")
        # checkpoints of earlier versions do not say: theirs go by number, those of a large capture's photos do not
        views = state["views"].tolist() if "views" in state else sorted(self.views)
        rows = torch.tensor([views.index(view) for view in self.views], dtype=torch.int64)
        self.gains, self.offsets = (state[name].cpu().float()[rows] for name in ("gains", "offsets"))
        self._sums = state["sums"].cpu().double()[rows]
