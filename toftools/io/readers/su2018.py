"""Image pairs by Su and others (CVPR 2018): phasors at 40 and 70 MHz beside a distance image.

Layout: MATLAB v5, key ``im_pair`` (5, H, 2 W). Left half, channels 0..3 in [0, 1]: I40, I70, Q40,
Q70, each mapped by 2x - 1 (both I first); channel 4: 40 MHz amplitude scaled to [0, 1]. Right half:
distance / 10 m, repeated in all channels. The phasors are normalised per pixel at every frequency.
Both are multiplied by that amplitude here (it is linear in light: times range^2 it is flat over
walls), which also goes to ``depth.amplitude``; how their lengths differ is lost. A file
``tofnet_output_<suffix>.mat`` (key ``x``, (1, H, W), distance / 10 m) beside it is the authors'
network output; it becomes ``reported["tofnet"]``, and alone it is a depth capture.
Convention: z = I + jQ, phase grows with range, offsets already calibrated out, distance radial.
Invalid: non-finite I or Q, zero phasors, distance 0 or infinite.
The right half is MPI-free truth in rendered frames and the camera's own answer in real ones.
Nothing in the file says which; the camera's is quantised to 2 cm, the renderer's is not, and
``right="auto"`` decides by that and records it.
Source: S. Su, F. Heide, G. Wetzstein, W. Heidrich, "Deep End-to-End Time-of-Flight Imaging",
CVPR 2018. Licence of the published files: MIT.
"""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toftools.io.readers._file import (
    depth_sensor,
    existing_file,
    metres,
    parsing,
    read_bytes,
    sensor_of_size,
)
from toftools.io.readers._mat5 import first_name, read_array
from toftools.types import Capture, DepthMap, Modulation, Phasors, Sensor, Truth

QUANTUM_M = 0.02
LEAST_AMPLITUDE = 1e-3
"""A pixel of amplitude zero keeps its phase: the channel is normalised to the brightest pixel."""
_CHANNELS = 5
_LIMIT = 1 << 27


def sniff(path: Path, head: bytes) -> bool:
    """Whether a file is an image pair or a network output of this family.

    Parameters
    ----------
    path : Path
        File.
    head : bytes
        Its first bytes.

    Returns
    -------
    bool
        True if the first array has the right name.
    """
    return first_name(head) in ("im_pair", "x")


def read(
    path: Path | str,
    *,
    right: str = "auto",
    freqs: tuple[float, float] = (40e6, 70e6),
    scale_m: float = 10.0,
    freq: float = 10e6,
) -> Capture:
    """Read an image pair or a network output.

    Parameters
    ----------
    path : path
        ``im_pair_*.mat`` or ``tofnet_output_*.mat``.
    right : {"auto", "truth", "camera"}
        What the right half is; auto looks for the camera's 2 cm steps.
    freqs : tuple of two floats
        Modulation frequencies, Hz.
    scale_m : float
        Metres per stored unit of distance.
    freq : float
        Nominal modulation frequency of a network output alone, Hz; its wrap must lie beyond 10 m.

    Returns
    -------
    Capture
        Phasors, amplitude and truth or camera distance; or a depth map for a network output.

    Raises
    ------
    ValueError
        If the file is not of this layout.
    """
    path = existing_file(path)
    if right not in ("auto", "truth", "camera"):
        msg = f"right must be auto, truth or camera, got {right!r}"
        raise ValueError(msg)
    with parsing(path, "su2018", OSError):
        name, array = read_array(read_bytes(path, limit=_LIMIT), "im_pair", "x")
        if name == "x":
            return _network_output(path, array, freq, scale_m)
        return _image_pair(path, array, right, freqs, scale_m)


def _sensor(width: int, height: int, freqs: tuple[float, float]) -> tuple[Sensor, str]:
    sensor, note = sensor_of_size("opt8241", width, height)
    modulation = Modulation(np.asarray(freqs), sensor.modulation.steps_rad[0])
    return Sensor(sensor.camera, modulation, sensor.noise, name=sensor.name), note


