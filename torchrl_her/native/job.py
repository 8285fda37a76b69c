"""Arguments of the compiled gradient steps: the structures of ``steps.cpp``, field by field."""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from enum import IntEnum
from functools import lru_cache
from typing import Any

import torch


class Algorithm(IntEnum):
    """Algorithms that have compiled gradient steps."""

    DDPG = 0
    TD3 = 1
    SAC = 2
    DQN = 3
    TQC = 4


STOCHASTIC = (Algorithm.SAC, Algorithm.TQC)  # algorithms with a stochastic actor and a temperature


class Activation(IntEnum):
    """Function that follows a layer."""

    NONE = 0
    RELU = 1
    TANH = 2
    ELU = 3


class Norm(IntEnum):
    """Normalization of a layer's outputs, before the activation."""

    PLAIN = 0
    LAYERNORM = 1
    BATCHNORM = 2


class Layer(ctypes.Structure):
    """Layer of a network: its widths, and how many inputs join the network here (in a critic, the action).

    A layer with 0 inputs normalizes the network's input.
    """

    _fields_ = [(name, ctypes.c_int) for name in ("inputs", "outputs", "joined", "activation", "norm")]


@dataclass(frozen=True)
class Structures:
    """The ctypes structures for one floating-point type."""

    dtype: torch.dtype
    real: Any
    tensors: Any
    entry: Any
    adam: Any
    job: Any


@lru_cache
def structures(dtype: torch.dtype) -> Structures:
    """Returns the ctypes structures of ``steps.cpp`` for float32 or float64.

    Example:
        >>> structures(torch.float64).real.__name__
        'c_double'
    """
    real = ctypes.c_float if dtype == torch.float32 else ctypes.c_double
    pointer = ctypes.c_void_p

    def structure(name: str, *fields: tuple[str, Any]) -> Any:
        kinds = [(field, kind) for fields_, kind in fields for field in fields_.split()]
        return type(name, (ctypes.Structure,), {"_fields_": kinds})

    tensors = structure(
        "Tensors", ("rows columns", ctypes.c_int), ("value target first_moment second_moment steps", pointer)
    )
    entry = structure("Entry", ("data", pointer), ("width", ctypes.c_int))
    adam = structure("Adam", ("size spread beta2 rest1 rest2 epsilon", real))
    job = structure(
        "Job",
        ("algorithm runs critics batch first_step steps rows actions threads", ctypes.c_int),
        ("actor_layers critic_layers actor_tensors critic_tensors bfloat16", ctypes.c_int),
        ("target_critics dropped counts", ctypes.c_int),
        ("actor critic", ctypes.POINTER(Layer)),
        ("tensors", ctypes.POINTER(tensors)),
        ("entries", ctypes.c_int),
        ("seen next_seen", ctypes.POINTER(entry)),
        ("action choice reward terminated weight discount noise own_noise low high idle drawn", pointer),
        (
            "gamma least greatest penalty saturation max_norm tau policy_noise noise_limit target_entropy",
            real,
        ),
        ("adam", ctypes.POINTER(adam)),
        ("priorities losses", pointer),
    )
    return Structures(dtype, real, tensors, entry, adam, job)
