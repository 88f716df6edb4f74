"""Values of both kinds, tensors and NumPy arrays, made and compared the same way."""

from __future__ import annotations

import numpy as np
import pytest
import torch


class Kind:
    """Makes one kind of array from nested lists and compares with them: type, dtype, shape and every value."""

    def __init__(self, name, class_, library):
        self.name, self.class_, self.library = name, class_, library

    def __call__(self, values, dtype="float32"):
        make = torch.tensor if self.library is torch else np.array
        return make(values, dtype=getattr(self.library, dtype))

    def zeros(self, *shape, dtype="float32"):
        return self.library.zeros(shape, dtype=getattr(self.library, dtype))

    def column(self, *values, dtype="float32"):
        """T x 1 from T numbers."""
        return self([[value] for value in values], dtype)

    def check(self, found, values, dtype="float32"):
        assert isinstance(found, self.class_)
        assert found.dtype == getattr(self.library, dtype)
        assert tuple(found.shape) == np.shape(values)
        assert found.tolist() == values


@pytest.fixture(params=["torch", "numpy"])
def kind(request):
    """The test runs twice: with tensors and with NumPy arrays."""
    if request.param == "torch":
        return Kind("torch", torch.Tensor, torch)
    return Kind("numpy", np.ndarray, np)


@pytest.fixture
def weight():
    return torch.tensor([2.0, 3.0], requires_grad=True)


@pytest.fixture
def gradient(weight):
    """The gradient of a loss for `weight`."""

    def of(loss):
        weight.grad = None
        loss.backward(retain_graph=True)
        return weight.grad.tolist()

    return of
