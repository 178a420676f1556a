"""`deeptof2017`: depth in, depth out, a convolutional autoencoder made a residual corrector.

Reference: J. Marco, Q. Hernandez, A. Munoz, Y. Dong, A. Jarabo, M. H. Kim, X. Tong, D. Gutierrez,
"DeepToF: off-the-shelf real-time correction of multipath interference in time-of-flight imaging",
ACM TOG 36 (2017); thesis 2018, 7.6: pairs of 5 x 5 convolutions at six scales (256 x 256 to 8 x 8),
stride two, each with batch normalisation, scale, bias and ReLU; upsampling and 5 x 5 convolutions
back. Stage one learns depth with multipath from itself, without skips; stage two freezes the
encoder and learns the decoder with element-wise additions of its features (`skip="add"`; the
alternatives of figure 7.8 are `concat` and `none`). With skips the input is added to the output
too: the text calls multipath a residue and does not print this; it can only help. Numbers of
channels are in neither text: ours are set by two CPU cores. Input: range in metres, not normalised.
Fails on what one range image cannot tell: albedo, and light from out of view.
"""

import itertools
from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional


def block(inside: int, outside: int, stride: int = 1) -> nn.Sequential:
    """A convolution of 5 x 5, normalised and rectified.

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
    return nn.Sequential(
        nn.Conv2d(inside, outside, 5, stride, 2), nn.BatchNorm2d(outside), nn.ReLU()
    )


class DeepToF(nn.Module):
    """The network.

    Parameters
    ----------
    widths : sequence of int
        Channels of the six scales.
    skip : {"add", "concat", "none"}
        How features of the encoder reach the decoder in stage two.
    """

    def __init__(self, widths: Sequence[int], skip: str = "add") -> None:
        super().__init__()
        self.skip = skip
        inside = [1, *widths[:-1]]
        self.encoder = nn.ModuleList(
            nn.Sequential(block(i, o, 1 if n == 0 else 2), block(o, o))
            for n, (i, o) in enumerate(zip(inside, widths, strict=True))
        )
        down = list(widths[::-1])
        more = 2 if skip == "concat" else 1
        self.decoder = nn.ModuleList(
            nn.Sequential(block(i, o), block(o * more, o)) for i, o in itertools.pairwise(down)
        )
        self.head = nn.Conv2d(widths[0], 1, 5, 1, 2)
        self.frozen = False

    def train(self, mode: bool = True) -> "DeepToF":
        """Training mode; a frozen encoder keeps the statistics that it was frozen with."""
        super().train(mode)
        if self.frozen:
            self.encoder.eval()
        return self

    def freeze(self) -> None:
        """Stage two: the encoder learns no more."""
        self.frozen = True
        self.encoder.requires_grad_(requires_grad=False)

    def forward(self, range_m: Tensor, coarse: bool = False) -> Tensor:
        """Corrected range.

        Parameters
        ----------
        range_m : Tensor, (B, 1, H, W)
            Range with multipath, m; H and W multiples of 32.
        coarse : bool
            Stage one: no skips, so that all has to pass the lowest scale.

        Returns
        -------
        Tensor, (B, 1, H, W)
            Range, m.
        """
        found, x = [], range_m
        for layer in self.encoder:
            x = layer(x)
            found.append(x)
        for layer, other in zip(self.decoder, found[-2::-1], strict=True):
            x = layer[0](functional.interpolate(x, scale_factor=2.0))
            if self.skip == "concat":
                x = torch.cat([x, torch.zeros_like(other) if coarse else other], dim=1)
            elif self.skip == "add" and not coarse:
                x = x + other
            x = layer[1](x)
        out = self.head(x)
        return out if coarse or self.skip == "none" else range_m + out


def loss_of(out: Tensor, truth: Tensor, known: Tensor) -> Tensor:
    """Mean squared error.

    Parameters
    ----------
    out : Tensor, (B, 1, H, W)
        Output, m.
    truth : Tensor, (B, H, W)
        Range wanted, m.
    known : Tensor, (B, H, W), bool
        Pixels that count.

    Returns
    -------
    Tensor
        Euclidean loss, as in the reference, per pixel.
    """
    error = torch.where(known, out[:, 0] - truth, torch.zeros_like(truth))
    return error.square().sum() / known.sum().clamp(1)
