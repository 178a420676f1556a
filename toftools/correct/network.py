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
from numba import njit, prange
from numpy.typing import NDArray

from toftools.camera import resized
from toftools.correct import INVALID, OK, kernel_input, refuse_emitter_offset, warm_up
from toftools.correct._net_coarse import SHIFT_M, STEP
from toftools.correct._net_engine import Engine, engine, tiled
from toftools.correct._net_file import WEIGHTS, Card, as_mapping, fitted, read_card, shipped, wanted
from toftools.correct._net_inputs import View, ranges, seen, view_of
from toftools.types import C64, F32, Bool, DepthMap, Modulation, Phasors, Sensor
from toftools.units import TWO_PI, joint_ambiguity_m

U8 = NDArray[np.uint8]
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
        ``run(Phasors) -> DepthMap``. `sigma_m` as the network says, and no less than the noise of
        the phasors, where that is known, leaves open (none for the kind `range`);
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
    in_order = order == sorted(order)
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
        sigma = None if phasors.sigma is None else phasors.sigma[order]
        frame = phasors if in_order else Phasors(phasors.values[order], sigma, phasors.valid)
        return answer(frame, views[shape], card, net)

    warm_up(run, len(order))
    return run


def _chosen(sensor: Sensor, model: str) -> tuple[Card, Engine, list[int], float]:
    """The network that suits a sensor, where its frequencies stand, and their factor."""
    freqs = sensor.modulation.freqs_hz
    own = WEIGHTS / f"{model}.onnx"
    path = shipped(freqs) if not model else own if own.is_file() else Path(model)
    if path is not None:
        card, data = read_card(path)
        suits = fitted(card, freqs)
        if suits is not None:
            return card, engine(data, str(path)), *suits
    cards = [read_card(p)[0] for p in ([path] if path else sorted(WEIGHTS.glob("*.onnx")))]
    known = "; ".join(wanted(card) for card in cards) or "none"
    asked = ", ".join(f"{freq / 1e6:g}" for freq in freqs)
    whose = f"the network {model} was" if model else "the networks of this package were"
    msg = f"got frequencies of {asked} MHz, {whose} trained for: {known}; train one for yours"
    raise ValueError(msg)


def _from_phasors(phasors: Phasors, view: View, card: Card, net: Engine) -> DepthMap:
    """Candidate, shift and scale."""
    looked = seen(phasors, view)
    inputs = {"full": looked.full, "coarse": looked.coarse}
    out = tiled(net, inputs, {"full": 1, "coarse": STEP}, card.multiple)
    if out.shape[0] != looked.candidates_m.shape[0] + 1:
        msg = (
            f"the network {card.name} gave {out.shape[0]} channels, wanted one per candidate and 2"
        )
        raise ValueError(msg)
    shape = looked.valid.shape
    range_m, sigma_m, shift_m = (np.empty(shape, np.float32) for _ in range(3))
    which, good = np.empty(shape, np.uint8), np.empty(shape, np.bool_)
    sigma = np.empty((0, *shape), np.float32) if phasors.sigma is None else phasors.sigma
    _answer(
        kernel_input(out), kernel_input(looked.candidates_m), kernel_input(looked.valid),
        kernel_input(phasors.values), kernel_input(sigma), view.turns_per_m,
        np.float32(SHIFT_M / view.metre), np.float32(looked.longest_m), range_m, sigma_m, shift_m,
        which, good,
    )  # fmt: skip
    with np.errstate(divide="ignore"):
        confidence = np.where(good, 1 / sigma_m, np.float32(0))
    return DepthMap(
        range_m,
        sigma_m,
        confidence,
        info={**_told(good, card), "candidate": which, "shift_m": shift_m},
    )


@njit(parallel=True, cache=True)  # type: ignore[untyped-decorator]  # numba has no types
def _answer(
    out: F32, candidates: F32, valid: Bool, values: C64, sigma: F32, turns_per_m: F32,
    unit: np.float32, longest: np.float32, range_m: F32, sigma_m: F32, shift_m: F32, which: U8,
    good: Bool,
) -> None:  # fmt: skip
    """Read the network's output: the first candidate has a logit of zero."""
    root2, turn = np.float32(np.sqrt(2)), np.float32(TWO_PI)
    for v in prange(valid.shape[0]):
        for u in range(valid.shape[1]):
            chosen, best = 0, np.float32(0)
            for c in range(1, candidates.shape[0]):
                if out[1 + c, v, u] > best:
                    chosen, best = c, out[1 + c, v, u]
            which[v, u] = chosen
            shift_m[v, u] = out[0, v, u] * unit
            found = candidates[chosen, v, u] + shift_m[v, u]
            # A range follows the phases of its own pixel: it is no better than those (Cramer-Rao
            # bound), and none where their noise is not a number.
            known = np.float32(0)
            for f in range(sigma.shape[0]):
                snr = abs(values[f, v, u]) / max(sigma[f, v, u], np.float32(1e-30))
                known += (turn * turns_per_m[f] * snr) ** 2
                if not sigma[f, v, u] < np.inf:
                    known = np.float32(np.nan)
            told = sigma.shape[0] == 0 or known > 0
            good[v, u] = valid[v, u] and np.isfinite(found) and told
            range_m[v, u], sigma_m[v, u] = np.nan, np.nan
            if good[v, u]:
                range_m[v, u] = min(max(found, np.float32(0)), longest)
                scale = min(max(out[1, v, u], np.float32(-WIDEST)), np.float32(WIDEST))
                # Standard deviation of a Laplace distribution of that scale.
                least = np.float32(0) if sigma.shape[0] == 0 else 1 / np.sqrt(known)
                sigma_m[v, u] = max(root2 * unit * np.exp(scale), least)


def _from_range(phasors: Phasors, view: View, card: Card, net: Engine) -> DepthMap:
    """A range from a range."""
    first, valid = ranges(phasors, view)
    metre = np.float32(view.metre)
    scaled = np.where(valid, first * metre, np.float32(0))[None]
    range_m = tiled(net, {"range_m": scaled}, {"range_m": 1}, card.multiple)[0] / metre
    good = valid & np.isfinite(range_m)
    kept = np.clip(range_m, 0, np.float32(view.walk.max_range_m))
    info = {**_told(good, card), "shift_m": range_m - first}
    return DepthMap(np.where(good, kept, np.float32(np.nan)), info=info)


def _told(good: Bool, card: Card) -> dict[str, Any]:
    """Status, and whose answer it is."""
    return {
        "status": np.where(good, np.uint8(OK), np.uint8(INVALID)),
        "network": as_mapping(card),
    }
