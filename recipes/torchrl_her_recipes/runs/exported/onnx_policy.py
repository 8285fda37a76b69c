"""A policy that onnxruntime plays, as a TensorDict module."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from torchrl_her_recipes.runs.exported.card import KEYS
from torchrl_her_recipes.runs.exported.onnx_file import OnnxFile, need_onnx

_SILENT = 4  # onnxruntime's level of messages: fatal ones only; errors are raised anyway


class OnnxPolicy(TensorDictModuleBase):
    """Reads ``observation`` and ``desired_goal`` and writes ``action``, as a policy of a .pt file does.

    It has no weights that could be trained. onnxruntime plays it on the CPU, in one thread; actions come
    where observations are. It can be copied and sent to other processes.

    Args:
        file: from :func:`~torchrl_her_recipes.runs.exported.onnx_file.read_onnx`.

    Raises:
        ValueError: onnxruntime cannot load the graph.
        ImportError: onnx or onnxruntime is missing.
    """

    def __init__(self, file: OnnxFile) -> None:
        super().__init__()
        self.in_keys, self.out_keys = list(KEYS), ["action"]
        self.file = file
        self._session: Any = _session_of(file)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the actions [..., width], or integers [...].

        Raises:
            ValueError: an entry has another width.
        """
        inputs = [tensordict.get(key) for key in KEYS]
        card = self.file.card
        for key, value in zip(KEYS, inputs, strict=True):
            if value.shape[-1] != card.widths[key]:
                raise ValueError(
                    f"a policy of {card.task} reads {key} of width {card.widths[key]}, got {value.shape[-1]}"
                )
        return tensordict.set("action", self._actions(inputs))

    def _actions(self, inputs: list[Tensor]) -> Tensor:
        batch, card = inputs[0].shape[:-1], self.file.card
        if math.prod(batch) == 0:
            return inputs[0].new_zeros((*batch, *card.action_shape), dtype=getattr(torch, card.action_dtype))
        feed = {
            key: np.ascontiguousarray(value.detach().reshape(-1, value.shape[-1]).float().cpu().numpy())
            for key, value in zip(KEYS, inputs, strict=True)
        }
        (action,) = self._session.run(["action"], feed)
        return torch.from_numpy(action).to(inputs[0].device).reshape(*batch, *card.action_shape)

    def __getstate__(self) -> dict[str, Any]:  # sessions cannot be copied
        return {**super().__getstate__(), "_session": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)
        self._session = _session_of(self.file)


def _session_of(file: OnnxFile) -> Any:
    """A session over the very bytes that were checked: no path, so no other file is looked for."""
    _, runtime = need_onnx()
    options = runtime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1  # policies are small
    options.log_severity_level = _SILENT
    try:
        return runtime.InferenceSession(file.model, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime's own types, which have no common base of their own
        raise ValueError(
            f"onnxruntime cannot load this policy: {str(error).strip().splitlines()[0]}"
        ) from error