def _image_pair(
    path: Path, pair: NDArray[Any], right: str, freqs: tuple[float, float], scale_m: float
) -> Capture:
    if pair.ndim != 3 or pair.shape[0] != _CHANNELS or pair.shape[2] % 2:
        msg = f"im_pair must be (5, H, 2 W), got {pair.shape}"
        raise ValueError(msg)
    width = pair.shape[2] // 2
    left, distance = pair[:, :, :width], pair[0, :, width:]
    finite = np.isfinite(left)
    if (np.abs(left[finite] - 0.5) > 0.5 + 1e-6).any():
        msg = "the channels must lie in 0..1, got values outside"
        raise ValueError(msg)
    signal = 2.0 * np.where(finite, left, 0.5)[:4] - 1.0  # a lost channel gives a zero phasor
    z = signal[:2] + 1j * signal[2:]
    valid = finite.all(axis=0) & (np.abs(z) > 0).all(axis=0)
    z *= np.maximum(np.where(finite[4], left[4], 0.0), LEAST_AMPLITUDE)
    range_m = metres(distance, scale_m, 0.0)
    meaning = _meaning(range_m) if right == "auto" else right
    sensor, camera_note = _sensor(width, pair.shape[1], freqs)
    nothing = np.full_like(range_m, np.nan)
    return Capture(
        sensor=sensor,
        phasors=Phasors(z, valid=valid),
        depth=DepthMap(
            range_m if meaning == "camera" else nothing,
            amplitude=np.where(finite[4], left[4], np.nan),
        ),
        truth=Truth(range_m) if meaning == "truth" else None,
        reported=_reported(path, range_m.shape, scale_m),
        provenance={
            "source": "Su et al., CVPR 2018",
            "licence": "MIT",
            "format": "su2018",
            "file": path.name,
            "camera": camera_note,
            "convention": {
                "phasor": "z = amplitude (I + jQ), unit I + jQ; channels I40 I70 Q40 Q70",
                "offset_m": 0.0,
                "distance": "radial",
                "right": meaning,
                "right_decided_by": "2 cm steps" if right == "auto" else "caller",
                "amplitude": "40 MHz, scaled to 0..1, for both frequencies",
            },
        },
    )


def _meaning(range_m: NDArray[Any]) -> str:
    """Camera if every distance is a whole number of 2 cm steps, else truth."""
    steps = range_m[np.isfinite(range_m)].astype(np.float64) / QUANTUM_M
    # float32 metres below 10 m are good to 5e-7 m, which is 2.5e-5 of a step.
    on_grid = np.abs(steps - np.round(steps)) < 1e-3
    return "camera" if on_grid.size and on_grid.all() else "truth"


def _reported(path: Path, shape: tuple[int, ...], scale_m: float) -> dict[str, NDArray[Any]]:
    """The authors' network output beside the file, if it is there."""
    beside = path.with_name(path.name.replace("im_pair", "tofnet_output"))
    if beside == path or not beside.is_file():
        return {}
    with parsing(beside, "su2018", OSError):
        _, output = read_array(read_bytes(beside, limit=_LIMIT), "x")
        if output.shape != (1, *shape):
            msg = f"x must be (1, {shape[0]}, {shape[1]}) like its image pair, got {output.shape}"
            raise ValueError(msg)
    return {"tofnet": metres(output[0], scale_m)}


def _network_output(path: Path, output: NDArray[Any], freq_hz: float, scale_m: float) -> Capture:
    if output.ndim != 3 or output.shape[0] != 1:
        msg = f"x must be (1, H, W), got {output.shape}"
        raise ValueError(msg)
    preset, camera_note = sensor_of_size("opt8241", output.shape[2], output.shape[1])
    return Capture(
        sensor=depth_sensor(preset.camera, freq_hz, preset.name),
        depth=DepthMap(metres(output[0], scale_m)),
        provenance={
            "source": "Su et al., CVPR 2018, network output",
            "licence": "MIT",
            "format": "su2018",
            "file": path.name,
            "camera": camera_note,
            "convention": {"distance": "radial", "modulation": "nominal; not in the file"},
        },
    )
