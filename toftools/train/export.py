"""A trained network as an ONNX file that says what it is, and the same in eight bits."""

import tempfile
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import onnx
import torch
from torch import nn

from toftools.correct._net_coarse import STEP
from toftools.correct._net_engine import engine
from toftools.correct._net_file import KEY, NORMALISATION, Card, to_text
from toftools.io.atomic import atomic_path
from toftools.train.recipe import MULTIPLE, TrainRecipe
from toftools.train.standard import folded
from toftools.types import F32

OPSET = 17
SIDE = 64
"""Rows and columns of the frame that the network is traced with; any others run."""
PARITY = 1e-3
"""Largest difference of the exported network from the trained one, relative to its outputs."""


def card_of(recipe: TrainRecipe, data: str) -> Card:
    """What the file of a recipe says of itself.

    Parameters
    ----------
    recipe : TrainRecipe
        The recipe.
    data : str
        Digest of the data set.

    Returns
    -------
    Card
        The card.
    """
    return Card(
        name=recipe.name, about=recipe.about, licence=recipe.licence,
        input="range" if recipe.model == "deeptof2017" else "phasors",
        freqs_hz=recipe.freqs_hz, scales=(min(recipe.scales), max(recipe.scales)),
        multiple=MULTIPLE[recipe.model], recipe=recipe.digest, data=data,
        normalisation=dict(NORMALISATION), max_range_m=recipe.max_range_m,
    )  # fmt: skip


def example(card: Card, channels: tuple[int, int]) -> dict[str, F32]:
    """Inputs of the kind of a network, drawn.

    Parameters
    ----------
    card : Card
        Of the network.
    channels : tuple of int
        At full resolution, and of patches.

    Returns
    -------
    dict of str to ndarray
        Inputs by name.
    """
    rng = np.random.default_rng(0)
    if card.input == "range":
        return {"range_m": rng.uniform(0.5, 5, (1, 1, SIDE, SIDE)).astype(np.float32)}
    small = SIDE // STEP
    return {
        "full": rng.standard_normal((1, channels[0], SIDE, SIDE), np.float32),
        "coarse": rng.standard_normal((1, channels[1], small, small), np.float32),
    }


def export(model: nn.Module, card: Card, inputs: Mapping[str, F32], out: Path) -> None:
    """Write a network, and see that what was written answers as what was trained.

    Parameters
    ----------
    model : Module
        Trained; its standardised convolutions become plain ones.
    card : Card
        What it says of itself.
    inputs : mapping of str to ndarray
        An example of its input.
    out : Path
        ONNX file.

    Raises
    ------
    RuntimeError
        If the file answers otherwise; none is left then.
    """
    model = model.to("cpu", memory_format=torch.contiguous_format).eval()
    tensors = tuple(torch.from_numpy(value) for value in inputs.values())
    with torch.no_grad():
        told = model(*tensors).numpy()
    folded(model)
    axes = {name: {2: f"{name}_rows", 3: f"{name}_columns"} for name in inputs}
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # what does not change between frames may be constant
        path = Path(folder) / "network.onnx"
        torch.onnx.export(
            model, tensors, str(path), dynamo=False, opset_version=OPSET,
            input_names=list(inputs), output_names=["out"],
            dynamic_axes={**axes, "out": {2: "rows", 3: "columns"}},
        )  # fmt: skip
        graph = onnx.load(str(path))
    data = labelled(graph, card)
    got = engine(data, card.name)(inputs)
    away = float(np.abs(got - told).max() / max(float(np.abs(told).max()), 1e-6))
    if not away < PARITY:
        msg = f"the exported network is off the trained one by {away:.1e} of its output"
        raise RuntimeError(msg)
    with atomic_path(out) as target:
        target.write_bytes(data)


def labelled(graph: onnx.ModelProto, card: Card) -> bytes:
    """An ONNX model with the card in its metadata.

    Parameters
    ----------
    graph : ModelProto
        Model.
    card : Card
        What it says of itself.

    Returns
    -------
    bytes
        The file.
    """
    graph.doc_string = ""
    onnx.helper.set_model_props(graph, {KEY: to_text(card)})
    data: bytes = graph.SerializeToString()
    return data


def quantised(source: Path, frames: Sequence[Mapping[str, F32]], card: Card, out: Path) -> None:
    """The network in eight bits: weights per channel, activations by the range of real frames.

    Parameters
    ----------
    source : Path
        ONNX file.
    frames : sequence of mapping
        Inputs that show the range of every activation.
    card : Card
        What the new file says of itself.
    out : Path
        ONNX file.
    """
    from onnxruntime.quantization import QuantFormat, QuantType, quantize_static

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "eight.onnx"
        quantize_static(
            str(source), str(path), _Reader(frames), quant_format=QuantFormat.QDQ,
            per_channel=True, activation_type=QuantType.QUInt8, weight_type=QuantType.QInt8,
            op_types_to_quantize=["Conv"],
        )  # fmt: skip
        graph = onnx.load(str(path))
    with atomic_path(out) as target:
        target.write_bytes(labelled(graph, card))


class _Reader:
    """Frames one by one, as onnxruntime asks for them."""

    def __init__(self, frames: Sequence[Mapping[str, F32]]) -> None:
        self.left = iter(frames)

    def get_next(self) -> Mapping[str, F32] | None:
        return next(self.left, None)
