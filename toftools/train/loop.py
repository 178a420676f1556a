"""The training loop: steps that follow from seed and number, checkpoints, a learning curve.

A checkpoint holds weights, the state of Adam and the number of the step as plain arrays; whoever is
stopped goes on from the last one and ends with the same weights (on the same machine and number of
threads).
"""

import json
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
import torch
from torch import Tensor, nn

from toftools.io.atomic import atomic_path

EVERY = 250
"""Steps between checkpoints, and between points of the curve."""
RISE = 0.05
"""Share of the steps in which the learning rate rises."""

LossOf = Callable[[int], Tensor]
Measure = Callable[[], Mapping[str, float]]


@dataclass(frozen=True)
class Stage:
    """One stage of a training.

    Parameters
    ----------
    name : str
        Of the stage: ``autoencoder``, ``network``.
    steps : int
        Steps.
    learning_rate : float
        Largest.
    """

    name: str
    steps: int
    learning_rate: float


def run(
    model: nn.Module, stage: Stage, loss_of: LossOf, measure: Measure, folder: Path,
    told: Callable[[str], None] = lambda _: None,
) -> None:  # fmt: skip
    """Train a model in place.

    Parameters
    ----------
    model : Module
        Parameters that do not require a gradient stay as they are.
    stage : Stage
        How long and how fast.
    loss_of : callable
        Loss of the batch of a step.
    measure : callable
        Figures on the validation part, in evaluation mode.
    folder : Path
        Of checkpoint and curve (``<stage>.npz``, ``<stage>.jsonl``); a run goes on from there.
    told : callable
        Takes lines of progress.
    """
    moving = [p for p in model.parameters() if p.requires_grad]
    adam = torch.optim.AdamW(moving, lr=stage.learning_rate, weight_decay=1e-4)
    begin, curve = _restored(model, adam, folder, stage)
    losses: list[float] = []
    for step in range(begin, stage.steps):
        model.train()
        for group in adam.param_groups:
            group["lr"] = stage.learning_rate * pace(step / stage.steps)
        adam.zero_grad(set_to_none=True)
        loss = loss_of(step)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(moving, 5.0)
        adam.step()
        losses.append(float(loss.detach()))
        if (step + 1) % EVERY == 0 or step + 1 == stage.steps:
            model.eval()
            with torch.no_grad():
                point = {"step": step + 1, "loss": float(np.mean(losses)), **measure()}
            losses.clear()
            curve.append(point)
            _save(model, adam, step + 1, curve, folder, stage)
            figures = ", ".join(f"{key} {value:.4g}" for key, value in point.items())
            told(f"{stage.name}: {figures}")
    model.eval()


def settle(model: nn.Module, forward: Callable[[int], object], steps: int) -> None:
    """Give normalisation the mean statistics of many batches, instead of those of the last few.

    Parameters
    ----------
    model : Module
        Trained; its weights stay as they are.
    forward : callable
        Sends the batch of a step through the model.
    steps : int
        Batches.
    """
    model.train()
    layers = [m for m in model.modules() if isinstance(m, nn.BatchNorm2d) and m.training]
    for layer in layers:
        layer.reset_running_stats()
        layer.momentum = None  # torch's word for the mean over all batches
    with torch.no_grad():
        for step in range(steps):
            forward(step)
    model.eval()


def pace(share: float) -> float:
    """Learning rate over the largest: a linear rise, then half a cosine.

    Parameters
    ----------
    share : float
        Of the steps done, 0..1.

    Returns
    -------
    float
        0..1.

    Examples
    --------
    >>> pace(0.025), pace(0.05), round(pace(0.525), 3)
    (0.5, 1.0, 0.5)
    """
    if share < RISE:
        return share / RISE
    return 0.5 + 0.5 * math.cos(math.pi * (share - RISE) / (1 - RISE))


def _named(model: nn.Module, adam: torch.optim.Optimizer) -> Iterator[tuple[str, Tensor]]:
    """All that a checkpoint holds, by name."""
    for name, value in model.state_dict().items():
        yield f"model {name}", value
    for number, parameter in enumerate(adam.param_groups[0]["params"]):
        for key, value in sorted(adam.state.get(parameter, {}).items()):
            yield f"adam {number} {key}", value


def _save(
    model: nn.Module, adam: torch.optim.Optimizer, step: int, curve: list[dict[str, Any]],
    folder: Path, stage: Stage,
) -> None:  # fmt: skip
    arrays = {name: value.detach().cpu().numpy() for name, value in _named(model, adam)}
    folder.mkdir(parents=True, exist_ok=True)
    text = "".join(json.dumps(point) + "\n" for point in curve)
    with atomic_path(folder / f"{stage.name}.npz") as path, path.open("wb") as file:
        np.savez(file, **{"step": np.array(step), "curve": np.array(text), **arrays})
    with atomic_path(folder / f"{stage.name}.jsonl") as path:
        path.write_text(text, encoding="utf-8")


def _restored(
    model: nn.Module, adam: torch.optim.Optimizer, folder: Path, stage: Stage
) -> tuple[int, list[dict[str, Any]]]:
    """Go on from a checkpoint: its step and curve; 0 and nothing without one."""
    path = folder / f"{stage.name}.npz"
    if not path.is_file():
        return 0, []
    try:
        with path.open("rb") as raw, np.load(raw, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        step, text = int(arrays.pop("step")), str(arrays.pop("curve"))
        weights = {n.removeprefix("model "): torch.from_numpy(a) for n, a in arrays.items()
                   if n.startswith("model ")}  # fmt: skip
        model.load_state_dict(weights)
    except (OSError, ValueError, KeyError, RuntimeError, EOFError, BadZipFile) as error:
        msg = f"cannot go on from {path}, which is damaged or of another network; delete {folder}"
        raise ValueError(msg) from error
    moving = adam.param_groups[0]["params"]
    for name, array in arrays.items():
        if name.startswith("adam "):
            _, number, key = name.split(" ")
            moment = torch.from_numpy(array)
            if moment.shape == moving[int(number)].shape and key != "step":
                # On the parameter's device and in its order in memory.
                moment = torch.zeros_like(moving[int(number)]).copy_(moment)
            adam.state[moving[int(number)]][key] = moment
    return step, [json.loads(line) for line in text.splitlines()]
