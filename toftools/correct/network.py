"""A learned correction: any ONNX file that says what it was trained on.

Two kinds of network: `phasors`, which sees the candidates for the range, how the frequencies
disagree and one bounce of light between the visible surfaces (`_net_inputs`), and answers with a
candidate, a shift and the scale of its error; and `range`, which sees a range image and answers
with one. The files that come with the package were trained on simulated rooms, tables and corners
(docs/learned): their cards say how good they are and where they fail. References: J. Marco et al.,
DeepToF, ACM TOG 36 (2017), for the second kind and the way to the data; the first kind is ours.
Inputs: phasors of the trained frequencies or a common multiple of them. Fails outside of what it
has seen: other frequencies are refused, other scenes cannot be told; sigma is that of scenes like
those of training, and light that did not bounce is taken for light that did, by millimetres to
centimetres.
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from toftools.camera import resized
from toftools.correct import INVALID, OK, refuse_emitter_offset, warm_up
from toftools.correct._net_coarse import SHIFT_M, STEP
from toftools.correct._net_engine import Engine, engine, tiled
from toftools.correct._net_file import WEIGHTS, Card, as_mapping, fitted, read_card, wanted
from toftools.correct._net_inputs import Seen, View, seen, view_of
from toftools.types import F32, DepthMap, Modulation, Phasors, Sensor
from toftools.units import joint_ambiguity_m

WIDEST = 6.0
"""Largest logarithm of a scale, as in training."""


def network(sensor: Sensor, *, model: str = "") -> Callable[[Phasors], DepthMap]:
    """Range by a learned network.

    Parameters
    ----------
    sensor : Sensor
        Frequencies that the network was trained on, or a common multiple, in any order. Frames of
        another size are taken for the same view on another grid.
    model : str
        ONNX file made by ``toftools train``, or the name of one that comes with the package; empty
        for the one of the package that suits.

    Returns
    -------
    callable
        ``run(Phasors) -> DepthMap``. `sigma_m` as the network says (none for the kind `range`);
        ``info``: `status`; `candidate` (H, W), which of the likeliest ranges it took; `shift_m`
        (H, W), what it added to that; `network`: name, licence, digest of the training recipe.

    Raises
    ------
    ValueError
        If there is no network for these frequencies, the file is none or another's, or the emitter
        is not at the camera.

    References
    ----------
    J. Marco et al., "DeepToF: off-the-shelf real-time correction of multipath interference in
    time-of-flight imaging", ACM TOG 36 (2017).
    """
    refuse_emitter_offset(sensor)
    card, net, order, metre = _chosen(sensor, model)
    # Amplitudes count relative to the frame alone, so electronics and noise do not matter.
    freqs = Modulation(sensor.modulation.freqs_hz[order])
    bare = Sensor(sensor.camera, freqs, emitters=sensor.emitters)
    # That of the frequencies trained: slightly other ones may repeat only after a kilometre.
    longest_m = (card.max_range_m or joint_ambiguity_m(np.array(card.freqs_hz))) / metre
    views: dict[tuple[int, ...], View] = {}
    answer = _from_phasors if card.input == "phasors" else _from_range

    def run(phasors: Phasors) -> DepthMap:
        shape = phasors.valid.shape
        if phasors.values.shape[0] != len(order):
            msg = f"phasors must have {len(order)} frequencies, got {phasors.values.shape[0]}"
            raise ValueError(msg)
        if shape not in views:
            views.clear()
            camera = resized(sensor.camera, shape[1], shape[0])
            views[shape] = view_of(replace(bare, camera=camera), metre, longest_m)
        values = phasors.values[order]
        return answer(seen(Phasors(values, valid=phasors.valid), views[shape]), card, net, metre)

    warm_up(run, len(order))
    return run


def _chosen(sensor: Sensor, model: str) -> tuple[Card, Engine, list[int], float]:
    """The network that suits a sensor, where its frequencies stand, and their factor."""
    freqs = sensor.modulation.freqs_hz
    own = WEIGHTS / f"{model}.onnx"
    named = own if own.is_file() else Path(model)
    files = [named] if model else sorted(WEIGHTS.glob("*.onnx"))
    cards = [(path, *read_card(path)) for path in files]
    for path, card, data in cards:
        suits = fitted(card, freqs)
        if suits is not None and (model or card.input == "phasors"):
            return card, engine(data, str(path)), *suits
    known = "; ".join(wanted(card) for _, card, _ in cards) or "none"
    asked = ", ".join(f"{freq / 1e6:g}" for freq in freqs)
    whose = f"the network {model} was" if model else "the networks of this package were"
    msg = f"got frequencies of {asked} MHz, {whose} trained for: {known}; train one for yours"
    raise ValueError(msg)


def _from_phasors(looked: Seen, card: Card, net: Engine, metre: float) -> DepthMap:
    """Candidate, shift and scale."""
    inputs = {"full": looked.full, "coarse": looked.coarse}
    out = tiled(net, inputs, {"full": 1, "coarse": STEP}, card.multiple)
    if out.shape[0] != looked.candidates_m.shape[0] + 1:
        msg = (
            f"the network {card.name} gave {out.shape[0]} channels, wanted one per candidate and 2"
        )
        raise ValueError(msg)
    unit = np.float32(SHIFT_M / metre)
    shift_m = out[0] * unit
    which = np.zeros(out.shape[1:], np.uint8)
    best = np.zeros(out.shape[1:], np.float32)
    range_m = looked.candidates_m[0].copy()
    for number, logit in enumerate(out[2:], start=1):
        better = logit > best
        which[better], best[better] = number, logit[better]
        range_m[better] = looked.candidates_m[number][better]
    # Standard deviation of a Laplace distribution of that scale.
    sigma_m = np.sqrt(np.float32(2)) * unit * np.exp(np.clip(out[1], -WIDEST, WIDEST))
    return _answer(
        range_m + shift_m, sigma_m, looked, card, {"candidate": which, "shift_m": shift_m}
    )


def _from_range(looked: Seen, card: Card, net: Engine, metre: float) -> DepthMap:
    """A range from a range."""
    first = looked.candidates_m[:1]
    scaled = np.where(looked.valid, first * np.float32(metre), 0).astype(np.float32)
    range_m = tiled(net, {"range_m": scaled}, {"range_m": 1}, card.multiple)[0] / np.float32(metre)
    return _answer(range_m, None, looked, card, {"shift_m": range_m - first[0]})


def _answer(
    range_m: F32, sigma_m: F32 | None, looked: Seen, card: Card, info: dict[str, Any]
) -> DepthMap:
    """Negative ranges and invalid pixels taken care of."""
    good = looked.valid & np.isfinite(range_m)
    nothing = np.float32(np.nan)
    sigma_m = None if sigma_m is None else np.where(good, sigma_m, nothing)
    return DepthMap(
        range_m=np.where(good, np.clip(range_m, 0, looked.longest_m), nothing),
        sigma_m=sigma_m,
        confidence=None if sigma_m is None else np.where(good, 1 / sigma_m, 0),
        info={
            "status": np.where(good, np.uint8(OK), np.uint8(INVALID)),
            "network": as_mapping(card),
            **info,
        },
    )
