"""The held-out protocol."""

from gsplat_core.io.recordings import is_heldout


def test_is_heldout_of_two_published_clips() -> None:
    assert [index for index in range(63) if is_heldout(index)] == [1, 9, 17, 25, 33, 41, 49, 57]
    cutting = [index for index in range(156) if is_heldout(index)]
    assert len(cutting) == 20 and cutting[0] == 1 and cutting[-1] == 153
