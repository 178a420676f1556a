"""Small recordings in every foreign format, written by independent little writers.

They hold planted numbers, so that readers can be checked without anybody's data.
"""

import json
import struct
from pathlib import Path

import numpy as np

WIDTH, HEIGHT = 8, 6
RANGE_M = np.linspace(0.5, 3.4, WIDTH * HEIGHT).reshape(HEIGHT, WIDTH)
AMPLITUDE = np.linspace(100, 400, WIDTH * HEIGHT).reshape(HEIGHT, WIDTH)
C_M_S = 299_792_458.0  # written out here: readers must not share a mistake with their test


def phase(range_m, freq_hz):
    return 4 * np.pi * freq_hz * np.asarray(range_m) / C_M_S


def su2018(folder, *, range_m=RANGE_M, right_m=None, tofnet_m=None, compress=True, lost=()):
    """Image pair; pixels in `lost` have NaN signal."""
    from scipy.io import savemat

    left = [0.5 + 0.5 * part(phase(range_m, f)) for part in (np.cos, np.sin) for f in (40e6, 70e6)]
    left.append(AMPLITUDE / AMPLITUDE.max())
    left = np.stack(left)
    for pixel in lost:
        left[(slice(4), *pixel)] = np.nan
    right = np.broadcast_to((range_m if right_m is None else right_m) / 10, left.shape)
    path = Path(folder) / "im_pair_000009.mat"
    savemat(path, {"im_pair": np.concatenate([left, right], axis=2)}, do_compression=compress)
    if tofnet_m is not None:
        beside = Path(folder) / "tofnet_output_000009.mat"
        savemat(beside, {"x": np.float32(tofnet_m / 10)[None]}, do_compression=compress)
    return path


def melexis_npy(folder, *, sign=1, offset_m=0.0, freq_hz=60e6, vendor=True):
    """Six files; the fixed pattern of each pair of taps cancels in its difference."""
    pattern = np.arange(WIDTH * HEIGHT).reshape(HEIGHT, WIDTH)
    for angle in (0, 90, 180, 270):
        measured = sign * phase(RANGE_M + offset_m, freq_hz)
        image = AMPLITUDE / 2 * np.cos(measured - np.radians(angle)) + pattern
        np.save(Path(folder) / f"Scene_phase{angle}_avg.npy", image)
    if vendor:
        np.save(Path(folder) / "Scene_dist_avg.npy", 1000 * RANGE_M)
        np.save(Path(folder) / "Scene_amp_avg.npy", AMPLITUDE)
    return Path(folder) / "Scene_phase90_avg.npy"


AZURE = {"cx": 0.5125, "cy": 0.5175, "fx": 0.4925, "fy": 0.495, "k": (0.5, -0.02, -0.003, 0.9,
         0.08, -0.014), "p1": 2e-5, "p2": -7e-5}  # fmt: skip


def azure_calibration():
    depth = AZURE
    parameters = [depth["cx"], depth["cy"], depth["fx"], depth["fy"], *depth["k"], 0, 0,
                  depth["p2"], depth["p1"]]  # fmt: skip
    color = {"Purpose": "CALIBRATION_CameraPurposePhotoVideo", "Intrinsics": {}}
    camera = {
        "Purpose": "CALIBRATION_CameraPurposeDepth",
        "Intrinsics": {"ModelParameters": parameters},
    }
    return json.dumps({"CalibrationInformation": {"Cameras": [color, camera]}}).encode()


def azure_mkv(
    folder, *, width=WIDTH, height=HEIGHT, z_mm=None, frames=2, attach=True, title="DEPTH"
):
    """Matroska with DEPTH and IR tracks; frame n is z + n millimetres."""
    import av

    path = Path(folder) / "recording.mkv"
    if z_mm is None:
        z_mm = np.arange(width * height).reshape(height, width) % 4000
    # Matroska takes 16-bit grey only in its Video-for-Windows wrapping, as the device writes it.
    raw = {"allow_raw_vfw": "1"}
    with av.open(str(path), "w", format="matroska", options=raw) as container:
        streams = []
        for name in (title, "IR"):
            stream = container.add_stream("rawvideo", rate=5)
            stream.width, stream.height, stream.pix_fmt = width, height, "gray16be"
            stream.metadata["title"] = name
            streams.append(stream)
        if attach:
            container.add_attachment("calibration.json", "text/plain", azure_calibration())
        container.start_encoding()
        for number in range(frames):
            for stream, image in zip(streams, (z_mm + number, z_mm * 2), strict=True):
                packet = av.Packet(image.astype(">u2").tobytes())
                packet.stream, packet.pts, packet.dts = stream, number, number
                packet.time_base = stream.time_base
                container.mux(packet)
    return path


