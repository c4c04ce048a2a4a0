"""Claim: sums over segments are those of a plain sum, whatever their sizes, and repeat to the bit."""

import numpy as np
import pytest
import torch

from diffvbd.ops import sums
from diffvbd.testing import generator, tolerance


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("sizes", [[0, 3, 0, 1], [1] * 40, [5000, 20], [2048], [100] * 6, [2000] + [30] * 9])
def test_segment_sum(device: str, sizes: list[int], dtype: torch.dtype) -> None:
    rng = generator("segments", *sizes)
    values = torch.as_tensor(rng.standard_normal((2, sum(sizes), 3)), dtype=dtype, device=device)
    order = torch.as_tensor(rng.permutation(sum(sizes)).astype(np.int32), device=device)
    ptr = torch.as_tensor(np.cumsum([0, *sizes]).astype(np.int32), device=device)
    got = sums.segment_sum(values, order, ptr)
    rows = values.double().cpu()[:, order.cpu().long()].split(sizes, 1)
    expected = torch.stack([r.sum(1) for r in rows], 1)
    atol = tolerance("long_sum" if dtype == torch.float64 else "long_sum_float32")
    torch.testing.assert_close(got.double().cpu(), expected, rtol=0, atol=atol)
    assert torch.equal(got, sums.segment_sum(values, order, ptr))
