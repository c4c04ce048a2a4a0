"""A part of a list of pairs keeps the order of its pairs and of those of each corner point, in lists of any length."""

import pytest
import torch
from torch import Tensor

from diffvbd.ops import contact_start

# pairs, room for them, corner points of all scenes; on CUDA short lists go another way (csrc/cuda/compact_list.cu)
SIZES = {"none": (0, 0, 7), "empty": (0, 200, 7), "few": (300, 300, 40), "room": (2_900, 5_000, 900),
         "limit": (32_768, 32_768, 4_096), "pairs": (33_000, 40_000, 900), "corners": (300, 400, 4_097)}  # fmt: skip


def some_list(pairs: int, room: int, corners: int) -> tuple[Tensor, ...]:
    """pairs, constants, ptr and entry of pairs of random corner points, as of ops.detect.contact_detect."""
    generator = torch.Generator().manual_seed(pairs + corners)
    rows = torch.full((room, 6), -1, dtype=torch.int32)
    points = torch.randint(corners, (pairs, 4), generator=generator)
    rows[:pairs, :4] = points
    rows[:pairs, 4:] = 0
    constants = torch.rand((room, 8), generator=generator, dtype=torch.float64)
    order = torch.sort(points.flatten(), stable=True).indices  # entries of a corner point in ascending order
    ptr = torch.cat([torch.zeros(1, dtype=torch.int64), torch.bincount(points.flatten(), minlength=corners).cumsum(0)])
    entry = torch.full((4 * room,), -1, dtype=torch.int32)
    entry[: 4 * pairs] = order
    return rows, constants, ptr.to(torch.int32), entry


@pytest.mark.parametrize("share", (0.0, 0.3, 1.0))
@pytest.mark.parametrize("size", SIZES)
def test_a_part_of_a_list(size: str, share: float, device: str) -> None:
    count, room, corners = SIZES[size]
    listed = some_list(count, room, corners)
    keep = torch.rand((room,), generator=torch.Generator().manual_seed(1)) < share  # of rows without a pair, too
    kept = keep[:count].nonzero()[:, 0]
    rows, pairs, constants, ptr, entry = (
        t.cpu() for t in contact_start.keep(keep.to(device), [t.to(device) for t in listed], False)
    )
    assert len(rows) == len(pairs) == len(constants) == room and len(entry) == 4 * room
    assert torch.equal(rows[: len(kept)], kept) and (rows[len(kept) :] == -1).all()
    assert torch.equal(pairs[: len(kept)], listed[0][kept]) and (pairs[len(kept) :] == -1).all()
    assert torch.equal(constants[: len(kept)], listed[1][kept]) and not constants[len(kept) :].any()
    # the same as a list that has been made of those pairs alone
    points = pairs[: len(kept), :4].flatten().long()
    assert torch.equal(ptr[1:].long(), torch.bincount(points, minlength=corners).cumsum(0)) and ptr[0] == 0
    assert torch.equal(entry[: 4 * len(kept)].long(), torch.sort(points, stable=True).indices)
    assert (entry[4 * len(kept) :] == -1).all()
