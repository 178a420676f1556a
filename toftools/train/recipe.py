"""Training recipes: a TOML file that says which network learns what, for how long."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

from toftools._recipe_file import read_toml
from toftools.bench.fingerprint import digest

RECIPES = Path(__file__).parent / "recipes"
MODELS: Mapping[str, int] = {"phasornet": 3, "deeptof2017": 6}
"""Networks, and how many scales each has."""
MULTIPLE: Mapping[str, int] = {"phasornet": 16, "deeptof2017": 32}
"""Rows and columns of their frames are multiples of it."""


@dataclass(frozen=True)
class TrainRecipe:
    """What to train.

    Parameters
    ----------
    name, about : str
        Name, and what it is.
    model : str
        ``phasornet`` or ``deeptof2017``.
    freqs_hz : tuple of float
        Modulation frequencies, Hz.
    widths : tuple of int
        Channels of each scale.
    scales : tuple of float
        Ratios of the data's frequencies to these: the same scenes made larger or smaller.
    without : tuple of str
        Inputs left out, for ablations: ``bounce`` (light of one bounce), ``residuals``,
        ``candidates``, ``reflectance``.
    skip : str
        Of deeptof2017: ``add``, ``concat`` or ``none``.
    pretrain_steps : int
        Of deeptof2017: steps of the autoencoder.
    steps, batch : int
        Steps, and frames in each.
    learning_rate : float
        Largest learning rate; it rises for a twentieth of the steps and falls to zero as a cosine.
    snr : tuple of float
        Least and largest signal to noise ratio of a frame's median pixel.
    max_range_m : float
        Longest range, m; 0 stands for the joint ambiguity.
    seed : int
        Of weights, draws and noise.
    licence : str
        Of the weights.
    data : str
        Folder of the data set, relative to the recipe's file; empty where it is told otherwise.
    digest : str
        What names the recipe: its content.
    """

    name: str
    model: str
    freqs_hz: tuple[float, ...]
    widths: tuple[int, ...]
    about: str = ""
    scales: tuple[float, ...] = (1.0,)
    without: tuple[str, ...] = ()
    skip: str = "add"
    pretrain_steps: int = 0
    steps: int = 1000
    batch: int = 8
    learning_rate: float = 1e-3
    snr: tuple[float, ...] = (20.0, 2000.0)
    max_range_m: float = 0.0
    seed: int = 0
    licence: str = "Apache-2.0"
    data: str = ""
    digest: str = ""


LEFT_OUT = ("bounce", "residuals", "candidates", "reflectance")
SKIPS = ("add", "concat", "none")


def read_train_recipe(source: Path | str) -> TrainRecipe:
    """Read a training recipe.

    Parameters
    ----------
    source : path or str
        TOML file, or the name of a recipe that comes with the package.

    Returns
    -------
    TrainRecipe
        Checked.

    Raises
    ------
    ValueError
        If there is no such recipe, or it asks for what is impossible.
    """
    path, text, given = read_toml(source, RECIPES, "training recipe")
    recipe = _checked({"name": path.stem, **given}, digest(text))
    return replace(recipe, data=str(path.parent / recipe.data)) if recipe.data else recipe


def _checked(given: Mapping[str, Any], mark: str) -> TrainRecipe:
    """Types first, then values."""
    known = {field.name: field for field in fields(TrainRecipe) if field.name != "digest"}
    values: dict[str, Any] = {"digest": mark}
    for key, value in given.items():
        if key not in known:
            msg = f"the training recipe has the key {key!r}; known: {', '.join(known)}"
            raise ValueError(msg)
        kind = known[key].type
        name = kind.__name__ if isinstance(kind, type) else str(kind)
        values[key] = _value(key, value, name)
    missing = [name for name in ("model", "freqs_hz", "widths") if name not in values]
    if missing:
        msg = f"the training recipe lacks {', '.join(missing)}"
        raise ValueError(msg)
    recipe = TrainRecipe(**values)
    _check_values(recipe)
    return recipe


def _value(key: str, value: object, kind: str) -> Any:  # noqa: ANN401 - of many types
    if kind.startswith("tuple"):
        inner = kind.removeprefix("tuple[").partition(",")[0]
        if isinstance(value, list):
            return tuple(_value(key, item, inner) for item in value)
    elif kind == "float" and isinstance(value, int | float) and not isinstance(value, bool):
        if math.isfinite(value):
            return float(value)
    elif (kind == "int" and isinstance(value, int) and not isinstance(value, bool)) or (
        kind == "str" and isinstance(value, str)
    ):
        return value
    msg = f"training recipe: {key} = {value!r}, wanted {kind.replace('tuple', 'a list ')}"
    raise ValueError(msg)


def _check_values(recipe: TrainRecipe) -> None:
    scales = MODELS.get(recipe.model)
    wishes = {
        "model": (scales is not None, f"one of {', '.join(MODELS)}"),
        "widths": (len(recipe.widths) == scales and min(recipe.widths, default=0) > 0,
                   f"{scales} positive numbers of channels"),
        "freqs_hz": (bool(recipe.freqs_hz) and min(recipe.freqs_hz) > 0
                     and len(set(recipe.freqs_hz)) == len(recipe.freqs_hz),
                     "different positive frequencies"),
        "scales": (bool(recipe.scales) and min(recipe.scales) > 0, "positive ratios"),
        "without": (set(recipe.without) <= set(LEFT_OUT), f"some of {', '.join(LEFT_OUT)}"),
        "skip": (recipe.skip in SKIPS, f"one of {', '.join(SKIPS)}"),
        "snr": (len(recipe.snr) == 2 and 0 < recipe.snr[0] <= recipe.snr[-1],
                "least and largest ratio"),
        "steps": (recipe.steps > 0, "1 or more"),
        "pretrain_steps": (recipe.pretrain_steps >= 0, "0 or more"),
        "batch": (recipe.batch > 0, "1 or more"),
        "learning_rate": (recipe.learning_rate > 0, "a positive number"),
        "max_range_m": (recipe.max_range_m >= 0, "metres, or 0"),
        "seed": (recipe.seed >= 0, "0 or more"),
    }  # fmt: skip
    for key, (good, wish) in wishes.items():
        if not good:
            msg = f"training recipe: {key} = {getattr(recipe, key)!r}, wanted {wish}"
            raise ValueError(msg)
    if recipe.model == "deeptof2017" and len(recipe.freqs_hz) != 1:
        msg = "deeptof2017 corrects the range of one frequency; give freqs_hz one number"
        raise ValueError(msg)
