"""Array aliases, and the checks that every frozen type makes once, when it is made."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

F32: TypeAlias = NDArray[np.float32]
F64: TypeAlias = NDArray[np.float64]
C64: TypeAlias = NDArray[np.complex64]
Bool: TypeAlias = NDArray[np.bool_]


def frozen(value: ArrayLike, dtype: DTypeLike, what: str, ndim: int) -> NDArray[Any]:
    """A read-only view of `value` as `dtype`, refused if its rank is wrong."""
    try:
        array = np.asarray(value, dtype=dtype)
    except (TypeError, ValueError) as error:
        msg = f"{what} must be an array of {np.dtype(dtype).name}, got {type(value).__name__}"
        raise ValueError(msg) from error
    if array.ndim != ndim or 0 in array.shape:
        msg = f"{what} must have {ndim} dimensions and no empty one, got shape {array.shape}"
        raise ValueError(msg)
    view = array.view()
    view.flags.writeable = False
    return view


def expect_shape(what: str, array: NDArray[Any], shape: tuple[int, ...]) -> None:
    """Refuse an array whose shape is not the one its siblings have."""
    if array.shape != shape:
        msg = f"{what} must have shape {shape}, got {array.shape}"
        raise ValueError(msg)


def frozen_mapping(value: Mapping[str, Any]) -> Mapping[str, Any]:
    return MappingProxyType(dict(value))


def valid_mask(valid: ArrayLike | None, shape: tuple[int, int]) -> Bool:
    """The given pixel mask, or all pixels."""
    mask = frozen(np.ones(shape, bool) if valid is None else valid, np.bool_, "valid", 2)
    expect_shape("valid", mask, shape)
    return mask


def set_fields(owner: object, **values: object) -> None:
    for name, value in values.items():
        object.__setattr__(owner, name, value)


def kernel_input(array: NDArray[Any]) -> NDArray[Any]:
    """The array as kernels get it, contiguous and read-only: another flavour compiles them anew.

    Parameters
    ----------
    array : ndarray
        Any array.

    Returns
    -------
    ndarray
        A read-only view, of a copy where `array` is not contiguous.
    """
    view = np.ascontiguousarray(array).view()
    view.flags.writeable = False
    return view
