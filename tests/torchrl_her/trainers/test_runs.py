"""Runs side by side learn what each would learn alone."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from torchrl_her.trainers import clip_by_run


def test_clipping_by_run_is_clipping_each_run() -> None:
    gradients = [torch.randn(2, 3, 4), torch.randn(2, 1, 4)]
    gradients[0][0] *= 100.0
    gradients[0][1], gradients[1][1] = gradients[0][1] * 0.01, gradients[1][1] * 0.01
    stacked = [nn.Parameter(torch.zeros_like(gradient)) for gradient in gradients]
    for parameter, gradient in zip(stacked, gradients, strict=True):
        parameter.grad = gradient.clone()
    norms = clip_by_run(stacked, 3.0, runs=2)
    for run in range(2):
        single = [nn.Parameter(torch.zeros_like(gradient[run])) for gradient in gradients]
        for parameter, gradient in zip(single, gradients, strict=True):
            parameter.grad = gradient[run].clone()
        assert norms[run].item() == pytest.approx(nn.utils.clip_grad_norm_(single, 3.0).item(), rel=1e-5)
        for parameter, one in zip(stacked, single, strict=True):
            assert torch.allclose(parameter.grad[run], one.grad, rtol=1e-5)
    assert torch.equal(stacked[0].grad[1], gradients[0][1])  # short enough: not touched
