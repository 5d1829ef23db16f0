"""Turns nested values into what ``torch.load(weights_only=True)`` reads, and back; knows nothing of what they mean."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch as th

__all__ = ["PLAIN", "pack", "unpack"]

PLAIN = (bool, int, float, str)

_ARRAY, _DEQUE, _TUPLE = "__array__", "__deque__", "__tuple__"


def pack(value: Any, where: str = "value") -> Any:
    """Return the value with arrays as tensors of bytes, and nothing but mappings, lists, numbers, texts and tensors.

    :param value: of those, and of tuples, deques, NumPy arrays and scalars
    :param where: it stands, for the message
    :raises TypeError: naming the part that is anything else
    """
    if value is None or type(value) in PLAIN:  # not an enumeration's member, which is pickled with its class
        return value
    if isinstance(value, th.Tensor):
        return value.detach()
    if isinstance(value, np.generic) and type(value.item()) in PLAIN:
        return value.item()
    if isinstance(value, np.ndarray) and value.dtype.kind in "biuf":
        flat = np.ascontiguousarray(value).reshape(-1).view(np.uint8)  # the same memory, where it can be
        data = th.from_numpy(flat if flat.flags.writeable else flat.copy())
        return {_ARRAY: value.dtype.str, "shape": list(value.shape), "bytes": data}
    if isinstance(value, Mapping):
        return {pack(key, where): pack(item, f"{where}[{key!r}]") for key, item in value.items()}
    if isinstance(value, list | tuple | deque):
        items = [pack(item, f"{where}[{index}]") for index, item in enumerate(value)]
        if isinstance(value, deque):
            return {_DEQUE: items, "maxlen": value.maxlen}
        return {_TUPLE: items} if isinstance(value, tuple) else items
    raise TypeError(f"{where} is a {type(value).__name__}, which a checkpoint cannot hold")


def unpack(value: Any) -> Any:
    """Return what :func:`pack` was given.

    :param value: packed
    :raises ValueError: if it was damaged
    """
    if isinstance(value, dict):
        if _ARRAY in value:
            flat = value["bytes"].numpy().view(np.dtype(value[_ARRAY]))
            return flat.reshape(value["shape"]).copy()
        if _DEQUE in value:
            return deque(map(unpack, value[_DEQUE]), value["maxlen"])
        if _TUPLE in value:
            return tuple(map(unpack, value[_TUPLE]))
        return {key: unpack(item) for key, item in value.items()}
    if isinstance(value, th.Tensor):
        return value.clone()  # the file may be mapped into memory
    return [unpack(item) for item in value] if isinstance(value, list) else value
