"""Files whose headers claim gigabytes that are not there, one per place where a size stands.

Each writer returns the file and how to force its format.
"""

import struct
import zipfile
import zlib

import foreign_files as foreign

from toftools.io.native import write_capture
from toftools.io.open import open_capture
from toftools.sensors import sensor
from toftools.sim.analytic import analytic
from toftools.types import Scene, Shot


def claims_npy(folder):
    path = foreign.melexis_npy(folder)
    whole = path.read_bytes()
    header = str({"descr": "<f8", "fortran_order": False, "shape": (1 << 15, 1 << 17)}).encode()
    path.write_bytes(whole[:8] + struct.pack("<H", 118) + header.ljust(117) + b"\n" + whole[128:])
    return path, "melexis_npy"


def claims_npy_header(folder):
    path = foreign.melexis_npy(folder)
    whole = path.read_bytes()
    path.write_bytes(whole[:6] + b"\x02\x00" + struct.pack("<I", 0xFFFFFFF0) + whole[10:])
    return path, "melexis_npy"


def claims_mat_element(folder):
    path = foreign.su2018(folder, compress=False)
    whole = path.read_bytes()
    path.write_bytes(whole[:132] + struct.pack("<I", 0xFFFFFFF0) + whole[136:])
    return path, "su2018"


def claims_mat_dims(folder):
    path = foreign.su2018(folder, compress=False)
    whole = path.read_bytes()
    dims = struct.pack("<3i", 5, foreign.HEIGHT, 2 * foreign.WIDTH)
    assert whole.count(dims) == 1
    path.write_bytes(whole.replace(dims, struct.pack("<3i", 5, 1 << 15, 1 << 15)))
    return path, "su2018"


def claims_mat_stream(folder):
    """A zlib stream of 200 MB of zeros, in 200 kB."""
    path = foreign.su2018(folder)
    whole = path.read_bytes()
    packer = zlib.compressobj(9)
    start = struct.pack("<II", 14, 200 << 20)
    stream = packer.compress(start) + b"".join(packer.compress(bytes(1 << 20)) for _ in range(200))
    stream += packer.flush()
    path.write_bytes(whole[:128] + struct.pack("<II", 15, len(stream)) + stream)
    return path, "su2018"


def claims_h5(folder):
    import h5py

    path = foreign.espros_h5(folder)
    with h5py.File(path, "r+") as file:
        del file["frames_0"]
        file.create_dataset("frames_0", (3, 1 << 15, 1 << 16), "f8", chunks=(1, 64, 64))
    return path, "espros_h5"


def claims_native(folder):
    import h5py

    path = folder / "capture.h5"
    write_capture(path, open_capture(foreign.npz(folder)))
    with h5py.File(path, "r+") as file:
        del file["depth/range_m"]
        file.create_dataset("depth/range_m", (1 << 15, 1 << 16), "f4", chunks=(64, 64))
    return path, None


def claims_native_sensor(folder):
    """A sensor that fits the claim: only the length of the file gives it away."""
    import h5py

    path = folder / "capture.h5"
    write_capture(path, open_capture(foreign.npz(folder)))
    with h5py.File(path, "r+") as file:
        del file["depth"]
        if "valid" in file:
            del file["valid"]
        file["sensor"].attrs.update(width=16_384, height=16_384)
        n_freqs = len(file["sensor"].attrs["freqs_hz"])
        file.create_dataset("phasors", (n_freqs, 16_384, 16_384), "c8", chunks=(1, 64, 64))
    return path, None


def claims_native_links(folder):
    """One dataset under a thousand names."""
    import h5py

    path = folder / "capture.h5"
    capture = analytic(Scene("wall"))(Shot(sensor("deeptof:width=256,height=256"), noisy=False))
    write_capture(path, capture)
    with h5py.File(path, "r+") as file:
        for number in range(1000):
            file[f"reported/{number}"] = file["truth/range_m"]
    return path, None


def claims_png(folder):
    path = foreign.depth_png(folder)
    whole = path.read_bytes()
    head = b"IHDR" + struct.pack(">II", 60_000, 60_000) + whole[24:29]
    path.write_bytes(whole[:12] + head + struct.pack(">I", zlib.crc32(head)) + whole[33:])
    return path, "depth_png"


