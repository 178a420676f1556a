"""Native libraries from wheels: LLVM for Dr.Jit, libusb for Open3D; no root, no compiler.

The only place that imports mitsuba and open3d. Dr.Jit needs LLVM 16 or newer: older ones abort
the process in the middle of a kernel, so they are refused here, where a sentence can still be
said. Open3D's Linux wheel is linked to libusb-1.0.so.0 without bringing it. Elsewhere than on
Linux both packages find or carry what they need, and nothing is done.
"""

import ctypes
import importlib.metadata
import importlib.util
import os
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

LLVM_VARIABLE = "DRJIT_LIBLLVM_PATH"
LLVM_WHEEL = "karellen-llvm-core"
LLVM_OLDEST = 16
_LLVM_ADVICE = (
    f"pip install {LLVM_WHEEL}, or set {LLVM_VARIABLE} to a libLLVM of version {LLVM_OLDEST} "
    "or newer"
)
_GPU_ADVICE = "it needs an NVIDIA GPU and its driver; without them trace on the CPU (no gpu=true)"


def prepare_llvm() -> str | None:
    """Point Dr.Jit at a libLLVM that works; call it before mitsuba or drjit is imported.

    Returns
    -------
    str or None
        The library Dr.Jit will load: the user's own ``DRJIT_LIBLLVM_PATH`` if set, else the one
        of the wheel karellen-llvm-core; None where Dr.Jit's own search must do (not on Linux).

    Raises
    ------
    RuntimeError
        If the library is missing, cannot be loaded, or is too old.
    """
    own = os.environ.get(LLVM_VARIABLE)
    library = own or _wheel_llvm()
    if library is None:
        if sys.platform != "linux":
            return None
        msg = f"found no libLLVM, which Mitsuba's llvm variants need: {_LLVM_ADVICE}"
        raise RuntimeError(msg)
    version = llvm_version(library)
    if version < (LLVM_OLDEST, 0, 0):
        found = "older than 16" if version == (0, 0, 0) else ".".join(map(str, version))
        msg = f"{library} is LLVM {found}, with which Dr.Jit aborts: {_LLVM_ADVICE}"
        raise RuntimeError(msg)
    os.environ[LLVM_VARIABLE] = library
    return library


def llvm_version(library: str) -> tuple[int, int, int]:
    """Version of a libLLVM.

    Parameters
    ----------
    library : str
        Path or name of the shared library.

    Returns
    -------
    tuple of int
        Major, minor, patch; (0, 0, 0) for the versions before 16, which cannot tell.

    Raises
    ------
    RuntimeError
        If the library cannot be loaded.
    """
    try:
        llvm = ctypes.CDLL(library)
    except OSError as error:
        msg = f"cannot load {library} as libLLVM ({error}): {_LLVM_ADVICE}"
        raise RuntimeError(msg) from error
    if not hasattr(llvm, "LLVMGetVersion"):
        return 0, 0, 0
    parts = [ctypes.c_uint(0) for _ in range(3)]
    llvm.LLVMGetVersion(*map(ctypes.byref, parts))
    major, minor, patch = (int(part.value) for part in parts)
    return major, minor, patch


def _wheel_llvm() -> str | None:
    """The libLLVM that pip installed, by the wheel's own list of files."""
    try:
        listed = importlib.metadata.files(LLVM_WHEEL) or []
    except importlib.metadata.PackageNotFoundError:
        return None
    # The wheel lists links beside the library (libLLVM.so, libLLVM-23.so) that some installers
    # leave out; they resolve to the same file, so any that exists will do.
    paths = [Path(str(file.locate())).resolve() for file in listed if file.match("libLLVM*.so*")]
    return next((str(path) for path in paths if path.is_file()), None)


def prepare_libusb() -> str | None:
    """Load libusb for Open3D, the system's or the wheel's; call it before open3d is imported.

    Returns
    -------
    str or None
        What was loaded; None where Open3D does not need it (not on Linux).

    Raises
    ------
    RuntimeError
        If there is neither.
    """
    if sys.platform != "linux":
        return None
    candidates = ["libusb-1.0.so.0"]
    spec = importlib.util.find_spec("libusb_package")
    if spec is not None and spec.origin is not None:
        candidates.append(str(Path(spec.origin).parent / "libusb-1.0.so"))
    for library in candidates:
        try:
            # What is loaded under the SONAME that Open3D asks for is not searched again.
            ctypes.CDLL(library, mode=ctypes.RTLD_GLOBAL)
        except OSError:
            continue
        return library
    msg = "found no libusb-1.0.so.0, which Open3D needs: pip install libusb-package"
    raise RuntimeError(msg)


def import_mitsuba(variant: str = "llvm_ad_mono") -> Any:  # noqa: ANN401 - a module
    """Mitsuba with a variant set.

    Parameters
    ----------
    variant : str
        Mitsuba variant.

    Returns
    -------
    module
        ``mitsuba``.

    Raises
    ------
    RuntimeError
        If Mitsuba or the LLVM it needs is not there.
    ValueError
        If there is no such variant.
    """
    if variant.startswith("llvm"):
        prepare_llvm()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            import mitsuba
        except ImportError as error:
            msg = f"cannot import mitsuba ({error}): pip install 'mitsuba>=3.9,<3.10'"
            raise RuntimeError(msg) from error
    if variant not in mitsuba.variants():
        msg = f"got Mitsuba variant {variant!r}, wanted one of {', '.join(mitsuba.variants())}"
        raise ValueError(msg)
    if mitsuba.variant() != variant:
        try:
            mitsuba.set_variant(variant)
        except ImportError as error:
            advice = _LLVM_ADVICE if variant.startswith("llvm") else _GPU_ADVICE
            msg = f"Mitsuba cannot use its variant {variant}: {advice}"
            raise RuntimeError(msg) from error
    return mitsuba


def limit_threads(count: int) -> None:
    """Leave cores to other processes.

    Parameters
    ----------
    count : int
        Threads that kernels of this process may use.
    """
    import numba

    import_mitsuba()
    import drjit

    drjit.set_thread_count(count)
    numba.set_num_threads(min(count, numba.config.NUMBA_NUM_THREADS))


@contextmanager
def two_threads_at_least() -> Iterator[None]:
    """Let an imported Mitsuba read files: its OpenEXR waits for ever if Dr.Jit has one thread."""
    import drjit

    before = drjit.thread_count()
    drjit.set_thread_count(max(before, 2))
    try:
        yield
    finally:
        drjit.set_thread_count(before)


def threads() -> int:
    """Threads that kernels of this process may use.

    Returns
    -------
    int
        All cores, unless `limit_threads` has said less.
    """
    import numba

    return int(numba.get_num_threads())


def import_open3d() -> Any:  # noqa: ANN401 - a module
    """Open3D, with the libusb it needs.

    Returns
    -------
    module
        ``open3d``.

    Raises
    ------
    RuntimeError
        If Open3D or its libusb is not there.
    """
    prepare_libusb()
    _leave_tbb_alone()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            import open3d
        except (ImportError, OSError) as error:
            msg = f"cannot import open3d ({error}): pip install open3d-cpu, or open3d off Linux x86"
            raise RuntimeError(msg) from error
    return open3d


def _leave_tbb_alone() -> None:
    """Let numba take OpenMP first: it would find the TBB of Open3D and complain about its age."""
    layers = ["omp", "workqueue", "tbb"]
    if "numba" in sys.modules:
        sys.modules["numba"].config.THREADING_LAYER_PRIORITY = layers
    os.environ.setdefault("NUMBA_THREADING_LAYER_PRIORITY", " ".join(layers))
