"""Run an ONNX network: onnxruntime, or OpenCV's dnn where that is not installed.

Large frames go through in tiles that overlap, so that memory does not grow with them; what a
network takes from the mean of the frame it then takes from the mean of the tile.
"""

import importlib.util
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import numpy as np

from toftools._native import threads
from toftools.types import F32

TILE, OVERLAP = 768, 64
"""Rows and columns of a tile, and how many of them it shares with the next; multiples of 32."""
Engine = Callable[[Mapping[str, F32]], F32]


def engine(data: bytes, name: str) -> Engine:
    """A network ready to run.

    Parameters
    ----------
    data : bytes
        ONNX file.
    name : str
        For messages.

    Returns
    -------
    callable
        Takes inputs (1, C, H, W) by name, gives the output (1, D, H, W).

    Raises
    ------
    ValueError
        If the network cannot be built.
    """
    build = _onnxruntime if importlib.util.find_spec("onnxruntime") else _opencv
    with _one_sentence(f"cannot build the network {name}"):
        ready = build(data)

    def run(inputs: Mapping[str, F32]) -> F32:
        with _one_sentence(f"the network {name} does not take the input that it names"):
            out = ready(inputs)
        whole = next(iter(inputs.values())).shape[2:]
        if out.ndim != 4 or out.shape[0] != 1 or out.shape[2:] != whole:
            msg = f"the network {name} answers {out.shape}, wanted an image of {whole} pixels"
            raise ValueError(msg)
        return out

    return run


@contextmanager
def _one_sentence(said: str) -> Iterator[None]:
    """Either library raises what it likes, over many lines."""
    try:
        yield
    except Exception as error:
        text = " ".join(str(error).split())
        msg = f"{said}: {text[:200]}"
        raise ValueError(msg) from error


def _onnxruntime(data: bytes) -> Engine:
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads, options.inter_op_num_threads = threads(), 1
    options.log_severity_level = 3
    # Threads that spin after a frame would take the cores from the kernels that prepare the next.
    options.add_session_config_entry("session.force_spinning_stop", "1")
    session = onnxruntime.InferenceSession(data, options, providers=["CPUExecutionProvider"])

    def run(inputs: Mapping[str, F32]) -> F32:
        return np.asarray(session.run(None, dict(inputs))[0])

    return run


def _opencv(data: bytes) -> Engine:
    import cv2

    net: Any = cv2.dnn.readNetFromONNX(np.frombuffer(data, np.uint8))

    def run(inputs: Mapping[str, F32]) -> F32:
        for name, value in inputs.items():
            net.setInput(value, name)
        return np.asarray(net.forward(), np.float32)

    return run


def tiled(run: Engine, inputs: Mapping[str, F32], steps: Mapping[str, int], multiple: int) -> F32:
    """Pad a frame to what a network takes, run it in tiles if it is large, and cut the padding off.

    Parameters
    ----------
    run : callable
        The network.
    inputs : mapping of str to ndarray, (C, H, W) or (C, H / s, W / s)
        The first is the full frame; others may be s times smaller.
    steps : mapping of str to int
        s of each.
    multiple : int
        Rows and columns are padded to a multiple of it.

    Returns
    -------
    ndarray, (D, H, W)
        Output.
    """
    whole = next(iter(inputs.values()))
    height, width = whole.shape[1:]
    rows, cols = (-(-n // multiple) * multiple for n in (height, width))
    padded = {name: _padded(a, rows // steps[name], cols // steps[name])
              for name, a in inputs.items()}  # fmt: skip
    if max(rows, cols) <= TILE + OVERLAP:
        out = run({name: a[None] for name, a in padded.items()})[0]
        return np.ascontiguousarray(out[:, :height, :width])
    out = np.empty((0,), np.float32)
    for top, bottom, first, last in _cuts(rows):
        for left, right, begin, end in _cuts(cols):
            part = {
                name: np.ascontiguousarray(
                    a[None, :, top // s : bottom // s, left // s : right // s]
                )
                for name, a in padded.items()
                for s in [steps[name]]
            }
            got = run(part)[0]
            if not out.size:
                out = np.empty((got.shape[0], rows, cols), np.float32)
            out[:, first:last, begin:end] = got[
                :, first - top : last - top, begin - left : end - left
            ]
    return np.ascontiguousarray(out[:, :height, :width])


def _cuts(size: int) -> list[tuple[int, int, int, int]]:
    """Begin and end of every tile, and of the part of it that counts."""
    count = max(-(-(size - OVERLAP) // (TILE - OVERLAP)), 1)
    found = []
    for i in range(count):
        begin = i * (TILE - OVERLAP)
        end = min(begin + TILE, size)
        first = 0 if i == 0 else begin + OVERLAP // 2
        last = size if i == count - 1 else end - OVERLAP // 2
        found.append((begin, end, first, last))
    return found


def _padded(array: F32, rows: int, cols: int) -> F32:
    more = rows - array.shape[1], cols - array.shape[2]
    if not any(more):
        return array
    return np.pad(array, ((0, 0), (0, more[0]), (0, more[1])), mode="edge")
