"""`phasornet`: which of the candidate ranges is right, and how far bounced light has shifted it.

A small U-net at a quarter of the resolution: 4 x 4 pixels become one place, and come out of its
channels again (W. Shi et al., CVPR 2016, sub-pixel convolution); three scales from there, and the
mean of the whole frame at the lowest, since all of a room's light is in every pixel. Weights are
standardised (`standard`): statistics of batches made the answer to a room depend on what else had
been in the last batches. Output per pixel: a shift of range, the logarithm of its scale (Laplace),
and how much better each further candidate is than the first. Input: `correct._net_inputs`. The
design is ours; a scale learned with the error follows A. Kendall and Y. Gal, NeurIPS 2017. Fails
outside of what it was trained on.
"""

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional

from toftools.correct._net_coarse import STEP
from toftools.train.standard import StandardConv

MOST_SHIFT = 45.0
"""Shifts beyond, in units of `SHIFT_M`, are no multipath but a missing candidate."""


def block(inside: int, outside: int, stride: int = 1) -> nn.Sequential:
    """A standardised convolution and its rectifier.

    Parameters
    ----------
    inside, outside : int
        Channels.
    stride : int
        Step.

    Returns
    -------
    Sequential
        The layers.
    """
    return nn.Sequential(StandardConv(inside, outside, stride), nn.ReLU())


class PhasorNet(nn.Module):
    """The network.

    Parameters
    ----------
    full, coarse : int
        Channels of the two inputs.
    candidates : int
        Ranges to choose from.
    widths : sequence of int
        Channels of the three scales.
    keep : Tensor or None, (full + coarse,)
        What of the input is used: 1, or 0 for an ablation; None for all.
    """

    def __init__(
        self, full: int, coarse: int, candidates: int, widths: Sequence[int],
        keep: Tensor | None = None,
    ) -> None:  # fmt: skip
        super().__init__()
        a, b, c = widths
        mask = torch.ones(full + coarse) if keep is None else keep
        self.register_buffer("keep_full", mask[:full].view(1, -1, 1, 1))
        self.register_buffer("keep_coarse", mask[full:].view(1, -1, 1, 1))
        self.embed = nn.Conv2d(full, a, STEP, STEP)
        self.stem = nn.Sequential(block(a + coarse, a), block(a, a))
        self.down1 = nn.Sequential(block(a, b, 2), block(b, b))
        self.down2 = nn.Sequential(block(b, c, 2), block(c, c))
        self.whole = nn.Conv2d(c, c, 1)
        self.deep = block(c, c)
        self.narrow1, self.up1 = nn.Conv2d(c, b, 1), block(b, b)
        self.narrow0, self.up0 = nn.Conv2d(b, a, 1), block(a, a)
        self.head = nn.Conv2d(2 * a, STEP * STEP * (candidates + 1), 1)
        nn.init.zeros_(self.head.weight)
        nn.init.zeros_(self.head.bias)

    def forward(self, full: Tensor, coarse: Tensor) -> Tensor:
        """Shift and log scale, in units of `SHIFT_M`, and logits of further candidates.

        Parameters
        ----------
        full : Tensor, (B, C, H, W)
            Channels at full resolution; H and W multiples of 16.
        coarse : Tensor, (B, D, H / 4, W / 4)
            Channels of patches.

        Returns
        -------
        Tensor, (B, 1 + K, H, W)
            Shift, log scale, logits of candidates 1 to K - 1.
        """
        seen = self.embed(full * self.keep_full)
        one = self.stem(torch.cat([seen, coarse * self.keep_coarse], dim=1))
        two = self.down1(one)
        three = self.down2(two)
        mean = three.mean(dim=(2, 3), keepdim=True)
        three = self.deep(three + functional.relu(self.whole(mean)))
        two = self.up1(two + functional.interpolate(self.narrow1(three), scale_factor=2.0))
        one = self.up0(one + functional.interpolate(self.narrow0(two), scale_factor=2.0))
        return functional.pixel_shuffle(self.head(torch.cat([one, seen], dim=1)), STEP)


def loss_of(out: Tensor, candidates: Tensor, truth: Tensor, known: Tensor) -> tuple[Tensor, Tensor]:
    """Negative log-likelihood per pixel, and the range that would be answered.

    Parameters
    ----------
    out : Tensor, (B, 1 + K, H, W)
        Output of the network.
    candidates : Tensor, (B, K, H, W)
        Ranges it refers to, in units of `SHIFT_M`.
    truth : Tensor, (B, H, W)
        True range, the same unit; anything where it is not known.
    known : Tensor, (B, H, W), bool
        Pixels that count.

    Returns
    -------
    Tensor
        Mean over the pixels that count.
    Tensor, (B, H, W)
        Range answered, in units of `SHIFT_M`.
    """
    shift, log_scale = out[:, 0], out[:, 1].clamp(-6, 6)
    away = (candidates - truth[:, None]).abs()
    right = away.argmin(dim=1, keepdim=True)
    target = truth - candidates.gather(1, right)[:, 0]
    near = known & (target.abs() < MOST_SHIFT)
    error = (shift - target).abs()
    likelihood = error * torch.exp(-log_scale) + log_scale
    logits = torch.cat([torch.zeros_like(out[:, :1]), out[:, 2:]], dim=1)
    choice = functional.cross_entropy(logits, right[:, 0], reduction="none")
    loss = torch.where(near, likelihood + choice, torch.zeros_like(shift)).sum() / near.sum().clamp(
        1
    )
    best = candidates.gather(1, logits.argmax(dim=1, keepdim=True))[:, 0]
    return loss, best + shift
