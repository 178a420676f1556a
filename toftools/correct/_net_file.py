"""ONNX files of learned corrections: what they say of themselves, and whether a sensor suits them.

What a file says stands in its metadata under the key ``toftools``, as JSON; it is read here without
any library that would build the network first (`_onnx_metadata`).
"""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from toftools.correct._net_coarse import COLUMNS, MIDDLE_ALBEDO, RANGE_M, SHIFT_M
from toftools.correct._net_guide import AGREES_M
from toftools.correct._net_guide import COLUMNS as GUIDE_COLUMNS
from toftools.correct._onnx_metadata import metadata
from toftools.types import F64

WEIGHTS = Path(__file__).parent / "weights"
KEY = "toftools"
INPUTS = ("phasors", "range")
"""Kinds of input: see `_net_inputs`; or one range image."""
NORMALISATION: Mapping[str, float] = {
    "range_m": RANGE_M, "shift_m": SHIFT_M, "middle_albedo": MIDDLE_ALBEDO, "columns": COLUMNS,
    "guide_columns": GUIDE_COLUMNS, "agrees_m": AGREES_M,
}  # fmt: skip
"""Constants of the input; a file with others was trained on another input."""
FORMAT = 1
LEAST_PIXELS = 112 * 160
"""Pixels of the smallest frames that a training sees (`train.samples`)."""
MULTIPLES = (16, 32, 64)
"""Of which rows and columns may be multiples; tiles are multiples of all."""
SAME_RATIO = 0.01
"""Relative error of frequencies up to which a set counts as the trained one."""
MOST_BYTES = 1 << 28
MOST_M = 1e6


@dataclass(frozen=True)
class Card:
    """What a network file says of itself.

    Parameters
    ----------
    name, about, licence : str
        Name, what it is, licence of the weights.
    input : {"phasors", "range"}
        Kind of input.
    freqs_hz : tuple of float
        Frequencies it was trained for, Hz.
    scales : tuple of float
        Least and largest common factor of the frequencies that it has seen.
    max_range_m : float
        Longest range, m; 0 stands for the joint ambiguity.
    multiple : int
        Rows and columns are padded to a multiple of it.
    recipe, data : str
        Digest of the training recipe, and of the data set's.
    normalisation : mapping
        Constants of the input.
    format : int
        Version of these words.
    """

    name: str
    input: str
    freqs_hz: tuple[float, ...]
    scales: tuple[float, ...]
    multiple: int
    licence: str
    recipe: str
    normalisation: Mapping[str, float]
    about: str = ""
    data: str = ""
    max_range_m: float = 0.0
    format: int = FORMAT


def to_text(card: Card) -> str:
    """The card as it stands in the file.

    Parameters
    ----------
    card : Card
        The card.

    Returns
    -------
    str
        JSON.
    """
    return json.dumps({field.name: getattr(card, field.name) for field in fields(Card)})


def read_card(path: Path) -> tuple[Card, bytes]:
    """Read a network file.

    Parameters
    ----------
    path : Path
        ONNX file.

    Returns
    -------
    Card
        What it says of itself.
    bytes
        The file.

    Raises
    ------
    ValueError
        If it cannot be read, is no ONNX file, or was not made for this program.
    """
    try:
        if path.stat().st_size > MOST_BYTES:
            msg = f"{path} has {path.stat().st_size >> 20} MiB, wanted a network of up to 256"
            raise ValueError(msg)
        data = path.read_bytes()
    except OSError as error:
        msg = f"cannot read the network {path}: {error.strerror or error}"
        raise ValueError(msg) from error
    try:
        told = metadata(data)
    except ValueError as error:  # words that are no UTF-8 too
        msg = f"{path} is no ONNX file, or a damaged one; wanted one made by toftools train"
        raise ValueError(msg) from error
    if KEY not in told:
        msg = (
            f"the network {path} does not say what its input is (no metadata {KEY!r}); wanted one "
            "made by toftools train"
        )
        raise ValueError(msg)
    return _card(told[KEY], path), data


