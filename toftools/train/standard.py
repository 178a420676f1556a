"""A convolution with standardised weights: what normalisation of batches does, without batches.

Per output channel the weights are ``g 1.71 (w - mean) / (sd sqrt(n))`` with n inputs each and a
learned gain g, so that signals keep their size through layers with ReLU (A. Brock, S. De, S. L.
Smith, ICLR 2021, "Characterizing signal propagation to close the performance gap in unnormalized
ResNets", equations 5 and 8). A network of these answers a frame the same whatever else was in its
batch; trained, it becomes plain convolutions (`folded`). Fails without an activation in between:
linear layers do not need it.
"""

import math

import torch
from torch import Tensor, nn
from torch.nn import functional

GAIN = math.sqrt(2 / (1 - 1 / math.pi))
"""Restores the variance that ReLU takes from a normal distribution."""
LEAST = 1e-4
"""Least variance of weights, times their number."""


class StandardConv(nn.Conv2d):
    """A convolution of 3 x 3 with standardised weights.

    Parameters
    ----------
    inside, outside : int
        Channels.
    stride : int
        Step.
    """

    def __init__(self, inside: int, outside: int, stride: int = 1) -> None:
        super().__init__(inside, outside, 3, stride, 1)
        nn.init.normal_(self.weight)
        assert self.bias is not None
        nn.init.zeros_(self.bias)
        self.gain = nn.Parameter(torch.ones(outside, 1, 1, 1))

    def standard(self) -> Tensor:
        """Weights as they act, (outside, inside, 3, 3)."""
        variance, mean = torch.var_mean(self.weight, dim=(1, 2, 3), correction=0, keepdim=True)
        scale = torch.rsqrt(variance * self.weight[0].numel() + LEAST)
        return self.gain * GAIN * scale * (self.weight - mean)

    def forward(self, x: Tensor) -> Tensor:
        """The convolution of x, (B, inside, H, W)."""
        return functional.conv2d(x, self.standard(), self.bias, self.stride, self.padding)


def folded(model: nn.Module) -> nn.Module:
    """Plain convolutions in place of standardised ones: the same answers, nothing to compute first.

    Parameters
    ----------
    model : Module
        Trained; it is changed.

    Returns
    -------
    Module
        The same object.
    """
    for name, layer in list(model.named_children()):
        if isinstance(layer, StandardConv):
            plain = nn.Conv2d(
                layer.in_channels, layer.out_channels, 3, layer.stride[0], 1
            )  # fmt: skip
            assert plain.bias is not None and layer.bias is not None
            with torch.no_grad():
                plain.weight.copy_(layer.standard())
                plain.bias.copy_(layer.bias)
            setattr(model, name, plain)
        else:
            folded(layer)
    return model