def claims_png_chunk(folder):
    path = foreign.depth_png(folder)
    whole = path.read_bytes()
    path.write_bytes(whole[:33] + struct.pack(">I", 0xFFFFFFF0) + whole[37:])
    return path, "depth_png"


def claims_ifm_chunk(folder):
    path = foreign.ifm_o3r(folder)
    whole = path.read_bytes()
    path.write_bytes(whole[:12] + struct.pack("<I", 0xFFFFFFF0) + whole[16:])
    return path, "ifm_o3r"


def claims_ifm_image(folder):
    path = foreign.ifm_o3r(folder)
    whole = path.read_bytes()
    path.write_bytes(whole[:24] + struct.pack("<2I", 1 << 16, 1 << 15) + whole[32:])
    return path, "ifm_o3r"


def claims_mkv_block(folder):
    """The first depth block of 4 + 96 bytes claims 2^40."""
    path = foreign.azure_mkv(folder)
    whole = path.read_bytes()
    assert b"\xa3\xe4\x81" in whole
    path.write_bytes(whole.replace(b"\xa3\xe4\x81", b"\xa3\x01\0\xff\xff\xff\xff\xff\xff\x81", 1))
    return path, "azure_mkv"


def claims_mkv_width(folder):
    """The tracks claim 65535 pixels a row where blocks hold 8."""
    path = foreign.azure_mkv(folder)
    whole = path.read_bytes()
    assert b"\xb0\x81\x08" in whole
    path.write_bytes(whole.replace(b"\xb0\x81\x08", b"\xb0\x81\xff"))
    return path, "azure_mkv"


def claims_npz_member(folder):
    path = foreign.npz(folder)
    whole = bytearray(path.read_bytes())
    at = whole.index(b"PK\x01\x02")
    whole[at + 20 : at + 28] = struct.pack("<II", 0xFFFFFFF0, 0xFFFFFFF0)
    path.write_bytes(whole)
    return path, "npz"


def claims_npz_stream(folder):
    """A member that says 400 MB and deflates to 400 MB of zeros."""
    path = folder / "bomb.npz"
    packed = zipfile.ZIP_DEFLATED
    with (
        zipfile.ZipFile(path, "w", packed) as archive,
        archive.open("range_m.npy", "w") as member,
    ):
        for _ in range(100):
            member.write(bytes(4 << 20))
    return path, "npz"


def claims_transient_array(folder):
    """The number format of the bins says 2^34 of them; the member is short."""
    path = foreign.transient(folder)
    with zipfile.ZipFile(path) as archive:
        members = {info.filename: archive.read(info) for info in archive.infolist()}
    whole = members["values.npy"]
    header = str({"descr": "<f4", "fortran_order": False, "shape": (1 << 20, 128, 128)})
    members["values.npy"] = whole[:10] + header.ljust(117).encode() + b"\n" + whole[128:]
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return path, "transient"


def claims_transient_h5(folder):
    import h5py

    path = foreign.transient(folder, suffix=".h5")
    with h5py.File(path, "r+") as file:
        del file["values"]
        file.create_dataset("values", (1 << 12, 1 << 9, 1 << 8), "f4", chunks=(64, 64, 64))
    return path, "transient"


def claims_transient_sparse(folder):
    """Two entries a billion bins apart."""
    index = [[0, 0], [0, 1], [0, 1 << 30]]
    path = foreign.npz(folder, values=[1.0, 1.0], index=index)
    return path, "transient:axes=sparse,bin_m=1e-3,width=64,height=64"


def claims_transient_words(folder):
    """A description of 200 MB of blanks."""
    path = foreign.transient(folder)
    with zipfile.ZipFile(path) as archive:
        members = {info.filename: archive.read(info) for info in archive.infolist()}
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in members.items():
            blank = bytes(1 << 20).replace(b"\0", b" ")
            with archive.open(name, "w") as member:
                member.write(content)
                for _ in range(200 if name.endswith(".json") else 0):
                    member.write(blank)
    return path, "transient"


CLAIMS = [value for name, value in sorted(globals().items()) if name.startswith("claims_")]
