"""What a training step sees: frames drawn, mirrored, cut, made larger or smaller, and noisy.

All draws follow from the recipe's seed and the number of the step, so that a run that is resumed
draws what it would have drawn. Mirroring and cutting keep the physics (what is cut off lights what
is left); a frequency s times higher shows the scene s times larger to the frequency asked for.
"""

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from toftools.correct._net_coarse import SHIFT_M
from toftools.correct._net_inputs import View, ranges, seen, view_of
from toftools.train.frames import Frame, indices
from toftools.train.recipe import MULTIPLE, TrainRecipe
from toftools.types import C64, F32, Bool, Camera, Modulation, Phasors, Sensor

SIZES = ((240, 320, 1), (192, 256, 1), (112, 160, 2))
"""Rows, columns, and step between the pixels taken, of a batch's frames; the fewest pixels are
`correct._net_file.LEAST_PIXELS`."""
SHARES = (0.6, 0.25, 0.15)
PLACES = 2
"""Cuts begin at multiples of half of what is left over: few views to prepare."""
CLEAN = 0.2
"""Share of frames without noise."""
VIEWS = 1200
NEAREST_M = 0.05
STREAMS = ("train", "unlabelled")
"""Draws of their own: the network's, and those of an autoencoder before it."""


@dataclass(frozen=True, eq=False)
class Batch:
    """Input and target of a step; ranges in units of `SHIFT_M`.

    Parameters
    ----------
    full, coarse : ndarray, (B, ...)
        Input of the network; coarse is empty for networks of range.
    candidates : ndarray, (B, K, H, W)
        Ranges that the output refers to.
    truth : ndarray, (B, H, W)
        True range, 0 where unknown.
    known : ndarray, (B, H, W), bool
        Pixels that count.
    """

    full: F32
    coarse: F32
    candidates: F32
    truth: F32
    known: Bool


