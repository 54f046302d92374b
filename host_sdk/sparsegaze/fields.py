# SPDX-License-Identifier: Apache-2.0
"""Integers into the fields of a stored structure: refused, not wrapped, when they do not fit."""

import numpy as np

from .errors import ModelError


def put(target, field, value, shape):
    """Assign integers of the given shape to the leading part of a field of a numpy structure.

    Raises ModelError for another shape, for what is no integer and for values that the field cannot hold.
    """
    value = np.asarray(value)
    if value.shape != shape or not np.issubdtype(value.dtype, np.integer):
        raise ModelError(
            f"{field} must be integers of shape {shape}, not {value.dtype} {value.shape}",
            "this is a bug: report it with the recording",
        )
    limits = np.iinfo(target[field].dtype)
    if value.size and (value.min() < limits.min or value.max() > limits.max):
        raise ModelError(
            f"{field} reaches {value.min()}..{value.max()}; it holds {limits.min}..{limits.max}",
            "this is a bug: report it with the recording",
        )
    if shape == ():
        target[field] = value
    else:
        target[field][(..., *(slice(0, length) for length in shape[-1:]))] = value