def adi_bin(folder, *, width=WIDTH, height=HEIGHT):
    path = Path(folder) / "out_depth_.bin"
    millimetres = np.round(1000 * RANGE_M) if width == WIDTH else np.full((height, width), 700)
    millimetres.astype("<u2").tofile(path)
    (millimetres // 2).astype("<u2").tofile(Path(folder) / "out_ir_.bin")
    return path


def ifm_chunk(kind, width, height, content, meta=None, *, version=3):
    text = json.dumps(meta).encode() + b"\0" if meta is not None else b""
    header = 48 + len(text)
    fields = (kind, header + len(content), header, version, width, height, 2, 0, 7, 0, 0, 0)
    return struct.pack("<12I", *fields) + text + content


IFM_CAMERA = (124.0, 125.0, 4.0, 3.0, 0.0, -0.2, 0.05, 1e-3, -2e-3, -5e-3)


def ifm_calibration(model=1):
    empty = struct.pack("<I32f", 0, *[0.0] * 32)
    inverse = struct.pack("<I32f", model, *IFM_CAMERA, *[0.0] * 22)
    return struct.pack("<I2f3f6f", 1, *[0.0] * 11) + empty + inverse


def ifm_o3r(folder, *, model=1):
    path = Path(folder) / "frame.data"
    counts = np.round(RANGE_M / 1e-3).astype("<u2")
    counts[0, 0] = 0
    metres = {"DistanceResolution": 1e-3}
    amplitude = np.round(AMPLITUDE).astype("<u2").tobytes()
    size = (WIDTH, HEIGHT)
    path.write_bytes(
        b"0000star"
        + ifm_chunk(100, *size, counts.tobytes(), metres)
        + ifm_chunk(105, *size, np.full((HEIGHT, WIDTH), 3, "<u2").tobytes(), metres)
        + ifm_chunk(101, *size, amplitude, {"AmplitudeResolution": 0.5})
        + ifm_chunk(300, *size, bytes(WIDTH * HEIGHT), version=2)
        + ifm_chunk(420, *size, ifm_calibration(model), version=2)
        + b"stop\r\n"
    )
    return path


def espros_h5(folder):
    import h5py

    path = Path(folder) / "amplitude.h5"
    frames = np.stack([AMPLITUDE, AMPLITUDE + 1])
    frames[0, 0, :2] = 2047.5 * np.sqrt(2), 0
    with h5py.File(path, "w") as file:
        file["frames_0"] = frames
        file["timestamps"] = np.arange(2.0)
        file.attrs.update(mod_frequency=20e6, image_type="Amplitude")
    return path


def depth_png(folder):
    import cv2

    path = Path(folder) / "depth.png"
    millimetres = np.round(1000 * RANGE_M).astype(np.uint16)
    millimetres[0, 0] = 0
    path.write_bytes(cv2.imencode(".png", millimetres)[1].tobytes())
    return path


def npz(folder, **arrays):
    path = Path(folder) / "answer.npz"
    np.savez(path, **(arrays or {"range_m": RANGE_M.astype(np.float32), "amplitude": AMPLITUDE}))
    return path


TRANSIENT_BINS, TRANSIENT_BIN_M = 160, 0.05


def transient_bins():
    """A lone return per pixel and a weak floor that ends well before the axis does."""
    bins = np.zeros((TRANSIENT_BINS, HEIGHT, WIDTH), np.float32)
    rows, columns = np.indices((HEIGHT, WIDTH))
    bins[(2 * RANGE_M / TRANSIENT_BIN_M).astype(int), rows, columns] = AMPLITUDE / 400
    bins[145:150] += 0.001
    return bins


def transient(folder, *, suffix=".npz"):
    """A transient file of our own; foreign ones are in test_adapt."""
    from toftools.io.transients import write_transient
    from toftools.transient import Transient

    path = Path(folder) / f"transient{suffix}"
    write_transient(path, Transient(transient_bins(), TRANSIENT_BIN_M))
    return path


MAKERS = {
    "su2018": su2018,
    "melexis_npy": melexis_npy,
    "azure_mkv": azure_mkv,
    "adi_bin": adi_bin,
    "ifm_o3r": ifm_o3r,
    "espros_h5": espros_h5,
    "depth_png": depth_png,
    "npz": npz,
    "transient": transient,
}
FORCED = {"adi_bin": f"adi_bin:width={WIDTH},height={HEIGHT}"}
"""How to force the format where its defaults do not fit the small file."""