def _card(text: str, path: Path) -> Card:
    """Check every word."""
    card = None
    try:
        given = json.loads(text)
        card = Card(
            **{
                **given,
                "freqs_hz": tuple(float(f) for f in given["freqs_hz"]),
                "scales": tuple(float(s) for s in given["scales"]),
            }
        )
    except (TypeError, KeyError, ValueError, OverflowError, RecursionError):
        pass
    if card is None or not _plausible(card):
        msg = f"the network {path} describes itself in words this version does not know"
        raise ValueError(msg)
    if dict(card.normalisation) != dict(NORMALISATION):
        msg = (
            f"the network {path} was trained on inputs with {dict(card.normalisation)}, this "
            f"version makes them with {dict(NORMALISATION)}; train it anew"
        )
        raise ValueError(msg)
    return card


def _plausible(card: Card) -> bool:
    texts = (card.name, card.about, card.licence, card.recipe, card.data, card.input)
    numbers = (*card.freqs_hz, *card.scales)
    return (
        all(isinstance(text, str) for text in texts)
        and card.format == FORMAT
        and card.input in INPUTS
        and bool(card.freqs_hz)
        and len(card.scales) == 2
        and all(math.isfinite(n) and n > 0 for n in numbers)
        and card.multiple in MULTIPLES
        and isinstance(card.max_range_m, int | float)
        and 0 <= card.max_range_m < MOST_M
        and isinstance(card.normalisation, dict)
    )


def fitted(card: Card, freqs_hz: F64) -> tuple[list[int], float] | None:
    """Whether a sensor's frequencies are those of a network, or a multiple of them.

    Parameters
    ----------
    card : Card
        The network.
    freqs_hz : ndarray, (F,)
        Frequencies of the sensor, Hz.

    Returns
    -------
    list of int
        Where the network's frequencies stand among the sensor's.
    float
        Ratio of the sensor's frequencies to the network's.
    None
        If they do not suit.
    """
    own = np.asarray(card.freqs_hz)
    if own.size != freqs_hz.size:
        return None
    order = np.empty(own.size, np.int64)
    order[np.argsort(own)] = np.argsort(freqs_hz)
    ratios = freqs_hz[order] / own
    metre = float(np.exp(np.log(ratios).mean()))
    low, high = card.scales
    same = bool((np.abs(ratios / metre - 1) < SAME_RATIO).all())
    if not same or not low * (1 - SAME_RATIO) <= metre <= high * (1 + SAME_RATIO):
        return None
    return [int(i) for i in order], metre


def shipped(freqs_hz: F64) -> Path | None:
    """The network of phasors of the package for a sensor.

    Parameters
    ----------
    freqs_hz : ndarray, (F,)
        Frequencies of the sensor, Hz.

    Returns
    -------
    Path
        ONNX file.
    None
        If there is none for these frequencies.
    """
    for path in sorted(WEIGHTS.glob("*.onnx")):
        card, _ = read_card(path)
        if card.input == "phasors" and fitted(card, freqs_hz) is not None:
            return path
    return None


def wanted(card: Card) -> str:
    """The frequencies of a network in words.

    Parameters
    ----------
    card : Card
        The network.

    Returns
    -------
    str
        Such as ``40 and 70 MHz times 0.5 to 2``.
    """
    freqs = " and ".join(f"{freq / 1e6:g}" for freq in card.freqs_hz)
    low, high = card.scales
    times = "" if low == high == 1 else f" times {low:g} to {high:g}"
    return f"{freqs} MHz{times}"


def as_mapping(card: Card) -> Mapping[str, Any]:
    """What an answer repeats of the card.

    Parameters
    ----------
    card : Card
        The network.

    Returns
    -------
    mapping
        Name, licence and digest of the recipe.
    """
    return {"name": card.name, "licence": card.licence, "recipe": card.recipe}