class Samples:
    """Draws batches from frames.

    Parameters
    ----------
    frames : sequence of Frame
        What to draw from.
    recipe : TrainRecipe
        Frequencies, scales, noise.
    """

    def __init__(self, frames: Sequence[Frame], recipe: TrainRecipe) -> None:
        self.frames, self.recipe = frames, recipe
        self.views: OrderedDict[tuple[object, ...], View] = OrderedDict()
        self.picks: dict[tuple[int, float], list[int]] = {}
        # Frames of a batch are of one size, which the smallest has.
        self.most = [min(frame.range_m.shape[axis] for frame in frames) for axis in (0, 1)]
        if min(self.most) < MULTIPLE[recipe.model]:
            msg = (
                f"the smallest frames have {self.most[0]} x {self.most[1]} pixels, wanted "
                f"{MULTIPLE[recipe.model]} or more; leave them out of the data set"
            )
            raise ValueError(msg)

    def drawn(self, step: int, stream: str = "train") -> Batch:
        """The batch of a step.

        Parameters
        ----------
        step : int
            Number of the step.
        stream : {"train", "unlabelled"}
            Draws differ between them.

        Returns
        -------
        Batch
            The same for the same seed, step and stream.
        """
        rng = np.random.default_rng([self.recipe.seed, step, STREAMS.index(stream)])
        size = SIZES[rng.choice(len(SIZES), p=SHARES)]
        return stacked([self._one(rng, size) for _ in range(self.recipe.batch)])

    def fixed(self, frame: int, scale: float, snr: float) -> Batch:
        """A frame as it is, for validation.

        Parameters
        ----------
        frame : int
            Which.
        scale : float
            Of the scene.
        snr : float
            Signal to noise ratio of the median pixel; 0 for none.

        Returns
        -------
        Batch
            Of one frame, in full.
        """
        rng = np.random.default_rng([self.recipe.seed, frame])
        device, values, range_m = self._taken(self.frames[frame], scale, SIZES[0], (0, 0))
        return stacked(
            [self._seen(device, noisy(values, snr, rng), range_m, scale, (frame, scale))]
        )

    def _one(self, rng: np.random.Generator, size: tuple[int, int, int]) -> Batch:
        number = int(rng.integers(len(self.frames)))
        scale = float(rng.choice(self.recipe.scales))
        place = (int(rng.integers(PLACES + 1)), int(rng.integers(PLACES + 1)))
        device, values, range_m = self._taken(self.frames[number], scale, size, place)
        flip = rng.random(2) < 0.5
        if flip[0]:
            values, range_m = values[..., ::-1], range_m[..., ::-1]
        if flip[1]:
            values, range_m = values[..., ::-1, :], range_m[..., ::-1, :]
        low, high = np.log(self.recipe.snr)
        snr = 0.0 if rng.random() < CLEAN else float(np.exp(rng.uniform(low, high)))
        centre = tuple(device.camera.K[:2, 2])
        key = (id(self.frames[number].sensor), scale, size, centre, *flip)
        if flip.any():
            device = mirrored(device, bool(flip[0]), bool(flip[1]))
        return self._seen(device, noisy(values, snr, rng), range_m, scale, key)

    def _taken(
        self, frame: Frame, scale: float, size: tuple[int, int, int], place: tuple[int, int]
    ) -> tuple[Sensor, C64, F32]:
        """Part of a frame at the frequencies of a scale, and the camera that sees it."""
        rows, columns, step = size
        camera, multiple = frame.sensor.camera, MULTIPLE[self.recipe.model]
        if min(self.most) // step < multiple:
            step = 1
        rows, columns = (
            min(want, most // step) // multiple * multiple
            for want, most in zip((rows, columns), self.most, strict=True)
        )
        spare = (camera.height - rows * step, camera.width - columns * step)
        top, left = (spare[i] * place[i] // PLACES for i in range(2))
        cut = (slice(top, top + rows * step, step), slice(left, left + columns * step, step))
        freqs = np.asarray(self.recipe.freqs_hz) * scale
        key = (id(frame.sensor), scale)
        if key not in self.picks:
            self.picks[key] = indices(frame.sensor, freqs.tolist())
        pick = self.picks[key]
        values = np.stack([frame.values[(i, *cut)] for i in pick])
        K = camera.K.copy()
        K[:2, 2] -= (left, top)
        K[:2] /= step
        smaller = Camera(columns, rows, K, camera.dist, camera.model)
        device = Sensor(smaller, Modulation(freqs), emitters=frame.sensor.emitters)
        return device, values, frame.range_m[cut]

    def _seen(
        self, device: Sensor, values: C64, range_m: F32, scale: float, key: tuple[object, ...]
    ) -> Batch:
        """What the network is to see, and to answer."""
        longest = self.recipe.max_range_m / scale
        if key not in self.views:
            self.views[key] = view_of(device, scale, longest)
            if len(self.views) > VIEWS:
                self.views.popitem(last=False)
        view = self.views[key]
        phasors = Phasors(np.ascontiguousarray(values))
        if self.recipe.model == "deeptof2017":
            first, valid = ranges(phasors, view)
            full, candidates = (first * valid)[None] * np.float32(scale), first[None]
            coarse = full[:0]
        else:
            got = seen(phasors, view)
            full, coarse, candidates, valid = got.full, got.coarse, got.candidates_m, got.valid
        reach = view.walk.max_range_m
        known = valid & np.isfinite(range_m) & (range_m > NEAREST_M) & (range_m < reach)
        unit = np.float32(scale / SHIFT_M)
        truth = np.where(known, range_m, 0) * unit
        return Batch(full, coarse, candidates * unit, truth, known)


def stacked(batches: Sequence[Batch]) -> Batch:
    """Batches of one frame each as one.

    Parameters
    ----------
    batches : sequence of Batch
        Of frames of one size.

    Returns
    -------
    Batch
        All of them.
    """
    parts = ((getattr(b, name) for b in batches) for name in Batch.__dataclass_fields__)
    return Batch(*(np.stack(list(part)) for part in parts))


def noisy(values: C64, snr: float, rng: np.random.Generator) -> C64:
    """Add noise, half of it constant and half that of the light itself.

    Parameters
    ----------
    values : ndarray, (F, H, W)
        Phasors.
    snr : float
        Amplitude over standard deviation at the frame's median amplitude; 0 adds nothing.
    rng : Generator
        Draws.

    Returns
    -------
    ndarray, (F, H, W)
        Phasors, complex64.
    """
    if snr == 0:
        return values
    amplitude = np.abs(values[0])
    middle = max(float(np.median(amplitude)), 1e-30)
    sigma = middle / snr * np.sqrt(0.5 + 0.5 * amplitude / middle)
    white = rng.standard_normal((2, *values.shape), dtype=np.float32)
    return np.asarray(values + sigma * (white[0] + 1j * white[1]), np.complex64)


def mirrored(device: Sensor, across: bool, down: bool) -> Sensor:
    """The camera that sees the mirrored image.

    Parameters
    ----------
    device : Sensor
        Camera without lens distortion.
    across, down : bool
        Whether columns and rows are reversed.

    Returns
    -------
    Sensor
        With its principal point mirrored.
    """
    camera = device.camera
    K = camera.K.copy()
    if across:
        K[0, 2] = camera.width - 1 - K[0, 2]
    if down:
        K[1, 2] = camera.height - 1 - K[1, 2]
    return replace(device, camera=replace(camera, K=K))
